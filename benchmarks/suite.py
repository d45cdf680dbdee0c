"""Measures by name, in the order of the pages."""

from __future__ import annotations

from types import ModuleType

from benchmarks import (
    agents,
    coldstart,
    endings,
    executors,
    jax_start,
    large_messages,
    latency,
    overhead,
    parallel_loops,
    pipes,
    sharing,
    startup,
    throughput,
    vector,
    workers,
)

MEASURES: dict[str, ModuleType] = {
    "overhead": overhead,
    "throughput": throughput,
    "latency": latency,
    "executors": executors,
    "parallel_loops": parallel_loops,
    "pipes": pipes,
    "large_messages": large_messages,
    "vector": vector,
    "sharing": sharing,
    "startup": startup,
    "coldstart": coldstart,
    "jax_start": jax_start,
    "workers": workers,
    "agents": agents,
    "endings": endings,
}
