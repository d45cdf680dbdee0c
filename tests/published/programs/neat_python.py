"""neat-python: its ParallelEvaluator, by its example of results that can be repeated."""

from __future__ import annotations

from published.records import Program, Version
from published.runs import Run, Value


def run(run: Run) -> dict[str, Value]:
    """Run the example with one changed line in `neat/parallel.py`; compare all that it prints."""
    copied = run.copy()
    if run.on_fiber:
        imports = "from multiprocessing import Pool\n"
        run.replace(copied / "neat" / "parallel.py", imports, "from fiber import Pool\n")
    run.import_from(copied)
    example = copied / "examples" / "parallel-reproducible" / "evolve-parallel.py"
    return {"printed": run.script(example).splitlines()}


PROGRAMS = [
    Program(
        name="neat-python",
        upstream="https://github.com/CodeReclaimers/neat-python",
        clone="neat-python",
        way="one changed line",
        ran="its example `parallel-reproducible`, whole",
        run=run,
        files=("neat/parallel.py", "examples/parallel-reproducible/evolve-parallel.py"),
        version=Version("neat/__init__.py", ">=2.0"),
    )
]
