"""Why a node does not start."""

from __future__ import annotations


class StartError(RuntimeError):
    """A node cannot start; the message says why and what to do."""
