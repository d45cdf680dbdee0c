"""Places that namespaces take in turn.

One namespace that asks for a thousand places does not make another wait for a thousand turns.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import OrderedDict, deque
from collections.abc import AsyncIterator, Iterable
from itertools import zip_longest

from fiber_operator.workqueue import Key


class Turns:
    """``places`` that may be taken at the same time; each further one waits for its turn."""

    def __init__(self, places: int) -> None:
        self._free = places
        self._waiting: OrderedDict[str, deque[asyncio.Future[None]]] = OrderedDict()
        """Waiters by namespace, in the order of their turns."""

    @contextlib.asynccontextmanager
    async def take(self, namespace: str) -> AsyncIterator[None]:
        """Hold a place."""
        await self._acquire(namespace)
        try:
            yield
        finally:
            self._release()

    async def _acquire(self, namespace: str) -> None:
        if self._free:
            self._free -= 1
            return
        turn = asyncio.get_running_loop().create_future()
        self._waiting.setdefault(namespace, deque()).append(turn)
        try:
            await turn
        except asyncio.CancelledError:
            if turn.done() and not turn.cancelled():
                self._release()  # the place was given just before
            raise

    def _release(self) -> None:
        while self._waiting:
            namespace, turns = self._waiting.popitem(last=False)
            turn = turns.popleft()
            if turns:
                self._waiting[namespace] = turns
            if not turn.done():
                turn.set_result(None)
                return
        self._free += 1


def in_turn(keys: Iterable[Key]) -> list[Key]:
    """Return ``keys`` with one of each namespace first, then a second of each, and so on."""
    namespaces: dict[str, list[Key]] = {}
    for key in keys:
        namespaces.setdefault(key.namespace, []).append(key)
    rounds = zip_longest(*namespaces.values())
    return [key for found in rounds for key in found if key is not None]
