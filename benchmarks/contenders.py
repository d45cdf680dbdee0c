"""Contenders: their names, abilities and style in pictures. Imports none of their libraries."""

from __future__ import annotations

import importlib.util
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field

_POOL = frozenset({"map", "stream", "stream in chunks", "submit", "apply"})
_CLIENT = frozenset({"map", "stream", "submit", "apply"})
EXECUTOR = frozenset({"executor", "executor in chunks"})
_PARALLEL = frozenset({"parallel"})
_PROCESSES = frozenset({"pipes", "sharing", "start", "cold start", "endings", "large messages"})
_GUARDED = frozenset({"guarded endings"})
VECTOR = frozenset({"vector steps", "cart poles"})
FIRST_READY = frozenset({"first ready"})
_WITH_JAX = frozenset({"start with jax"})
EVOLUTION = frozenset({"evolution"})
PPO = frozenset({"ppo"})
_AGAINST_BASELINE = frozenset({"placed pipes", "agents", "import"})


@dataclass(frozen=True)
class Contender:
    """Library in one configuration.

    `servers`: it keeps servers that use the processor even when idle. So it is started for its turn
    only, takes part in fewer rounds and gets a tenth of the no-op tasks. `by_name`: packages that
    it imports and does not use here. If one is not installed, a stand-in that has every name takes
    its place.
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
    by_name: tuple[str, ...] = ()

    def needs_stand_in(self) -> bool:
        """Tell whether a package is missing that the contender only imports."""
        return not all(_found(name) for name in self.by_name)

    def missing(self) -> str:
        """Return what must be installed before the contender can take part; empty if nothing."""
        wanting = [name for name in self.modules if not _found(name)]
        if self.program and not shutil.which(self.program):
            wanting.append(self.program)
        return ", ".join(wanting)


def _found(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:
        # The package that would contain it is missing.
        return False


# Colours: Okabe and Ito's set, which colour-blind readers can tell apart, and some of Tol's.
ALL = (
    Contender(
        "fiber",
        "Fiber",
        ("fiber",),
        _POOL
        | _PROCESSES
        | _GUARDED
        | _WITH_JAX
        | _AGAINST_BASELINE
        | VECTOR
        | FIRST_READY
        | EVOLUTION
        | PPO
        | {"fake workers"},
        "#0072B2",
        "o",
        environment={"FIBER_BACKEND": "local"},
    ),
    Contender(
        "fiber-loopback",
        "Fiber, loopback agents",
        ("fiber",),
        _POOL | _PROCESSES | _GUARDED | _WITH_JAX | VECTOR | FIRST_READY | PPO,
        "#56B4E9",
        "s",
        environment={"FIBER_BACKEND": "loopback"},
    ),
    Contender(
        "fiber-watched",
        "Fiber, everything shown",
        ("fiber",),
        _POOL,
        "#0072B2",
        "p",
        environment={
            "FIBER_BACKEND": "local",
            "FIBER_DASHBOARD": "1",
            "FIBER_LOG_RECORDS": "INFO",
            "FIBER_LOG_TO": "logs",
            "FIBER_METRICS_PORT": "0",
            "FIBER_PROGRESS": "always",
            "FIBER_TIMELINE": "timeline.json",
        },
    ),
    Contender(
        "fiber-executor",
        "fiber.Executor",
        ("fiber",),
        EXECUTOR | {"apply"},
        "#0072B2",
        "v",
        environment={"FIBER_BACKEND": "local"},
    ),
    Contender(
        "fiber-executor-loopback",
        "fiber.Executor, loopback agents",
        ("fiber",),
        EXECUTOR,
        "#56B4E9",
        "v",
        environment={"FIBER_BACKEND": "loopback"},
    ),
    Contender(
        "fiber-joblib",
        "joblib on Fiber",
        ("fiber", "joblib"),
        _PARALLEL,
        "#0072B2",
        "^",
        environment={"FIBER_BACKEND": "local"},
    ),
    Contender(
        "multiprocessing",
        "multiprocessing, fork",
        (),
        _POOL | _PROCESSES | _AGAINST_BASELINE | EVOLUTION,
        "#000000",
        "D",
    ),
    Contender(
        "forkserver",
        "multiprocessing, forkserver",
        (),
        frozenset({"start", "cold start"}) | _WITH_JAX,
        "#666666",
        "d",
    ),
    Contender("spawn", "multiprocessing, spawn", (), _WITH_JAX, "#aaaaaa", "X"),
    Contender(
        "concurrent.futures",
        "concurrent.futures",
        (),
        _CLIENT | EXECUTOR,
        "#999999",
        "v",
    ),
    Contender("loky", "loky", ("joblib",), EXECUTOR, "#009E73", "v"),
    Contender("joblib", "joblib (loky)", ("joblib",), _POOL | _PARALLEL, "#009E73", "^"),
    Contender(
        "joblib-dask",
        "joblib on Dask",
        ("joblib", "distributed"),
        _PARALLEL,
        "#E69F00",
        "^",
        servers=True,
    ),
    Contender(
        "dask",
        "Dask",
        ("distributed", "dask.bag"),
        _CLIENT | EVOLUTION | {"executor"},
        "#E69F00",
        "<",
        servers=True,
    ),
    Contender(
        "ipyparallel",
        "ipyparallel",
        ("ipyparallel",),
        _POOL | EVOLUTION,
        "#CC79A7",
        ">",
        servers=True,
    ),
    Contender(
        "ray", "Ray's Pool", ("ray",), _POOL | EXECUTOR | EVOLUTION, "#D55E00", "P", servers=True
    ),
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
    Contender("async-vector-env", "AsyncVectorEnv", ("gymnasium",), VECTOR, "#000000", "D"),
    Contender("sync-vector-env", "SyncVectorEnv", ("gymnasium",), VECTOR, "#999999", "p"),
    Contender(
        "stable-baselines3",
        "SubprocVecEnv",
        ("stable_baselines3",),
        VECTOR | PPO,
        "#999933",
        "H",
        by_name=("torch",),
    ),
    Contender(
        "pufferlib",
        "PufferLib",
        ("pufferlib",),
        VECTOR | FIRST_READY,
        "#CC79A7",
        "h",
        by_name=("torch",),
    ),
    Contender(
        "ray-actors",
        "Ray actors",
        ("ray",),
        VECTOR | FIRST_READY,
        "#D55E00",
        "X",
        servers=True,
    ),
    Contender("envpool", "EnvPool", ("envpool",), frozenset({"cart poles"}), "#882255", "*"),
)

ON_PODS = Contender(
    "fiber-kubernetes",
    "Fiber, pods",
    ("fiber", "kubernetes"),
    _POOL | _PROCESSES | VECTOR | FIRST_READY | EVOLUTION | PPO,
    "#117733",
    "*",
    environment={"FIBER_BACKEND": "kubernetes"},
)
RELAYED = Contender(
    "fiber-relay",
    "Fiber, pods, relay",
    ("fiber", "kubernetes"),
    _POOL | VECTOR,
    "#44AA99",
    "*",
    environment={"FIBER_BACKEND": "kubernetes", "FIBER_RELAY": "always"},
)
EXECUTOR_ON_PODS = Contender(
    "fiber-executor-kubernetes",
    "fiber.Executor, pods",
    ("fiber", "kubernetes"),
    EXECUTOR,
    "#117733",
    "v",
    environment={"FIBER_BACKEND": "kubernetes"},
)
"""Contenders that take part where a cluster is: see kubernetes_run.py."""

ON_HOSTS = Contender(
    "fiber-hosts",
    "Fiber, 8 workers a host",
    ("fiber",),
    EVOLUTION,
    "#332288",
    "d",
    environment={"FIBER_BACKEND": "local"},
)
ADOPTED = Contender(
    "fiber-adopted",
    "SubprocVecEnv, adopted",
    ("fiber", "stable_baselines3"),
    PPO,
    "#009E73",
    "s",
    environment={"FIBER_BACKEND": "local"},
    by_name=("torch",),
)
"""Contenders of the paper's experiments: see the package `paper`."""

BY_NAME = {
    contender.name: contender
    for contender in (*ALL, ON_PODS, RELAYED, EXECUTOR_ON_PODS, ON_HOSTS, ADOPTED)
}
