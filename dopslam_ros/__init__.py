"""Online Doppler SLAM for ROS 2: the EK-PMB filter of Ge et al. and its error bounds."""

__version__ = "0.1.0"
