"""Fiber on pods beside others on processes: `python -m benchmarks.kubernetes_run`.

Pods are made where Fiber's environment says: KUBECONFIG, FIBER_NAMESPACE, and FIBER_IMAGE, which
has numpy. kubernetes_cluster.py prepares all of it.
"""

from __future__ import annotations

import argparse
import shlex
import signal
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from benchmarks import budgets, kubernetes_report, machine, processes, report
from benchmarks.contenders import (
    BY_NAME,
    EXECUTOR,
    EXECUTOR_ON_PODS,
    FIRST_READY,
    ON_PODS,
    RELAYED,
    VECTOR,
    Contender,
)
from benchmarks.model import Run
from benchmarks.rounds import Rounds, say, scratch_folder
from benchmarks.session import ROOT

_OURS = (ON_PODS, RELAYED, EXECUTOR_ON_PODS)
CONTENDERS = (
    *_OURS,
    replace(BY_NAME["fiber"], offers=VECTOR | FIRST_READY),
    replace(BY_NAME["concurrent.futures"], offers=EXECUTOR),
    *(BY_NAME[name] for name in ("multiprocessing", "async-vector-env", "ray", "dask")),
)
_QUICK_SIZE = 0.02


def main(arguments: Sequence[str]) -> int:
    """Return 0 if Fiber got through every case; 1 if not; 130 after Ctrl-C, without a page."""
    options = _parse(arguments)
    skipped = {each.name: missing for each in CONTENDERS if (missing := each.missing())}
    for name, missing in skipped.items():
        say(f"{name} is skipped, not installed: {missing}")
    able = [each for each in CONTENDERS if each.name not in skipped]
    command = shlex.join(["python", "-m", "benchmarks.kubernetes_run", *arguments])
    about = {**machine.about(able, command, options.rounds, options.size), "skipped": skipped}
    new = {name: Run(dict(about)) for name in options.measure}
    try:
        _measure(new, able, options)
    except KeyboardInterrupt:
        return 130
    runs = {**report.load(options.output, kubernetes_report.RESULTS), **new}
    runs = {name: runs[name] for name in kubernetes_report.MEASURES if name in runs}
    kubernetes_report.write(options.output, runs)
    for verdict in budgets.verdicts(runs, budgets.ON_PODS):
        budget = f"{verdict.budget.what}: {verdict.measured}, {verdict.budget.in_words()}"
        say(f"{budget}: {verdict.verdict}")
    say(f"written to {options.output}")
    failed = {name for run in new.values() for those in run.failures.values() for name in those}
    return int(any(each.name in failed | set(skipped) for each in _OURS))


def _measure(runs: dict[str, Run], able: list[Contender], options: argparse.Namespace) -> None:
    processes.adopt_orphans()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with scratch_folder() as scratch:
        rounds = Rounds(scratch, runs)
        try:
            cases = kubernetes_report.cases(options.size)
            mine = [case for case in cases if case.measure in runs]
            rounds.play(mine, able, options.rounds)
        except KeyboardInterrupt:
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            say("interrupted: stopping the contenders; no page is written")
            raise
        finally:
            rounds.abandon()


def _parse(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        "benchmarks.kubernetes_run", description="Measure Fiber on pods beside others on processes."
    )
    parser.add_argument(
        "--measure",
        nargs="+",
        choices=list(kubernetes_report.MEASURES),
        default=list(kubernetes_report.MEASURES),
        metavar="NAME",
        help=f"any of {', '.join(kubernetes_report.MEASURES)}; default: all. The page keeps the "
        "earlier figures of the others, so it must have been written once",
    )
    parser.add_argument("--quick", action="store_true", help="small, once, to build/benchmarks")
    parser.add_argument("--rounds", type=int, help="default 5; 1 with --quick")
    parser.add_argument("--output", type=Path, help="folder to write to, default docs/benchmarks")
    options = parser.parse_args(arguments)
    options.rounds = options.rounds or (1 if options.quick else 5)
    options.size = _QUICK_SIZE if options.quick else 1.0
    options.output = options.output or ROOT / ("build" if options.quick else "docs") / "benchmarks"
    return options


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
