"""First steps of a program's first process or pool, before the rest of Fiber is imported."""

from __future__ import annotations

import contextlib
import resource
import sys

from fiber import config
from fiber._agent import zygote_process

_FEW_DESCRIPTORS = 64
"""A limit below which what cannot be opened is to be said by who needs it."""

_LOCAL = ("local", "auto")
"""Backends whose children are this process's own, or may be."""


def start_zygote() -> None:
    """Have the zygote start and import while this process does."""
    if "fiber._runtime.state" in sys.modules or config.current().backend not in _LOCAL:
        return
    if resource.getrlimit(resource.RLIMIT_NOFILE)[0] < _FEW_DESCRIPTORS:
        return
    with contextlib.suppress(OSError):  # whoever needs it will try again, and say what is wrong
        zygote_process.start_early()
