"""Command line: choose, run, report."""

from __future__ import annotations

import argparse
import shlex
import signal
from collections.abc import Sequence
from pathlib import Path

from benchmarks import budgets, machine, processes, report
from benchmarks.contenders import ALL, BY_NAME, Contender
from benchmarks.model import Run
from benchmarks.rounds import Rounds, say, scratch_folder
from benchmarks.session import ROOT
from benchmarks.suite import MEASURES

_ROUNDS = 5
_QUICK_SIZE = 0.02


def main(arguments: Sequence[str]) -> int:
    """Return 0 if Fiber, where it took part, got through every case; 1 if not; 130 after Ctrl-C."""
    options = _parse(arguments)
    contenders = [BY_NAME[name] for name in options.contenders]
    able, skipped = _able(contenders)
    command = shlex.join(["python", "benchmarks/run.py", *arguments])
    about = {**machine.about(able, command, options.rounds, options.size), "skipped": skipped}
    runs = {name: Run(dict(about)) for name in options.measure}
    cases = [case for name in options.measure for case in MEASURES[name].cases(options.size)]
    for name in {case.baseline for case in cases} - {each.name for each in able}:
        say(f"without {name} the pages have no ratios to it")
    processes.adopt_orphans()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with scratch_folder() as scratch:
        rounds = Rounds(scratch, runs)
        try:
            rounds.play(cases, able, options.rounds)
        except KeyboardInterrupt:
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            say("interrupted: stopping the contenders; no page is written")
            return 130
        finally:
            rounds.abandon()
    known = {**report.load(options.output), **runs}
    report.write(options.output, known, runs)
    _conclude(options.output, runs)
    failed = {
        name
        for run in runs.values()
        for by_contender in run.failures.values()
        for name in by_contender
    }
    return 1 if any(name.startswith("fiber") for name in failed) else 0


def _parse(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        "run.py", description="Measure Fiber beside multiprocessing and its peers."
    )
    parser.add_argument(
        "--measure",
        nargs="+",
        choices=list(MEASURES),
        default=list(MEASURES),
        metavar="NAME",
        help=f"any of {', '.join(MEASURES)}; default: all",
    )
    parser.add_argument(
        "--contenders",
        type=_names,
        default=[each.name for each in ALL],
        metavar="A,B",
        help=f"any of {','.join(BY_NAME)}; default: all that are installed",
    )
    parser.add_argument("--rounds", type=count_of, help=f"default {_ROUNDS}; 1 with --quick")
    parser.add_argument("--size", type=share_of, help="share of the full amount of work, default 1")
    parser.add_argument(
        "--quick",
        action="store_true",
        help=f"one round at size {_QUICK_SIZE}, written to build/benchmarks, as a trial",
    )
    parser.add_argument("--output", type=Path, help="folder to write to, default docs/benchmarks")
    options = parser.parse_args(arguments)
    options.rounds = options.rounds or (1 if options.quick else _ROUNDS)
    options.size = options.size or (_QUICK_SIZE if options.quick else 1.0)
    options.output = options.output or ROOT / ("build" if options.quick else "docs") / "benchmarks"
    return options


def _names(text: str) -> list[str]:
    names = text.split(",")
    for name in names:
        if name not in BY_NAME:
            raise argparse.ArgumentTypeError(
                f"no contender {name!r}; there are {', '.join(BY_NAME)}"
            )
    return names


def count_of(text: str) -> int:
    """Return the number of an option, which is at least 1."""
    if (count := int(text)) < 1:
        raise argparse.ArgumentTypeError(f"{count} is less than 1")
    return count


def share_of(text: str) -> float:
    """Return the share of an option, which is above 0 and up to 1."""
    if not 0 < (share := float(text)) <= 1:
        raise argparse.ArgumentTypeError(f"{share:g} is not above 0 and up to 1")
    return share


def _able(contenders: Sequence[Contender]) -> tuple[list[Contender], dict[str, str]]:
    skipped = {each.name: missing for each in contenders if (missing := each.missing())}
    for name, missing in skipped.items():
        say(f"{name} is skipped, not installed: {missing} (pip install 'fiberpool[bench]')")
    return [each for each in contenders if each.name not in skipped], skipped


def _conclude(folder: Path, runs: dict[str, Run]) -> None:
    for verdict in budgets.verdicts(runs):
        if verdict.kept is not None:
            budget = f"{verdict.budget.what}: {verdict.measured}, {verdict.budget.in_words()}"
            say(f"{budget}: {verdict.verdict}")
    say(f"written to {folder}")
