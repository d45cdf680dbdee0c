"""Start on pods: until a pool's first result, without pods and with running pods."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from benchmarks import peers
from benchmarks.model import Case, Metric
from benchmarks.tasks import no_op

if TYPE_CHECKING:
    from benchmarks.contender import Bench

TITLE = "Start"
WORKERS = 8
ABOUT = f"""\
A pool of {WORKERS} workers, from the call that makes it until a first map of as many no-ops is
complete. Cold: in a program that has done nothing before. This includes the start of Ray's and
Dask's clusters, and for pods all work of Kubernetes until they run, with the image on the nodes.
Warm: a second pool of the same program, after the first was closed."""

TIME = Metric("time", "first results", "s")
COLD, WARM = "cold", "warm"


def cases(size: float) -> list[Case]:
    """Return the same at every size: one pool cannot be made smaller."""
    return [
        Case(
            measure="kubernetes_start",
            name=name,
            group="start",
            needs=needs,
            params={"warm": name == WARM},
            metrics=(TIME,),
            fresh=True,
            limit=120.0,
        )
        for name, needs in ((COLD, "map"), (WARM, "start"))
    ]


def run(bench: Bench, warm: bool) -> dict[str, float]:
    """Return seconds to the first results of the first pool, or of the second."""
    first = _time_of_one(bench.contender)
    return {TIME.name: _time_of_one(bench.contender) if warm else first}


def _time_of_one(contender: str) -> float:
    begin = time.perf_counter()
    pool = peers.start(contender, WORKERS, lazily=True)
    try:
        pool.map(no_op, range(WORKERS), 1)
        return time.perf_counter() - begin
    finally:
        pool.close()
