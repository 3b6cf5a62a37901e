"""Arrays, small matrices and compiled code."""
