"""Pods as hosts, without a cluster: what becomes of who waits, and how it ends."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from fiber._agent.interface import Cause, ChildSpec, ExitReport
from fiber._backends.agent_set import AgentSet
from fiber._backends.kubernetes import provisioner, waiting
from fiber._backends.kubernetes.backend import Pods
from fiber._backends.kubernetes.provisioner import PreparedPool
from fiber._backends.kubernetes.template import PodShape
from fiber._backends.remote import RemoteChild
from fiber._transport.authentication import Identity
from fiber._transport.loop import Loop
from fiber.config import Config
from fiber.errors import FiberError, FiberPoolError
from patience import PATIENCE
from unit.agent_children import ReadLink
from unit.kubernetes_rig import kubeconfig

DAMAGED = "the loop is to fail in this test"


class Said:
    """An ``Output``, or another object whose methods and results do not matter here."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def write(self, who: str, text: str) -> None:
        self.lines.append(f"{who}: {text}")

    def show(self, line: str) -> None:
        self.lines.append(line)

    def __getattr__(self, name: str) -> Any:
        return lambda *args, **kwargs: self


class Owner:
    """Hears of one child."""

    def __init__(self, said: Said) -> None:
        self.said = said
        self.report: ExitReport | None = None
        self.gone = threading.Event()

    def exited(self, report: ExitReport) -> None:
        self.report = report
        self.said.lines.append("refused")
        self.gone.set()


class Listener:
    """A ``MasterListener`` that is closed at once."""

    def __init__(self) -> None:
        self.closed = False

    def close(self, reason: str, *, then: Callable[[], None]) -> None:
        self.closed = True
        then()


class Attachment:
    """A pool that must not begin."""

    name, namespace, doing, displaced, remedy = "es-1", "lab", "make", "", "delete"

    def attach(self, cancel: threading.Event) -> Any:
        raise AssertionError("it was made after the end")

    def detach(self, timeout: float) -> None:
        raise AssertionError("there is none to end")


class Site:
    """Pods of the pool that ``prepare`` gives."""

    def __init__(self) -> None:
        self.loop = Loop()
        self.loop.start_thread("test-io")
        self.said = Said()
        self.api = SimpleNamespace(server="kube", trouble=None)

    def pods(
        self,
        prepare: Callable[[threading.Event], PreparedPool],
        config: Config | None = None,
        successor: Callable[[], AgentSet] | None = None,
    ) -> Pods:
        """``prepare`` is called with the event that ends its calls."""
        nothing: Any = self.said
        api: Any = self.api
        self.made = Pods(
            self.loop,
            nothing,
            nothing,
            config or Config(),
            api,
            lambda observer, cancel: prepare(cancel),
            successor,
        )
        return self.made

    def start(self, *, worker: bool = False) -> tuple[RemoteChild, Owner]:
        owner: Any = Owner(self.said)
        spec = ChildSpec(
            name="child", method="fork", preparation=b"", payload=b"", fds=(), tasks=worker
        )
        child = self.made.agents.child(spec, owner)
        self.loop.call_soon(child.start)
        return child, owner


@pytest.fixture
def site() -> Iterator[Site]:
    made = Site()
    yield made
    made.loop.stop()


def test_an_unexpected_error_of_the_opening_ends_the_wait(site: Site) -> None:
    def prepare(cancel: threading.Event) -> PreparedPool:
        raise KeyError("containers")

    site.pods(prepare)
    child, owner = site.start()
    assert owner.gone.wait(PATIENCE)
    assert owner.report is not None
    assert owner.report.cause == Cause.NO_HOST
    assert isinstance(child.start_error, FiberError)
    assert "KeyError('containers')" in str(child.start_error)
    site.made.close()


def test_a_thread_that_the_system_has_no_room_for_ends_the_wait(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    site.pods(lambda cancel: pytest.fail("it has no thread"))
    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", refuse_threads)
        _, owner = site.start()
        assert owner.gone.wait(PATIENCE)
    assert owner.report is not None
    assert "can't start new thread" in owner.report.reason
    site.made.close()


def refuse_threads(thread: threading.Thread) -> None:
    raise RuntimeError("can't start new thread")


def test_an_end_during_the_opening_makes_no_pool_and_closes_the_listener(site: Site) -> None:
    asks, listener, attachment = threading.Event(), Listener(), Attachment()

    def prepare(cancel: threading.Event) -> PreparedPool:
        asks.set()
        assert cancel.wait(PATIENCE)  # so it is not asked again and again
        some_listener: Any = listener
        return PreparedPool(some_listener, "10.0.0.7:41337", attachment, 1, 0, 10)

    site.pods(prepare)
    site.start()
    assert asks.wait(PATIENCE)
    site.made.close()
    assert listener.closed
    assert not [t for t in threading.enumerate() if t.name == "fiber-kubernetes"]


def until_the_end(cancel: threading.Event) -> PreparedPool:
    """Fail as an API server that does not answer."""
    assert cancel.wait(PATIENCE)
    raise FiberError("the end")


def telling(asked: threading.Event) -> Callable[[threading.Event], PreparedPool]:
    """Make an ``until_the_end`` that first tells that it was asked."""

    def prepare(cancel: threading.Event) -> PreparedPool:
        asked.set()
        return until_the_end(cancel)

    return prepare


def test_an_error_that_ends_the_wait_ends_later_waits_too(site: Site) -> None:
    pods = site.pods(until_the_end)
    hopeless = {"reason": "BackoffLimitExceeded", "message": "all die", "terminal": True}
    site.loop.call_soon(pods.on_status, {"problems": [hopeless]})
    child, owner = site.start()
    assert owner.gone.wait(PATIENCE)
    assert "all die" in str(child.start_error)
    pods.close()


def test_an_agent_whose_pod_is_about_to_go_is_not_let_in(site: Site) -> None:
    pods = site.pods(until_the_end)
    metadata = {
        "name": "a",
        "uid": "uid",
        "labels": {},
        "deletionTimestamp": "2026-01-01T00:00:00Z",
    }
    pods.on_pod("a", {"metadata": metadata})
    link: Any = SimpleNamespace(peer=SimpleNamespace(name="a", uid="uid"))
    assert pods.on_agent(link) == "a, whose pod is ending"
    assert not pods.agents.agents
    pods.close()


def test_the_live_line_is_removed_before_a_refusal(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(waiting, "_is_terminal", lambda: True)
    waits = threading.Event()
    pods = site.pods(telling(waits))
    _, owner = site.start()
    assert waits.wait(PATIENCE)
    error = FiberPoolError("it was deleted", pool="es-1", namespace="lab", reason="Deleted")
    site.loop.call_soon(pods.on_error, error)
    assert owner.gone.wait(PATIENCE)
    assert site.said.lines == ["", "fiber: it was deleted", "refused"]
    pods.close()


def test_the_timeout_error_says_that_the_api_server_does_not_answer(site: Site) -> None:
    waits = threading.Event()
    pods = site.pods(telling(waits), Config(pod_timeout=0.1))
    child, owner = site.start()
    assert owner.gone.wait(PATIENCE)
    assert "within 0.1 s: the API server kube has not answered yet" in str(child.start_error)
    site.api.trouble = "etcd has no leader"
    child, owner = site.start()
    assert owner.gone.wait(PATIENCE)
    assert "kube fail and are repeated: etcd has no leader" in str(child.start_error)
    pods.close()


def test_an_end_after_the_loop_has_failed(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    asks, failed = threading.Event(), threading.Event()
    monkeypatch.setattr(threading, "excepthook", lambda _: failed.set())

    def prepare(cancel: threading.Event) -> PreparedPool:
        asks.set()
        assert failed.wait(PATIENCE)
        listener: Any = Listener()
        return PreparedPool(listener, "10.0.0.7:41337", Attachment(), 1, 0, 10)

    def damage() -> None:
        raise KeyboardInterrupt(DAMAGED)

    site.pods(prepare)
    site.start()
    assert asks.wait(PATIENCE)
    site.loop.call_soon(damage)
    assert failed.wait(PATIENCE)
    closer = threading.Thread(target=site.made.close, daemon=True)
    closer.start()
    closer.join(PATIENCE / 4)
    assert not closer.is_alive()


def test_a_failed_opening_leaves_no_listener(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*args: object) -> Any:
        raise FiberError("no template")

    monkeypatch.setenv("KUBECONFIG", str(kubeconfig(tmp_path, "http://127.0.0.1:9")))
    monkeypatch.setattr(provisioner, "reachable_address", lambda *args, **kwargs: "127.0.0.1")
    monkeypatch.setattr(provisioner, "pod_template", refuse)
    nobody: Any = None
    ours = provisioner.PoolProvisioner(Config())
    with pytest.raises(FiberError, match="no template"):
        ours.prepare_own(PodShape(), site.loop, nobody, threading.Event())
    assert not [t for t in threading.enumerate() if t.name == "fiber-accept"]
    ours.api.close()


RUNNING: Any = {
    "metadata": {"name": "es-1-a", "uid": "uid", "labels": {}},
    "status": {"phase": "Running"},
}


class Dialled(ReadLink):
    """The link of an agent that has dialled in."""

    def __init__(self, name: str) -> None:
        super().__init__()
        self.peer = SimpleNamespace(name=name, uid="uid")


def test_only_agents_of_the_pool_show_that_pods_reach_the_program(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stranger shows nothing: a port scan, or a pod of another program."""
    pods = site.pods(until_the_end)
    reached: list[None] = []
    monkeypatch.setattr(pods._waiting, "reached", lambda: reached.append(None))
    pods.on_refused("127.0.0.1:1 was turned away: the TLS handshake failed")
    assert reached == []
    pods.on_proven()
    assert reached == [None]
    pods.close()


def test_an_agent_that_began_anew_is_let_in_and_its_pod_stays(site: Site) -> None:
    """After this program was stopped for so long that its agents gave it up."""
    pods = site.pods(lambda cancel: pytest.fail("nothing is to be opened"))
    pod: Any = {
        "metadata": {"name": "es-1-a", "uid": "uid", "labels": {}},
        "status": {"phase": "Running"},
    }
    first: Any = Dialled("es-1-a")
    second: Any = Dialled("es-1-a")
    done = threading.Event()
    told: list[str | None] = []

    def happen() -> None:
        pods.on_pod("es-1-a", pod)
        told.append(pods.on_agent(first))
        told.append(pods.on_agent(second))
        done.set()

    site.loop.call_soon(happen)
    assert done.wait(PATIENCE)
    assert told == [None, None]
    (agent,) = pods.agents.agents.values()
    assert agent._link is second
    assert pods._given_up == set()
    pods.close()


@pytest.mark.parametrize(
    ("worker", "told"),
    [
        (False, ["fiber: waiting for pods: 1 of 2 pods ready: QuotaExceeded: it is full"]),
        (True, []),
    ],
    ids=["process", "pool"],
)
def test_only_a_waiting_process_prints_why_one_more_pod_is_missing(
    worker: bool, told: list[str], site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pool works with what it has; nothing else can do what a process is to do."""
    monkeypatch.setattr(waiting, "_is_terminal", lambda: False)
    monkeypatch.setattr(waiting, "_FIRST_WRITTEN", 0.0)
    pods = site.pods(until_the_end)
    full = {"reason": "QuotaExceeded", "severity": "Error", "message": "it is full"}
    status = {"observedGeneration": 1, "desiredReplicas": 2, "readyReplicas": 1}

    def begin() -> None:
        pods.on_pod("es-1-a", RUNNING)
        pods.on_agent(Dialled("es-1-a"))  # type: ignore[arg-type]
        pods.on_attached(SimpleNamespace(relay=False))  # type: ignore[arg-type]
        pods.on_status({**status, "problems": [full]})

    site.loop.call_soon(begin)
    for _ in range(2):
        site.start(worker=worker)
    settled(site)
    assert site.said.lines[1:] == told  # after the problem itself
    pods.close()


def lost(reason: str) -> FiberPoolError:
    return FiberPoolError("it is gone", pool="es-1", namespace="lab", reason=reason)


def identity(name: str, uid: str) -> Identity:
    return Identity.of_this_process(name, uid)


def test_an_agent_with_another_uid_is_not_let_in(site: Site) -> None:
    pods = site.pods(until_the_end)
    assert pods.objection(identity("es-1-a", "uid")) is None, "the watch has no such pod yet"
    pods.on_pod("es-1-a", RUNNING)
    assert pods.objection(identity("es-1-a", "uid")) == ""
    assert "another uid than 'forged'" in (pods.objection(identity("es-1-a", "forged")) or "")
    pods.close()


def lose_pool(site: Site, pods: Pods, error: FiberPoolError, *, used: bool) -> tuple[Any, Owner]:
    """A child waits for a pool whose agent has gone, if it was ``used``, and which is lost now."""
    owner: Any = Owner(site.said)
    spec = ChildSpec(name="child", method="fork", preparation=b"", payload=b"", fds=(), tasks=True)
    child = pods.agents.child(spec, owner)
    over = threading.Event()

    def lose() -> None:
        if used:
            pods.on_pod("es-1-a", RUNNING)
            pods.on_agent(Dialled("es-1-a"))  # type: ignore[arg-type]
            pods.agents.agents["es-1-a"].lose("its pod is gone")
        child.start()
        pods.on_error(error)
        pods.on_end()
        over.set()

    site.loop.call_soon(lose)
    assert over.wait(PATIENCE)
    return child, owner


def test_waiters_of_the_own_pool_that_is_lost_get_the_next_one(site: Site) -> None:
    """Also where its agents had gone before anybody heard of that."""
    follows = site.pods(until_the_end)
    pods = site.pods(until_the_end, successor=lambda: follows.agents)
    child, owner = lose_pool(site, pods, lost("Deleted"), used=True)
    assert pods.over
    assert list(follows.agents.placement.waiting) == [child]
    assert owner.report is None
    assert site.said.lines == ["fiber: it is gone"]
    pods.close()
    follows.close()


@pytest.mark.parametrize(
    ("ours", "reason", "used"),
    [(False, "Deleted", True), (True, "NoOperator", True), (True, "Deleted", False)],
    ids=["somebody-elses", "not-lost", "never-of-use"],
)
def test_a_process_that_another_pool_cannot_help_is_refused(
    ours: bool, reason: str, used: bool, site: Site
) -> None:
    successor = (lambda: pytest.fail("no other is to be made")) if ours else None
    pods = site.pods(until_the_end, successor=successor)
    error = lost(reason)
    child, owner = lose_pool(site, pods, error, used=used)
    assert owner.gone.is_set()
    assert child.start_error is error
    pods.close()


def settled(site: Site) -> None:
    """Wait until what was asked of the loop is done, with what follows, timers of 0 s too."""
    for _ in range(5):
        done = threading.Event()
        site.loop.call_later(0.0, done.set)
        assert done.wait(PATIENCE)
