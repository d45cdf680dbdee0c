"""Server of ``kubernetes_api`` for clients that block: its loop runs on a separate thread."""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from typing import TypeVar

from fakes.kubernetes_api import KubernetesApi
from fakes.store import Body, Store
from patience import PATIENCE

T = TypeVar("T")


class Served:
    """Served ``api`` and its ``store``; only ``do`` may change the store."""

    def __init__(self, api: KubernetesApi, loop: asyncio.AbstractEventLoop) -> None:
        self.api = api
        self.store = api.store
        self._loop = loop

    def do(self, function: Callable[..., T], *arguments: object) -> T:
        """Call it on the server's thread."""
        done: concurrent.futures.Future[T] = concurrent.futures.Future()

        def call() -> None:
            try:
                done.set_result(function(*arguments))
            except BaseException as error:
                done.set_exception(error)

        self._loop.call_soon_threadsafe(call)
        return done.result(PATIENCE)

    def objects(self, plural: str) -> list[Body]:
        """Return the existing ones in all namespaces."""
        return self.do(self.store.list, plural)


@contextlib.contextmanager
def served(tls: ssl.SSLContext | None = None) -> Iterator[Served]:
    """A new API with an empty store."""
    started: concurrent.futures.Future[Served] = concurrent.futures.Future()
    end = asyncio.Event()

    async def serve() -> None:
        api = KubernetesApi(Store(time.monotonic))
        async with api.serving(tls):
            started.set_result(Served(api, asyncio.get_running_loop()))
            await end.wait()

    thread = threading.Thread(target=asyncio.run, args=(serve(),), name="fake API")
    thread.start()
    try:
        server = started.result(PATIENCE)
        yield server
    finally:
        server.do(end.set)
        thread.join()
