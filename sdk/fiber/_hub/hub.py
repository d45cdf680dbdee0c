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
from fiber._hub.client import NoHub
from fiber._hub.client_handler import ClientHandler
from fiber._hub.hosted import Hosted, HostedChannel, HostedCounter
from fiber._hub.local import QuietSocket, without_timeout
from fiber._hub.poller import Poller
from fiber._hub.protocol import HubAddress, ObjectKind
from fiber._hub.registry import Registry
from fiber._hub.streams import SocketStream, Stream
from fiber._hub.tunnel import Router, Send, Tunnels
from fiber._transport.loop import Loop
from fiber._transport.unix import naming_the_limit, socketpair
from fiber.errors import TooManyOpenFiles

_PEER = struct.Struct("iII")  # pid, uid, gid

_ACCEPT_AGAIN = 0.1
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
        self._router = Router(host, self._accept)
        self._handlers: set[ClientHandler] = set()
        self._streams: weakref.WeakSet[SocketStream] = weakref.WeakSet()
        # A finalizer that shares something may come while this thread holds it.
        self._lock = threading.RLock()
        self._listener: socket.socket | None = None
        self._address: HubAddress | None = None
        self._closed = False

    @property
    def address(self) -> HubAddress:
        """Where other processes of this host find the hub; NoHub if there can be no socket."""
        address = self.address_or_problem
        if address.problem:
            raise NoHub(address.problem)
        return address

    @property
    def address_or_problem(self) -> HubAddress:
        """What the processes of this host are told at birth.  The first call opens the socket.

        If that fails it is not tried again: those who clean up after us know the directory, or that
        there is none, from the first child on.
        """
        with self._lock:
            if self._address is None:
                self._open_socket()
            assert self._address is not None
            return self._address

    @property
    def known_address(self) -> HubAddress | None:
        """The same, if anybody was told yet."""
        return self._address

    @property
    def directory(self) -> str | None:
        """The socket's directory, once it is there."""
        return os.path.dirname(self._address.path) or None if self._address else None

    def on_loop(self) -> bool:
        """Whether the caller is the thread that serves this hub."""
        return self._loop.on_thread()

    def dial(self) -> socket.socket:
        """A stream to this hub for its own process.  Any thread."""
        ours, theirs = socketpair("using a pipe or queue of another host")
        self._loop.call_soon(self._admit, theirs)
        return without_timeout(QuietSocket(fileno=ours.detach()))

    def link(self, host: str | None, send: Send, *, dialer: bool) -> Tunnels:
        """The hub of ``host`` can be reached by tunnels whose frames go out by ``send``.

        None stands for every host that has no link of its own, as an agent's link to the master.
        """
        return self._router.link(host, send, dialer=dialer)

    def unlink(self, host: str | None, reason: str) -> None:
        """That link is over; whoever used it is told ``reason``."""
        self._router.unlink(host, reason)

    def connect(self, host: str, stream: Stream) -> None:
        """Lead ``stream`` to the hub of ``host``."""
        self._router.connect(host, stream)

    def ended(self, handler: ClientHandler) -> None:
        """A handler is over."""
        self._handlers.discard(handler)

    def close(self) -> None:
        """End all streams, let go of all objects, leave no file.  On the loop, or after its end."""
        if self._closed:
            return
        self._closed = True
        for handler in list(self._handlers):
            handler.close("the program that keeps it has ended")
        for stream in list(self._streams):
            stream.finish("the program has ended")
        self.registry.close()
        with self._lock:
            if self._listener is not None:
                self._loop.unregister(self._listener.fileno())
                self._listener.close()
        self._poller.close()
        if self.directory is not None:
            remove_directory(self.directory)

    # The socket

    def _open_socket(self) -> None:
        try:
            sock, path = _listen(self._parent)
        except TooManyOpenFiles:
            raise
        except OSError as error:
            self._address = HubAddress(self.host, "", self.key, _problem(error))
            return
        address = HubAddress(self.host, path, self.key)
        if self._address is not None:  # a finalizer that came meanwhile has opened one
            sock.close()
            remove_directory(os.path.dirname(path))
            return
        self._listener, self._address = sock, address
        self._loop.register(sock.fileno(), self._accept_socket)

    def _accept_socket(self) -> None:
        assert self._listener is not None
        try:
            sock, _ = self._listener.accept()
        except BlockingIOError:
            return
        except OSError as error:
            if error.errno not in (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM):
                raise
            # Who knocked waits; without this pause the loop would do nothing else.
            self._loop.unregister(self._listener.fileno())
            self._loop.call_later(_ACCEPT_AGAIN, self._listen_again)
            return
        _, uid, _ = _PEER.unpack(sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _PEER.size))
        if uid in (os.geteuid(), 0):
            self._admit(sock)
        else:
            sock.close()

    def _listen_again(self) -> None:
        if self._listener is not None and self._listener.fileno() >= 0:
            self._loop.register(self._listener.fileno(), self._accept_socket)

    def _admit(self, sock: socket.socket) -> None:
        stream = SocketStream(self._poller, sock)
        self._streams.add(stream)
        self._accept(stream)

    def _accept(self, stream: Stream) -> None:
        self._handlers.add(ClientHandler(self, stream))

    # The objects

    def _host_object(self, kind: ObjectKind, fd: int) -> Hosted:
        if kind is ObjectKind.CHANNEL:
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


def _listen(parent: str | None) -> tuple[socket.socket, str]:
    """A socket in a directory of its own in ``parent``, or in the system's place for such."""
    directory = tempfile.mkdtemp(prefix="fiber-", dir=parent)
    path = os.path.join(directory, "hub")
    with contextlib.ExitStack() as undo:
        undo.callback(remove_directory, directory)
        with naming_the_limit("opening the hub"):
            sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        undo.callback(sock.close)
        sock.bind(path)
        sock.listen(4096)
        undo.pop_all()
    return sock, path


def _problem(error: OSError) -> str:
    return (
        "no pipe, queue or event can be shared with another process of this host: Fiber keeps a "
        f"socket for it in a temporary directory, and there can be none ({error}). Set "
        "FIBER_RUNTIME_DIRECTORY (runtime_directory) to a directory that can be written to and has "
        "a short path, and start the program again"
    )
