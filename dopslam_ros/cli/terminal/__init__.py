"""A run in a terminal: what is said, as tables that are drawn anew."""
