"""Parameters, each declared once: name, default, unit, range and text."""
