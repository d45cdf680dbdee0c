"""Hub: keeps the objects that processes of this host share with others.

There is one hub for each host and program.  It runs in the agent of its host, on the agent's loop.
A process of the same host asks it once for an object's descriptors.  A process of another host
reaches it through a tunnel and uses the object by requests (``fiber._hub.remote``).  A client needs
the hub's key, and a grant for each object.
"""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import select
import socket
import struct
import tempfile
import weakref
from collections import deque
from collections.abc import Callable
from functools import partial
from queue import Empty, SimpleQueue

from fiber._exceptions import fresh
from fiber._hub import protocol
from fiber._hub.client import NoHub, ObjectUnreachable
from fiber._hub.client_handler import ClientHandler
from fiber._hub.directory import HUB_SOCKET, remove_directory
from fiber._hub.heap import block_of
from fiber._hub.hosted import (
    HostedChannel,
    HostedCounter,
    HostedMemory,
    HostedReceiver,
    HostedSemaphore,
    HostedSender,
    HostedWaitList,
)
from fiber._hub.local import LocalChannel, LocalCounter, QuietSocket, without_timeout
from fiber._hub.one_way import ENDS, Backlog, ReceivingEnd
from fiber._hub.protocol import Doorbell, HubAddress, ObjectKind
from fiber._hub.registry import Hosted, Registry, SharedObject
from fiber._hub.replicas import MemoryLink, Replicas
from fiber._hub.streams import Poller, Router, SocketStream, Stream, TunnelFrame, Tunnels
from fiber._transport.channels import naming_the_limit, socketpair
from fiber._transport.loop import DOZE, Loop
from fiber._wire.descriptor import Descriptor, own
from fiber._wire.messages import HubMessage, MemoryMessage
from fiber.errors import TooManyOpenFiles

_PEER = struct.Struct("iII")  # pid, uid, gid

_ACCEPT_AGAIN = 0.1
"""Seconds until the next attempt to accept a stream, if no descriptor is free."""


class Hub:
    """Hub of a host.  Runs on the loop thread, except methods marked "any thread"."""

    def __init__(
        self, loop: Loop, host: str, parent: str | None = None, directory: str | None = None
    ) -> None:
        """``directory``: the one to make for the socket, else one with a new name in ``parent``."""
        self.host = host
        self.key = secrets.token_bytes(protocol.KEY_BYTES)
        self.loop = loop
        self._parent = parent
        self._directory = directory
        self._poller = Poller(loop)
        self.registry = Registry(self._host_object, loop.call_soon)
        self.doorbell = Doorbell(loop.call_soon)
        self.replicas = Replicas(host, self.registry)
        self._router = Router(host, self._accept)
        self._handlers: set[ClientHandler] = set()
        self._streams: weakref.WeakSet[SocketStream] = weakref.WeakSet()
        # If several threads open it at the same time, the first entry is valid.
        self._opened: list[tuple[HubAddress, socket.socket | None]] = []
        self._rests_from_accepting = False
        """True for a moment when no descriptor is free."""
        self._closed = False

    @property
    def address(self) -> HubAddress:
        """Address of the hub for other processes of this host; NoHub if there can be no socket.

        Any thread.
        """
        address = self.address_or_problem
        if address.problem:
            raise NoHub(address.problem)
        return address

    @property
    def address_or_problem(self) -> HubAddress:
        """Address, or problem, for new processes of this host.  The first call opens the socket.

        A failure is final: from the first child on, the processes that clean up know the directory
        or know that there is none.  Any thread.
        """
        if not self._opened:
            self._open_socket()
        return self._opened[0][0]

    @property
    def known_address(self) -> HubAddress | None:
        """Address of the hub if the socket was opened, else None."""
        return self._opened[0][0] if self._opened else None

    @property
    def directory(self) -> str | None:
        """Directory of the socket, once it is opened."""
        address = self.known_address
        return os.path.dirname(address.path) or None if address else None

    def on_loop(self) -> bool:
        """Tell whether the caller runs on the thread that serves this hub."""
        return self.loop.on_thread()

    def dial(self) -> socket.socket:
        """Return the socket of a new stream from this process to its hub.  Any thread."""
        ours, theirs = socketpair("using a pipe or queue of another host")
        self.loop.call_soon(self._admit, theirs)
        return without_timeout(QuietSocket(fileno=ours.detach()))

    def fetch(self, grant: bytes) -> list[Descriptor]:
        """Return an object's descriptors for this process.  Any thread; waits for the loop."""
        if self.loop.on_thread():
            return list(map(own, self.registry.fetch(grant)))
        answers: SimpleQueue[list[Descriptor] | Exception] = SimpleQueue()
        self.loop.call_soon(self._answer, grant, answers)
        while not self._closed and not self.loop.broken:
            try:
                answer = answers.get(timeout=DOZE)
            except Empty:
                continue
            if isinstance(answer, Exception):
                raise fresh(answer)
            return answer
        raise ObjectUnreachable(self.host, "the program that keeps it has ended")

    def _answer(self, grant: bytes, answers: SimpleQueue[list[Descriptor] | Exception]) -> None:
        try:
            answers.put(list(map(own, self.registry.fetch(grant))))
        except Exception as error:
            answers.put(error)

    def link(self, host: str | None, send: SendHubMessage, *, dialer: bool) -> HubLink:
        """Add a link to the hub of ``host``; ``send`` sends its messages.

        None stands for every host without a link here, as for an agent's link to the master.
        """
        link = HubLink(self.loop.call_soon, send)
        link.memory = self.replicas.link(host, send, dialer=dialer)
        link.tunnels = self._router.link(host, link.send, dialer=dialer)
        return link

    def unlink(self, host: str | None, reason: str) -> None:
        """Remove the link to ``host``, which has ended, and close its streams with ``reason``."""
        self._router.unlink(host, reason)
        self.replicas.unlink(host, reason)

    def connect(self, host: str, stream: Stream) -> None:
        """Connect ``stream`` to the hub of ``host``."""
        self._router.connect(host, stream)

    def read_from_ended(self) -> None:
        """Read what processes of this host sent before they ended.

        A stream that waits for credit of another host is read later.
        """
        if self._closed:
            return
        for _, listener in self._opened[:1]:
            while listener is not None and self._accept_socket(listener):
                pass
        poller = select.poll()
        streams = {stream.fileno(): stream for stream in self._streams}
        streams.pop(-1, None)
        for fd in streams:
            poller.register(fd, 0)
        for fd, _ in poller.poll(0):  # an empty mask reports only the end of a stream
            streams[fd].read_rest()

    def ended(self, handler: ClientHandler) -> None:
        """Forget a handler that has ended."""
        self._handlers.discard(handler)

    def close(self) -> None:
        """End all streams, drop all objects, remove all files.  On the loop, or after its end."""
        if self._closed:
            return
        self._closed = True
        for handler in list(self._handlers):
            handler.close("the program that keeps it has ended")
        for stream in list(self._streams):
            stream.finish("the program has ended")
        self.registry.close()
        for _, listener in self._opened[:1]:
            if listener is not None:
                self.loop.unregister(listener.fileno())
                listener.close()
        self._poller.close()
        if self.directory is not None:
            remove_directory(self.directory)

    # The socket

    def _open_socket(self) -> None:
        try:
            listener, path = _listen(self._parent, self._directory)
        except TooManyOpenFiles:
            raise
        except OSError as error:
            self._opened.append((HubAddress(self.host, "", self.key, _problem(error)), None))
            return
        opened = HubAddress(self.host, path, self.key), listener
        try:
            self.loop.register(listener.fileno(), partial(self._accept_socket, listener))
            self._opened.append(opened)
        finally:
            if not self._opened or self._opened[0] is not opened:
                # Another thread, or a handler that interrupted this one, was faster.
                self.loop.unregister(listener.fileno())
                listener.close()
                remove_directory(os.path.dirname(path))

    def _accept_socket(self, listener: socket.socket) -> bool:
        """Accept a stream; return False if there is none."""
        try:
            sock, _ = listener.accept()
        except BlockingIOError:
            return False
        except OSError as error:
            if error.errno not in (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM):
                raise
            # The client still waits.  Without this pause the loop would spin.
            if not self._rests_from_accepting:
                self._rests_from_accepting = True
                self.loop.unregister(listener.fileno())
                self.loop.call_later(_ACCEPT_AGAIN, self._listen_again, listener)
            return False
        _, uid, _ = _PEER.unpack(sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _PEER.size))
        if uid in (os.geteuid(), 0):
            self._admit(sock)
        else:
            sock.close()
        return True

    def _listen_again(self, listener: socket.socket) -> None:
        self._rests_from_accepting = False
        if listener.fileno() >= 0:
            self.loop.register(listener.fileno(), partial(self._accept_socket, listener))

    def _admit(self, sock: socket.socket) -> None:
        stream = SocketStream(self._poller, sock)
        self._streams.add(stream)
        self._accept(stream)

    def _accept(self, stream: Stream) -> None:
        self._handlers.add(ClientHandler(self, stream))

    # The objects

    def _host_object(self, shared: SharedObject) -> Hosted:
        if shared.kind is ObjectKind.MEMORY:
            return HostedMemory()
        fd, *beside = map(own, shared.duplicates())
        if shared.kind is ObjectKind.CHANNEL:
            return HostedChannel(self._poller, LocalChannel(fd))
        if shared.kind in ENDS:
            (segment,) = beside
            end = ENDS[shared.kind](fd, Backlog(block_of(segment, *shared.extent)))
            if isinstance(end, ReceivingEnd):
                return HostedReceiver(self.loop, self._poller, end)
            return HostedSender(self.loop, self._poller, end)
        if shared.kind is ObjectKind.SEMAPHORE:
            return HostedSemaphore(self.loop, self.doorbell, block_of(fd, *shared.extent))
        if shared.kind is ObjectKind.WAIT_LIST:
            return HostedWaitList(self.loop, self.doorbell, block_of(fd, *shared.extent))
        return HostedCounter(self._poller, LocalCounter(fd))


def _listen(parent: str | None, directory: str | None) -> tuple[socket.socket, str]:
    """Return a listening socket and its path, in a new directory.

    The directory is ``directory``, or a temporary one in ``parent``, or else in the system's folder
    for temporary files.
    """
    if directory is None:
        directory = tempfile.mkdtemp(prefix="fiber-", dir=parent)
    else:
        os.mkdir(directory, 0o700)
    path = os.path.join(directory, HUB_SOCKET)
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
        "no pipe, queue, lock or value can be shared with another process of this host: Fiber "
        f"needs a socket in a temporary directory, and cannot make it ({error}). Set "
        "FIBER_RUNTIME_DIRECTORY (runtime_directory) to a writable directory with a short path, "
        "and start the program again"
    )


SendHubMessage = Callable[[HubMessage], None]


class HubLink:
    """Hub's part of a link to another host.  Runs on the loop thread.

    Call ``flush`` before any other message is sent over the link.
    """

    memory: MemoryLink
    tunnels: Tunnels

    def __init__(self, call_soon: Callable[..., None], send: SendHubMessage) -> None:
        self._call_soon = call_soon
        self._send = send
        self._waiting: deque[TunnelFrame] = deque()

    def on_frame(self, frame: HubMessage) -> None:
        """Take a message of the other side's hub."""
        if isinstance(frame, MemoryMessage):
            self.memory.on_frame(frame)
        else:
            self.tunnels.on_frame(frame)

    def send(self, frame: TunnelFrame) -> None:
        """Send a frame of a tunnel, after the changes of shared memory."""
        if not self.memory and not self._waiting:
            self._send(frame)
            return
        # To look for changes takes time, so do it once for all frames of a turn of the loop.
        self._waiting.append(frame)
        if len(self._waiting) == 1:
            self._call_soon(self.flush)

    def flush(self) -> None:
        """Send the changes of shared memory, and the frames that wait for that."""
        self.memory.flush()
        while self._waiting:
            self._send(self._waiting.popleft())
