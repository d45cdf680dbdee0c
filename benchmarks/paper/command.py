"""Command line of the paper's experiments: choose, check, run, draw, fill the page."""

from __future__ import annotations

import argparse
import json
import os
import shlex
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks import machine, processes
from benchmarks.command import count_of, share_of
from benchmarks.contenders import BY_NAME, Contender
from benchmarks.model import Case, Run
from benchmarks.paper import packages, page, pictures
from benchmarks.paper.packages import Missing
from benchmarks.paper.parts import PARTS, Part, contenders_of, has_cluster
from benchmarks.paper.recording import BadRecording
from benchmarks.paper.walker import minutes_of
from benchmarks.rounds import Rounds, say, scratch_folder
from benchmarks.session import ROOT

_ROUNDS = 3
_QUICK_SIZE = 0.005
_MINUTES = 15.0
_WALKER = "walker"
_PODS = "fiber-kubernetes"


def main(arguments: Sequence[str]) -> int:
    """Return 0 if all parts ran; 1 if one failed or something is missing; 130 after Ctrl-C."""
    options = _parse(arguments)
    parts = [PARTS[name] for name in options.only if name != _WALKER]
    if problems := _problems(parts, options):
        for each in problems:
            say(each)
        return 1
    runs = page.load(options.output)
    command = shlex.join(["python", "-m", "benchmarks.paper", *arguments])
    processes.adopt_orphans()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        for part in parts:
            runs[part.name] = _measure(part, options, command)
            _write(options.output, runs)
        walked = _WALKER not in options.only or _walk(options)
    except KeyboardInterrupt:
        say("interrupted: the part that was being measured is not written")
        return 130
    if _WALKER in options.only:
        _write(options.output, runs)
    new = [runs[part.name] for part in parts]
    failed = {name for run in new for those in run.failures.values() for name in those}
    return int(not walked or any(name.startswith("fiber") for name in failed))


def _problems(parts: Sequence[Part], options: argparse.Namespace) -> list[str]:
    """Return a line for each thing that is missing, before anything is measured."""
    found = []
    checks = [part.check for part in parts]
    if _WALKER in options.only:
        checks.append(lambda: packages.walker(packages.WALKER).close())
    for check in checks:
        try:
            check()
        except (Missing, BadRecording) as error:
            found.append(str(error))
    if _PODS in (options.contenders or []) and not has_cluster():
        found.append(
            f'{_PODS} needs a cluster: set KUBECONFIG and FIBER_IMAGE, or run eval "$(make -s '
            'cluster)" first'
        )
    return [*found, *_nothing_to_measure(parts, options)]


def _nothing_to_measure(parts: Sequence[Part], options: argparse.Namespace) -> list[str]:
    """Return a line for each part of which the options choose nothing."""
    found = []
    for part in parts:
        if not contenders_of(part, options.contenders):
            wanted = ", ".join(options.contenders)
            there = ", ".join(each.name for each in part.contenders)
            found.append(f"part {part.name} has no contender {wanted}; it has {there}")
        cases = part.cases(options.size)
        if not _chosen(cases, options.workers):
            wanted = ", ".join(map(str, options.workers))
            there = ", ".join(dict.fromkeys(str(case.params["workers"]) for case in cases))
            found.append(f"part {part.name} has no case with {wanted} workers; it has {there}")
    return found


def _measure(part: Part, options: argparse.Namespace, command: str) -> Run:
    able, skipped = _able(contenders_of(part, options.contenders))
    about = machine.about(able, command, options.rounds, options.size)
    run = Run({**about, "skipped": skipped})
    with scratch_folder() as scratch:
        rounds = Rounds(scratch, {part.measure: run})
        try:
            rounds.play(_chosen(part.cases(options.size), options.workers), able, options.rounds)
        finally:
            rounds.abandon()
    run.about["load after"] = round(os.getloadavg()[0], 2)
    return run


def _chosen(cases: Sequence[Case], workers: list[int] | None) -> list[Case]:
    """Return the cases with these numbers of workers, and those whose number is not varied."""
    return [
        case for case in cases if workers is None or case.params.get("workers") in (None, *workers)
    ]


def _able(contenders: Sequence[Contender]) -> tuple[list[Contender], dict[str, str]]:
    skipped = {each.name: missing for each in contenders if (missing := each.missing())}
    for name, missing in skipped.items():
        say(f"{name} is skipped: {missing} is not installed; make paper installs what it needs")
    return [each for each in contenders if each.name not in skipped], skipped


def _walk(options: argparse.Namespace) -> bool:
    """Train the walker in its own process, since Fiber must not share one with the contenders.

    Return False if it failed.
    """
    minutes = 0.0 if options.quick else options.minutes
    command = [sys.executable, "-m", "benchmarks.paper.walker", "--minutes", str(minutes)]
    status = subprocess.call([*command, "--output", str(options.output)], cwd=ROOT)
    if status:
        say(f"the walker failed with status {status}: its output is above")
    return status == 0


def _write(folder: Path, runs: dict[str, Run]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    data = {name: runs[name].as_json() for name in PARTS if name in runs}
    text = json.dumps(data, separators=(",", ":")) + "\n"
    (folder / page.RESULTS).write_text(text, encoding="utf-8")
    if folder != page.FOLDER / page.PODS:  # the page has tables of pods, and no pictures
        pictures.draw(runs, folder)
    say(f"written to {page.write(folder, runs)}")


def _parse(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        "benchmarks.paper", description="Make the figures of the paper, with the peers beside them."
    )
    every = [*PARTS, _WALKER]
    parser.add_argument("--only", nargs="+", choices=every, default=every, help="default: all")
    parser.add_argument(
        "--contenders",
        type=_names,
        metavar="A,B",
        help="default: all that a part has, but fiber-kubernetes",
    )
    parser.add_argument(
        "--workers", type=_numbers, metavar="N,M", help="default: all numbers that a part has"
    )
    parser.add_argument("--rounds", type=count_of, help=f"default {_ROUNDS}; 1 with --quick")
    parser.add_argument("--size", type=share_of, help="share of the full amount of work, default 1")
    parser.add_argument(
        "--minutes", type=minutes_of, default=_MINUTES, help="training of the walker, default 15"
    )
    parser.add_argument(
        "--quick", action="store_true", help="one tiny round, written to build/paper, as a trial"
    )
    parser.add_argument("--output", type=Path, help="folder to write to, default docs/paper")
    options = parser.parse_args(arguments)
    options.rounds = options.rounds or (1 if options.quick else _ROUNDS)
    options.size = options.size or (_QUICK_SIZE if options.quick else 1.0)
    options.output = options.output or (ROOT / "build" / "paper" if options.quick else page.FOLDER)
    options.output = options.output.resolve()
    return options


def _names(text: str) -> list[str]:
    names = text.split(",")
    known = {each.name for part in PARTS.values() for each in part.contenders} | {_PODS}
    for name in names:
        if name not in known:
            there = ", ".join(each for each in BY_NAME if each in known)
            raise argparse.ArgumentTypeError(f"no contender {name!r}; there are {there}")
    return names


def _numbers(text: str) -> list[int]:
    return [count_of(each) for each in text.split(",")]
