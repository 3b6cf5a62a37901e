"""Filtering a bag without middleware, and judging what came out."""
