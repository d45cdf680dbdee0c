"""Where and when a run was made."""

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

_DISTRIBUTIONS = {"fiber": "fiberpool", "dask.bag": "dask"}
_ALWAYS = ("numpy", "gymnasium")


def about(
    contenders: Sequence[Contender], command: str, rounds: int, size: float
) -> dict[str, Any]:
    """What stands above every table."""
    names = [name for contender in contenders for name in contender.modules]
    return {
        "date": time.strftime("%Y-%m-%d %H:%M %Z"),
        "command": command,
        "rounds": rounds,
        "size": size,
        "cores": len(os.sched_getaffinity(0)),
        "processor": _field("/proc/cpuinfo", "model name"),
        "memory": in_words(int(_field("/proc/meminfo", "MemTotal").split()[0]) * 1024, "B"),
        "load": round(os.getloadavg()[0], 2),
        "system": f"{platform.system()} {'.'.join(platform.release().split('.')[:2])}",
        "python": platform.python_version(),
        "versions": {name: version for name in (*names, *_ALWAYS) if (version := _version(name))},
    }


def _version(module: str) -> str:
    name = _DISTRIBUTIONS.get(module, module)
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        # Run from a checkout, or absent: either is said elsewhere.
        return ""


def _field(path: str, name: str) -> str:
    for line in Path(path).read_text(encoding="utf-8").splitlines():
        key, _, value = line.partition(":")
        if key.strip() == name:
            return value.strip()
    return "0"
