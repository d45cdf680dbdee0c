"""A manager's server: multiprocessing's, with another way in, and an eye on who its clients are.

Each thread of a client has a thread here, as in multiprocessing; so who acquired an RLock is who
may release it.  What a process has references to is counted for that process, and let go when it
is gone.
"""

from __future__ import annotations

import itertools
import sys
import threading
from contextlib import suppress
from multiprocessing import managers as mp_managers
from multiprocessing.managers import Token
from traceback import format_exc
from typing import Any

from fiber import reduction
from fiber._agent.travelling import Travelling
from fiber._managers.client import TravellingToken
from fiber._managers.door import NUMBER, TAKE_BACK, received
from fiber._managers.holdings import CONTENDED, Client, ClientThread, Holdings
from fiber._transport.base import Channel
from fiber._wire import packet
from fiber._wire.packet import Message
from fiber.errors import ConnectionClosed

_mp: Any = mp_managers  # typeshed has part of it

_PROXY = b"RebuildProxy"
"""Bytes that a pickle has if there is a proxy in it."""

_Answer = tuple[str, Any]
"""Kind of an answer, in multiprocessing's words, and its value."""


class Server(_mp.Server):  # type: ignore[misc]
    """Serves a manager's objects to the processes of the program."""

    def __init__(self, *options: Any) -> None:
        super().__init__(*options)
        self.stop_event = threading.Event()
        self._numbers = itertools.count(1)
        self._holdings = Holdings()

    def serve_forever(self) -> None:
        """Serve until ``shutdown`` is called, then end the process."""
        _start(self.accepter)
        try:
            self.stop_event.wait()
        except (KeyboardInterrupt, SystemExit):
            pass
        sys.exit(0)

    def accepter(self) -> None:
        """Give each client that comes a thread."""
        while True:
            try:
                _, name, control = self.listener.accept()
            except (OSError, ConnectionClosed):  # nobody can come any more
                return
            _start(self._serve_client, Client(name), control)

    # A client

    def _serve_client(self, client: Client, control: Channel) -> None:
        try:
            control.send(b"")
            while True:
                self._heed(client, *received(control))
        except (OSError, ConnectionClosed):
            pass
        finally:
            control.close()
            self._let_go(client)

    def _heed(self, client: Client, what: str, *about: Any) -> None:
        if what == "line":
            _start(self._serve_line, client, *about)
        elif what == "incref":
            with suppress(KeyError):
                self.incref(client, *about)
        elif what == "decref":
            self.decref(client, *about)
        elif what == "bye":
            client.left_in_order = True

    def _let_go(self, client: Client) -> None:
        self._holdings.end(client)
        with client.mutex:
            references = list(client.references.elements())
            client.references.clear()
        for ident in references:
            self._forget(ident)

    # A thread of a client

    def _serve_line(self, client: Client, name: str, owner: str, line: Channel) -> None:
        threading.current_thread().name = name
        thread = ClientThread(self._holdings, client, owner)
        try:
            line.send(b"")
            while True:
                thread.kept = self._serve_call(client, thread, line, line.recv())
        except (OSError, ConnectionClosed):
            pass
        finally:
            line.close()
            thread.end()

    def _serve_call(
        self, client: Client, thread: ClientThread, line: Channel, message: Message
    ) -> Any:
        (number,) = NUMBER.unpack_from(message.payload)
        message.payload = message.payload[NUMBER.size :]
        ident, method = None, ""
        got_before, thread.got = thread.got, None
        answer: _Answer
        try:
            ident, method, args, kwds = packet.loads(message)
            if ident is not None:
                answer = self._call(client, thread, ident, method, args, kwds)
            elif method == TAKE_BACK:
                thread.take_back(got_before)
                answer = "#RETURN", None
            else:
                answer = self._own(client, method, args, kwds)
        except BaseException:
            answer = "#TRACEBACK", format_exc()
        try:
            return _reply(line, number, answer)
        except BrokenPipeError:  # it is not there any more, or waits for no answer
            thread.take_back(thread.got)
            return None
        finally:
            if ident is None and method == "shutdown":
                self.stop_event.set()

    def _own(self, client: Client, method: str, args: Any, kwds: Any) -> _Answer:
        if method not in self.public:
            raise AttributeError(f"a manager has no {method!r}")
        return "#RETURN", getattr(self, method)(client, *args, **kwds)

    def _call(
        self, client: Client, thread: ClientThread, ident: str, method: str, args: Any, kwds: Any
    ) -> _Answer:
        obj, exposed, typeids = self._found(ident)
        function = getattr(obj, method, None) if method in exposed else None
        if function is None:
            fallback = self.fallback_mapping.get(method)
            if fallback is None:
                raise AttributeError(
                    f"method {method!r} of {type(obj)!r} object is not in exposed={exposed!r}"
                )
            return "#RETURN", fallback(self, client, ident, obj, *args, **kwds)
        try:
            if isinstance(obj, CONTENDED):
                return thread.call(obj, method, function, args, kwds)
            result = function(*args, **kwds)
        except BaseException as error:  # SystemExit too: the caller waits for an answer
            return _error(error)
        if typeids and method in typeids:
            return "#PROXY", self._made(client, typeids[method], result)
        return "#RETURN", result

    def _found(self, ident: str) -> Any:
        try:
            return self.id_to_obj[ident]
        except KeyError:
            raise _gone(ident) from None

    def _made(self, client: Client, typeid: str, obj: Any) -> tuple[Any, Token, tuple[str, ...]]:
        ident, exposed = self.create(client, typeid, obj)
        return self.registry[typeid][-1], TravellingToken(typeid, self.address, ident), exposed

    # What managers ask of the server itself; ``c`` is the client

    def create(
        self, c: Any, typeid: str, /, *args: Any, **kwds: Any
    ) -> tuple[str, tuple[str, ...]]:
        """Make an object; its id and the names of its methods."""
        make, exposed, typeids, _ = self.registry[typeid]
        if make is not None:
            obj = make(*args, **kwds)
        elif kwds or len(args) != 1:
            raise ValueError("Without callable, must have one non-keyword argument")
        else:
            obj = args[0]
        if exposed is None:
            exposed = _mp.public_methods(obj)
        names = (*exposed, *(typeids or ()))
        # Not the object's own id, which the next one may have while this one is being dropped.
        ident = format(next(self._numbers), "x")
        with self.mutex:
            self.id_to_obj[ident] = (obj, frozenset(names), typeids)
            self.id_to_refcount[ident] = 0
        self.incref(c, ident)
        return ident, names

    def incref(self, c: Any, ident: str) -> None:
        """The client has one more reference."""
        with self.mutex:
            if ident not in self.id_to_refcount:
                raise _gone(ident)
            self.id_to_refcount[ident] += 1
        with c.mutex:
            c.references[ident] += 1
        if c.gone:
            self._let_go(c)

    def decref(self, c: Any, ident: str) -> None:
        """The client has one less."""
        with c.mutex:
            if not c.references[ident]:
                return
            c.references[ident] -= 1
        self._forget(ident)

    def _forget(self, ident: str) -> None:
        with self.mutex:
            self.id_to_refcount[ident] -= 1
            if self.id_to_refcount[ident]:
                return
            del self.id_to_refcount[ident]
            last = self.id_to_obj.pop(ident)
        del last  # not before: with it may go proxies, and then other objects

    def accept_connection(self, c: Any, name: str) -> None:
        """A proxy begins: nothing is left to do."""

    def shutdown(self, c: Any) -> None:
        """End the process, once this is answered."""


def _start(target: Any, *args: Any) -> None:
    threading.Thread(target=target, args=args, daemon=True).start()


def _gone(ident: str) -> KeyError:
    return KeyError(
        f"the manager's object {ident!r} is gone: it went with its last proxy. Keep a proxy until "
        "the process that was sent one has received it"
    )


def _error(error: BaseException) -> _Answer:
    """An error of the object's own, which is raised as it is where that can be."""
    travelling = Travelling(error)
    return ("#ERROR", travelling) if travelling.whole else ("#TRACEBACK", travelling.text)


def _reply(line: Channel, number: int, answer: _Answer) -> Any:
    """Send an answer; the result, if it has proxies in it."""
    try:
        payload, buffers = reduction.encode((number, *answer))
        line.send(payload, buffers)
    except BrokenPipeError:
        raise
    except BaseException:  # it does not pickle, or there is no memory for it
        payload, buffers = reduction.encode((number, "#UNSERIALIZABLE", format_exc()))
        line.send(payload, buffers)
    return answer[1] if _PROXY in payload else None
