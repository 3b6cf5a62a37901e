"""Scenes and what is heard in them."""
