"""Client: finds the relay, connects through the API server, and says what is in the way."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from fakes.kubernetes_api import Call, Fault
from fakes.served import Served, served
from faults.program import wait_for
from fiber._backends.kubernetes import api as api_module
from fiber._backends.kubernetes import relay_client
from fiber._backends.kubernetes.api import Api
from fiber._backends.kubernetes.port_forward import PortForward
from fiber._backends.kubernetes.relay_client import RelayClient, RelayedPool
from fiber._transport.link import Keepalive
from fiber._transport.relay import Relay
from fiber._wire.streams import hello
from fiber_api import names
from fiber_api.rest import ApiError, Forbidden
from patience import PATIENCE
from ports import reserved_port
from unit.kubernetes_rig import NAMESPACE, kubeconfig
from unit.link_site import Notes, Site

PATIENT = Keepalive(heartbeat=0.2, suspect_after=PATIENCE / 2, lost_after=PATIENCE)
POOL = RelayedPool("es-1", NAMESPACE, "uid-1", "laptop", 3)
LABELS = {names.LABEL_RELAY: POOL.uid}
RUNNING = {"phase": "Running"}


class Told(Notes):
    """Record of what a client has called back."""

    def __init__(self) -> None:
        super().__init__()
        self.troubles: list[str] = []
        self.refused: list[ApiError] = []

    def on_trouble(self, reason: str) -> None:
        self.add(self.troubles, reason)

    def on_api_refused(self, error: ApiError) -> None:
        # Its traceback would keep the connection of that call open.
        self.add(self.refused, error.with_traceback(None))

    def wait_for_trouble(self, text: str, after: int = 0) -> None:
        self.wait(lambda: any(text in trouble for trouble in self.troubles[after:]))

    def wait_until_open(self, times: int = 1) -> None:
        self.wait(lambda: self.troubles.count("") >= times)


class RelaySite:
    """API server, a relay that its port-forwards lead to, and a client."""

    def __init__(self, site: Site, server: Served, api: Api) -> None:
        self.site = site
        self.server = server
        self.api = api
        self.told = Told()
        self.relay: Relay = site.on_loop(lambda: Relay(site.loop, 0, 0, lambda line: None))
        server.api.forwards.target = self.relay.master_port
        self.address = f"127.0.0.1:{self.relay.agents_port}"
        self._clients: list[RelayClient] = []

    def pod(self, name: str = "relay-1", **status: Any) -> None:
        """Add a pod of the relay, or change its status."""
        store = self.server.store
        with contextlib.suppress(Exception):  # it is there already
            body = {"metadata": {"name": name, "labels": LABELS}, "spec": {}}
            self.server.do(store.create, "pods", NAMESPACE, body)
        patch = {"status": status}
        self.server.do(store.merge, "pods", NAMESPACE, name, patch, "status")

    def client(
        self,
        take: Callable[[socket.socket, str], None] = lambda sock, origin: sock.close(),
        pool: RelayedPool = POOL,
    ) -> RelayClient:
        client = RelayClient(
            self.api,
            pool,
            take=take,
            on_trouble=self.told.on_trouble,
            on_refused=self.told.on_api_refused,
        )
        self._clients.append(client)
        client.start()
        return client

    def linked(self) -> tuple[Notes, Notes]:
        """Link an agent through the client."""
        self.pod(**RUNNING)
        listener, master = self.site.listener(keepalive=PATIENT)
        self.client(listener.take)
        _, agent = self.site.dialer(self.address)
        assert agent.link is not master.link
        return master, agent

    def break_forward(self) -> None:
        self.server.do(self.server.api.forwards.opened[-1].abort)

    def close(self) -> None:
        for client in self._clients:
            client.close()
        self.site.on_loop(self.relay.close)


@pytest.fixture
def server() -> Iterator[Served]:
    with served() as server:
        yield server


@pytest.fixture
def at(
    site: Site, server: Served, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[RelaySite]:
    monkeypatch.setattr(relay_client, "_PAUSE_MIN", 0.01)
    monkeypatch.setattr(relay_client, "_PAUSE_MAX", 0.05)
    monkeypatch.setenv("KUBECONFIG", str(kubeconfig(tmp_path, server.api.url)))
    with contextlib.closing(Api.connect()) as api:
        at = RelaySite(site, server, api)
        yield at
        at.close()


def exchange(master: Notes, agent: Notes, count: int) -> None:
    """Send ``count`` more frames in each direction; check that all ever sent have arrived."""
    for _ in range(count):
        for sender in (master, agent):
            number = sender.sent = getattr(sender, "sent", 0) + 1  # type: ignore[attr-defined]
            sender.link.send(b"%d " % number + bytes(20_000))
    for notes, other in ((master, agent), (agent, master)):
        total: int = other.sent  # type: ignore[attr-defined]
        notes.wait_for_frames(total)
        assert [int(bytes(f).split()[0]) for f in notes.frames] == list(range(1, total + 1))


# -- Through the client


def test_an_agent_reaches_the_program_through_the_client(at: RelaySite) -> None:
    master, agent = at.linked()
    exchange(master, agent, 200)
    assert at.told.troubles == [""]
    gets = [call for call in at.server.api.calls if call.verb == "get"]
    assert gets == [Call("get", "pods", NAMESPACE, "relay-1", "portforward")]


def test_a_client_that_breaks_is_made_again_and_nothing_is_lost(at: RelaySite) -> None:
    master, agent = at.linked()
    for times in range(1, 4):
        at.told.wait_until_open(times)
        exchange(master, agent, 20)
        before = len(at.told.troubles)
        at.break_forward()
        at.told.wait_for_trouble("the connection to the relay broke: ", before)
    exchange(master, agent, 20)
    assert (len(master.links), len(agent.links)) == (1, 1)


def test_an_end_of_the_relay_is_told_and_mended(at: RelaySite) -> None:
    at.pod(**RUNNING)
    at.client()
    at.told.wait_until_open()
    site = at.site
    with reserved_port() as nothing:
        at.server.api.forwards.target = nothing
        at.site.on_loop(at.relay.close)
        at.told.wait_for_trouble("error forwarding port")
    at.relay = site.on_loop(lambda: Relay(site.loop, 0, 0, lambda line: None))
    at.server.api.forwards.target = at.relay.master_port
    at.told.wait_until_open(2)


def test_a_refusal_of_the_relay_is_told(at: RelaySite) -> None:
    at.pod(**RUNNING)
    at.client()
    at.told.wait_until_open()
    at.client(pool=POOL._replace(epoch=2))
    at.told.wait_for_trouble(
        "the relay refused this program: the pool has a master with the epoch 3"
    )


# -- What may be in the way


def test_what_the_relays_pod_waits_for_is_told(at: RelaySite) -> None:
    at.client()
    told = at.told
    told.wait_for_trouble("it has no pod yet (`kubectl describe deployment")
    at.pod(phase="Pending")
    told.wait_for_trouble("its pod relay-1 starts")
    unscheduled = {"type": "PodScheduled", "status": "False", "message": "0/3 nodes fit"}
    at.pod(phase="Pending", conditions=[unscheduled])
    told.wait_for_trouble("its pod relay-1 has no node: 0/3 nodes fit")
    at.pod(phase="Pending", containerStatuses=[_waits("ContainerCreating")])
    at.pod(phase="Pending", containerStatuses=[_waits("ErrImagePull", "no such image")])
    told.wait_for_trouble("its pod relay-1 waits: ErrImagePull: no such image")
    at.pod(phase="Pending", containerStatuses=[_waits("CrashLoopBackOff", None)])
    told.wait(lambda: "its pod relay-1 waits: CrashLoopBackOff" in told.troubles)
    at.pod(**RUNNING)
    told.wait_until_open()


def _waits(reason: str, message: str | None = "") -> dict[str, Any]:
    return {"name": "relay", "state": {"waiting": {"reason": reason, "message": message}}}


def test_a_pod_that_ends_is_not_used(at: RelaySite) -> None:
    at.pod("old", **RUNNING)
    ends = {"metadata": {"deletionTimestamp": "2026-01-01T00:00:00Z"}}
    at.server.do(at.server.store.merge, "pods", NAMESPACE, "old", ends, "")
    at.client()
    at.told.wait_for_trouble("it has no pod yet")
    at.pod("new", **RUNNING)
    at.told.wait_until_open()
    assert {call.name for call in at.server.api.calls if call.verb == "get"} == {"new"}


def test_a_pod_that_has_just_gone_is_looked_for_again(at: RelaySite) -> None:
    at.pod(**RUNNING)
    at.server.api.faults = [Fault("get", "pods", 404, reason="NotFound", message="it is gone")]
    at.client()
    at.told.wait_for_trouble("it is gone")
    at.told.wait_until_open()


def test_an_api_server_that_is_gone_is_told_until_it_is_back(at: RelaySite) -> None:
    at.pod(**RUNNING)
    at.server.api.down = True
    at.client()
    at.told.wait(lambda: len(at.told.troubles) > 2)
    assert all(at.told.troubles)
    at.server.api.down = False
    at.told.wait_until_open()


def test_an_answer_that_is_no_list_of_pods_does_not_end_the_attempts(at: RelaySite) -> None:
    at.pod(**RUNNING)
    at.server.api.faults = [Fault("list", "pods", text='{"items": [{"metadata": {}}, 7]}')]
    at.client()
    at.told.wait_for_trouble("unexpected ")
    at.told.wait_until_open()


def test_a_login_that_has_expired_is_renewed(at: RelaySite, tmp_path: Path) -> None:
    at.pod(**RUNNING)

    def expire(call: Call) -> None:
        at.server.api.accepts = {"Bearer two"}

    at.server.api.after = expire  # after the list, so that the port-forward is the first without
    kubeconfig(tmp_path, at.server.api.url, {"token": "two"})
    at.client()
    at.told.wait_until_open()
    assert at.told.troubles == [""]
    assert at.server.api.tokens == ["Bearer one", "Bearer one", "Bearer two"]


@pytest.mark.parametrize("verb", ["list", "get"])
def test_a_missing_right_ends_the_attempts(at: RelaySite, verb: str) -> None:
    at.pod(**RUNNING)
    at.server.api.allows = lambda call: call.verb != verb
    client = at.client()
    at.told.wait(lambda: at.told.refused)
    assert isinstance(at.told.refused[0], Forbidden)
    assert f"you may not {verb} pods" in str(at.told.refused[0])
    assert client._dialer is not None
    client._dialer.join(PATIENCE)
    assert at.told.troubles == []
    assert at.server.api.count(verb, "pods") == 1


def test_a_system_without_a_free_thread_is_asked_again(
    at: RelaySite, monkeypatch: pytest.MonkeyPatch
) -> None:
    at.pod(**RUNNING)
    start, left = threading.Thread.start, [None] * 3

    def refuse(thread: threading.Thread) -> None:
        if thread.name == "fiber-relay-dial" and left:
            left.pop()
            raise RuntimeError("can't start new thread")
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", refuse)
    at.client()
    at.told.wait_until_open()
    assert at.told.troubles == ["can't start new thread"] * 3 + [""]


# -- Close.  After each test no thread and no descriptor may be left


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(api_module, "CONNECT_TIMEOUT", 0.2)


def test_a_client_that_never_began_closes(at: RelaySite) -> None:
    client = RelayClient(
        at.api,
        POOL,
        take=lambda sock, origin: sock.close(),
        on_trouble=at.told.on_trouble,
        on_refused=at.told.on_api_refused,
    )
    client.close()
    client.close()


def test_close_during_a_pause(at: RelaySite, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(relay_client, "_PAUSE_MIN", PATIENCE)
    monkeypatch.setattr(relay_client, "_PAUSE_MAX", PATIENCE)
    client = at.client()
    at.told.wait(lambda: at.told.troubles)
    client.close()
    assert len(at.told.troubles) <= 2


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("verb", ["list", "get"])
def test_close_while_the_api_server_does_not_answer(at: RelaySite, verb: str) -> None:
    at.pod(**RUNNING)
    at.server.api.faults = [Fault(verb, "pods", late=PATIENCE)]
    client = at.client()
    wait_for(lambda: at.server.api.count(verb, "pods") > 0)
    client.close()


def test_close_before_the_relay_has_answered(at: RelaySite) -> None:
    at.pod(**RUNNING)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        at.server.api.forwards.target = silent.getsockname()[1]
        client = at.client()
        sock, _ = silent.accept()
        with sock:
            expected = hello(identity=POOL.identity, epoch=POOL.epoch).encode()
            assert sock.recv(len(expected), socket.MSG_WAITALL) == expected
            client.close()
            assert sock.recv(1) == b""
    assert at.told.troubles == []


def test_close_with_streams_ends_them(at: RelaySite) -> None:
    at.pod(**RUNNING)
    taken = Notes()

    def take(sock: socket.socket, origin: str) -> None:
        taken.add(taken.events, sock)

    client = at.client(take)
    with socket.create_connection(("127.0.0.1", at.relay.agents_port), PATIENCE) as agent:
        taken.wait(lambda: taken.events)
        master: Any = taken.events[0]
        with master:
            client.close()
            assert master.recv(1) == b""
            with contextlib.suppress(ConnectionResetError):
                assert agent.recv(1) == b""
    assert at.told.troubles == [""]


@pytest.mark.parametrize("order", ["handed over, then closed", "closed, then handed over"])
def test_a_connection_that_comes_during_close_is_closed(at: RelaySite, order: str) -> None:
    near, far = socket.socketpair()
    socket_client: Any = _Client(near)
    client = at.client()
    at.told.wait_for_trouble("it has no pod yet")
    busy, go_on = threading.Event(), threading.Event()

    def wait() -> None:
        busy.set()
        go_on.wait(PATIENCE)

    client._loop.call_soon(wait)
    assert busy.wait(PATIENCE)
    if order.startswith("handed"):
        client._hand_over(PortForward(socket_client))
    client.begin_close()
    if order.startswith("closed"):
        client._hand_over(PortForward(socket_client))
    assert near.fileno() < 0
    go_on.set()
    client.close()
    far.close()


class _Client:
    def __init__(self, sock: socket.socket) -> None:
        self.sock = sock


def test_nothing_is_called_back_after_close(at: RelaySite) -> None:
    at.pod(**RUNNING)
    client = at.client()
    at.told.wait_until_open()
    client.close()
    told = list(at.told.troubles)
    at.break_forward()
    client._fail("late")
    client._dial(0.0)
    client._connected()
    assert at.told.troubles == told
