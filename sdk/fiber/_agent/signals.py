"""Whether a process is prepared for a signal, as the kernel shows it."""

from __future__ import annotations


def is_expected(pid: int, signum: int) -> bool:
    """Return whether process ``pid`` handles, blocks or ignores ``signum``.

    False for a signal that would only end it, and for a process that cannot be looked at.
    """
    try:
        with open(f"/proc/{pid}/status") as status:
            lines = dict(line.split(":", 1) for line in status)
        masks = [int(lines[name], 16) for name in ("SigCgt", "SigBlk", "SigIgn")]
    except (OSError, KeyError, ValueError):
        return False
    return any(mask >> (signum - 1) & 1 for mask in masks)
