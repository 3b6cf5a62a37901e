"""The pieces of the step for a mixture, whose hypotheses exchange a word between them."""

from __future__ import annotations

from dopslam_ros.core.pmb import step_kernels as step
from dopslam_ros.core.linalg.jit import exposed

rank = exposed(step.rank)
name = exposed(step.name)
