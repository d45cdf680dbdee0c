"""Who takes part, what each can do, and how it is drawn. Imports none of them."""

from __future__ import annotations

import importlib.util
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field

_POOL = frozenset({"map", "stream", "stream in chunks", "submit", "apply"})
_EXECUTOR = frozenset({"map", "stream", "submit", "apply"})
_PROCESSES = frozenset({"pipes", "sharing", "start", "cold start"})
_AGAINST_BASELINE = frozenset({"placed pipes", "agents", "import"})


@dataclass(frozen=True)
class Contender:
    """A library in one configuration.

    `servers`: it keeps servers that use the processor even when idle, so it is started for its
    turn only, takes part in fewer rounds and gets a tenth of the no-op tasks.
    """

    name: str
    label: str
    modules: tuple[str, ...]
    offers: frozenset[str]
    colour: str
    marker: str
    program: str = ""
    servers: bool = False
    environment: Mapping[str, str] = field(default_factory=dict)

    def missing(self) -> str:
        """What must be installed before it can take part; empty if nothing."""
        wanting = [name for name in self.modules if not _found(name)]
        if self.program and not shutil.which(self.program):
            wanting.append(self.program)
        return ", ".join(wanting)


def _found(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:
        # It would be part of a package that is not there.
        return False


# Colours: Okabe and Ito's set, told apart by colour-blind readers, and Tol's wine.
ALL = (
    Contender(
        "fiber",
        "Fiber",
        ("fiber",),
        _POOL | _PROCESSES | _AGAINST_BASELINE | {"fake workers"},
        "#0072B2",
        "o",
        environment={"FIBER_BACKEND": "local"},
    ),
    Contender(
        "fiber-loopback",
        "Fiber, loopback agents",
        ("fiber",),
        _POOL | _PROCESSES,
        "#56B4E9",
        "s",
        environment={"FIBER_BACKEND": "loopback"},
    ),
    Contender(
        "fiber-executor",
        "fiber.Executor",
        ("fiber",),
        _EXECUTOR,
        "#0072B2",
        "v",
        environment={"FIBER_BACKEND": "local"},
    ),
    Contender(
        "fiber-joblib",
        "joblib on Fiber",
        ("fiber", "joblib"),
        frozenset({"map", "stream", "stream in chunks"}),
        "#009E73",
        "v",
        environment={"FIBER_BACKEND": "local"},
    ),
    Contender(
        "multiprocessing",
        "multiprocessing, fork",
        (),
        _POOL | _PROCESSES | _AGAINST_BASELINE,
        "#000000",
        "D",
    ),
    Contender(
        "forkserver",
        "multiprocessing, forkserver",
        (),
        frozenset({"start", "cold start"}),
        "#666666",
        "d",
    ),
    Contender(
        "concurrent.futures",
        "concurrent.futures",
        (),
        _EXECUTOR,
        "#999999",
        "v",
    ),
    Contender("joblib", "joblib (loky)", ("joblib",), _POOL, "#009E73", "^"),
    Contender(
        "dask",
        "Dask",
        ("distributed", "dask.bag"),
        _EXECUTOR,
        "#E69F00",
        "<",
        servers=True,
    ),
    Contender("ipyparallel", "ipyparallel", ("ipyparallel",), _POOL, "#CC79A7", ">", servers=True),
    Contender("ray", "Ray's Pool", ("ray",), _POOL, "#D55E00", "P", servers=True),
    Contender(
        "spark",
        "PySpark",
        ("pyspark",),
        frozenset({"map", "apply"}),
        "#882255",
        "X",
        program="java",
        servers=True,
    ),
)

ON_PODS = Contender(
    "fiber-kubernetes",
    "Fiber, pods",
    ("fiber", "kubernetes"),
    _POOL | _PROCESSES,
    "#117733",
    "*",
    environment={"FIBER_BACKEND": "kubernetes"},
)
"""Takes part where a cluster is: see kubernetes_run.py."""

BY_NAME = {contender.name: contender for contender in (*ALL, ON_PODS)}
