"""Client of the relay of a FiberPool.

``fiber._transport.relay`` says what a relay is for.  The client finds the relay's pod, opens a
port-forward to it through the API server, and gives the connection of each agent to the pool's
listener, through a socket pair.  When the port-forward breaks, the client makes another one.  Then
the agents connect anew, and their links go on.
"""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from fiber._backends.kubernetes.api import Api
from fiber._backends.kubernetes.port_forward import PortForward
from fiber._transport.loop import Loop
from fiber._transport.multiplexer import Multiplexer
from fiber._wire.messages import ProtocolError
from fiber._wire.streams import StreamFrame, hello
from fiber_api import names
from fiber_api.rest import PODS, ApiError, Body, Forbidden

_PAUSE_MIN, _PAUSE_MAX = 0.2, 2.0
"""Seconds between attempts to connect; they grow."""

_CLOSE_TIMEOUT = 6.0
"""Seconds until an attempt to connect has ended, after ``close``."""


class RelayedPool(NamedTuple):
    """FiberPool with a relay, and its master."""

    name: str
    namespace: str
    uid: str
    identity: str
    epoch: int


class NoRelay(Exception):
    """Error: the relay has no pod yet that accepts connections.  Its text says why."""


class RelayClient:
    """Client of the relay of one pool, on the thread ``fiber-relay``.

    The functions are called on that thread.  ``take`` gets a connection to an agent, and the
    agent's address.  ``on_trouble`` gets the reason why the relay cannot be used now, and "" once
    it can.  ``on_refused`` gets the error if this program may not open port-forwards.
    """

    def __init__(
        self,
        api: Api,
        pool: RelayedPool,
        *,
        take: Callable[[socket.socket, str], None],
        on_trouble: Callable[[str], None],
        on_refused: Callable[[ApiError], None],
    ) -> None:
        self._api = api
        self._pool = pool
        self._take = take
        self._on_trouble = on_trouble
        self._on_refused = on_refused
        self._loop = Loop()
        self._closing = threading.Event()
        self._dialer: threading.Thread | None = None
        self._lock = threading.Lock()
        self._opened: PortForward | None = None
        """Connection on its way from the thread that dials; under the lock."""
        self._end: Multiplexer | None = None
        self._pause = _PAUSE_MIN

    def start(self) -> None:
        """Start the thread."""
        self._loop.start_thread("fiber-relay")
        self._loop.call_soon(self._dial, 0.0)

    def begin_close(self) -> None:
        """Close all connections through the relay; return at once.  Any thread."""
        with self._lock:
            self._closing.set()
        if (carrier := self._collect()) is not None:
            carrier.close()
        self._loop.call_soon(self._disconnect)

    def close(self) -> None:
        """Close the client, and wait for its end.  Do not call it on its own thread."""
        self.begin_close()
        self._loop.stop()
        if self._dialer is not None:
            self._dialer.join(_CLOSE_TIMEOUT)

    def _collect(self) -> PortForward | None:
        """Return the connection on its way; None if somebody else has it."""
        with self._lock:
            carrier, self._opened = self._opened, None
        return carrier

    def _disconnect(self) -> None:
        if self._end is not None:
            self._end.close()
            self._end = None

    # -- On its own thread

    def _dial(self, pause: float) -> None:
        if self._closing.is_set():
            return
        # The calls of the API server block, so they run on another thread.
        self._dialer = threading.Thread(
            target=self._connect, args=(pause,), name="fiber-relay-dial", daemon=True
        )
        try:
            self._dialer.start()
        except RuntimeError as error:  # the system has no thread left; try again later
            self._dialer = None
            self._on_trouble(str(error))
            self._loop.call_later(_PAUSE_MAX, self._dial, 0.0)

    def _fail(self, reason: str) -> None:
        if self._closing.is_set():
            return
        self._on_trouble(reason)
        self._pause = min(2 * self._pause, _PAUSE_MAX)
        self._dial(self._pause)

    def _connected(self) -> None:
        carrier = self._collect()
        if carrier is None:
            return
        self._end = Multiplexer(
            self._loop, carrier, on_open=self._open, on_hello=self._greeted, on_end=self._broken
        )
        self._end.send(hello(identity=self._pool.identity, epoch=self._pool.epoch))

    def _greeted(self, frame: StreamFrame) -> None:
        try:
            refused = frame.hello.get("refused")
        except ProtocolError as error:
            refused = str(error)
        if refused:
            self._disconnect()
            self._fail(f"the relay refused this program: {refused}")
            return
        self._pause = _PAUSE_MIN
        self._on_trouble("")

    def _open(self, origin: str) -> socket.socket:
        near, far = socket.socketpair()
        self._take(far, origin)
        return near

    def _broken(self, reason: str) -> None:
        self._end = None
        self._fail(f"the connection to the relay broke: {reason}")

    # -- On the thread that dials

    def _connect(self, pause: float) -> None:
        if self._closing.wait(pause):
            return
        try:
            pod = self._find_pod()
            path = PODS.path(self._pool.namespace, pod)
            carrier = self._api.port_forward(path, names.RELAY_PORT)
        except Forbidden as error:
            self._loop.call_soon(self._on_refused, error)
        except (NoRelay, ApiError) as error:
            self._loop.call_soon(self._fail, str(error))
        except Exception as error:  # a bug must not end the attempts
            self._loop.call_soon(self._fail, f"unexpected {error!r}")
        else:
            self._hand_over(carrier)

    def _hand_over(self, carrier: PortForward) -> None:
        with self._lock:
            if not self._closing.is_set():
                self._opened = carrier
                self._loop.call_soon(self._connected)
                return
        carrier.close()

    def _find_pod(self) -> str:
        """Return the name of the relay's pod."""
        selector = {"labelSelector": f"{names.LABEL_RELAY}={self._pool.uid}"}
        listing = self._api.list(
            PODS.path(self._pool.namespace), selector, timeout=0.0, cancel=self._closing
        )
        pods: list[Body] = listing.get("items") or []
        present = [pod for pod in pods if not pod["metadata"].get("deletionTimestamp")]
        for pod in present:
            if (pod.get("status") or {}).get("phase") == "Running":
                return str(pod["metadata"]["name"])
        if present:
            raise NoRelay(f"its pod {present[0]['metadata']['name']} {state_of(present[0])}")
        name = names.relay_name(self._pool.name)
        raise NoRelay(
            f"it has no pod yet (`kubectl describe deployment {name} -n {self._pool.namespace}`)"
        )


def state_of(pod: Mapping[str, Any]) -> str:
    """Return why a pod does not run, in words that the pod's name precedes."""
    status = pod.get("status") or {}
    for container in status.get("containerStatuses") or ():
        waiting = (container.get("state") or {}).get("waiting")
        if waiting and waiting.get("reason") != "ContainerCreating":
            return f"waits: {waiting.get('reason')}: {waiting.get('message') or ''}".rstrip(": ")
    for condition in status.get("conditions") or ():
        if condition.get("type") == "PodScheduled" and condition.get("status") == "False":
            return f"has no node: {condition.get('message') or ''}".rstrip(": ")
    return "starts"
