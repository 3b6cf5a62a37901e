"""The pieces of the step for a mixture, whose hypotheses exchange a word between them."""

from __future__ import annotations

from dopslam_ros.core.linalg.jit import from_python
from dopslam_ros.core.pmb import step_kernels

associate_paths = from_python(step_kernels.associate_paths)
by_landmark_id = from_python(step_kernels.by_landmark_id)
