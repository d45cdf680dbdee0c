"""POET, which imports fiber itself: a growing population of terrains and walkers."""

from __future__ import annotations

import csv
import re
from pathlib import Path

from published.records import Package, Program
from published.runs import Run, Value

NUMBER = re.compile(r"-?[0-9.]+(e[+-][0-9]+)?")
# Few short episodes; every environment reproduces, and every child is admitted.
OPTIONS = (
    "--init=random --master_seed=111 --num_workers=2 --n_iterations=2 --batch_size=1 "
    "--batches_per_chunk=2 --eval_batch_size=1 --eval_batches_per_step=1 --max_num_envs=3 "
    "--steps_before_transfer=1 --adjust_interval=1 --repro_threshold=-1000 --mc_lower=-1000 "
    "--mc_upper=1000 --normalize_grads_by_noise_std --propose_with_adam "
    "--returns_normalization=centered_ranks --envs stump pit roughness"
)


def run(run: Run) -> dict[str, Value]:
    """Run its program; compare the logs of all walkers, without the values of the clock."""
    run.stand_in("gym")
    copied = run.copy()
    noise = copied / "poet_distributed" / "noise.py"
    run.replace(noise, "debug = False\n", "debug = True\n")
    # Two functions of the published commit fail at the first reproduction: one is called without
    # its bounds, the other with no score, as long as no terrain is archived.
    strategy = copied / "poet_distributed" / "es.py"
    whole = "def cap_score(score, lower=lower_bound, upper=upper_bound):\n"
    run.replace(strategy, "def cap_score(score, lower, upper):\n", whole)
    algorithm = copied / "poet_distributed" / "poet_algo.py"
    run.replace(algorithm, "if score < self", "if score is None or score < self")
    logs = run.folder / "poet"
    logs.mkdir()
    run.script(copied / "master.py", str(logs), *OPTIONS.split(), cwd=copied)
    # Names of terrains are drawn anew in each run, so the logs are sorted by what they say.
    return {"walkers": sorted(_numbers(path) for path in logs.glob("poet.*.log"))}


def _numbers(log: Path) -> list[str]:
    """Return all numbers of a log but those of the clock, with their names."""
    terrain = "_" + log.name.removeprefix("poet.").removesuffix(".log")
    with log.open(newline="") as lines:
        return [
            f"{name.removesuffix(terrain)}={value}"
            for row in csv.DictReader(lines)
            for name, value in row.items()
            if NUMBER.fullmatch(value) and not name.startswith("time_elapsed")
        ]


PROGRAMS = [
    Program(
        name="poet",
        upstream="https://github.com/uber-research/poet",
        clone="poet",
        way="it imports fiber",
        ran="2 iterations, 2 terrains; a line makes its noise table small, two mend calls",
        run=run,
        files=("master.py", "poet_distributed/poet_algo.py"),
        packages=(
            Package("Box2D", "box2d>=2.3.10"),
            Package("gymnasium", "gymnasium>=1.0"),
            Package("neat.six_util", "neat-python==0.92"),
        ),
        stood_in=("gym",),
    )
]
