"""Where this process finds its host's hub.

The hub's own process has it at hand; the processes that its agent starts are told its address and
key when they are born.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

from fiber.errors import FiberError

if TYPE_CHECKING:
    from fiber._hub.hub import Hub


class Access(NamedTuple):
    """How to reach a hub.  The key opens everything that the hub hosts: never show it."""

    host: str
    address: str
    key: bytes

    def __repr__(self) -> str:
        return f"Access(host={self.host!r}, address={self.address!r})"


class NoHub(FiberError):
    """A handle has to leave this process and no hub is there to keep what it stands for."""


def install(access: Access) -> None:
    """This process's hub is elsewhere on its host."""
    global _access, _hub
    _access, _hub = access, None


def serve(hub: Hub | None) -> None:
    """This process is the hub's own; None: it is no longer."""
    global _hub
    _hub = hub


def start_with(starter: Callable[[], object]) -> None:
    """How a program that needs a hub, and was told of none, makes the runtime that has one."""
    global _starter
    _starter = starter


def own_hub() -> Hub | None:
    """The hub, if it lives in this process; made now if this process is to have one."""
    if _hub is None and _access is None:
        if _starter is None:
            raise NoHub(
                "a pipe, queue or event cannot leave this process: nothing of Fiber runs here that "
                "could keep it for the other side. Start a process or pool first."
            )
        _starter()
    return _hub


def current() -> Access:
    """How to reach this host's hub."""
    hub = own_hub()
    if hub is not None:
        return hub.access
    assert _access is not None
    return _access


def host() -> str:
    """The name of this host."""
    hub = own_hub()
    return hub.host if hub is not None else current().host


def told() -> Access | None:
    """What this process was told when it was born."""
    return _access


def refuse_on_loop() -> None:
    """RuntimeError on the thread that would have to carry the answer."""
    if _hub is not None and _hub.on_loop():
        raise RuntimeError(
            "an object of another host is used in a callback on Fiber's own thread, which would "
            "wait for itself for ever: use it on a thread of the program"
        )


def forget() -> None:
    """In a process forked by someone else: the hub did not come along, but can be reached."""
    global _hub, _access
    if _hub is not None:
        _access, _hub = _hub.access_if_open, None


_access: Access | None = None
_hub: Hub | None = None
_starter: Callable[[], object] | None = None
os.register_at_fork(after_in_child=forget)
