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
import urllib.parse
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

_LONGEST = 16 << 20
"""Bytes of a frame, at most.  An API server sends some thousands in one."""


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
            redirect_limit=0,  # another host must not get the login
            **self.proxy,
        )
        return client


def proxy_options(proxy: str | None, no_proxy: str | None) -> dict[str, Any]:
    """Return the keywords of ``WebSocket.connect`` for the URL of a proxy.

    ``no_proxy`` has the hosts that are reached without it, with commas between.
    """
    if not proxy:
        return {}
    parts = urllib.parse.urlsplit(proxy)
    options: dict[str, Any] = {
        "http_proxy_host": parts.hostname,
        "http_proxy_port": parts.port or _PROXY_PORTS.get(parts.scheme, 80),
        "proxy_type": parts.scheme if parts.scheme.startswith("socks") else "http",
        "http_no_proxy": [host.strip() for host in (no_proxy or "").split(",") if host.strip()],
    }
    if parts.username:
        words = (parts.username, parts.password or "")
        options["http_proxy_auth"] = tuple(map(urllib.parse.unquote, words))
    return options


_PROXY_PORTS = {"https": 443, "socks4": 1080, "socks4a": 1080, "socks5": 1080, "socks5h": 1080}


class PortForward:
    """Open port-forward, as a ``Carrier``: it never blocks."""

    def __init__(self, client: WebSocket) -> None:
        import websocket

        if client.sock is None:
            raise ConnectionResetError("the API server closed the port-forward")

        self._abnf = websocket.ABNF
        self._wrong = websocket.WebSocketException
        self._sock = client.sock
        self._sock.setblocking(False)
        self._frames = websocket.frame_buffer(self._receive, skip_utf8_validation=True)
        self._begun = [False, False]
        """Flags of the channels: True once the first message has come."""
        self._part_of: int | None = None
        """Channel of the message of which another frame follows; None if none follows."""
        self._skips = False
        """True if the bytes of that message are not used."""
        self._ended = False
        """True once the API server has sent the end."""
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
                piece = self._piece()
                if piece is None:
                    return b"".join(found)
                found.append(piece)
                size += len(piece)
        except BlockingIOError:
            if not found:
                return None
        return b"".join(found) or None

    def write(self, data: bytes) -> None:
        """Send ``data`` as one message, or keep what cannot be sent now."""
        self._keep(bytes((_DATA,)) + data, self._abnf.OPCODE_BINARY)

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
        message = memoryview(self._abnf.create_frame(payload, opcode).format())
        self._kept.append(message)
        self.backlog += len(message)
        if len(self._kept) == 1:
            self.flush()

    def _piece(self) -> bytes | None:
        """Return the bytes of the connection in the next frame, and None at the end.

        BlockingIOError: no frame is there now.
        """
        if self._ended:
            return None
        try:
            frame = self._frames.recv_frame()
        except self._wrong as error:
            raise ConnectionResetError(f"the API server sent a wrong frame: {error}") from error
        payload = frame.data if isinstance(frame.data, bytes) else frame.data.encode()
        if frame.opcode == self._abnf.OPCODE_CLOSE:
            self._ended = True
            return None
        if frame.opcode == self._abnf.OPCODE_PING:
            self._keep(payload, self._abnf.OPCODE_PONG)
            return b""
        if frame.opcode == self._abnf.OPCODE_PONG:
            return b""
        return self._part(frame.opcode, payload, last=bool(frame.fin))

    def _part(self, opcode: int, payload: bytes, *, last: bool) -> bytes:
        """Return the bytes of the connection in a part of a message, or in a whole message."""
        if opcode == self._abnf.OPCODE_BINARY and self._part_of is None:
            payload = self._begin(payload)
        elif opcode != self._abnf.OPCODE_CONT or self._part_of is None:
            raise ConnectionResetError("the API server sent a message of an unknown kind")
        channel = self._part_of
        if last:
            self._part_of = None
        if self._skips or not payload:
            return b""
        if channel == _ERROR:
            raise OSError(payload.decode(errors="replace").strip())
        return payload

    def _begin(self, payload: bytes) -> bytes:
        """Begin a message; return its bytes without the number of the channel."""
        channel = self._part_of = payload[0] if payload else _ERROR + 1
        self._skips = channel > _ERROR or not self._begun[channel]
        if channel <= _ERROR:
            self._begun[channel] = True
        return payload[1:]

    def _receive(self, size: int) -> bytes:
        if (length := self._frames.length or 0) > _LONGEST:
            raise ConnectionResetError(f"the API server sent a frame of {length} bytes")
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
