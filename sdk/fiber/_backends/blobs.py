"""Blobs on their way to the agents: from the master, or from an agent that has them.

Each agent has a ``BlobSender``, which knows what the agent has.  The agents of one shape share a
``Fanout``: it carries out the plan of ``fiber._engine.fanout`` for each large blob.
"""

from __future__ import annotations

import ipaddress
import itertools
import secrets
import weakref
from collections.abc import Callable, Iterable
from functools import partial
from typing import Protocol

from fiber import _logs
from fiber._engine.fanout import WORTH, Spread, Transfer
from fiber._transport.authentication import parse_address
from fiber._transport.loop import EventLoop
from fiber._wire import messages
from fiber._wire.blob_messages import (
    RECEIVER,
    Fetch,
    Forget,
    Holding,
    KeepBlob,
    Lacking,
    Serve,
    Unfetched,
)
from fiber._wire.memory_files import Blob
from fiber.errors import ConfigError
from fiber_api import identity


class Send(Protocol):
    """Function that sends a message, and calls ``on_left`` once the whole message has left."""

    def __call__(
        self, message: messages.LinkMessage, on_left: Callable[[], None] | None = None
    ) -> None: ...


class BlobSender:
    """Sender of blobs to one agent, by itself or by the ``fanout``.

    It sends each blob once, and Forget when no object refers to the blob.  So an agent keeps no
    more blobs than this program does.  A blob lives as long as a pool, a child or the program
    refers to it.  Runs on the loop thread.
    """

    def __init__(self, loop: EventLoop, send: Send, fanout: Fanout | None = None) -> None:
        self._loop = loop
        self._send = send
        self._fanout = fanout
        self._sent: dict[bytes, list[weakref.ref[Blob]]] = {}
        """Objects with the content of each blob that was sent."""
        self._lacking: set[bytes] = set()
        """Blobs that were sent, and that the agent has lost or could not keep."""
        self._leaving: dict[bytes, int] = {}
        """Number of times that each blob was sent and has not left."""
        self._ordered: dict[bytes, int] = {}
        """Blobs that the fanout brings and that are not there yet, with the number of the order.

        The number is 0 before the order.
        """
        self._waiting: list[tuple[list[bytes], Callable[[], None]]] = []
        """Blobs that a caller needs, and the function to call when they have left."""

    def send_missing(self, blobs: Iterable[Blob], then: Callable[[], None]) -> None:
        """Send the blobs that the agent does not have, and call ``then`` when all have left.

        Without this wait a small message could overtake a large blob.
        """
        needed, missing = [], []
        for blob in blobs:
            needed.append(blob.digest)
            if blob.digest not in self._sent or blob.digest in self._lacking:
                self._lacking.discard(blob.digest)
                missing.append(blob)
            self._note(blob)
        for blob in missing:
            self._bring(blob)
        self._waiting.append((needed, then))
        self._go_on()

    def _note(self, blob: Blob) -> None:
        known = self._sent.setdefault(blob.digest, [])
        if not any(one() is blob for one in known):
            known.append(weakref.ref(blob, self._forgetter(blob.digest)))

    def _bring(self, blob: Blob) -> None:
        digest = blob.digest
        self._leaving[digest] = self._leaving.get(digest, 0) + 1
        if self._fanout is not None and len(blob.data) >= WORTH:
            self._ordered[digest] = 0
            self._fanout.want(self, blob)
        else:
            self._send(KeepBlob(digest, blob.data), partial(self._left, digest))

    def on_report(self, message: Lacking | Holding | Unfetched) -> None:
        """Handle what the agent says about a blob."""
        if isinstance(message, Lacking):
            if message.digest in self._ordered:
                return  # of an earlier start: the blob is on its way again
            self._lacking.add(message.digest)
            if self._fanout is not None:
                self._fanout.gone(self, message.digest)
        elif self._fanout is None or message.digest not in self._sent:
            return  # a report that was not asked for, or of a blob that is forgotten
        elif isinstance(message, Holding):
            self._fanout.holding(self, message)
        else:
            self._fanout.unfetched(self, message)

    def retire(self) -> None:
        """Note that the agent will end."""
        if self._fanout is not None:
            self._fanout.retire(self)

    def close(self) -> None:
        """Note that the agent is lost."""
        if self._fanout is not None:
            self._fanout.lost(self)

    # Orders of the fanout

    def send_copy(self, blob: Blob, number: int, port: int) -> None:
        """Send a blob that the agent then serves to others at ``port``."""
        self._ordered[blob.digest] = number
        self._send(KeepBlob(blob.digest, blob.data), partial(self.brought, blob.digest, number))
        self._send(Serve(blob.digest, number, port))

    def order(self, message: Fetch) -> None:
        """Have the agent fetch a blob from another one."""
        self._ordered[message.digest] = message.number
        self._send(message)

    def brought(self, digest: bytes, number: int) -> None:
        """Note that an order is carried out, unless a later one has replaced it."""
        if self._ordered.get(digest) == number:
            self._end_order(digest)

    def _end_order(self, digest: bytes) -> None:
        del self._ordered[digest]
        self._left(digest)

    def _left(self, digest: bytes) -> None:
        self._leaving[digest] -= 1
        if not self._leaving[digest]:
            del self._leaving[digest]
            self._go_on()

    def _go_on(self) -> None:
        waiting, self._waiting = self._waiting, []
        for needed, then in waiting:
            if self._leaving.keys().isdisjoint(needed):
                then()
            else:
                self._waiting.append((needed, then))

    def _forgetter(self, digest: bytes) -> Callable[[object], None]:
        # A finalizer runs on any thread, and may only put a call into the loop's queue.
        return lambda _: self._loop.call_soon(self._forget, digest)

    def _forget(self, digest: bytes) -> None:
        if digest not in self._sent:
            return
        self._sent[digest] = [one for one in self._sent[digest] if one() is not None]
        if self._sent[digest]:
            return  # another object has the same content
        del self._sent[digest]
        self._lacking.discard(digest)
        self._send(Forget(digest))
        if self._fanout is not None:
            self._fanout.gone(self, digest)
        if digest in self._ordered:
            self._end_order(digest)


class _Spreading:
    """Spread of one blob, and the agents that serve it."""

    def __init__(self, plan: Spread[BlobSender]) -> None:
        self.plan = plan
        self.blob: Blob | None = None
        """The blob, while an agent needs it; then the master has no need to keep it."""
        self.sources: dict[BlobSender, Holding] = {}
        self.agents: set[BlobSender] = set()


def _is_usable(holding: Holding) -> bool:
    """Tell whether an agent serves a blob, and gives an address and keys that others can use."""
    try:
        host, _ = parse_address(holding.address)
        ipaddress.ip_address(host.partition("%")[0])
        identity.check_key(holding.key)
        identity.check_key(holding.certificate)
    except (ConfigError, ValueError):
        return False
    return True


class Fanout:
    """Spread of large blobs over the agents of one shape.  Runs on the loop thread.

    The agents serve each other at ``port``; 0 takes a free one on each host.
    """

    def __init__(self, port: int) -> None:
        self._port = port
        self._blobs: dict[bytes, _Spreading] = {}
        self._numbers = itertools.count(1)
        """Numbers of the orders for all blobs."""
        self._retired: set[BlobSender] = set()
        """Agents that will end."""
        self._reachable = True
        """False once no agent reached another one: the master serves all."""

    def want(self, agent: BlobSender, blob: Blob) -> None:
        """Bring a blob to an agent."""
        spreading = self._blobs.get(blob.digest)
        if spreading is None:
            plan = Spread(reachable=self._reachable, numbers=self._numbers, retired=self._retired)
            spreading = self._blobs[blob.digest] = _Spreading(plan)
        spreading.blob = blob
        spreading.agents.add(agent)
        self._carry_out(blob.digest, spreading, spreading.plan.want(agent))

    def holding(self, agent: BlobSender, message: Holding) -> None:
        """Note that an agent has a blob."""
        spreading = self._blobs.get(message.digest)
        if spreading is not None and spreading.plan.is_under_way(agent, message.number):
            agent.brought(message.digest, message.number)
            serves = _is_usable(message)
            if serves:
                spreading.sources[agent] = message
            orders = spreading.plan.arrived(agent, message.number, serves=serves)
            self._carry_out(message.digest, spreading, orders)

    def unfetched(self, agent: BlobSender, message: Unfetched) -> None:
        """Note that a transfer to an agent has failed."""
        spreading = self._blobs.get(message.digest)
        if spreading is not None:
            _logs.debug("an agent did not get a blob from another one: %s", message.reason)
            orders = spreading.plan.failed(agent, message.number)
            self._carry_out(message.digest, spreading, orders)

    def retire(self, agent: BlobSender) -> None:
        """Let an agent serve no new receivers."""
        self._retired.add(agent)

    def gone(self, agent: BlobSender, digest: bytes) -> None:
        """Note that an agent does not have a blob, or needs it no more."""
        spreading = self._blobs.get(digest)
        if spreading is not None and agent in spreading.agents:
            spreading.agents.discard(agent)
            spreading.sources.pop(agent, None)
            self._carry_out(digest, spreading, spreading.plan.gone(agent))

    def lost(self, agent: BlobSender) -> None:
        """Note that an agent is lost."""
        self._retired.discard(agent)
        for digest in list(self._blobs):
            self.gone(agent, digest)

    def _carry_out(
        self, digest: bytes, spreading: _Spreading, orders: list[Transfer[BlobSender]]
    ) -> None:
        for receiver, source, number in orders:
            blob = spreading.blob
            assert blob is not None  # kept while an agent waits
            if source is None:
                receiver.send_copy(blob, number, self._port)
            else:
                receiver.order(self._fetch(blob, number, spreading.sources[source]))
        if not spreading.plan.reachable and self._reachable:
            self._reachable = False
            _logs.debug("agents do not reach each other, so the master sends all blobs")
        if spreading.plan.idle:
            spreading.blob = None
        if not spreading.agents:
            del self._blobs[digest]

    def _fetch(self, blob: Blob, number: int, source: Holding) -> Fetch:
        uid = secrets.token_hex(16)
        return Fetch(
            blob.digest,
            number,
            len(blob.data),
            source.address,
            uid,
            identity.agent_key(source.key, RECEIVER, uid),
            source.certificate,
            self._port,
        )
