"""`python -m benchmarks.operator_scale.floods`: one namespace floods the operator, another waits.

In the healthy namespace a FiberPool is scaled between one pod and two. The delay until its status
says so is measured without a flood, and beside each flood of another namespace.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import shlex
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median
from typing import Any, TypeAlias

from benchmarks.operator_scale import command, trial
from benchmarks.operator_scale.cases import FIBER, Body, is_settled, pod_template
from benchmarks.operator_scale.installed import Operator
from benchmarks.operator_scale.results import MEGA
from benchmarks.operator_scale.watched import Watched
from benchmarks.report import table
from benchmarks.rounds import say
from benchmarks.samples import in_words, times
from benchmarks.session import ROOT

from e2e.kube import Kube, Refused, path_of

Change: TypeAlias = Callable[[int], Body]

CHANGES = 20
_LIMIT = 120.0
"""Seconds that one change of the healthy pool may take."""
_SETTLE = 5.0
"""Seconds between the making of a flood's objects and the first change."""
MOST_MEMORY = 200 * MEGA
RESULTS, PAGE = "operator-floods.json", "operator-floods.md"


@dataclass(frozen=True)
class Flood:
    """Flood: pools that fill a namespace, and what is written there again and again."""

    title: str
    write: Callable[[Kube, str, int], object] | None = None
    """Function that is called with the namespace and a number that grows."""
    pools: Sequence[Body] = ()


@dataclass
class Measured:
    """Effect of one flood."""

    delays: list[float] = field(default_factory=list)
    changes: int = 0
    """Changes that the flood made meanwhile."""
    seconds: float = 0.0
    memory: float = 0.0
    """The operator's resident memory at its peak, in bytes."""


def _pool(name: str, **spec: Any) -> Body:
    manifest = FIBER.manifest(name, 1)
    manifest["spec"] = {**manifest["spec"], "replicas": 0, **spec}
    return manifest


def _large(name: str) -> Body:
    template = pod_template()
    # One character of four bytes: Python then keeps four bytes for each character of the text.
    template["metadata"]["annotations"] = {"filler": "\N{GRINNING FACE}" + "x" * 1_300_000}
    return _pool(name, suspend=True, template=template)


def _manifold(name: str) -> Body:
    """Return a pool whose values take 25 times the memory of their JSON."""
    template = pod_template()
    template["spec"]["unknown"] = [{}] * 430_000
    return _pool(name, suspend=True, template=template)


def _broken(name: str) -> Body:
    template = pod_template()
    template["spec"]["containers"][0]["volumeMounts"] = [{"name": "lacking", "mountPath": "/data"}]
    return _pool(name, replicas=10, maxReplicas=10, template=template)


def _filled(title: str, make: Callable[[str], Body], pools: int, change: Change) -> Flood:
    """Return a flood of so many pools, which are changed in turn."""

    def write(kube: Kube, namespace: str, number: int) -> None:
        kube.patch(f"{FIBER.collection(namespace)}/flood-{number % pools:03}", change(number))

    return Flood(title, write, [make(f"flood-{number:03}") for number in range(pools)])


def _annotated(number: int) -> Body:
    return {"metadata": {"annotations": {"changed": str(number)}}}


def _scaled(number: int) -> Body:
    return {"spec": {"maxReplicas": 10 + number % 100}}


def _complain(kube: Kube, namespace: str, number: int) -> None:
    event = {
        "metadata": {"generateName": "flood-"},
        "involvedObject": {
            "apiVersion": "v1",
            "kind": "Pod",
            "namespace": namespace,
            "name": f"flood-{number % 100:03}",
        },
        "type": "Warning",
        "reason": "Failed",
        "message": "x" * 1000,
    }
    kube.create(path_of("events", namespace), event)


FLOODS = {
    "none": Flood("no flood"),
    "large": _filled("40 pools of 1.3 MB", _large, 40, _annotated),
    "manifold": _filled("12 pools of 430,000 values", _manifold, 12, _annotated),
    "changed": _filled("200 pools whose spec changes", _pool, 200, _scaled),
    "broken": _filled("100 pools whose template is refused", _broken, 100, _scaled),
    "events": Flood("Warning events of pods", _complain),
}


def measure(kube: Kube, operator: Operator, name: str) -> Measured:
    """Flood one namespace, and time the changes of a pool in another."""
    flood, found = FLOODS[name], Measured()
    with trial.namespace(kube, f"{name}-healthy") as healthy, contextlib.ExitStack() as stack:
        kube.create(FIBER.collection(healthy), FIBER.manifest("healthy", 2))
        watched = Watched(kube, FIBER.collection(healthy), time.monotonic())
        stack.callback(watched.close)
        _settle(watched, 2)
        flooded = stack.enter_context(trial.namespace(kube, name))
        memory = stack.enter_context(operator.memory(time.monotonic()))
        for pool in flood.pools:
            kube.create(FIBER.collection(flooded), pool)
        time.sleep(_SETTLE)
        began = time.monotonic()
        with _repeating(kube, flooded, flood) as count:
            for number in range(CHANGES):
                found.delays.append(_delay(kube, healthy, watched, 1 + number % 2))
        found.changes, found.seconds = next(count), time.monotonic() - began
        found.memory = max((size for _, size in memory), default=0.0)
    return found


def _delay(kube: Kube, namespace: str, watched: Watched, replicas: int) -> float:
    began = time.monotonic()
    path = f"{FIBER.collection(namespace)}/healthy"
    kube.patch(path, {"spec": {"replicas": replicas}})
    _settle(watched, replicas)
    return time.monotonic() - began


def _settle(watched: Watched, replicas: int) -> None:
    deadline = time.monotonic() + _LIMIT
    while not watched.count(lambda body: is_settled(body, replicas)):
        if time.monotonic() > deadline:
            raise trial.TooSlow(f"the healthy pool has not {replicas} pods after {_LIMIT:g} s")
        watched.wait(until=deadline)


@contextlib.contextmanager
def _repeating(kube: Kube, namespace: str, flood: Flood) -> Iterator[Iterator[int]]:
    """Change the flood's objects one after the other; the next number is how often it was done."""
    numbers, ended = itertools.count(), threading.Event()

    def run() -> None:
        while flood.write is not None and not ended.is_set():
            with contextlib.suppress(Refused):  # a conflict, or the API server defends itself
                flood.write(kube, namespace, next(numbers))

    thread = threading.Thread(target=run, name="flood", daemon=True)
    thread.start()
    try:
        yield numbers
    finally:
        ended.set()
        thread.join()


def page(about: dict[str, Any], found: dict[str, Measured]) -> str:
    """Return the page of these results."""
    usual = median(found["none"].delays)
    rows = [
        (
            FLOODS[name].title,
            f"{measured.changes / measured.seconds:,.0f}",
            in_words(median(measured.delays), "s"),
            in_words(max(measured.delays), "s"),
            times(median(measured.delays) / usual),
            in_words(measured.memory, "B"),
        )
        for name, measured in found.items()
    ]
    parts = [
        "<!-- Written by benchmarks/operator_scale/floods.py; changes by hand are lost. -->",
        "# The operator under floods",
        _ABOUT,
        table(("flood", "writes a second", "delay", "longest", "ratio", "memory, peak"), rows),
        f"Budget: less than {in_words(MOST_MEMORY, 'B')} of memory with {FLOODS['large'].title}: "
        + ("met." if found["large"].memory < MOST_MEMORY else "missed."),
        "## Made on",
        table(("", ""), [(name, str(value)) for name, value in about.items()]),
    ]
    return "\n\n".join(parts) + "\n"


_ABOUT = (
    "One namespace is flooded. In another one a FiberPool is scaled between one pod and two, "
    f"{CHANGES} times for each flood. The delay is the time until its status says that its pods "
    "are ready. The flood writes to its objects one after the other, as fast as the API server "
    "answers. Memory is the resident memory of the operator, looked at twice a second. The pods "
    "are on nodes that only pretend to run them (KWOK). All else is real and shares the "
    "processors of one machine, so a flood also slows the API server. `make bench-operator` "
    "writes this page."
)


def main(arguments: Sequence[str]) -> int:
    """Return 0 if all was measured, 1 if an obstacle stopped it, 130 after Ctrl-C."""
    parser = argparse.ArgumentParser(
        "benchmarks.operator_scale.floods",
        description="Measure how long one namespace waits while another floods the operator.",
    )
    parser.add_argument("--set-up", action="store_true", help="as for benchmarks.operator_scale")
    parser.add_argument("--output", type=Path, default=ROOT / "docs" / "benchmarks")
    options = parser.parse_args(arguments)
    return command.guarded(lambda stack: _run(stack, options, shlex.join(arguments)))


def _run(
    stack: contextlib.ExitStack, options: argparse.Namespace, arguments: str
) -> Callable[[], None]:
    kube, operator, about = command.prepared(stack, 500, options.set_up, f".floods {arguments}")
    found = {}
    for name, flood in FLOODS.items():
        say(flood.title)
        found[name] = measured = measure(kube, operator, name)
        delay = in_words(median(measured.delays), "s")
        say(f"  delay {delay}; operator {in_words(measured.memory, 'B')}")
    return lambda: _write(options.output, about, found)


def _write(output: Path, about: dict[str, Any], found: dict[str, Measured]) -> None:
    results = {"about": about, "floods": {name: asdict(each) for name, each in found.items()}}
    (output / RESULTS).write_text(json.dumps(results) + "\n", encoding="utf-8")
    (output / PAGE).write_text(page(about, found), encoding="utf-8")
    say(f"written to {output / PAGE}")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
