"""Port-forwards of a fake API server: WebSockets whose messages lead to a port of this machine.

``PortForwards`` serves them.  ``message`` makes frames of a WebSocket for tests without a server.
"""

from __future__ import annotations

import asyncio
import contextlib
import struct

from aiohttp import WSMsgType, web

PROTOCOL = "v4.channel.k8s.io"
CONTINUATION, TEXT, BINARY, CLOSE, PING, PONG = 0, 1, 2, 8, 9, 10
DATA, ERROR = 0, 1


def frame(payload: bytes, opcode: int = BINARY, *, last: bool = True, reserved: int = 0) -> bytes:
    """Return a frame as a server sends it."""
    first = (0x80 if last else 0) | reserved << 4 | opcode
    if len(payload) < 126:
        return bytes((first, len(payload))) + payload
    if len(payload) < 1 << 16:
        return struct.pack(">BBH", first, 126, len(payload)) + payload
    return struct.pack(">BBQ", first, 127, len(payload)) + payload


def message(channel: int, data: bytes) -> bytes:
    """Return a message of a channel in one frame."""
    return frame(bytes([channel]) + data)


def greetings(port: int) -> bytes:
    """Return the first messages of both channels."""
    return b"".join(message(channel, struct.pack("<H", port)) for channel in (DATA, ERROR))


class Forward:
    """Port-forward that is open.  Its functions run on the server's thread."""

    def __init__(self, request: web.Request, socket: web.WebSocketResponse) -> None:
        assert request.transport is not None
        self._transport: asyncio.Transport = request.transport
        self._socket = socket

    def send(self, data: bytes) -> None:
        """Send bytes that need not be a frame."""
        self._transport.write(data)

    def abort(self) -> None:
        """Break the connection without a word."""
        self._transport.abort()

    async def pump(self, target: int) -> None:
        """Carry bytes between the WebSocket and a port until one of them ends."""
        try:
            reader, writer = await asyncio.open_connection("127.0.0.1", target)
        except OSError as error:
            self.send(message(ERROR, f"error forwarding port {target}: {error}".encode()))
            await self._socket.receive()
            return
        down = asyncio.ensure_future(self._down(reader))
        try:
            async for got in self._socket:
                if got.type is not WSMsgType.BINARY:
                    break
                writer.write(got.data[1:])
                await writer.drain()
        finally:
            down.cancel()
            with contextlib.suppress(asyncio.CancelledError, ConnectionError):
                await down
            writer.close()
            with contextlib.suppress(ConnectionError):
                await writer.wait_closed()

    async def _down(self, reader: asyncio.StreamReader) -> None:
        while data := await reader.read(1 << 17):
            await self._socket.send_bytes(bytes([DATA]) + data)
        await self._socket.close()


class PortForwards:
    """All port-forwards of one fake API server."""

    def __init__(self) -> None:
        self.target = 0
        """Port on 127.0.0.1 that they lead to."""
        self.opened: list[Forward] = []

    async def serve(self, request: web.Request) -> web.StreamResponse:
        """Serve one of them."""
        socket = web.WebSocketResponse(protocols=(PROTOCOL,), max_msg_size=0, compress=False)
        await socket.prepare(request)
        forward = Forward(request, socket)
        forward.send(greetings(int(request.query["ports"])))
        self.opened.append(forward)
        with contextlib.suppress(ConnectionError):
            await forward.pump(self.target)
        return socket
