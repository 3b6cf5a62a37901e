"""The error of an input that is not used."""

from __future__ import annotations


class Refused(ValueError):
    """An input that is not used.

    Attributes:
        reason: a short key to count by.
    """

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason
