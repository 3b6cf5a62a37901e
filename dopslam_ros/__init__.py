"""Online Doppler SLAM for ROS 2: the EK-PMB filter of Ge et al. and its error bounds."""

import os

__version__ = "0.1.0"

# The matrices here are tiny: threads inside the linear algebra cost more than they bring, and how
# many there are must not change the last bit of a replay. Works only before NumPy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")
