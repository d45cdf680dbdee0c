"""Blobs of an agent: those that the master sent, and the exchange of large ones between agents.

    master ── Fetch(address, key, …) ──► receiver ── Want(digest) ──► source
                                         receiver ◄── KeepBlob ────── source
    master ◄── Holding(address, key) ─── receiver

Between two agents there is a link like that to the master.  The source is its accepting side, with
a certificate and a key that it has made for this purpose and told the master.  The master gives a
receiver a key that is derived from the source's and serves for one order.  So a stranger is turned
away as at the master's port, and no agent can take another one's place.  The receiver compares the
blob with the digest that the master named, and unpickles nothing.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import partial
from typing import Any

from fiber import _logs
from fiber._transport.authentication import Identity, join_address
from fiber._transport.credentials import Credentials, OwnCredentials, make_credentials
from fiber._transport.dialer import AgentDialer
from fiber._transport.link import Keepalive, Link
from fiber._transport.link_protocol import Frame
from fiber._transport.listener import MasterListener
from fiber._transport.loop import Loop, ScheduledCall
from fiber._wire import messages
from fiber._wire.blob_messages import (
    RECEIVER,
    Fetch,
    Forget,
    Holding,
    KeepBlob,
    Serve,
    Unfetched,
    Want,
)
from fiber._wire.descriptor import contents
from fiber._wire.memory_files import Blob
from fiber.errors import AuthenticationError, FiberError

_REACH = 10.0
"""Seconds in which a receiver must have reached a source."""

_KEEPALIVE = Keepalive(heartbeat=1.0, suspect_after=5.0, lost_after=15.0)
"""Limits of silence between two agents.  A receiver gives up a source that is suspect."""

_SLOWEST = 64 << 10
"""Bytes a second below which a transfer is given up."""

_LINKS = 8
"""Limit of the receivers that a source serves at a time; the master asks for fewer."""

_STEP = 4 << 20
"""Bytes that are hashed in one turn of the loop."""

_CANNOT_SERVE = (FiberError, AuthenticationError, OSError, RuntimeError)
"""Errors of an agent that cannot listen, or that has no descriptor or thread for it."""


class BlobLacking(Exception):
    """Error: the agent does not have a blob.  The text says why."""

    def __init__(self, digest: bytes, reason: str) -> None:
        super().__init__(f"what its master sent ahead is not there: {reason}")
        self.digest = digest


class BlobStore:
    """Blobs of one master, in files in ``directory``, until the master sends Forget.

    Frames come in order.  A blob that is sent before a Start is here when the Start comes.  A child
    that was started before a Forget still has the blob open.
    """

    def __init__(self, directory: str | None) -> None:
        self._directory = directory
        self._blobs: dict[bytes, Blob] = {}
        self._refused: dict[bytes, str] = {}
        """Blobs for which the system had no room, and the reasons."""

    def put(self, message: KeepBlob) -> None:
        """Keep a blob.  If the system refuses that, ``get`` raises the reason."""
        try:
            blob = Blob.in_file(message.digest, message.data, self._directory)
        except OSError as error:
            self._refused[message.digest] = str(error)
            return
        self._refused.pop(message.digest, None)
        self._blobs[message.digest] = blob

    def get(self, digest: bytes) -> Blob:
        """Return a blob that was sent; raise BlobLacking if it is not here."""
        blob = self._blobs.get(digest)
        if blob is None:
            raise BlobLacking(digest, self._refused.pop(digest, "it was forgotten"))
        return blob

    def find(self, digest: bytes) -> Blob | None:
        """Return a blob; None if it is not here."""
        return self._blobs.get(digest)

    def forget(self, digest: bytes) -> None:
        """Delete a blob, which no later Start names."""
        self._blobs.pop(digest, None)
        self._refused.pop(digest, None)


class BlobExchange:
    """Exchange of blobs with other agents, as the master orders.  Runs on the loop thread.

    ``host`` is the address at which other agents may reach this one, empty if there is none.
    ``send`` sends a message to the master.
    """

    def __init__(
        self,
        loop: Loop,
        store: BlobStore,
        host: str,
        send: Callable[[messages.LinkMessage], None],
    ) -> None:
        self._loop = loop
        self._store = store
        self._host = host
        self._send = send
        self._source: BlobSource | None = None
        self._fetches: dict[bytes, BlobFetch] = {}
        self._closed = False

    def serve(self, message: Serve) -> None:
        """Serve a blob that the master has sent."""
        self._end_fetch(message.digest)
        self._tell(message)

    def fetch(self, message: Fetch) -> None:
        """Fetch a blob from another agent."""
        self._end_fetch(message.digest)
        if self._closed:
            return
        if self._store.find(message.digest) is not None:
            self._tell(message)
            return
        self._fetches[message.digest] = BlobFetch(
            self._loop,
            message,
            on_blob=partial(self._fetched, message),
            on_failed=partial(self._failed, message),
        )

    def forget(self, message: Forget) -> None:
        """Forget a blob, and stop its transfer to this agent."""
        self._end_fetch(message.digest)

    def close(self) -> None:
        """End all transfers."""
        self._closed = True
        for digest in list(self._fetches):
            self._end_fetch(digest)
        if self._source is not None:
            self._source.close()

    def _end_fetch(self, digest: bytes) -> None:
        fetch = self._fetches.pop(digest, None)
        if fetch is not None:
            fetch.close()

    def _fetched(self, order: Fetch, message: KeepBlob) -> None:
        self._end_fetch(order.digest)
        self._store.put(message)
        self._tell(order)

    def _failed(self, order: Fetch, reason: str) -> None:
        _logs.debug("a blob did not come from %s: %s", order.address, reason)
        self._end_fetch(order.digest)
        self._send(Unfetched(order.digest, order.number, reason))

    def _tell(self, order: Serve | Fetch) -> None:
        """Tell the master that the blob is here, and how others get it."""
        if self._source is None and self._host and not self._closed:
            address = join_address(self._host, order.port)
            try:
                self._source = BlobSource(self._loop, self._store, address)
            except _CANNOT_SERVE as error:
                _logs.debug("this agent serves no blobs: %s", error)
        source = self._source
        # A blob for which the system has no room is held, too: the child that needs it reports so.
        if source is None or self._store.find(order.digest) is None:
            self._send(Holding(order.digest, order.number))
        else:
            key, certificate = source.credentials.pool_key, source.credentials.fingerprint
            self._send(Holding(order.digest, order.number, source.address, key, certificate))


class BlobSource:
    """Server of the blobs in ``store`` for other agents, at ``address``."""

    def __init__(self, loop: Loop, store: BlobStore, address: str) -> None:
        self._loop = loop
        self._store = store
        self._receivers: set[_Receiver] = set()
        self.credentials: OwnCredentials = make_credentials()
        self._listener = MasterListener(
            loop,
            address,
            self.credentials,
            on_agent=self._joined,
            on_refused=partial(_logs.debug, "%s"),
            keepalive=_KEEPALIVE,
        )
        self.address = self._listener.address

    def close(self) -> None:
        """End all links."""
        for receiver in list(self._receivers):
            receiver.close("this agent ends")
        self._listener.close("this agent ends", linger=0.0)

    def _joined(self, link: Link) -> str | None:
        if len(self._receivers) >= _LINKS:
            return f"this agent serves {_LINKS} others already"
        receiver = _Receiver(self._loop, self._store, link, self._receivers.discard)
        self._receivers.add(receiver)
        link.limit(0)  # a Want fits into one datagram
        link.attach(receiver)
        return None


class _Receiver:
    """Receiver of one blob, as its source sees it; a ``LinkObserver``."""

    def __init__(
        self, loop: Loop, store: BlobStore, link: Link, on_end: Callable[[_Receiver], None]
    ) -> None:
        self._loop = loop
        self._store = store
        self._link = link
        self._on_end = on_end
        self._has_asked = False
        self._limit: ScheduledCall = loop.call_later(_REACH, self.close, "it asked for nothing")

    def on_frame(self, frame: Frame) -> None:
        """Send the blob that the receiver wants."""
        message = messages.decode(frame)
        if not isinstance(message, Want) or self._has_asked:
            raise messages.ProtocolError(f"an agent sent another one a {type(message).__name__}")
        self._has_asked = True
        blob = self._store.find(message.digest)
        if blob is None:
            self.close("this agent does not have the blob")
            return
        data = memoryview(contents(blob.fileno()))
        self._limit.cancel()
        self._limit = self._loop.call_later(_longest(len(data)), self.close, "it took too long")
        self._link.send(*KeepBlob(message.digest, data).pieces())

    def on_suspect(self) -> None:
        """Do nothing: the limit of the time is enough."""

    def on_trusted(self) -> None:
        """Do nothing."""

    def on_lost(self, reason: str) -> None:
        """Note the end of the link."""
        self._limit.cancel()
        self._on_end(self)

    def close(self, reason: str) -> None:
        """End the link."""
        self._limit.cancel()
        self._link.close(reason, linger=0.0)
        self._on_end(self)


class BlobFetch:
    """Transfer of a blob from another agent to this one; a ``LinkObserver``.

    Calls back once, unless it is closed before: ``on_blob`` with the blob that has the digest, or
    ``on_failed`` with the reason.
    """

    def __init__(
        self,
        loop: Loop,
        order: Fetch,
        *,
        on_blob: Callable[[KeepBlob], None],
        on_failed: Callable[[str], None],
    ) -> None:
        self._loop = loop
        self._digest = order.digest
        self._size = order.size
        self._on_blob = on_blob
        self._on_failed = on_failed
        self._over = False
        self._link: Link | None = None
        self._dialer = AgentDialer(
            loop,
            order.address,
            Credentials(RECEIVER, order.uid, order.key, order.certificate),
            Identity.of_this_process(RECEIVER, order.uid),
            on_link=self._joined,
            on_failed=lambda error: self._fail(str(error)),
            timeout=_REACH,
        )
        self._limit = loop.call_later(_longest(order.size), self._fail, "it took too long")

    def close(self) -> None:
        """End the transfer."""
        if not self._over:
            self._end("the transfer was ended")

    def _joined(self, link: Link) -> None:
        if self._over:
            link.close("the transfer was ended", linger=0.0)
            return
        self._link = link
        link.limit(KeepBlob.frame_size(self._size))
        link.attach(self)
        link.send(Want(self._digest).encode())

    def on_frame(self, frame: Frame) -> None:
        """Take the blob."""
        message = messages.decode(frame)
        if not isinstance(message, KeepBlob):
            self._fail(f"it sent a {type(message).__name__} instead of a blob")
        else:
            self._check(message, hashlib.sha256(), 0)

    def on_suspect(self) -> None:
        """Give up a source that is silent."""
        self._fail("it is silent")

    def on_trusted(self) -> None:
        """Do nothing."""

    def on_lost(self, reason: str) -> None:
        """Give up a source whose link has ended."""
        self._fail(reason)

    def _check(self, message: KeepBlob, digest: Any, done: int) -> None:
        """Hash the rest of the blob in turns, and take it if it is the right one."""
        if self._over:
            return
        view = memoryview(message.data)
        digest.update(view[done : done + _STEP])
        if done + _STEP < len(view):
            self._loop.call_soon(self._check, message, digest, done + _STEP)
        elif digest.digest() == self._digest:
            self._end("the blob has come")
            self._on_blob(KeepBlob(self._digest, message.data))
        else:
            self._fail("what it sent is not the blob that the master named")

    def _fail(self, reason: str) -> None:
        if not self._over:
            self._end(reason)
            self._on_failed(reason)

    def _end(self, reason: str) -> None:
        self._over = True
        self._limit.cancel()
        if self._link is None:
            self._dialer.close()
        else:
            self._link.close(reason, linger=0.0)  # that ends the dialer, too


def _longest(size: int) -> float:
    """Return the seconds in which a transfer of so many bytes must be over."""
    return _REACH + size / _SLOWEST
