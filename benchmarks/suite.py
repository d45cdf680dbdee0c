"""The measures by name, in the order of the pages."""

from __future__ import annotations

from types import ModuleType

from benchmarks import latency, overhead, pipes, startup, throughput

MEASURES: dict[str, ModuleType] = {
    "overhead": overhead,
    "throughput": throughput,
    "latency": latency,
    "pipes": pipes,
    "startup": startup,
}
