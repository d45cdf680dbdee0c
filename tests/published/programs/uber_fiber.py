"""The original Fiber: its examples and the notebook of its tutorial at GECCO 2020."""

from __future__ import annotations

import json
import re
from pathlib import Path

from published.records import Package, Program
from published.runs import Run, RunFailed, Value

EXAMPLES = ("basic_queue", "line_count", "parzen_estimation", "shared_data")
NOTEBOOK = "examples/gecco-2020/Fiber_ES_tutorial.ipynb"
ASYNC = "examples/async_manager.py"
SOLUTION = (5.0, -5.0, 1.5)


def examples(run: Run) -> dict[str, Value]:
    """Run the examples that print the same in each run; compare what they print."""
    folder = run.copy("examples")
    return {name: _lines(run, folder / f"{name}.py") for name in EXAMPLES}


def async_manager(run: Run) -> dict[str, Value]:
    """Step CartPoles by managers, one after the other and side by side; it ends in time."""
    run.stand_in("gym")
    if not run.on_fiber:  # multiprocessing has no AsyncManager
        return {"measured": ["Sync manager", "Async manager"]}
    program = run.copy("examples") / "async_manager.py"
    run.replace(program, "STEPS = 5000\n", "STEPS = 200\n")
    return {"measured": re.findall(r"^(\w+ manager) took", run.script(program), re.MULTILINE)}


def notebook(run: Run) -> dict[str, Value]:
    """Run the notebook's cells in a program without a file; its strategy finds the solution.

    The workers draw numbers that nobody seeds, so each run prints other numbers.
    """
    cells = json.loads((run.clone / NOTEBOOK).read_text(encoding="utf-8"))["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    kernel = run.folder / "kernel.py"
    kernel.write_text(KERNEL.format(cells=[cell for cell in code if not cell.startswith("!")]))
    found = re.search(r"Result \[(.*?)\]", run.script(kernel), re.DOTALL)
    if found is None:
        raise RunFailed("the notebook printed no result: its output is above")
    near = (abs(float(x) - y) < 1 for x, y in zip(found[1].split(), SOLUTION, strict=True))
    return {"near the solution": list(near)}


# A notebook's cells are run in a kernel, which shows its output as messages.
KERNEL = """
import sys
from jupyter_client.manager import start_new_kernel

manager, client = start_new_kernel()
try:
    for cell in {cells!r}:
        reply = client.execute_interactive(cell, timeout=500)
        if reply["content"]["status"] != "ok":
            sys.exit("a cell failed: " + reply["content"]["evalue"])
finally:
    client.stop_channels()
    manager.shutdown_kernel()
"""


def _lines(run: Run, program: Path) -> list[str]:
    printed = run.script(program, cwd=program.parent)
    return re.sub(r"\bat 0x[0-9a-f]+", "at an address", printed).splitlines()


UPSTREAM = "https://github.com/uber/fiber"
NUMPY = Package("numpy", "numpy>=1.26")
PROGRAMS = [
    Program(
        name="uber-fiber-examples",
        upstream=UPSTREAM,
        clone="fiber",
        way="it imports fiber",
        ran=f"{len(EXAMPLES)} examples whose output can be repeated",
        run=examples,
        files=tuple(f"examples/{name}.py" for name in EXAMPLES),
        packages=(NUMPY,),
    ),
    Program(
        name="uber-fiber-managers",
        upstream=UPSTREAM,
        clone="fiber",
        way="it imports fiber",
        ran="`async_manager.py`; the line makes its steps fewer",
        run=async_manager,
        files=(ASYNC,),
        packages=(NUMPY, Package("gymnasium", "gymnasium>=1.0")),
        stood_in=("gym",),
    ),
    Program(
        name="uber-fiber-gecco",
        upstream=UPSTREAM,
        clone="fiber",
        way="it imports fiber",
        ran="the GECCO 2020 notebook in a kernel; it finds its solution",
        run=notebook,
        files=(NOTEBOOK,),
        packages=(
            NUMPY,
            Package("ipykernel", "ipykernel>=6.29"),
            Package("jupyter_client", "jupyter-client>=8.6"),
        ),
    ),
]
