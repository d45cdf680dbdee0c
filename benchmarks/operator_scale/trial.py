"""Trial: make the objects, wait, halve them, delete them, and measure meanwhile.

A trial has a separate namespace, which is deleted at the end in any case. Pods are counted by
asking for one of them: the API server adds the number of the others, which costs it next to
nothing.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator

from benchmarks.operator_scale import counters
from benchmarks.operator_scale.cases import FIBER, Case, Subject, is_settled
from benchmarks.operator_scale.installed import MEMORY, PROCESSOR, CannotMeasure, Operator
from benchmarks.operator_scale.results import STEPS, Curve, OperatorUse, Trial
from benchmarks.operator_scale.watched import Watched

from e2e.kube import Kube, path_of

LABEL = "fiber.dev/benchmark"
_PAUSE = 0.1
"""Seconds between two counts of the pods."""
_END_LIMIT = 300.0
_REST = 3.0
"""Seconds after a trial until postponed work is done and memory has settled."""


class TooSlow(Exception):
    """Step that was not done in time; the message says how far it was."""


def run(kube: Kube, operator: Operator, case: Case, subject: Subject, turn: int) -> Trial:
    """Do the trial, and leave nothing behind."""
    with namespace(kube, case.name) as name:
        trial = Trial(subject.name, turn)
        _Attempt(kube, operator, case, subject, name, trial).run()
        return trial


@contextlib.contextmanager
def namespace(kube: Kube, word: str) -> Iterator[str]:
    """Make a namespace with this word in its name, and remove it in the end."""
    metadata = {"generateName": f"fiber-bench-{word}-", "labels": {LABEL: "true"}}
    name = kube.create(path_of("namespaces"), {"metadata": metadata})["metadata"]["name"]
    try:
        _wait(
            "the namespace has an account for its pods",
            lambda: kube.get(path_of("serviceaccounts", name, "default")) is not None,
            60.0,
        )
        yield name
    finally:
        remove_namespaces(kube, name)


def remove_namespaces(kube: Kube, name: str = "") -> None:
    """Delete one namespace, or all that trials ever left, and wait until they are gone.

    By kubectl alone, which needs no process that an interrupt may have ended.
    """
    which = [name] if name else ["--selector", f"{LABEL}=true"]
    kube.kubectl("delete", "namespaces", *which, "--ignore-not-found", "--wait=false")
    _wait(
        f"namespaces are gone ({which[-1]})",
        lambda: not kube.kubectl("get", "namespaces", *which, "--ignore-not-found", "-oname"),
        _END_LIMIT,
        pause=0.5,
    )


def _wait(what: str, done: Callable[[], bool], seconds: float, pause: float = _PAUSE) -> None:
    deadline = time.monotonic() + seconds
    while not done():
        if time.monotonic() > deadline:
            raise TooSlow(f"not so after {seconds:g} s: {what}")
        time.sleep(pause)


class _Attempt:
    """State of one trial."""

    def __init__(
        self,
        kube: Kube,
        operator: Operator,
        case: Case,
        subject: Subject,
        namespace: str,
        trial: Trial,
    ) -> None:
        self._kube = kube
        self._operator = operator
        self._case = case
        self._subject = subject
        self._collection = subject.collection(namespace)
        self._pods_path = path_of("pods", namespace)
        self._trial = trial
        self._names = [f"scale-{index:03}" for index in range(case.objects)]

    def run(self) -> None:
        page, writes = self._operator.page(), self._writes()
        self._start = time.monotonic()
        self._watched = Watched(self._kube, self._collection, self._start)
        try:
            with self._operator.memory(self._start) as memory:
                self._grow()
                settled = self._operator.page()
                self._trial.writes = counters.growth(writes, self._writes())
                self._shrink()
                time.sleep(_REST)
        finally:
            self._watched.close()
        self._trial.ready = self._watched.ready
        self._note_use(page, settled, self._operator.page(), memory)

    def _grow(self) -> None:
        for name in self._names:
            self._kube.create(self._collection, self._subject.manifest(name, self._case.size))
        self._until("settled", self._start, lambda: self._settled(self._case.size))
        self._trial.steps.setdefault("created", self._trial.steps["settled"])

    def _shrink(self) -> None:
        half = self._case.size // 2
        started = time.monotonic()
        for name in self._names:
            self._kube.patch(f"{self._collection}/{name}", {"spec": {"replicas": half}})
        self._until(
            "halved",
            started,
            lambda: self._settled(half) and self._pods == half * self._case.objects,
        )
        started = time.monotonic()
        self._kube.call("DELETE", self._collection, {"propagationPolicy": "Background"})
        self._until("gone", started, lambda: self._pods == 0)

    def _settled(self, size: int) -> bool:
        done = self._watched.count(lambda body: is_settled(body, size))
        return done == self._case.objects

    def _until(self, step: str, started: float, done: Callable[[], bool]) -> None:
        """Wait, and note how long it took; count the pods meanwhile."""
        deadline = started + self._case.limit
        self._pods, due = -1, 0.0
        while True:
            now = time.monotonic()
            if now >= due and not (step == "settled" and "created" in self._trial.steps):
                self._count(step)
                due = time.monotonic() + _PAUSE
            if done():
                self._trial.steps[step] = time.monotonic() - started
                return
            if now > deadline:
                raise TooSlow(self._so_far(step))
            self._watched.wait(until=max(due, now + _PAUSE))

    def _count(self, step: str) -> None:
        page = self._kube.call("GET", self._pods_path, query={"limit": "1"})
        self._pods = len(page["items"]) + int(page["metadata"].get("remainingItemCount") or 0)
        elapsed = time.monotonic() - self._start
        if step == "settled":
            self._trial.created.append([elapsed, self._pods])
            if self._pods >= self._case.pods:
                self._trial.steps["created"] = elapsed

    def _so_far(self, step: str) -> str:
        seen = self._watched.count(lambda body: bool(body.get("status", {}).get("replicas")))
        ready = self._watched.ready[-1][1] if self._watched.ready else 0
        said = (
            f"{self._subject.label}, {self._case.title}: not so after {self._case.limit:g} s: "
            f"{STEPS[step]}. There are {self._pods:,} pods, {ready:,.0f} of them ready"
        )
        if self._subject is FIBER and not seen and not self._pods:
            said += (
                "; the operator does not look at the pool: either it does not watch all "
                "namespaces (scope: cluster), or its log says what hinders it"
            )
        return said

    def _writes(self) -> counters.Counts:
        return counters.server_writes(self._kube.text("/metrics"))

    def _note_use(self, before: str, settled: str, after: str, memory: Curve) -> None:
        if self._operator.born(before) != self._operator.born(after):
            raise CannotMeasure(
                "the operator was restarted during a trial, so that its counters say nothing: "
                "kubectl describe its pod to see why (OOMKilled, a probe that failed), and try "
                "again"
            )
        if self._subject is not FIBER:
            return
        pages = (before, settled, after)
        busy = [counters.value(page, PROCESSOR) for page in pages]
        requests = [counters.operator_requests(page) for page in pages]
        self._trial.operator = OperatorUse(
            memory=memory,
            memory_before=counters.value(before, MEMORY),
            memory_after=counters.value(after, MEMORY),
            seconds_until_settled=busy[1] - busy[0],
            seconds=busy[2] - busy[0],
            requests_until_settled=counters.growth(requests[0], requests[1]),
            requests_after=counters.growth(requests[1], requests[2]),
        )
