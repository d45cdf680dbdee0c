"""Handles: how a channel or counter gets into another process.

* To a process that is being started on the same host, descriptors go along with the start message.
* Otherwise the hub of this host keeps a descriptor, and the pickle holds how to ask for it.  Who
  unpickles it on the same host is handed a descriptor, on another host it gets an object of which
  every operation is a request.

A handle of the second kind works once, for whoever unpickles it first; within ``collecting_grants``
it works as often as wanted until its grants are released.
"""

from __future__ import annotations

import copyreg
from collections.abc import Sequence
from multiprocessing import context as mp_context
from typing import Any, NamedTuple, Protocol, TypeAlias

from fiber._hub import access, grants
from fiber._hub.access import Access
from fiber._hub.client import Line, Unreachable
from fiber._hub.local import LocalChannel, LocalCounter
from fiber._hub.protocol import TWO, Kind, Op
from fiber._hub.registry import NoSuchObject
from fiber._hub.remote import RemoteChannel, RemoteCounter, RemoteObject
from fiber._transport.base import Channel, Counter
from fiber._transport.unix import UnixChannel, UnixCounter
from fiber._wire.packet import BytesLike


class SharedChannel(Channel, Protocol):
    """A channel that a queue can use: it never has to wait."""

    @property
    def prompt(self) -> bool:
        """Whether ``try_send`` is worth a try."""

    def post(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> None:
        """Send one message, waiting for room but not until it is read."""

    def try_send(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> bool:
        """Send one message if there is room for it now."""


class SharedCounter(Counter, Protocol):
    """A counter whose every change can be waited for."""

    def changed(self, since: int, timeout: float | None) -> bool:
        """Wait until the count is not ``since``; False when ``timeout`` is over."""


class InheritedDescriptor(Protocol):
    """Stands for a descriptor that goes along with a start message."""

    def detach(self) -> int:
        """In the started process: the descriptor."""


class HubHandle(NamedTuple):
    """Stands for an object that a hub keeps."""

    home: Access
    number: int
    grant: int

    def here(self) -> bool:
        """Whether the hub is on this host."""
        return self.home.host == access.host()

    def fetch(self) -> int:
        """On the hub's host: a descriptor."""
        hub = access.own_hub()
        if hub is not None and hub.key == self.home.key:
            try:
                return hub.registry.fetch(self.number, self.grant)
            except NoSuchObject as error:
                raise Unreachable(hub.host, str(error)) from None
        line = Line(self.home)
        try:
            reply = line.ask(Op.FETCH, self.number, self.grant, form=TWO)
            (fd,) = reply.fds
            return fd
        finally:
            line.close()


collecting_grants = grants.collecting_grants

Handle: TypeAlias = InheritedDescriptor | HubHandle


def channel(handle: Handle) -> SharedChannel:
    """Where a handle was unpickled: the channel that it stands for."""
    if not isinstance(handle, HubHandle):
        return LocalChannel.from_fd(handle.detach())
    if handle.here():
        return LocalChannel.from_fd(handle.fetch())
    return RemoteChannel(*handle)


def counter(handle: Handle) -> SharedCounter:
    """Where a handle was unpickled: the counter that it stands for."""
    if not isinstance(handle, HubHandle):
        return LocalCounter(handle.detach())
    if handle.here():
        return LocalCounter(handle.fetch())
    return RemoteCounter(*handle)


def lend(end: Any) -> Handle:
    """What to pickle in place of a channel or counter."""
    if isinstance(end, RemoteObject):
        return HubHandle(*grants.current().for_remote(end))
    spawning: Any = mp_context.get_spawning_popen()
    if spawning is not None and not getattr(spawning, "other_host", False):
        handle: InheritedDescriptor = spawning.DupFd(spawning.duplicate_for_child(end.fileno()))
        return handle
    kind = Kind.CHANNEL if isinstance(end, UnixChannel) else Kind.COUNTER
    return HubHandle(*grants.current().for_local(kind, end.fileno()))


def _reduce_channel(end: Any) -> tuple[Any, ...]:
    return channel, (lend(end),)


def _reduce_counter(end: Any) -> tuple[Any, ...]:
    return counter, (lend(end),)


copyreg.pickle(UnixChannel, _reduce_channel)
copyreg.pickle(LocalChannel, _reduce_channel)
copyreg.pickle(RemoteChannel, _reduce_channel)
copyreg.pickle(UnixCounter, _reduce_counter)
copyreg.pickle(LocalCounter, _reduce_counter)
copyreg.pickle(RemoteCounter, _reduce_counter)
