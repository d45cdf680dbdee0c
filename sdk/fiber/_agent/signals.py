"""Whether a process is prepared for a signal, as the kernel shows it."""

from __future__ import annotations

from fiber._agent.last_words import TELL


def is_expected(pid: int, signum: int) -> bool:
    """Return whether process ``pid`` handles, blocks or ignores ``signum``.

    False for a signal that would only end it, for a process that cannot be looked at, and for a
    child that still has what its zygote handles, blocks and ignores: TELL is ignored there.
    """
    try:
        with open(f"/proc/{pid}/status") as status:
            lines = dict(line.split(":", 1) for line in status)
        caught, blocked, ignored = (int(lines[name], 16) for name in ("SigCgt", "SigBlk", "SigIgn"))
    except (OSError, KeyError, ValueError):
        return False
    if ignored >> (TELL - 1) & 1:
        return False
    return bool((caught | blocked | ignored) >> (signum - 1) & 1)
