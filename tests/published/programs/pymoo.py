"""pymoo: NSGA-II, whose evaluations go to a pool by StarmapParallelization."""

from __future__ import annotations

import importlib
from typing import Any

from published.records import Package, Program
from published.runs import Run, Value

GENERATIONS, POPULATION = 10, 40


def problem(runner: Any) -> Any:
    """Return pymoo's ZDT1, evaluated one solution at a time by the runner."""
    core = importlib.import_module("pymoo.core.problem")
    zdt1 = importlib.import_module("pymoo.problems.multi.zdt").ZDT1
    return core.ElementwiseProblem, zdt1, runner


def run(run: Run) -> dict[str, Value]:
    """Optimize with a pool; compare solutions and objectives of the last generation."""
    run.import_from()
    welded_beam = importlib.import_module("pymoo.problems.single.pressure_vessel").PressureVessel
    starmap = importlib.import_module("pymoo.parallelization").StarmapParallelization
    algorithm = importlib.import_module("pymoo.algorithms.moo.nsga2").NSGA2
    minimize = importlib.import_module("pymoo.optimize").minimize
    with run.multiprocessing.Pool(2) as pool:
        problem = welded_beam(elementwise_runner=starmap(pool.starmap))
        result = minimize(
            problem, algorithm(pop_size=POPULATION), ("n_gen", GENERATIONS), seed=1
        )
    return {
        "solutions": result.pop.get("X").tolist(),
        "objectives": result.pop.get("F").tolist(),
        "constraints": result.pop.get("G").tolist(),
    }


PROGRAMS = [
    Program(
        name="pymoo",
        upstream="https://github.com/anyoptimization/pymoo",
        clone="pymoo",
        way="`StarmapParallelization(pool.starmap)`",
        ran=f"NSGA-II, {GENERATIONS} generations of {POPULATION}",
        run=run,
        files=("pymoo/parallelization/starmap.py",),
        packages=(Package("numpy", "numpy>=1.26"), Package("moocore", "moocore>=0.1")),
    )
]
