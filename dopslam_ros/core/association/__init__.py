"""Which path belongs to which source: the k best assignments of paths to sources."""
