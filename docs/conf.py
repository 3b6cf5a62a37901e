"""Settings of Sphinx; `make docs` builds into docs/_build, and every warning is an error."""

import sys
from importlib.util import find_spec
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "extensions"))

project = "dopslam_ros"
author = "dopslam maintainers"
copyright = author
extensions = ["node_reference"]
exclude_patterns = ["_build"]
nitpicky = True
# Clearer where it is installed; Sphinx's own otherwise.
html_theme = "furo" if find_spec("furo") else "alabaster"
html_static_path = ["static"]
html_css_files = ["tables.css"]
html_show_sourcelink = False
