"""The error of being asked for what cannot be done."""

from __future__ import annotations


class UsageError(ValueError):
    """The command line asks for something that cannot be done; the message says what."""
