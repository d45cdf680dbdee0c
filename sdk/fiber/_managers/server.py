"""A manager's server: multiprocessing's, with another listener, and a record of its clients.

Each thread of a client has a thread in the server, as in multiprocessing.  The server counts the
references of each process, and drops them when the process ends.
"""

from __future__ import annotations

import itertools
import os
import sys
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing import managers as mp_managers
from multiprocessing.managers import Token
from multiprocessing.process import current_process
from queue import Queue
from traceback import format_exc
from typing import Any

from fiber import reduction
from fiber._agent.exception_pickles import PickledException
from fiber._hub.handles import GrantSet
from fiber._hub.local import LocalChannel
from fiber._hub.protocol import ObjectKind
from fiber._managers import primitives
from fiber._managers.client import (
    DECREF,
    INCREF,
    NUMBER,
    OPEN_CHANNEL,
    TAKE_BACK,
    ManagerAddress,
    TravellingToken,
    receive_notice,
)
from fiber._transport.channels import Channel
from fiber._wire import packet
from fiber._wire.packet import INLINE_LIMIT, Message
from fiber.errors import ConnectionClosed

_mp: Any = mp_managers  # typeshed has part of it

_PROXY = b"RebuildProxy"
"""Bytes in every pickle that has a proxy in it."""

_Taken = tuple[Queue[Any], Any]
"""A queue, and an item of it."""

_Answer = tuple[str, Any]
"""Kind of an answer, in multiprocessing's words, and its value."""


class ManagerListener:
    """Listener of a manager: a channel that every process with the address may reach."""

    def __init__(self, address: object = None, backlog: int = 0) -> None:
        self._inbox, outbox = LocalChannel.pair()
        self._grants = GrantSet()
        handle = self._grants.for_local(ObjectKind.CHANNEL, outbox.fileno())
        outbox.close()
        self.address = ManagerAddress(
            f"manager {current_process().name!r} (pid {os.getpid()} on host {handle.home.host!r})",
            handle,
        )

    def accept(self) -> Channel:
        """Return the control channel of the next client."""
        control: Channel
        _, control = receive_notice(self._inbox)
        return control

    def close(self) -> None:
        """Admit no more clients."""
        self._grants.release()
        self._inbox.close()


class Client:
    """Process that uses the manager."""

    def __init__(self) -> None:
        self.ended = False
        self.references: Counter[str] = Counter()
        self.mutex = threading.Lock()
        self.barriers: list[threading.Barrier] = []
        """Barriers at which threads of the client wait."""

    @contextmanager
    def waiting_at(self, obj: object) -> Iterator[None]:
        """Note a call of a barrier, which is broken if the client dies in it."""
        if not isinstance(obj, threading.Barrier):
            yield
            return
        self.barriers.append(obj)
        try:
            yield
        finally:
            self.barriers.remove(obj)


class ClientThread:
    """Thread of the server that acts for one thread of a client."""

    def __init__(self) -> None:
        self.taken: _Taken | None = None
        """Item that the last call has taken."""
        self.kept: Any = None
        """Last result that has proxies in it.

        It keeps their objects until the client has its own references.  The client has them when
        it makes the next call.
        """

    def begin_call(self) -> _Taken | None:
        """Return the item that the last call has taken.  The next call has taken none yet."""
        previous, self.taken = self.taken, None
        return previous


class Server(_mp.Server):  # type: ignore[misc]
    """Server of a manager's objects for the processes of the program."""

    def __init__(self, *options: Any) -> None:
        super().__init__(*options)
        self.stop_event = threading.Event()
        self._numbers = itertools.count(1)

    def serve_forever(self) -> None:
        """Serve until ``shutdown`` is called, then end the process."""
        _start(self.accepter)
        try:
            self.stop_event.wait()
        except (KeyboardInterrupt, SystemExit):
            pass
        sys.exit(0)

    def accepter(self) -> None:
        """Start a thread for each client that connects."""
        while True:
            try:
                control = self.listener.accept()
            except (OSError, ConnectionClosed):  # the listener is closed
                return
            _start(self._serve_client, Client(), control)

    # A client

    def _serve_client(self, client: Client, control: Channel) -> None:
        try:
            control.send(b"")
            while True:
                self._handle_notice(client, *receive_notice(control))
        except (OSError, ConnectionClosed):
            pass
        finally:
            control.close()
            self._end_client(client)

    def _handle_notice(self, client: Client, notice: str, *values: Any) -> None:
        if notice == OPEN_CHANNEL:
            _start(self._serve_channel, client, *values)
        elif notice == INCREF:
            with suppress(KeyError):
                self.incref(client, *values)
        elif notice == DECREF:
            self.decref(client, *values)

    def _end_client(self, client: Client) -> None:
        client.ended = True
        for barrier in list(client.barriers):
            barrier.abort()
        with client.mutex:
            references = list(client.references.elements())
            client.references.clear()
        for ident in references:
            self._drop_reference(ident)

    # A thread of a client

    def _serve_channel(self, client: Client, name: str, channel: Channel) -> None:
        threading.current_thread().name = name
        thread = ClientThread()
        try:
            channel.send(b"")
            message = channel.recv()
            while True:
                message = self._serve_call(client, thread, channel, message)
        except (OSError, ConnectionClosed):
            pass
        finally:
            channel.close()

    def _serve_call(
        self, client: Client, thread: ClientThread, channel: Channel, message: Message
    ) -> Message:
        """Make a call and send the answer; return the next message of the client."""
        (number,) = NUMBER.unpack_from(message.payload)
        message.payload = message.payload[NUMBER.size :]
        ident, method = None, ""
        previous = thread.begin_call()
        answer: _Answer
        try:
            ident, method, args, kwds = packet.loads(message)
            if ident is not None:
                answer = self._call(client, thread, ident, method, args, kwds)
            elif method == TAKE_BACK:
                _put_back(previous)
                answer = "#RETURN", None
            else:
                answer = self._call_server(client, method, args, kwds)
        except BaseException:
            answer = "#TRACEBACK", format_exc()
        payload, buffers = _encoded(thread, number, answer)
        ends = ident is None and method == "shutdown"
        try:
            if thread.taken is None and not (ends or buffers) and len(payload) <= INLINE_LIMIT:
                # On another host this is one request, which does not tell whether the answer came.
                return channel.exchange(payload)
            _send(channel, number, payload, buffers)
        except BrokenPipeError:  # the client has ended, or does not wait for the answer
            _put_back(thread.taken)
        finally:
            if ends:
                self.stop_event.set()
        return channel.recv()

    def _call_server(self, client: Client, method: str, args: Any, kwds: Any) -> _Answer:
        if method not in self.public:
            raise AttributeError(f"a manager has no {method!r}")
        return "#RETURN", getattr(self, method)(client, *args, **kwds)

    def _call(
        self, client: Client, thread: ClientThread, ident: str, method: str, args: Any, kwds: Any
    ) -> _Answer:
        obj, exposed, typeids, _ = self._look_up(ident)
        function = getattr(obj, method, None) if method in exposed else None
        if function is None:
            fallback = self.fallback_mapping.get(method)
            if fallback is None:
                raise AttributeError(
                    f"method {method!r} of {type(obj)!r} object is not in exposed={exposed!r}"
                )
            return "#RETURN", fallback(self, client, ident, obj, *args, **kwds)
        try:
            with client.waiting_at(obj):
                result = function(*args, **kwds)
            if method == "get" and type(obj) is Queue:
                thread.taken = obj, result
        except BaseException as error:  # SystemExit too: the caller waits for an answer
            return _error_answer(error)
        if typeids and method in typeids:
            return "#PROXY", self._create_result(client, typeids[method], result)
        return "#RETURN", result

    def _look_up(self, ident: str) -> Any:
        try:
            return self.id_to_obj[ident]
        except KeyError:
            raise _no_object(ident) from None

    def _create_result(
        self, client: Client, typeid: str, obj: Any
    ) -> tuple[Any, Token, tuple[str, ...]]:
        ident, exposed = self.create(client, typeid, obj)
        return self.registry[typeid][-1], TravellingToken(typeid, self.address, ident), exposed

    # Methods that managers call of the server itself; ``c`` is the client

    def create(
        self, c: Any, typeid: str, /, *args: Any, **kwds: Any
    ) -> tuple[str, tuple[str, ...]]:
        """Make an object; return its id and the names of its methods."""
        make, exposed, typeids, proxytype = self.registry[typeid]
        make = primitives.maker(make, proxytype)
        if make is not None:
            obj = make(*args, **kwds)
        elif kwds or len(args) != 1:
            raise ValueError("Without callable, must have one non-keyword argument")
        else:
            obj = args[0]
        if exposed is None:
            exposed = _mp.public_methods(obj)
        names = (*exposed, *(typeids or ()))
        # No ``id(obj)``: another object may have the same while this one is being dropped.
        ident = format(next(self._numbers), "x")
        with self.mutex:
            is_lock = primitives.is_lock(obj, proxytype)
            self.id_to_obj[ident] = (obj, frozenset(names), typeids, is_lock)
            self.id_to_refcount[ident] = 0
        self.incref(c, ident)
        return ident, names

    def incref(self, c: Any, ident: str) -> Any:
        """Count one more reference of the client.  Return the object if it is a lock."""
        with self.mutex:
            if ident not in self.id_to_refcount:
                raise _no_object(ident)
            self.id_to_refcount[ident] += 1
            obj, _, _, is_lock = self.id_to_obj[ident]
        with c.mutex:
            c.references[ident] += 1
        if c.ended:
            self._end_client(c)
        return obj if is_lock else None

    def decref(self, c: Any, ident: str) -> None:
        """Count one reference of the client less."""
        with c.mutex:
            if not c.references[ident]:
                return
            c.references[ident] -= 1
        self._drop_reference(ident)

    def _drop_reference(self, ident: str) -> None:
        with self.mutex:
            self.id_to_refcount[ident] -= 1
            if self.id_to_refcount[ident]:
                return
            del self.id_to_refcount[ident]
            last = self.id_to_obj.pop(ident)
        del last  # without the mutex: it may hold proxies, whose end drops other objects

    def shutdown(self, c: Any) -> None:
        """End the process, once this call is answered."""


def _put_back(taken: _Taken | None) -> None:
    """Put back an item that the client does not get, so that other clients can have it."""
    if taken is not None:
        queue, item = taken
        with queue.mutex:
            queue.queue.appendleft(item)
            queue.not_empty.notify()


def _start(target: Any, *args: Any) -> None:
    threading.Thread(target=target, args=args, daemon=True).start()


def _no_object(ident: str) -> KeyError:
    return KeyError(
        f"the manager's object {ident!r} is gone: it went with its last proxy. Keep a proxy until "
        "the process that gets one has received it"
    )


def _error_answer(error: BaseException) -> _Answer:
    """Return the answer for an error that a method raised: the error itself if it pickles."""
    pickled = PickledException(error)
    return ("#ERROR", pickled) if pickled.whole else ("#TRACEBACK", pickled.text)


def _encoded(thread: ClientThread, number: int, answer: _Answer) -> tuple[bytes, Any]:
    """Return the message of an answer.  If it has proxies in it, the thread keeps their objects."""
    try:
        payload, buffers = reduction.encode((number, *answer))
    except BaseException:  # the answer does not pickle
        payload, buffers = _failure(number)
    thread.kept = answer[1] if _PROXY in payload else None
    return payload, buffers


def _send(channel: Channel, number: int, payload: bytes, buffers: Any) -> None:
    try:
        channel.send_surely(payload, buffers)
    except BrokenPipeError:
        raise
    except BaseException:  # there is no memory for the answer
        channel.send_surely(*_failure(number))


def _failure(number: int) -> tuple[bytes, Any]:
    return reduction.encode((number, "#UNSERIALIZABLE", format_exc()))
