"""Handles: the pickled form of channels, counters and blocks.

* For a process that is being started on the same host, descriptors go along with the start message.
* Otherwise the hub of this host keeps a descriptor, and the handle says how to ask for it.  A
  process of the same host that unpickles the handle gets a descriptor.  A process of another host
  gets an object whose operations are requests.

A handle carries a grant.  The hub keeps the object while there is a grant for it.  A handle works
once, for the first process that unpickles it.  If its grant is in a ``GrantSet``, the handle works
until the set is released.
"""

from __future__ import annotations

import contextlib
import copyreg
import os
import threading
import weakref
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from multiprocessing import context as mp_context
from typing import Any, NamedTuple, Protocol, Self, TypeAlias

from fiber._hub import client
from fiber._hub.client import HubStream, ObjectUnreachable
from fiber._hub.heap import Block, block_of
from fiber._hub.local import LocalChannel, LocalCounter
from fiber._hub.one_way import ENDS, Backlog, OneWayEnd, ReceivingEnd, SendingEnd
from fiber._hub.protocol import (
    FOUR,
    GRANTING,
    SECRET,
    WHOLE,
    Extent,
    GrantFlags,
    HubAddress,
    ObjectKind,
    Op,
)
from fiber._hub.registry import NoSuchObject, Registry
from fiber._hub.remote import RemoteChannel, RemoteCounter, RemoteEnd, RemoteObject
from fiber._transport.channels import Channel, SharedCounter, UnixChannel, UnixCounter
from fiber._wire.descriptor import Descriptor, own


class DescriptorHandle(Protocol):
    """Handle of a descriptor that goes along with a start message.

    multiprocessing's ``DupFd`` and ``fiber.reduction.PayloadDescriptor`` implement it.
    """

    def detach(self) -> int:
        """Return the descriptor, in the started process."""


class HubHandle(NamedTuple):
    """Handle of an object that a hub keeps."""

    home: HubAddress
    grant: bytes
    identity: bytes
    """Identity of shared memory, the same in all its handles."""

    def __repr__(self) -> str:
        return f"HubHandle(home={self.home!r})"

    def is_local(self) -> bool:
        """Tell whether the hub is on this host."""
        return self.home.host == client.host()

    def fetch(self) -> list[Descriptor]:
        """Return the object's descriptors, on the host of the hub."""
        hub = client.local_hub()
        if hub is not None and hub.key == self.home.key:
            try:
                return hub.fetch(self.grant)
            except NoSuchObject as error:
                raise ObjectUnreachable(hub.host, str(error)) from None
        stream = HubStream(self.home)
        try:
            reply = stream.ask(Op.FETCH, self.grant, form=SECRET)
            return list(map(own, reply.fds))
        finally:
            stream.close()


Handle: TypeAlias = DescriptorHandle | HubHandle


class BlockHandle(NamedTuple):
    """Handle of a block of shared memory.

    The class that pickled it decides what it becomes on another host.
    """

    segment: Handle
    extent: Extent

    def remote_handle(self) -> HubHandle | None:
        """Return the handle at the hub of another host; None for a block of this host."""
        segment = self.segment
        return segment if isinstance(segment, HubHandle) and not segment.is_local() else None

    def block(self) -> Block:
        """Return the block, on its own host."""
        segment = self.segment
        (owner,) = _descriptors(segment)
        return block_of(owner, *self.extent)


class EndHandle(NamedTuple):
    """Handle of an end of a one-way channel: a socket, and a block for its backlog."""

    kind: ObjectKind
    socket: Handle
    segment: Handle | None
    """Segment of the block; None if the hub keeps it together with the socket."""
    extent: Extent

    def end(self) -> Channel:
        """Return the end for the process that unpickled the handle."""
        if isinstance(self.socket, HubHandle) and not self.socket.is_local():
            return RemoteEnd(self.kind, self.extent, *self.socket)
        socket, *beside = _descriptors(self.socket)
        (segment,) = beside if self.segment is None else _descriptors(self.segment)
        return ENDS[self.kind](socket, Backlog(block_of(segment, *self.extent)))


def _descriptors(handle: Handle) -> list[Descriptor]:
    """Return the descriptors of a handle, on its own host."""
    return handle.fetch() if isinstance(handle, HubHandle) else [own(handle.detach())]


# Unpickling


def channel(handle: Handle | EndHandle) -> Channel:
    """Return the channel of an unpickled handle."""
    if isinstance(handle, EndHandle):
        return handle.end()
    if isinstance(handle, HubHandle) and not handle.is_local():
        return RemoteChannel(*handle)
    return LocalChannel(*_descriptors(handle))


def counter(handle: Handle) -> SharedCounter:
    """Return the counter of an unpickled handle."""
    if isinstance(handle, HubHandle) and not handle.is_local():
        return RemoteCounter(*handle)
    return LocalCounter(*_descriptors(handle))


# Pickling


def handle_for(end: Any) -> Handle | EndHandle:
    """Return the handle to pickle in place of a channel or counter."""
    if isinstance(end, RemoteEnd):
        return EndHandle(end.kind, _grants().for_remote(end), None, end.extent)
    if isinstance(end, RemoteObject):
        return _grants().for_remote(end)
    if isinstance(end, OneWayEnd):
        return _handle_for_end(end)
    spawning = _spawning_here()
    if spawning is not None:
        return _inherited(spawning, end.fileno())
    kind = ObjectKind.CHANNEL if isinstance(end, UnixChannel) else ObjectKind.COUNTER
    return _grants().for_local(kind, end.fileno())


def _handle_for_end(end: OneWayEnd) -> EndHandle:
    block = end.backlog.block
    block.give()
    extent = Extent(block.offset, block.size)
    spawning = _spawning_here()
    if spawning is not None:
        segment = _inherited_segment(spawning, block)
        return EndHandle(end.kind, _inherited(spawning, end.fileno()), segment, extent)
    kept = _grants().for_local(end.kind, end.fileno(), extent, beside=[block.segment.fileno()])
    return EndHandle(end.kind, kept, None, extent)


def _inherited(spawning: Any, fd: int) -> DescriptorHandle:
    handle: DescriptorHandle = spawning.DupFd(spawning.duplicate_for_child(fd))
    return handle


def _inherited_segment(spawning: Any, block: Block) -> DescriptorHandle:
    inherit = getattr(spawning, "inherit_segment", None)
    if inherit is not None:
        segment: DescriptorHandle = inherit(block.segment)
        return segment
    # multiprocessing's Process takes each descriptor once, and closes it in the child.  It keeps
    # the duplicate until the child has started.
    duplicate = own(os.dup(block.segment.fileno()))
    vars(spawning).setdefault("_fiber_duplicates", []).append(duplicate)
    return _inherited(spawning, duplicate.fileno())


def handle_for_block(kind: ObjectKind, block: Block) -> BlockHandle:
    """Return the handle to pickle in place of a block of this host, as an object of ``kind``."""
    block.give()
    extent = Extent(block.offset, block.size)
    spawning = _spawning_here()
    if spawning is None:
        segment = _grants().for_local(kind, block.segment.fileno(), extent)
        return BlockHandle(segment, extent)
    return BlockHandle(_inherited_segment(spawning, block), extent)


def handle_for_remote_block(end: RemoteObject, extent: Extent) -> BlockHandle:
    """Return the handle to pickle in place of a block of another host."""
    return BlockHandle(_grants().for_remote(end), extent)


def _spawning_here() -> Any:
    """Return the start of a process of this host that is in progress on this thread, or None."""
    spawning: Any = mp_context.get_spawning_popen()
    return None if getattr(spawning, "other_host", False) else spawning


class GrantSet:
    """Grants that last until the set is released or forgotten, or this process ends.

    ``reusable`` grants are for handles that may be unpickled several times, as those of a task that
    may run again.  Other grants also end with their first use, as those for a new process.
    """

    __slots__ = ("_direct", "_kept", "_reusable", "_streams")

    def __init__(self, *, reusable: bool = True) -> None:
        self._reusable = reusable
        self._direct: dict[Registry, list[bytes]] = {}
        self._streams: dict[HubAddress, HubStream] = {}
        self._kept: list[object] = []

    def __bool__(self) -> bool:
        """Tell whether the set has grants or objects to release."""
        return bool(self._direct or self._streams or self._kept)

    def keep(self, thing: object) -> None:
        """Keep an object alive that the unpickled handles need."""
        self._kept.append(thing)

    def for_local(
        self, kind: ObjectKind, fd: int, extent: Extent = WHOLE, *, beside: Sequence[int] = ()
    ) -> HubHandle:
        """Return a handle for an object of this host."""
        home = client.hub_address()
        hub = client.local_hub()
        if hub is not None:
            granted = hub.registry.register(
                kind, fd, extent, beside=beside, reusable=self._reusable
            )
            self._direct.setdefault(hub.registry, []).append(granted[0])
            return HubHandle(home, *granted)
        fds = (fd, *beside)
        return _register(self._stream(home), home, kind, fds, extent, self._flags())

    def for_remote(self, end: RemoteObject) -> HubHandle:
        """Return a handle for an object of another host."""
        end.confirm()  # its hub must know the token before another stream uses it
        reply = self._stream(end.home).ask(Op.GRANT, self._flags(), end.token, form=GRANTING)
        return HubHandle(end.home, *reply.values)

    def release(self) -> None:
        """End the grants: no process unpickles the handles from now on."""
        direct, self._direct = self._direct, {}
        streams, self._streams = self._streams, {}
        self._kept.clear()
        for registry, grants in direct.items():
            registry.release(grants)
        for stream in streams.values():
            stream.close()  # at the end of a stream its hub ends the stream's grants

    def __del__(self) -> None:
        if hasattr(self, "_streams"):  # else ``__init__`` was interrupted
            self.release()

    def _flags(self) -> GrantFlags:
        flags = GrantFlags.ENDS_WITH_STREAM
        return flags | GrantFlags.REUSABLE if self._reusable else flags

    def _stream(self, home: HubAddress) -> HubStream:
        if home not in self._streams:
            self._streams[home] = HubStream(home)
        return self._streams[home]


class _SingleUse:
    """Grants for the first process that unpickles a handle.  They outlive this process."""

    def __init__(self) -> None:
        self.reset()
        os.register_at_fork(after_in_child=self.reset)

    def reset(self) -> None:
        """Forget the streams, so that new ones are opened."""
        # A thread owns the stream that it has taken out.  A finalizer may take one in between.
        self._streams: deque[tuple[HubAddress, HubStream]] = deque()

    def for_local(
        self, kind: ObjectKind, fd: int, extent: Extent = WHOLE, *, beside: Sequence[int] = ()
    ) -> HubHandle:
        """Return a handle for an object of this host."""
        home = client.hub_address()
        hub = client.local_hub()
        if hub is None:
            with self.stream(home) as stream:
                handle = _register(stream, home, kind, (fd, *beside), extent, GrantFlags(0))
            _undo_by(lambda: self._release(handle))
            return handle
        registry = hub.registry
        granted = registry.register(kind, fd, extent, beside=beside, reusable=False)
        _undo_by(lambda: registry.release(granted[:1]))
        return HubHandle(home, *granted)

    def for_remote(self, end: RemoteObject) -> HubHandle:
        """Return a handle for an object of another host."""
        with end.stream() as stream:
            reply = stream.ask(Op.GRANT, GrantFlags(0), end.token, form=GRANTING)
        handle = HubHandle(end.home, *reply.values)
        _undo_by(lambda: _release_remote(end, handle.grant))
        return handle

    @contextlib.contextmanager
    def stream(self, home: HubAddress) -> Iterator[HubStream]:
        """Yield a stream to the hub ``home``, for one request."""
        try:
            to, stream = self._streams.pop()
        except IndexError:
            to, stream = home, HubStream(home)
        if to != home:
            stream.close()
            stream = HubStream(home)
        try:
            yield stream
        except BaseException:
            # After Ctrl-C or a refusal of the hub, the next request needs a new stream.
            stream.close()
            raise
        self._streams.append((home, stream))

    def _release(self, handle: HubHandle) -> None:
        with self.stream(handle.home) as stream:
            stream.say(Op.RELEASE, handle.grant, form=SECRET)


def _register(
    stream: HubStream,
    home: HubAddress,
    kind: ObjectKind,
    fds: Sequence[int],
    extent: Extent,
    flags: GrantFlags,
) -> HubHandle:
    reply = stream.ask(Op.REGISTER, kind, flags, *extent, form=FOUR, fds=fds)
    return HubHandle(home, *reply.values)


def _release_remote(end: RemoteObject, grant: bytes) -> None:
    with end.stream() as stream:
        stream.say(Op.RELEASE, grant, form=SECRET)


class Pickling:
    """Pickling of an object on this thread: it gives grants to handles, and ends them if it fails.

    Within ``with``, handles that are pickled on this thread work once, or, if ``reusable``, until
    ``grants`` are released.  A signal's handler may pickle in the middle of another pickling.
    """

    __slots__ = ("__weakref__", "_outer", "grants", "reusable", "undo")

    def __init__(self, *, reusable: bool = False) -> None:
        self.reusable = reusable
        self.grants: GrantSet | None = None
        self.undo: list[Callable[[], None]] = []

    def __enter__(self) -> Self:
        # An interrupt may strike before the block begins, and then no call of __exit__ follows.
        # Without the weak reference, this would stay the thread's pickling for ever.
        self._outer, _this_thread.pickling = _this_thread.pickling, weakref.ref(self)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        _this_thread.pickling = self._outer
        if kind is not None:
            self.take_back()

    def take_back(self) -> None:
        """End the grants of a pickling that failed."""
        if self.grants is not None:
            self.grants.release()
        while self.undo:
            with contextlib.suppress(OSError, ObjectUnreachable):  # the hub has ended
                self.undo.pop()()


def ring_doorbell() -> None:
    """Ring the doorbell of this host's hub, so that it looks at shared memory again.

    Never waits.  If the hub cannot be reached, it looks again by itself some time later.
    """
    with contextlib.suppress(OSError, ObjectUnreachable):
        hub = client.local_hub()
        if hub is not None:
            hub.doorbell.ring()
            return
        with _single_use.stream(client.hub_address()) as stream:
            stream.say(Op.RING)


class _ThisThread(threading.local):
    pickling: weakref.ref[Pickling] | None = None


_this_thread = _ThisThread()
_single_use = _SingleUse()


def _current() -> Pickling | None:
    reference = _this_thread.pickling
    return None if reference is None else reference()


def undo_pickling() -> None:
    """End the grants of the current pickling, which begins again in another way."""
    pickling = _current()
    if pickling is not None:
        pickling.take_back()


def _undo_by(step: Callable[[], None]) -> None:
    """Note how to end a grant if the current pickling fails."""
    pickling = _current()
    if pickling is not None:
        pickling.undo.append(step)


def _grants() -> GrantSet | _SingleUse:
    """Return the source of grants for the handle that is being pickled."""
    pickling = _current()
    if pickling is None:
        return _single_use
    if pickling.reusable and pickling.grants is None:
        pickling.grants = GrantSet()
    return pickling.grants if pickling.grants is not None else _single_use


def keep_until_released(thing: object) -> None:
    """Keep an object alive while the handles of the current pickling may be unpickled.

    That time is known for the arguments of a new process, until it ends, and for a task, until it
    is done.
    """
    grants = _grants()
    if isinstance(grants, GrantSet):
        grants.keep(thing)


@contextlib.contextmanager
def collecting_grants(*, reusable: bool = True) -> Iterator[GrantSet]:
    """Yield a set for the grants of handles that this thread pickles within the block.

    The handles work until the set is released.  If the block raises, it is released.  Without
    ``reusable`` each handle works once.
    """
    with Pickling(reusable=reusable) as pickling:
        pickling.grants = GrantSet(reusable=reusable)
        yield pickling.grants


def _reduce_channel(end: Any) -> tuple[Any, ...]:
    return channel, (handle_for(end),)


def _reduce_counter(end: Any) -> tuple[Any, ...]:
    return counter, (handle_for(end),)


for _channel in (UnixChannel, LocalChannel, ReceivingEnd, SendingEnd, RemoteChannel, RemoteEnd):
    copyreg.pickle(_channel, _reduce_channel)
for _counter in (UnixCounter, LocalCounter, RemoteCounter):
    copyreg.pickle(_counter, _reduce_counter)
