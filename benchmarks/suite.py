"""The measures by name, in the order of the pages."""

from __future__ import annotations

from types import ModuleType

from benchmarks import (
    agents,
    coldstart,
    latency,
    overhead,
    pipes,
    sharing,
    startup,
    throughput,
    workers,
)

MEASURES: dict[str, ModuleType] = {
    "overhead": overhead,
    "throughput": throughput,
    "latency": latency,
    "pipes": pipes,
    "sharing": sharing,
    "startup": startup,
    "coldstart": coldstart,
    "workers": workers,
    "agents": agents,
}
