"""Runs as pages for the browser: one run with its map over time, several runs beside each other."""
