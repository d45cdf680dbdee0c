"""Why the cluster does not come up, for a person: what happened, what was said, what to do."""

from __future__ import annotations

import shutil
import signal
from collections.abc import Iterable, Iterator

from cluster import memory, places
from cluster.daemons import Daemon

_LITTLE_MEMORY = 512 << 20
_LITTLE_SPACE = 1 << 30
_AGAIN = (
    "What runs goes on. `make cluster` starts what does not; where that ends too, `make "
    "cluster-down` and then `make cluster` begin afresh."
)
_NEEDED = "the cluster takes a gigabyte of memory, with its images a few gigabytes of disk"


def end_of(daemons: Iterable[Daemon]) -> str | None:
    """Return the diagnosis of the first of these that has ended; None while all run."""
    return next((_end(daemon) for daemon in daemons if not daemon.runs()), None)


def _end(daemon: Daemon) -> str:
    said = [f"{daemon.name} has ended: {_manner(daemon)}", daemon.last_words()]
    return "\n".join([*said, *_shortages(), _AGAIN])


def ends_meanwhile(daemons: Iterable[Daemon]) -> str:
    """Return the last words of those that ended by themselves and were started again."""
    return "\n\n".join(f"{daemon.name}:\n{end}" for daemon in daemons for end in daemon.ends())


def silence_of(daemons: Iterable[Daemon], answer: str) -> str:
    """Return the diagnosis if these run and the awaited condition does not come.

    The answer is what was said last to who asked.
    """
    said = [f"the last answer: {answer.strip() or 'none'}"]
    said += [f"{daemon.name} runs; {daemon.last_words()}" for daemon in daemons]
    return "\n".join([*said, *_shortages(), _AGAIN])


def _manner(daemon: Daemon) -> str:
    status = daemon.status()
    if status is None:
        return "nobody saw how, since what watched over it has ended too"
    if status <= 128:
        return f"exit status {status}"
    number = status - 128
    manner = f"signal {number} ({signal.strsignal(number) or 'unknown'})"
    if number == signal.SIGKILL and (kills := daemon.killed_meanwhile()):
        manner += (
            f"; since it began, the kernel has killed {kills} of the machine's processes for want "
            f"of memory, this one probably among them: {_NEEDED}"
        )
    return manner


def _shortages() -> Iterator[str]:
    if (left := memory.available()) < _LITTLE_MEMORY:
        yield f"the machine has {left >> 20} MiB of memory left: {_NEEDED}"
    if (left := _free_space()) < _LITTLE_SPACE:
        yield f"{places.STATE} has {left >> 20} MiB of disk left: {_NEEDED}"


def _free_space() -> int:
    return shutil.disk_usage(places.STATE).free
