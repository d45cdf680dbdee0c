"""Several hosts in one process: a hub each, linked as those of agents and master are."""

from __future__ import annotations

import contextlib
import pickle
import threading
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

from fiber._hub import client, handles
from fiber._hub.hub import Hub, HubLink
from fiber._runtime.state import runtime
from fiber._transport.loop import Loop
from fiber._wire import messages
from fiber._wire.messages import HubMessage
from patience import PATIENCE


class Wire:
    """Direction of a link: encodes frames, counts them, and can be stopped."""

    def __init__(self, loop: Loop) -> None:
        self._loop = loop
        self.to: HubLink | None = None
        self.held: deque[bytes] | None = None
        self.frames = 0

    def send(self, frame: HubMessage) -> None:
        """Send on the loop thread, where links are used."""
        self.frames += 1
        encoded = frame.encode()
        if self.held is None:
            self._loop.call_soon(self._deliver, encoded)
        else:
            self.held.append(encoded)

    def hold(self) -> None:
        """Deliver nothing until ``let_go``."""
        self.held = deque()

    def let_go(self) -> None:
        """Deliver the held frames, before any later one."""
        self._loop.call_soon(self._release)

    def _release(self) -> None:
        # On the loop thread, as ``send``: a frame that is sent meanwhile would overtake these.
        held, self.held = self.held or deque(), None
        for encoded in held:
            self._loop.call_soon(self._deliver, encoded)

    def _deliver(self, encoded: bytes) -> None:
        if self.to is not None:
            frame = messages.decode(bytearray(encoded))
            assert isinstance(frame, HubMessage)
            self.to.on_frame(frame)


class Hosts:
    """Hubs on one loop."""

    def __init__(self) -> None:
        runtime()  # one that was made on one of these hosts would lose its own hub with it
        self.loop = Loop()
        self.loop.start_thread("hubs")
        self._hubs: dict[str, Hub] = {}

    def __getitem__(self, name: str) -> Hub:
        if name not in self._hubs:
            self._hubs[name] = Hub(self.loop, name)
        return self._hubs[name]

    def link(self, agent: str, master: str, *, only: bool = True) -> tuple[Wire, Wire]:
        """Link an agent to its master; unless ``only``, everything foreign goes over this link."""
        up, down = Wire(self.loop), Wire(self.loop)
        down.to = self[agent].link(master if only else None, up.send, dialer=True)
        up.to = self[master].link(agent, down.send, dialer=False)
        return up, down

    def on_loop(self, function: object, *args: object) -> None:
        """Call on the loop thread."""
        self.loop.call_soon(function, *args)  # type: ignore[arg-type]

    @contextlib.contextmanager
    def at(self, name: str) -> Iterator[Hub]:
        """Make this process a part of that host in the block, and the hub's own."""
        before = client._local_hub, client._address
        client._local_hub, client._address = self[name], None
        try:
            yield self[name]
        finally:
            client._local_hub, client._address = before

    @contextlib.contextmanager
    def child_at(self, name: str) -> Iterator[Hub]:
        """Make this process a child there in the block; it reaches the hub by its socket."""
        before = client._local_hub, client._address
        client._local_hub, client._address = None, self[name].address
        try:
            yield self[name]
        finally:
            client._local_hub, client._address = before
            handles._single_use.reset()

    def close(self) -> None:
        """End all."""
        for hub in self._hubs.values():
            self.loop.call_soon(hub.close)
        self.loop.stop()


def objects_kept(hub: Hub) -> int:
    """Return how many objects it keeps, once it has done all earlier requests."""
    done = threading.Event()
    hub.loop.call_soon(done.set)
    assert done.wait(PATIENCE)
    return len(hub.registry._objects)


class Far:
    """Function that moves an object of host a to this process on host b."""

    def __init__(self, hosts: Hosts) -> None:
        self._hosts = hosts

    def __call__(self, thing: Any) -> Any:
        with self._hosts.at("a"):
            data = pickle.dumps(thing)
        return pickle.loads(data)


def background(function: Callable[..., Any], *args: Any) -> threading.Thread:
    thread = threading.Thread(target=function, args=args)
    thread.start()
    return thread
