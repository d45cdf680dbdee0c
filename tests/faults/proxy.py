"""A wire that a test can cut: a TCP proxy between the agents and their master."""

from __future__ import annotations

import selectors
import socket
import threading
from types import TracebackType


class Proxy:
    """Proxy that forwards to ``target`` (``host:port``) until cut; it runs on a separate thread.

    ``silence``: packets vanish, as with an unplugged cable.  ``sever``: connections break and new
    ones are refused, as with a crashed host.  ``heal`` ends either.
    """

    def __init__(self, target: str, at: tuple[str, int] = ("127.0.0.1", 0)) -> None:
        host, _, port = target.rpartition(":")
        self._target = host, int(port)
        self._door = socket.create_server(at)
        self.address = "{}:{}".format(*self._door.getsockname())
        self._selector = selectors.DefaultSelector()
        self._peers: dict[socket.socket, socket.socket] = {}
        self._silent = threading.Event()
        self._severed = False
        self._lock = threading.Lock()
        self._wake_in, self._wake_out = socket.socketpair()
        self._over = False
        self.connections = 0
        self.break_after: int | None = None
        """Bytes after which all connections break, once; new ones are taken."""
        self.silent_after: int | None = None
        """Bytes after which no packet gets through until ``heal``."""
        self._selector.register(self._door, selectors.EVENT_READ)
        self._selector.register(self._wake_out, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._run, name="proxy")
        self._thread.start()

    def __enter__(self) -> Proxy:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._over = True
        self._wake_in.send(b"x")
        self._thread.join()
        self._hang_up()
        self._selector.close()
        for sock in (self._door, self._wake_in, self._wake_out):
            sock.close()

    def lead_to(self, target: str) -> None:
        """Forward new connections there, as a Service does; those that are there stay."""
        host, _, port = target.rpartition(":")
        with self._lock:
            self._target = host, int(port)

    def silence(self) -> None:
        with self._lock:
            self._silent.set()

    def sever(self) -> None:
        with self._lock:
            self._severed = True
            self._hang_up()

    def heal(self) -> None:
        """Let packets through again, over new connections.

        Packets that a silent wire swallowed were not acknowledged. So the old connections break,
        as TCP's do after its retransmissions.
        """
        with self._lock:
            self._severed = False
            self._silent.clear()
            self._hang_up()

    def _run(self) -> None:
        while not self._over:
            for key, _ in self._selector.select():
                with self._lock:
                    self._serve(key.fileobj)

    def _serve(self, ready: object) -> None:
        if ready is self._door:
            self._accept()
        elif isinstance(ready, socket.socket) and ready in self._peers:
            self._forward(ready)

    def _accept(self) -> None:
        inner, _ = self._door.accept()
        if self._severed or self._silent.is_set():
            inner.close()
            return
        try:
            outer = socket.create_connection(self._target)
        except OSError:  # no process listens there now
            inner.close()
            return
        self.connections += 1
        for one, other in ((inner, outer), (outer, inner)):
            self._peers[one] = other
            self._selector.register(one, selectors.EVENT_READ)

    def _forward(self, source: socket.socket) -> None:
        try:
            data = source.recv(1 << 16)
            if self._silent.is_set():
                if not data:
                    self._selector.unregister(source)
                return
            if data:
                self._peers[source].sendall(data)
                self._count(len(data))
                return
        except OSError:
            pass  # one side broke: so does the other
        self._drop(source)

    def _count(self, size: int) -> None:
        if self.silent_after is not None:
            self.silent_after -= size
            if self.silent_after <= 0:
                self.silent_after = None
                self._silent.set()
        if self.break_after is not None:
            self.break_after -= size
            if self.break_after <= 0:
                self.break_after = None
                self._hang_up()

    def _drop(self, source: socket.socket) -> None:
        for sock in (source, self._peers.pop(source)):
            self._peers.pop(sock, None)
            if sock.fileno() in self._selector.get_map():
                self._selector.unregister(sock)
            sock.close()

    def _hang_up(self) -> None:
        while self._peers:
            self._drop(next(iter(self._peers)))
