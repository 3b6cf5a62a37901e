"""The inner loops of the filter, compiled: plain functions of numbers and arrays."""
