"""The command ``dopslam``."""
