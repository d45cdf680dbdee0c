"""pymoo: NSGA-II, whose evaluations go to a pool by StarmapParallelization."""

from __future__ import annotations

import importlib
from typing import Any

from published.records import Package, Program
from published.runs import Run, Value

GENERATIONS, POPULATION, VARIABLES = 10, 40, 6


def distance(x: Any) -> float:
    """Return the first objective of a solution: its distance from the origin."""
    return float((x * x).sum())


def roughness(x: Any) -> float:
    """Return the second objective: distance from (2, …, 2), and a cost of two unequal variables."""
    return float(((x - 2) ** 2).sum() + abs(x[0] - x[1]))


def run(run: Run) -> dict[str, Value]:
    """Optimize with a pool; compare solutions and objectives of the last generation."""
    run.import_from()
    functional = importlib.import_module("pymoo.problems.functional").FunctionalProblem
    starmap = importlib.import_module("pymoo.parallelization").StarmapParallelization
    algorithm = importlib.import_module("pymoo.algorithms.moo.nsga2").NSGA2
    minimize = importlib.import_module("pymoo.optimize").minimize
    with run.multiprocessing.Pool(2) as pool:
        problem = functional(
            VARIABLES,
            [distance, roughness],
            xl=-5,
            xu=5,
            elementwise_runner=starmap(pool.starmap),
        )
        result = minimize(problem, algorithm(pop_size=POPULATION), ("n_gen", GENERATIONS), seed=1)
    return {
        "solutions": result.pop.get("X").tolist(),
        "objectives": result.pop.get("F").tolist(),
    }


OTHERS = (
    Package("scipy", "scipy>=1.1"),
    Package("autograd", "autograd>=1.4"),
    Package("cma", "cma>=3.4"),
    Package("matplotlib", "matplotlib>=3.8"),
    Package("alive_progress", "alive-progress>=3.0"),
    Package("deprecated", "Deprecated>=1.2"),
)

PROGRAMS = [
    Program(
        name="pymoo",
        upstream="https://github.com/anyoptimization/pymoo",
        clone="pymoo",
        way="`StarmapParallelization(pool.starmap)`",
        ran=f"NSGA-II, {GENERATIONS} generations of {POPULATION}",
        run=run,
        files=("pymoo/parallelization/starmap.py",),
        packages=(Package("numpy", "numpy>=1.26"), Package("moocore", "moocore>=0.3.1"), *OTHERS),
    )
]
