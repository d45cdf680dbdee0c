"""The hub: keeps what processes of this host share with others, one per host and program.

It lives in the agent of its host, on its loop.  A process of the same host asks it for descriptors
and needs it no more; one on another host reaches it through a tunnel and uses its objects by
request (``fiber._hub.remote``).  Who wants anything has to know the hub's key.
"""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import shutil
import socket
import struct
import tempfile
import threading
import weakref

from fiber._hub import protocol
from fiber._hub.access import Access
from fiber._hub.hosted import Hosted, HostedChannel, HostedCounter
from fiber._hub.local import QuietSocket, blocking
from fiber._hub.poller import Poller
from fiber._hub.protocol import Kind
from fiber._hub.registry import Registry
from fiber._hub.session import Session
from fiber._hub.streams import SocketStream, Stream
from fiber._hub.tunnel import Send, Switch, Tunnels
from fiber._transport.loop import Loop
from fiber._transport.unix import naming_the_limit, socketpair

_PEER = struct.Struct("iII")  # pid, uid, gid

_RETRY = 0.1
"""Seconds until the next try when no descriptor is free to accept a stream with."""


class Hub:
    """``register``, ``fetch`` and the like may be called on any thread; the rest on the loop's."""

    def __init__(self, loop: Loop, host: str, directory: str | None = None) -> None:
        self.host = host
        self.key = secrets.token_bytes(protocol.KEY_BYTES)
        self._loop = loop
        self._parent = directory
        self._poller = Poller(loop)
        self.registry = Registry(self._host_object, self._discard, loop.call_soon)
        self._switch = Switch(host, self._accept)
        self._sessions: set[Session] = set()
        self._streams: weakref.WeakSet[SocketStream] = weakref.WeakSet()
        self._lock = threading.Lock()
        self._door: socket.socket | None = None
        self._access: Access | None = None
        self.directory: str | None = None
        self._closed = False

    @property
    def access(self) -> Access:
        """What other processes of this host have to be told; opens the door."""
        with self._lock:
            if self._access is None:
                self._access = self._open_door()
            return self._access

    @property
    def access_if_open(self) -> Access | None:
        """The same, if anybody was told yet."""
        return self._access

    def on_loop(self) -> bool:
        """Whether the caller is the thread that serves this hub."""
        return self._loop.on_thread()

    def dial(self) -> socket.socket:
        """A stream to this hub for its own process.  Any thread."""
        ours, theirs = socketpair("using a pipe or queue of another host")
        self._loop.call_soon(self._admit, theirs)
        return blocking(QuietSocket(fileno=ours.detach()))

    def link(self, host: str | None, send: Send, *, dialer: bool) -> Tunnels:
        """The hub of ``host`` can be reached by tunnels whose frames go out by ``send``.

        None stands for every host that has no link of its own, as an agent's link to the master.
        """
        return self._switch.link(host, send, dialer=dialer)

    def unlink(self, host: str | None, reason: str) -> None:
        """That link is over; whoever used it is told ``reason``."""
        self._switch.unlink(host, reason)

    def connect(self, host: str, stream: Stream) -> None:
        """Lead ``stream`` to the hub of ``host``."""
        self._switch.connect(host, stream)

    def ended(self, session: Session) -> None:
        """A session is over."""
        self._sessions.discard(session)

    def close(self) -> None:
        """End all streams, let go of all objects, leave no file.  On the loop, or after its end."""
        if self._closed:
            return
        self._closed = True
        for session in list(self._sessions):
            session.close("the program that keeps it has ended")
        for stream in list(self._streams):
            stream.finish("the program has ended")
        self.registry.close()
        with self._lock:
            if self._door is not None:
                self._loop.unregister(self._door.fileno())
                self._door.close()
        self._poller.close()
        if self.directory is not None:
            remove_directory(self.directory)

    # The door

    def _open_door(self) -> Access:
        self.directory = tempfile.mkdtemp(prefix="fiber-", dir=self._parent)
        address = os.path.join(self.directory, "hub")
        try:
            with naming_the_limit("opening the hub"):
                door = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
            with contextlib.ExitStack() as undo:
                undo.callback(door.close)
                _bind(door, address)
                door.listen(4096)
                undo.pop_all()
        except BaseException:
            remove_directory(self.directory)
            self.directory = None
            raise
        self._door = door
        self._loop.register(door.fileno(), self._knocked)
        return Access(self.host, address, self.key)

    def _knocked(self) -> None:
        assert self._door is not None
        try:
            sock, _ = self._door.accept()
        except BlockingIOError:
            return
        except OSError as error:
            if error.errno not in (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM):
                raise
            # Who knocked waits; without this pause the loop would do nothing else.
            self._loop.unregister(self._door.fileno())
            self._loop.call_later(_RETRY, self._listen_again)
            return
        _, uid, _ = _PEER.unpack(sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _PEER.size))
        if uid in (os.geteuid(), 0):
            self._admit(sock)
        else:
            sock.close()

    def _listen_again(self) -> None:
        if self._door is not None and self._door.fileno() >= 0:
            self._loop.register(self._door.fileno(), self._knocked)

    def _admit(self, sock: socket.socket) -> None:
        stream = SocketStream(self._poller, sock)
        self._streams.add(stream)
        self._accept(stream)

    def _accept(self, stream: Stream) -> None:
        self._sessions.add(Session(self, stream))

    # The objects

    def _host_object(self, kind: Kind, fd: int) -> Hosted:
        if kind is Kind.CHANNEL:
            return HostedChannel(self._poller, fd)
        return HostedCounter(self._poller, fd)

    def _discard(self, hosted: Hosted) -> None:
        if self._closed or self._loop.on_thread():
            hosted.close()
        else:
            self._loop.call_soon(hosted.close)


def remove_directory(path: str) -> None:
    """Remove a hub's directory, also after its process was killed; nothing if it is gone."""
    shutil.rmtree(path, ignore_errors=True)


def _bind(door: socket.socket, address: str) -> None:
    try:
        door.bind(address)
    except OSError as error:
        if error.errno != errno.ENAMETOOLONG and "too long" not in str(error):
            raise
        raise OSError(
            errno.ENAMETOOLONG,
            f"the path {address!r} is too long for a unix socket: set FIBER_RUNTIME_DIRECTORY "
            "(runtime_directory) to a directory with a short path",
        ) from error
