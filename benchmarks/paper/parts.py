"""Parts of the paper's experiments: which cases each has, and which contenders take part."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace

from benchmarks import overhead
from benchmarks.contenders import ADOPTED, ALL, ON_HOSTS, ON_PODS, Contender
from benchmarks.model import Case
from benchmarks.paper import breakout, evolution, packages, recording

SHORTEST = 0.001


@dataclass(frozen=True)
class Part:
    """Figure of the paper. `check` raises if something is missing that all contenders need."""

    name: str
    measure: str
    cases: Callable[[float], list[Case]]
    contenders: tuple[Contender, ...]
    check: Callable[[], object] = lambda: None


def _overhead(size: float) -> list[Case]:
    """Return the cases of the paper's figure: tasks of 1 s to 1 ms, handed out one by one.

    Their limit is that of a busy machine: a peer's first case includes the start of its servers.
    """
    return [
        replace(case, limit=300.0)
        for case in overhead.cases(size)
        if case.params["chunksize"] == 1 and case.params["duration"] >= SHORTEST
    ]


def _check_evolution() -> None:
    recording.read(recording.WALKER)


def _check_breakout() -> None:
    recording.read(recording.BREAKOUT)
    packages.breakout().close()


def _that_offer(needs: str, *others: Contender) -> tuple[Contender, ...]:
    return tuple(each for each in (*ALL, *others) if needs in each.offers)


_IN_THE_FIGURE = (
    "fiber",
    "fiber-loopback",
    "multiprocessing",
    "dask",
    "ipyparallel",
    "ray",
    "spark",
)

PARTS = {
    part.name: part
    for part in (
        Part(
            "overhead",
            "overhead",
            _overhead,
            tuple(each for each in ALL if each.name in _IN_THE_FIGURE),
        ),
        Part(
            "evolution",
            "paper.evolution",
            evolution.cases,
            _that_offer("evolution", ON_HOSTS),
            _check_evolution,
        ),
        Part(
            "breakout",
            "paper.breakout",
            breakout.cases,
            _that_offer("ppo", ADOPTED),
            _check_breakout,
        ),
    )
}


def contenders_of(part: Part, chosen: list[str] | None) -> list[Contender]:
    """Return the contenders of a part: those chosen, or all but pods."""
    if chosen is None:
        return list(part.contenders)
    return [each for each in (*part.contenders, ON_PODS) if each.name in chosen]


def has_cluster() -> bool:
    """Tell whether the environment names a cluster and an image for pods."""
    return all(os.environ.get(name) for name in ("KUBECONFIG", "FIBER_IMAGE"))
