"""``python -m dopslam_ros.cli`` is the command ``dopslam``."""

import sys

from dopslam_ros.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
