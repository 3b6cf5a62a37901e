"""Benchmarks of everything that takes time or memory, each beside something to hold it against."""
