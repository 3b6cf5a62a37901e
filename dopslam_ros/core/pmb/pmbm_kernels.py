"""The pieces of the step for a mixture, whose hypotheses exchange a word between them."""

from __future__ import annotations

from dopslam_ros.core.linalg.jit import from_python
from dopslam_ros.core.pmb import step_kernels as step

rank = from_python(step.rank)
name = from_python(step.name)
