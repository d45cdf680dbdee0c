"""DEAP: its example of a genetic algorithm whose evaluations run in a pool."""

from __future__ import annotations

from published.records import Package, Program
from published.runs import Run, Value


def run(run: Run) -> dict[str, Value]:
    """Run the example with one changed line; compare the statistics of all generations."""
    run.import_from()
    program = run.copy("examples/ga") / "onemax_mp.py"
    if run.on_fiber:
        run.replace(program, "import multiprocessing\n", "import fiber as multiprocessing\n")
    return {"statistics": run.script(program).splitlines()}


PROGRAMS = [
    Program(
        name="DEAP",
        upstream="https://github.com/DEAP/deap",
        clone="deap",
        way="one changed line",
        ran="its example `onemax_mp.py`, whole: 40 generations of 300",
        run=run,
        files=("examples/ga/onemax_mp.py", "deap/base.py"),
        packages=(Package("numpy", "numpy>=1.26"),),
    )
]
