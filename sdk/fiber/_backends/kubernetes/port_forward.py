"""Port-forward of the API server: a connection to a port of a pod, over a WebSocket.

The API server, the kubelet and the container runtime pass the bytes on to the loopback of the pod.
Each message of the WebSocket begins with the number of a channel: 0 has the bytes of the
connection, 1 has the reason if the connection failed.  The first message of each channel repeats
the port (``v4.channel.k8s.io``).

The package ``websocket-client``, which the package ``kubernetes`` needs too, makes the connection
and the frames.
"""

from __future__ import annotations

import ssl
from collections import deque
from typing import TYPE_CHECKING, Any, NamedTuple

from fiber._transport.multiplexer import send
from fiber_api.rest import ServerUnreachable, document_of

if TYPE_CHECKING:
    from websocket import WebSocket

_PROTOCOL = "v4.channel.k8s.io"
_DATA, _ERROR = 0, 1
_MOST = 256 << 10
"""Bytes that one ``receive`` returns, at most."""


class PortForwardRequest(NamedTuple):
    """Request for a port-forward."""

    url: str
    """Address, with the scheme ``wss`` or ``ws``."""
    authorization: str | None
    context: ssl.SSLContext
    server_name: str | None
    """Name that the API server's certificate must have, if it is not the URL's host."""
    proxy: dict[str, Any]
    """Keywords of ``WebSocket.connect`` for a proxy."""

    def connect(self, timeout: float) -> PortForward:
        """Open the port-forward.  Blocks at most ``timeout`` seconds for each step.

        ``ApiError`` as for other calls.
        """
        import websocket

        try:
            return PortForward(self._connect(timeout))
        except websocket.WebSocketBadStatusException as error:
            document_of(error.status_code, error.resp_headers or {}, error.resp_body or b"")
            raise ServerUnreachable(str(error)) from error
        except (websocket.WebSocketException, OSError) as error:
            raise ServerUnreachable(str(error) or type(error).__name__) from error

    def _connect(self, timeout: float) -> WebSocket:
        import websocket

        options: dict[str, Any] = {"context": self.context}
        if self.server_name:
            options["server_hostname"] = self.server_name
        client = websocket.WebSocket(sslopt=options, skip_utf8_validation=True)
        client.settimeout(timeout)
        header = [f"Authorization: {self.authorization}"] if self.authorization else []
        client.connect(  # type: ignore[no-untyped-call]
            self.url,
            header=header,
            subprotocols=[_PROTOCOL],
            suppress_origin=True,
            **self.proxy,
        )
        return client


class PortForward:
    """Open port-forward, as a ``Carrier``: it never blocks."""

    def __init__(self, client: WebSocket) -> None:
        import websocket

        if client.sock is None:
            raise ConnectionResetError("the API server closed the port-forward")

        self._create_frame = websocket.ABNF.create_frame
        self._binary, self._close = websocket.ABNF.OPCODE_BINARY, websocket.ABNF.OPCODE_CLOSE
        self._ping, self._pong = websocket.ABNF.OPCODE_PING, websocket.ABNF.OPCODE_PONG
        self._sock = client.sock
        self._sock.setblocking(False)
        self._frames = websocket.frame_buffer(self._receive, skip_utf8_validation=True)
        self._begun = [False, False]
        """Flags of the channels: True once the first message has come."""
        self.backlog = 0
        self._kept: deque[memoryview] = deque()

    def fileno(self) -> int:
        """Return the socket's descriptor."""
        return int(self._sock.fileno())

    def receive(self) -> bytes | None:
        """Return bytes of the connection; OSError with the words of the cluster if it failed."""
        found: list[bytes] = []
        size = 0
        try:
            while size < _MOST:
                piece = self._message()
                if piece is None:
                    return b"".join(found) if found else b""
                found.append(piece)
                size += len(piece)
        except BlockingIOError:
            if not found:
                return None
        return b"".join(found) or None

    def write(self, data: bytes) -> None:
        """Send ``data`` as one message, or keep what cannot be sent now."""
        self._keep(bytes((_DATA,)) + data, self._binary)

    def flush(self) -> None:
        """Send what was kept."""
        while self._kept:
            sent = self._send(self._kept[0])
            if not sent:
                return
            self.backlog -= sent
            if sent == len(self._kept[0]):
                self._kept.popleft()
            else:
                self._kept[0] = self._kept[0][sent:]

    def close(self) -> None:
        """Close the connection."""
        self._sock.close()

    def _keep(self, payload: bytes, opcode: int) -> None:
        message = memoryview(self._create_frame(payload, opcode).format())
        self._kept.append(message)
        self.backlog += len(message)
        if len(self._kept) == 1:
            self.flush()

    def _message(self) -> bytes | None:
        """Return the bytes of the next message, and None at the end.

        BlockingIOError: no message is there now.
        """
        frame = self._frames.recv_frame()
        payload = frame.data if isinstance(frame.data, bytes) else frame.data.encode()
        if frame.opcode == self._close:
            return None
        if frame.opcode == self._ping:
            self._keep(payload, self._pong)
            return b""
        if frame.opcode != self._binary or not frame.fin:
            raise ConnectionResetError("the API server sent a message of an unknown kind")
        if not payload or payload[0] > _ERROR:
            return b""
        channel = payload[0]
        if not self._begun[channel]:
            self._begun[channel] = True
            return b""
        if channel == _ERROR:
            raise OSError(payload[1:].decode(errors="replace").strip())
        return payload[1:]

    def _receive(self, size: int) -> bytes:
        try:
            found: bytes = self._sock.recv(size)
        except (ssl.SSLWantReadError, ssl.SSLWantWriteError):
            raise BlockingIOError from None
        if not found:
            raise ConnectionResetError("the API server closed the port-forward")
        return found

    def _send(self, data: memoryview) -> int:
        try:
            return send(self._sock, data)
        except (ssl.SSLWantWriteError, ssl.SSLWantReadError):
            return 0
