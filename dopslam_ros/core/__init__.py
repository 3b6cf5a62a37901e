"""The estimation core. Nothing in here knows about ROS, files or time: arrays in, arrays out."""
