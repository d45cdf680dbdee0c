"""Go-Explore, phase 1: exploration of Montezuma's Revenge in a pool."""

from __future__ import annotations

import bz2
import hashlib

from published.records import Package, Program
from published.runs import Run, RunFailed, Value

# Four iterations with few cells each, and cells that are made from the picture.
OPTIONS = (
    "--game=generic_MontezumaRevenge --seed=1 --pool_class=py --max_iterations=4 --batch_size=8 "
    "--explore_steps=30 --resize_shape=11x8x8 --state_is_pixels --seen_weight=1.0 "
    "--reset_cell_on_update --high_score_weight=0.0 --max_hours=1"
)


def run(run: Run) -> dict[str, Value]:
    """Run its program with one changed line; compare frames and trajectories."""
    run.stand_in("gym")
    copied = run.copy("robustified")
    if run.on_fiber:
        basics = copied / "goexplore_py" / "basics.py"
        run.replace(basics, "import multiprocessing\n", "import fiber as multiprocessing\n")
    run.import_from(copied)
    results = run.folder / "results"
    program = copied / "goexplore_py" / "main.py"
    run.script(program, f"--base_path={results}", *OPTIONS.split(), cwd=copied)
    experiences = [
        path for path in sorted(results.glob("*/*_experience.bz2")) if "thisisfake" not in path.name
    ]
    if not experiences or list(results.glob("*/has_died")):
        raise RunFailed("Go-Explore wrote no experience: its output is above")
    digests = [
        hashlib.sha256(bz2.decompress(path.read_bytes())).hexdigest() for path in experiences
    ]
    return {"frames": [path.name for path in experiences], "trajectories": digests}


PROGRAMS = [
    Program(
        name="go-explore",
        upstream="https://github.com/uber-research/go-explore",
        clone="go-explore",
        way="one changed line",
        ran="phase 1 on Montezuma's Revenge: 4 iterations of 8 cells",
        run=run,
        files=("robustified/goexplore_py/main.py", "robustified/goexplore_py/basics.py"),
        packages=(
            Package("ale_py", "ale-py>=0.10"),
            Package("gymnasium", "gymnasium>=1.0"),
            Package("cv2", "opencv-python-headless>=4.8"),
            Package("loky", "loky>=3.0"),
            Package("matplotlib", "matplotlib>=3.8"),
            Package("psutil", "psutil>=5.9"),
            Package("scipy", "scipy>=1.1"),
        ),
        roms=("montezuma_revenge",),
        stood_in=("gym",),
    )
]
