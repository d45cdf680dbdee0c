"""aiohttp's client and server in one process, with memory between them in place of sockets.

All of HTTP is spoken; only the kernel is not asked, which takes most of the time of a small call.
"""

from __future__ import annotations

import asyncio
from typing import Any

import aiohttp
from aiohttp.client_proto import ResponseHandler

from fakes.kubernetes_api import KubernetesApi


class _End(asyncio.Transport):
    """End of a connection: the other end's protocol receives the bytes written here."""

    def __init__(self, protocol: asyncio.Protocol) -> None:
        super().__init__({"peername": ("127.0.0.1", 1), "sockname": ("127.0.0.1", 2)})
        self._protocol = protocol
        self._loop = asyncio.get_running_loop()
        self._closed = False
        self.other: _End

    def get_protocol(self) -> asyncio.BaseProtocol:
        return self._protocol

    def set_protocol(self, protocol: asyncio.BaseProtocol) -> None:
        assert isinstance(protocol, asyncio.Protocol)
        self._protocol = protocol

    def write(self, data: Any) -> None:
        if not self._closed:
            self._loop.call_soon(self.other._receive, bytes(data))

    def _receive(self, data: bytes) -> None:
        if not self._closed:
            self._protocol.data_received(data)

    def is_closing(self) -> bool:
        return self._closed

    def is_reading(self) -> bool:
        return not self._closed

    def pause_reading(self) -> None:
        """Do nothing: written bytes are in memory already."""

    def resume_reading(self) -> None: ...

    def close(self) -> None:
        self._lose(None)
        self._loop.call_soon(self.other._lose, None)

    def abort(self) -> None:
        self._lose(None)
        self._loop.call_soon(self.other._lose, ConnectionResetError("reset"))

    def _lose(self, error: Exception | None) -> None:
        if not self._closed:
            self._closed = True
            self._loop.call_soon(self._protocol.connection_lost, error)


class MemoryConnector(aiohttp.BaseConnector):
    """Connects to ``api`` for every address."""

    def __init__(self, api: KubernetesApi) -> None:
        super().__init__(limit=0)
        self._api = api

    async def _create_connection(self, *_: Any) -> ResponseHandler:
        ends = [_End(protocol) for protocol in (self._factory(), self._api.server())]
        for end, other in zip(ends, reversed(ends), strict=True):
            end.other = other
        for end in ends:
            end._protocol.connection_made(end)
        protocol = ends[0].get_protocol()
        assert isinstance(protocol, ResponseHandler)
        return protocol
