"""Following objects: what is there, what changes, and every way in which a watch ends."""

from __future__ import annotations

import queue
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

from fakes.kubernetes_api import Call, Fault
from fiber._backends.kubernetes import informer
from fiber._backends.kubernetes.informer import Informer
from fiber_api.rest import PODS
from patience import PATIENCE
from unit.kubernetes_rig import NAMESPACE, Rig
from unit.kubernetes_rig import rig as make_rig


class Case:
    """A watch on the pods with the label app=x, and what it tells: ``+a``, ``-a``."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.server = rig.server
        self.told: queue.Queue[str] = queue.Queue()
        self.troubles: queue.Queue[Exception] = queue.Queue()
        self.faults: queue.Queue[Exception] = queue.Queue()
        self.follow()

    def follow(self, known: Iterable[str] = ()) -> None:
        self.watch = Informer(
            self.rig.api,
            PODS.path(NAMESPACE),
            {"labelSelector": "app=x"},
            known=known,
            on_change=lambda name, found: self.told.put(f"{'-' if found is None else '+'}{name}"),
            on_trouble=self.troubles.put,
            on_fault=self.faults.put,
        )

    def add(self, name: str) -> None:
        body = {"metadata": {"name": name, "labels": {"app": "x"}}, "spec": {}}
        self.server.do(self.server.store.create, "pods", NAMESPACE, body)

    def remove(self, name: str) -> None:
        self.rig.remove("pods", name)

    def next(self, number: int = 1) -> list[str]:
        return [self.told.get(timeout=PATIENCE) for _ in range(number)]

    def end(self) -> None:
        self.watch.stop()
        self.watch.join(PATIENCE)


@pytest.fixture
def case(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Case]:
    with make_rig(tmp_path, monkeypatch) as rig:
        case = Case(rig)
        yield case
        case.end()


def test_an_informer_reports_objects_and_their_changes(case: Case) -> None:
    case.add("a")
    case.watch.start()
    assert case.next() == ["+a"]
    case.add("b")
    assert case.next() == ["+b"]
    case.remove("a")
    assert case.next() == ["-a"]


def test_objects_gone_before_the_first_list_are_reported(case: Case) -> None:
    case.follow(known={"a", "b"})
    case.add("b")
    case.watch.start()
    assert case.next(2) == ["-a", "+b"]


@pytest.mark.parametrize("how", ["cut off", "refused once", "listed too late"])
def test_no_change_is_lost_when_a_watch_ends(case: Case, how: str) -> None:
    case.add("a")
    case.add("b")
    case.watch.start()
    assert case.next(2) == ["+a", "+b"]

    def change_meanwhile() -> None:
        if how == "refused once":
            case.server.api.faults.append(Fault("watch", "pods", status=503))
        case.server.store.remove("pods", NAMESPACE, "a")
        case.server.api.drop_watches()
        if how == "listed too late":
            case.server.store.forget_history()

    case.server.do(change_meanwhile)
    case.add("c")
    told: list[str] = []
    while told[-1:] != ["+c"]:
        told += case.next()
    assert "-a" in told
    assert "-b" not in told


def test_an_informer_continues_an_ended_watch_without_a_list(case: Case) -> None:
    case.add("a")
    case.watch.start()
    case.next()
    case.server.do(case.server.api.drop_watches)
    case.add("b")
    assert case.next() == ["+b"]
    assert case.server.api.count("list", "pods") == 1


def test_a_lasting_error_is_reported_until_it_passes(case: Case) -> None:
    case.server.api.faults.append(Fault("list", "pods", status=403, message="no right", times=2))
    case.watch.start()
    assert [str(case.troubles.get(timeout=PATIENCE)) for _ in range(2)] == ["no right"] * 2
    case.add("a")
    assert case.next() == ["+a"]


def test_a_single_broken_connection_is_not_reported(case: Case) -> None:
    case.watch.start()
    for name in ("a", "b"):
        case.add(name)
        assert case.next() == [f"+{name}"]
        case.server.do(case.server.api.drop_watches)
    case.add("c")
    assert case.next() == ["+c"]
    assert case.troubles.empty()


def test_a_lasting_outage_of_the_api_is_reported(case: Case) -> None:
    case.watch.start()
    case.add("a")
    case.next()
    case.server.api.faults.append(Fault("watch", "pods", status=503, message="down", times=2))
    case.server.do(case.server.api.drop_watches)
    case.add("b")
    assert case.next() == ["+b"]
    assert str(case.troubles.get_nowait()) == "down"


def test_an_api_that_ends_every_watch_at_once_is_not_flooded(
    case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    pauses: queue.Queue[float] = queue.Queue()

    def wait(seconds: float) -> bool:
        pauses.put(seconds)
        if pauses.qsize() < 4:
            return False
        case.watch._stopped.set()
        return True

    monkeypatch.setattr(informer, "_EARLY", float("inf"))
    monkeypatch.setattr(case.watch._stopped, "wait", wait)
    case.server.api.faults.append(Fault("watch", "pods", text="", times=99))
    case.watch.start()
    case.watch.join(PATIENCE)
    drawn = [pauses.get_nowait() for _ in range(4)]
    assert drawn[0] <= informer._PAUSE_MIN
    assert drawn[-1] >= 4 * informer._PAUSE_MIN


def test_a_retry_after_is_respected(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    pauses: queue.Queue[float] = queue.Queue()

    def wait(seconds: float) -> bool:
        pauses.put(seconds)
        case.watch._stopped.set()
        return True

    monkeypatch.setattr(case.watch._stopped, "wait", wait)
    case.server.api.faults.append(Fault("list", "pods", status=429, retry_after=20))
    case.watch.start()
    case.watch.join(PATIENCE)
    assert pauses.get_nowait() == 20


def test_an_event_that_no_api_server_sends_is_a_fault_and_not_a_silence(case: Case) -> None:
    case.server.api.faults.append(
        Fault("watch", "pods", text='{"type": "ADDED", "object": {"metadata": {}}}\n')
    )
    case.watch.start()
    assert isinstance(case.faults.get(timeout=PATIENCE), KeyError)


def test_an_informer_that_was_never_started_can_be_stopped(case: Case) -> None:
    case.end()
    assert case.told.empty()


def test_a_long_list_comes_in_pages_with_the_changes_meanwhile(case: Case) -> None:
    pods = [f"pod-{number:03}" for number in range(2 * informer._PAGE + 1)]
    for name in pods:
        case.add(name)
    api, store = case.server.api, case.server.store

    def change(call: Call) -> None:
        if call.verb == "list" and api.count("list", "pods") == 2:
            store.merge("pods", NAMESPACE, pods[0], {"spec": {"nodeName": "node-1"}})

    api.after = change
    case.watch.start()
    assert case.next(len(pods) + 1) == [*(f"+{name}" for name in pods), f"+{pods[0]}"]
    assert api.count("list", "pods") == 3
