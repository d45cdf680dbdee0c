"""Origin of a run: where and when it was made, and how busy the machine was meanwhile."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.contenders import Contender
from benchmarks.samples import in_words

_DISTRIBUTIONS = {"fiber": "fiberpool", "dask.bag": "dask", "pufferlib": "pufferlib-core"}
_ALWAYS = ("numpy", "gymnasium")
_MOMENT = 0.2
_IDLE_FIELDS = slice(3, 5)  # of the times in /proc/stat: idle, and idle while a disk works
_COUNTED = slice(0, 8)  # without guests, whose time is in the others already


def in_use() -> float:
    """Return the share of all processors' time that was used in a fifth of a second from now.

    Called when no contender works, it measures all other programs, and the machine's other guests.
    """
    before = Path("/proc/stat").read_text(encoding="ascii")
    time.sleep(_MOMENT)
    return share_in_use(before, Path("/proc/stat").read_text(encoding="ascii"))


def share_in_use(before: str, after: str) -> float:
    """Return the share of the time between two readings of /proc/stat in which processors
    worked."""
    first, second = (
        [int(word) for word in text.splitlines()[0].split()[1:]] for text in (before, after)
    )
    passed = [b - a for a, b in zip(first, second, strict=True)][_COUNTED]
    return 1 - sum(passed[_IDLE_FIELDS]) / sum(passed) if sum(passed) else 0.0


def about(
    contenders: Sequence[Contender], command: str, rounds: int, size: float
) -> dict[str, Any]:
    """Return the facts that stand above every table."""
    names = [name for contender in contenders for name in contender.modules]
    return {
        "date": time.strftime("%Y-%m-%d %H:%M %Z"),
        "command": command,
        "rounds": rounds,
        "size": size,
        "cores": len(os.sched_getaffinity(0)),
        "processor": processor(),
        "memory": in_words(int(_field("/proc/meminfo", "MemTotal").split()[0]) * 1024, "B"),
        "load": round(os.getloadavg()[0], 2),
        "system": f"{platform.system()} {'.'.join(platform.release().split('.')[:2])}",
        "python": platform.python_version(),
        "versions": {name: version for name in (*names, *_ALWAYS) if (version := _version(name))},
    }


def processor() -> str:
    """Return the name of the machine's processors."""
    return _field("/proc/cpuinfo", "model name")


def _version(module: str) -> str:
    name = _DISTRIBUTIONS.get(module, module)
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        # Run from a checkout, or no git: both are recorded elsewhere.
        return ""


def _field(path: str, name: str) -> str:
    for line in Path(path).read_text(encoding="utf-8").splitlines():
        key, _, value = line.partition(":")
        if key.strip() == name:
            return value.strip()
    return "0"
