"""The ROS 2 nodes: convert, call the core, publish. No mathematics in here."""
