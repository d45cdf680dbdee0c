"""Check whether a process is prepared for a signal, from the kernel's status file."""

from __future__ import annotations

from fiber._agent.last_words import TELL


def is_expected(pid: int, signum: int) -> bool:
    """Return whether process ``pid`` handles, blocks or ignores ``signum``.

    False if the signal would end the process, if the process cannot be inspected, and for a child
    that still has its zygote's handlers, recognized by TELL, which zygotes ignore.
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
