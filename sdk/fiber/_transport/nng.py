"""Sealed connections over nng, between two sides that have proved themselves.

This is the only module that imports pynng.  Each connection is a Pair1 socket, made of a descriptor
(nng's transport ``socket://``).  Acceptor and dialer have made the descriptor and checked the peer.
Here every message is sealed.

Facts about nng, and their consequences:

* nng queues messages that the connection does not take yet, up to the size of its queue.  A link
  never has so many on the way.
* nng reports the beginning and the end of a connection on a thread of nng.  These callbacks only
  leave a note for the loop.
* If a connection is closed while nng still exchanges its greeting (eight bytes in each direction),
  nng may not close the descriptor.  So such a connection is first shut down, which nng notices in a
  moment, and then closed.
* An nng socket does not survive a fork.  The child must not touch it, and does not close it.
* pynng copies a message twice.  Here a message is sealed into nng's memory, and opened from there,
  without these copies.

Messages are sealed by AES-256-GCM under a counter, with one key for each direction.  The counter is
not sent: both sides count.  A message that was changed, repeated or moved on the way does not open,
and neither does any message after it.  The same holds if a message was left out.  A key serves for
a bounded number of messages and bytes.  Then its successor is derived from it, and the key is
forgotten.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import socket
import threading
import time
import weakref
from collections.abc import Callable
from multiprocessing import util
from typing import Any

import pynng
from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCM
from pynng import _nng

from fiber._transport.authentication import Secrets, expand
from fiber._transport.channels import naming_the_limit
from fiber._transport.link import LinkConnection
from fiber._transport.link_protocol import LARGEST, WINDOW, Datagram
from fiber._transport.loop import Loop
from fiber._wire.memory_files import BytesLike
from fiber._wire.messages import ProtocolError
from fiber.errors import LinkError, TooManyOpenFiles

OVERHEAD = 16
"""Bytes by which a sealed message is longer."""

MESSAGES_PER_KEY = 1 << 20
BYTES_PER_KEY = 1 << 36
"""Bytes well below the limit of GCM: TLS 1.3 stops at about 2**38 (RFC 8446, 5.5)."""

_NONCE = 12

_TURN = 64
"""Limit of the messages read in one turn of the loop.  Then other descriptors get their turn."""

_LARGEST = LARGEST + OVERHEAD + 4
"""Bytes of the longest message.  nng adds a hop count to a datagram."""

_QUEUE = 2 * WINDOW
"""Limit of the messages that nng queues: a link's window, and its acknowledgements."""

_NOTICES = 1.0
"""Seconds for nng to notice the end of a connection; it takes a fraction of a millisecond."""

_lib, _ffi = _nng.lib, _nng.ffi


class Sealer:
    """Sealer of the messages in one direction."""

    def __init__(
        self, secret: bytes, messages: int = MESSAGES_PER_KEY, size: int = BYTES_PER_KEY
    ) -> None:
        self._keys = _Keys(secret, messages, size)

    def seal_into(self, data: BytesLike, sealed: BytesLike) -> None:
        """Write ``data`` sealed to ``sealed``, which is OVERHEAD bytes longer."""
        cipher, nonce = self._keys.next(len(data))
        cipher.encrypt_into(nonce, data, None, sealed)


class _OpenedMessage(threading.local):
    """Memory for the message that a thread has just opened.

    All connections share it.  So it stays in the processor's cache and needs no zeroing, and a
    thousand connections take no more memory than one.
    """

    def __init__(self) -> None:
        self.view = memoryview(bytearray())

    def of(self, size: int) -> memoryview:
        """Return ``size`` bytes of the memory."""
        if size > len(self.view):
            self.view = memoryview(bytearray(size))
        return self.view[:size]


_opened = _OpenedMessage()


class Opener:
    """Opener of the messages in the other direction."""

    def __init__(
        self, secret: bytes, messages: int = MESSAGES_PER_KEY, size: int = BYTES_PER_KEY
    ) -> None:
        self._keys = _Keys(secret, messages, size)

    def open(self, sealed: BytesLike) -> memoryview:
        """Return the next message; ProtocolError if ``sealed`` is not that message.

        The caller must use it before this thread opens another message, of any connection.
        """
        size = len(sealed) - OVERHEAD
        if size < 0:
            raise ProtocolError(f"a sealed message cannot have {len(sealed)} bytes")
        cipher, nonce = self._keys.next(size)
        data = _opened.of(size)
        try:
            cipher.decrypt_into(nonce, sealed, None, data)
        except InvalidTag:
            raise ProtocolError(
                f"a sealed message of {len(sealed)} bytes does not open: it was changed on the "
                "way, or is not the one that comes next"
            ) from None
        return data


class _Keys:
    """Sequence of keys, each with its counter.  Both sides change the key at the same message."""

    def __init__(self, secret: bytes, messages: int, size: int) -> None:
        self._messages = messages
        self._size = size
        self._begin(secret)

    def next(self, size: int) -> tuple[AESGCM, bytes]:
        """Return key and nonce for the next message, which has ``size`` bytes."""
        if self._count == self._messages or self._used + size > self._size:
            self._begin(self._successor)
        nonce = self._count.to_bytes(_NONCE, "big")
        self._count += 1
        self._used += size
        return self._cipher, nonce

    def _begin(self, secret: bytes) -> None:
        self._cipher = AESGCM(expand(secret, b"key"))
        self._successor = expand(secret, b"next")
        self._count = 0
        self._used = 0


class SealedConnection:
    """Connection over nng; a ``LinkConnection``.  Its callbacks run on the loop thread.

    ``on_gone`` is called once when the connection breaks, and not after ``close``.
    """

    def __init__(
        self,
        loop: Loop,
        descriptor: int,
        secrets: Secrets,
        *,
        on_datagram: Callable[[LinkConnection, memoryview], None],
        on_gone: Callable[[LinkConnection], None],
    ) -> None:
        """Take over ``descriptor``, also if an error is raised."""
        self._loop = loop
        self._sealer = Sealer(secrets.outgoing)
        self._opener = Opener(secrets.incoming)
        self._on_datagram = on_datagram
        self._on_gone = on_gone
        self._closed = False
        self._message = _ffi.new("nng_msg **")
        self._descriptor = descriptor
        greeting = _duplicate(descriptor)
        try:
            self._socket, self._fd = _pair(
                descriptor,
                on_here=lambda: loop.call_soon(self._came),
                on_gone=lambda: loop.call_soon(self._went),
            )
        except BaseException:
            greeting.close()
            raise
        self._greeting: socket.socket | None = greeting
        _live.add(self)
        loop.register(self._fd, self._readable)

    def put(self, datagram: Datagram) -> None:
        """Seal and send a datagram.  If nng cannot queue it, the connection breaks."""
        if self._closed:
            return
        # Join the pieces late, in memory that the datagram before has just left.
        data = datagram if isinstance(datagram, bytes) else b"".join(datagram)
        size = len(data) + OVERHEAD
        message = self._message
        if _lib.nng_msg_alloc(message, size):
            self.break_off()
            return
        body = _ffi.buffer(_lib.nng_msg_body(message[0]), size)
        self._sealer.seal_into(data, body)
        if _lib.nng_sendmsg(self._socket.socket, message[0], _lib.NNG_FLAG_NONBLOCK):
            _lib.nng_msg_free(message[0])
            self.break_off()

    def break_off(self) -> None:
        """Close the connection, and call ``on_gone`` as if it had broken."""
        if not self._closed:
            self.close()
            self._loop.call_soon(self._on_gone, self)

    def close(self) -> None:
        """Close the connection."""
        if not self._closed:
            self._closed = True
            self._loop.unregister(self._fd)
            if self._greeting is not None:
                self._end_greeting(self._greeting)
            self._socket.close()

    def abandon_after_fork(self) -> None:
        """Do not touch the socket in a forked child: nng would abort the child."""
        self._closed = True
        # pynng closes the object in this attribute at ``close`` and at garbage collection.
        vars(self._socket).pop("_socket", None)

    def _came(self) -> None:
        if self._greeting is not None and not self._closed:
            self._greeting.close()
            self._greeting = None

    def _end_greeting(self, ours: socket.socket) -> None:
        """Shut down a connection whose greeting nng still exchanges; wait until nng closes it."""
        with contextlib.suppress(OSError):  # it has broken already
            ours.shutdown(socket.SHUT_RDWR)
        connection = os.fstat(ours.fileno()).st_ino
        ours.close()
        until = time.monotonic() + _NOTICES
        with contextlib.suppress(OSError):  # an error means that it is closed
            while os.fstat(self._descriptor).st_ino == connection and time.monotonic() < until:
                time.sleep(0.0005)

    def _went(self) -> None:
        # First read the messages that came before it broke.
        self._readable()
        self.break_off()

    def _readable(self) -> None:
        for _ in range(_TURN):
            if self._closed:
                return
            message = self._message
            if _lib.nng_recvmsg(self._socket.socket, message, _lib.NNG_FLAG_NONBLOCK):
                return  # no message; if the connection has ended, ``_went`` follows
            try:
                datagram = self._open(message[0])
            except ProtocolError:
                # The message was changed on the way.  Earlier messages are safe; this one and later
                # ones are repeated on the next connection.
                self.break_off()
                return
            self._on_datagram(self, datagram)

    def _open(self, message: Any) -> memoryview:
        try:
            body = _ffi.buffer(_lib.nng_msg_body(message), _lib.nng_msg_len(message))
            return self._opener.open(body)
        finally:
            _lib.nng_msg_free(message)


def _duplicate(descriptor: int) -> socket.socket:
    try:
        with naming_the_limit("making a link"):
            return socket.socket(fileno=os.dup(descriptor))
    except BaseException:
        os.close(descriptor)
        raise


def _pair(
    descriptor: int, on_here: Callable[[], None], on_gone: Callable[[], None]
) -> tuple[Any, int]:
    """Return a Pair1 socket over the connection ``descriptor``, and a descriptor to watch.

    The latter is readable whenever there is a message.
    """
    owned = True
    try:
        pair = pynng.Pair1(recv_max_size=_LARGEST, recv_buffer_size=_TURN, send_buffer_size=_QUEUE)
        try:
            readable: int = pair.recv_fd  # made now, as it opens more descriptors
            pair.add_post_pipe_connect_cb(lambda _: on_here())
            pair.add_post_pipe_remove_cb(lambda _: on_gone())
            listener = _ffi.new("nng_listener *")
            pynng.check_err(_lib.nng_listener_create(listener, pair.socket, b"socket://"))
            pynng.check_err(_lib.nng_listener_start(listener[0], 0))
            owned = False
            pynng.check_err(_lib.nng_listener_set_int(listener[0], b"socket:fd", descriptor))
        except BaseException:
            pair.close()
            raise
    except pynng.OutOfFiles as error:
        raise TooManyOpenFiles("making a link") from error
    except pynng.NoMemory as error:
        raise LinkError(
            "no memory is left for a link. Raise the limit of this process (`ulimit -v` in the "
            "shell that starts the program, or that of its container), or use fewer agents"
        ) from error
    except pynng.NNGException as error:
        raise LinkError(f"nng does not take the connection: {str(error).lower()}") from error
    finally:
        if owned:
            os.close(descriptor)
    return pair, readable


_live: weakref.WeakSet[SealedConnection] = weakref.WeakSet()


def _after_fork_in_child() -> None:
    for connection in _live:
        connection.abandon_after_fork()


os.register_at_fork(after_in_child=_after_fork_in_child)

# pynng ends nng before multiprocessing's exit functions run, which still need the links.  In a
# forked child it would also close the parent's sockets.  A Finalize runs after these functions, and
# in this process only.
atexit.unregister(pynng.nng._pynng_atexit)
util.Finalize(None, pynng.nng._pynng_atexit, exitpriority=-200)
