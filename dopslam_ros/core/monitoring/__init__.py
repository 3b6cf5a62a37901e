"""Whether the filter still knows where it is, and how it finds out again."""
