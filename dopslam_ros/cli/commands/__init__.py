"""The commands of ``dopslam``, a module each: what it is for, an example, its options, its work.

What the work needs is imported when it begins: help and a shell that completes are not to wait for
compilers, plotting libraries and ROS.
"""
