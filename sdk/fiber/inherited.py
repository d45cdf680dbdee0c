"""The configuration that a process has from the one that started it, until somebody asks for it.

Most children never do, and what reads configurations takes longer to import than they take to
start.
"""

from __future__ import annotations

_configuration: bytes | None = None


def keep(pickled: bytes) -> None:
    """Keep the pickled ``Config`` of the parent, in a child."""
    global _configuration
    _configuration = pickled


def configuration() -> bytes | None:
    """Return the pickled ``Config`` of the parent; None in a program."""
    return _configuration
