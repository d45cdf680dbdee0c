"""Command line: choose, run in turns, report."""

from __future__ import annotations

import argparse
import contextlib
import http.client
import shlex
import signal
import subprocess
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from benchmarks import machine
from benchmarks.operator_scale import preparation, report, results, trial
from benchmarks.operator_scale.cases import (
    BY_DEFAULT,
    CASES,
    SUBJECTS,
    WARM_UP,
    Case,
    Subject,
    in_turn,
)
from benchmarks.operator_scale.installed import (
    CannotMeasure,
    Operator,
    check_nodes,
    find_operator,
    server_version,
)
from benchmarks.operator_scale.results import Result, Trial
from benchmarks.rounds import say
from benchmarks.samples import in_words
from benchmarks.session import ROOT

from cluster.shell import ClusterError
from e2e.kube import Failed, Kube, Refused

_TROUBLE = (
    CannotMeasure,
    trial.TooSlow,
    ClusterError,
    Failed,
    Refused,
    OSError,
    http.client.HTTPException,
    subprocess.TimeoutExpired,
    AssertionError,  # the operator that was set up did not get ready; the message has its log
)
_PODS_OF_A_NODE = 500


def main(arguments: Sequence[str]) -> int:
    """Return 0 if all was measured, 1 if an obstacle stopped it, 130 after Ctrl-C."""
    options = _parse(arguments)
    return guarded(lambda stack: _run(stack, options, " " + shlex.join(arguments)))


def guarded(measure: Callable[[contextlib.ExitStack], Callable[[], None]]) -> int:
    """Measure, remove the objects that were made, and then do what `measure` returned: write the
    results."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _interrupt)
    try:
        with contextlib.ExitStack() as stack:
            write = measure(stack)
    except KeyboardInterrupt:
        say("everything is removed; no page is written")
        return 130
    except _TROUBLE as error:
        say(f"not measured: {error}")
        return 1
    write()
    return 0


def _run(
    stack: contextlib.ExitStack, options: argparse.Namespace, arguments: str
) -> Callable[[], None]:
    largest = max(case.pods for case in options.cases)
    kube, operator, about = prepared(stack, largest, options.set_up, arguments)
    found = _play(kube, operator, options, about)
    return lambda: _write(options.output, found)


def _write(output: Path, found: dict[str, Result]) -> None:
    known = {**results.load(output / report.RESULTS), **found}
    report.write(output, known)
    for line in report.budgets(known):
        say(f"{line.what}: {line.measured}, {line.bound}: {line.verdict}")
    say(f"written to {output}")


def prepared(
    stack: contextlib.ExitStack, pods: int, set_up: bool, arguments: str
) -> tuple[Kube, Operator, dict[str, Any]]:
    """Return a cluster that has room for so many pods, its operator, and facts about its
    machine."""
    kubeconfig = (
        stack.enter_context(preparation.own_cluster(-(-pods // _PODS_OF_A_NODE)))
        if set_up
        else preparation.kubeconfig()
    )
    kube = stack.enter_context(open_api(kubeconfig))
    if set_up:
        stack.enter_context(preparation.operator(kube))
    operator, nodes = find_operator(kube), check_nodes(kube, pods)
    trial.remove_namespaces(kube)  # of a run that was killed
    # Once more at the end, because the removal of a trial's objects can be interrupted.
    stack.callback(trial.remove_namespaces, kube)
    return kube, operator, _about(kube, operator, nodes, arguments)


def _play(
    kube: Kube, operator: Operator, options: argparse.Namespace, about: dict[str, Any]
) -> dict[str, Result]:
    found = {}
    for subject in SUBJECTS:
        say(f"{WARM_UP.title}, {subject.label}")
        trial.run(kube, operator, WARM_UP, subject, 0)
    for case in options.cases:
        rounds = options.rounds or case.rounds
        result = found[case.name] = Result({**about, "rounds": rounds})
        for turn in range(rounds):
            for subject in in_turn(turn):
                say(f"round {turn + 1}/{rounds}: {case.title}, {subject.label}")
                result.trials.append(_visit(kube, operator, case, subject, turn))
    slow = [case for case in options.cases if case.by_default]
    if slow and options.set_up:  # a cluster of other people is not started again for this
        with preparation.default_rate():
            trial.run(kube, operator, WARM_UP, BY_DEFAULT, 0)
            for case in slow:
                say(f"{case.title}, {BY_DEFAULT.label} calls a second")
                found[case.name].trials.append(_visit(kube, operator, case, BY_DEFAULT, 0))
    return found


def _visit(kube: Kube, operator: Operator, case: Case, subject: Subject, turn: int) -> Trial:
    done = trial.run(kube, operator, case, subject, turn)
    steps = ", ".join(f"{step} {in_words(done.steps[step], 's')}" for step in results.STEPS)
    used = done.operator
    say(f"  {steps}" + (f"; operator {in_words(used.peak, 'B')}" if used else ""))
    return done


@contextlib.contextmanager
def open_api(kubeconfig: Path) -> Iterator[Kube]:
    """Client of the cluster's API, also while a Ctrl-C is answered."""
    # Its processes must outlive a Ctrl-C, which a terminal sends to all of the group: they remove
    # the objects.
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        kube = Kube(kubeconfig)
    finally:
        signal.signal(signal.SIGINT, handler)
    try:
        kube.call("GET", "/version")
    except (Refused, OSError, ValueError) as error:
        kube.close()
        raise CannotMeasure(
            f"the cluster of {kubeconfig} does not answer ({error}): start it, or name another "
            "with KUBECONFIG"
        ) from error
    try:
        yield kube
    finally:
        kube.close()


def _interrupt(*_: object) -> None:
    # A second one must not stop the removal.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    say("interrupted: removing what was made, which takes up to a minute or two")
    raise KeyboardInterrupt


def _about(kube: Kube, operator: Operator, nodes: int, arguments: str) -> dict[str, Any]:
    command = f"python -m benchmarks.operator_scale{arguments}".strip()
    about = machine.about((), command, 0, 1.0)
    wanted = ("date", "command", "cores", "processor", "memory", "load", "system", "python")
    return {
        **{name: about[name] for name in wanted},
        "kubernetes": server_version(kube),
        "operator": operator.image,
        "nodes": nodes,
    }


def _parse(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        "benchmarks.operator_scale",
        description="Measure FiberPools beside ReplicaSets at thousands of pretended pods.",
    )
    parser.add_argument(
        "--cases",
        type=_cases,
        default=list(CASES.values()),
        metavar="A,B",
        help=f"any of {','.join(CASES)}; default: all",
    )
    parser.add_argument("--rounds", type=_count, help="of each case; default: the case's")
    parser.add_argument(
        "--set-up",
        action="store_true",
        help="bring up the cluster of tests/cluster, pretended nodes and the operator where they "
        "are missing, and remove at the end what was made",
    )
    parser.add_argument("--output", type=Path, default=ROOT / "docs" / "benchmarks")
    return parser.parse_args(arguments)


def _cases(text: str) -> list[Case]:
    for name in (chosen := text.split(",")):
        if name not in CASES:
            raise argparse.ArgumentTypeError(f"no case {name!r}; there are {', '.join(CASES)}")
    return [case for name, case in CASES.items() if name in chosen]


def _count(text: str) -> int:
    if (count := int(text)) < 1:
        raise argparse.ArgumentTypeError(f"{count} is less than 1")
    return count
