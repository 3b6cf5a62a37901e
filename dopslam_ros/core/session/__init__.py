"""Inputs over time: their order, what is remembered between them, and the events."""
