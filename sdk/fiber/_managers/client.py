"""The client's side: a session with each manager's server that this process knows.

::

    proxies of this process ── Request ── Line, one a thread ──► a thread of the server
                                  └────── control ────────────►  who this process is, what it lets
                                                                 go, and by its end: that it is gone

A line has one call under way at a time.  What is said on the control channel has no answer, so that
a finalizer may say it wherever the garbage collector runs.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import pickle
import warnings
import weakref
from collections import deque
from multiprocessing import util
from multiprocessing.managers import Token
from multiprocessing.process import BaseProcess, current_process
from threading import current_thread, main_thread
from typing import Any

from fiber import reduction
from fiber._hub import handles
from fiber._hub.client import Unreachable, host
from fiber._hub.handles import collecting_grants
from fiber._hub.local import LocalChannel
from fiber._managers.door import NUMBER, TAKE_BACK, ManagerAddress, knock
from fiber._transport.base import Channel
from fiber._wire import packet
from fiber.connection import how_it_ended
from fiber.errors import ConnectionClosed

_LOOK_AGAIN = 0.5
"""Seconds after which whoever waits to be let in looks whether anybody is there."""

_ACQUIRING = ("acquire", "wait")
"""Methods whose results are no objects of the user's."""

_BEFORE_EXIT = -50
"""Exit priority: after the managers of this process have been shut down."""


class Line:
    """A channel to a thread of the server."""

    def __init__(self, channel: LocalChannel) -> None:
        self._channel = channel
        self._asked = 0
        self._draining = False
        self.busy = False
        self.came = False
        """True if the server has answered the last request."""

    def ask(self, request: tuple[Any, ...]) -> None:
        """Send a request."""
        payload, buffers = reduction.encode(request)
        self._asked += 1
        self._channel.send(NUMBER.pack(self._asked) + payload, buffers)

    def answer(self) -> tuple[str, Any]:
        """The answer to the last request."""
        self.came = False
        while True:
            message = self._channel.recv_answer()
            self.came = True
            number, kind, result = packet.loads(message)
            if number == self._asked:  # else an earlier call was interrupted
                return kind, result
            self.came = False

    def take_back(self) -> None:
        """Take back the last request: its answer is not wanted."""
        self._draining = True
        self.ask((None, TAKE_BACK, (), {}))

    def is_free(self) -> bool:
        """Tell whether a call may begin."""
        while self._draining and self._channel.poll(0):
            try:
                number, *_ = self._channel.recv_object()
            except ConnectionClosed:
                return False
            except Exception:  # nobody wants it
                continue
            self._draining = number != self._asked
        return not (self.busy or self._draining)

    def close(self) -> None:
        """End it."""
        self._channel.close()


class Session:
    """Session of this process with the server of one manager."""

    def __init__(self, address: ManagerAddress) -> None:
        self.address = address
        self.pid = os.getpid()
        self.process: weakref.ref[BaseProcess] | None = None
        """The server's process, where it is a child of this one."""
        self._references = 0
        self._ended = False
        self._said: deque[tuple[str, ...]] = deque()
        self._of_thread: Any = util.ForkAwareLocal()
        try:
            door = knock(address)
            try:
                self._control = _hand_over(door, "join", introduction())
            finally:
                door.close()
        except (ConnectionClosed, BrokenPipeError) as error:
            raise self.gone() from error

    def hand_over(self, owner: str) -> LocalChannel:
        """A new channel to a new thread of the server.

        What that acquires, all have that are handed over for the same ``owner``.
        """
        try:
            return _hand_over(self._control, "line", thread_name(), owner)
        except (ConnectionClosed, BrokenPipeError) as error:
            raise self.gone() from error

    def line(self) -> Line:
        """A line of this thread on which no call is under way."""
        if self._ended:
            raise self.gone()
        lines: list[Line] | None = getattr(self._of_thread, "lines", None)
        if lines is None:
            self._of_thread.owner = new_owner()
            lines = self._of_thread.lines = []
        for line in lines:
            if line.is_free():
                return line
        return self._new_line()

    def _new_line(self) -> Line:
        line = Line(self.hand_over(self._of_thread.owner))
        self._of_thread.lines.append(line)
        return line

    def replace(self, line: Line) -> None:
        """Replace a line whose answer is not wanted.  This thread keeps what it has acquired."""
        with contextlib.suppress(ConnectionClosed):
            self._new_line()
        self.give_up(line)

    def give_up(self, line: Line) -> None:
        """Close a line whose answer is not wanted."""
        line.close()
        lines: list[Line] = getattr(self._of_thread, "lines", [])
        if line in lines:
            lines.remove(line)

    def got_reference(self) -> None:
        """Count a new reference to an object of the manager."""
        self._references += 1
        _held[self.address] = self

    def let_go(self, ident: str) -> None:
        """Drop a reference.  From anywhere, also from a finalizer."""
        self.say("decref", ident)
        self._references -= 1
        if self._references <= 0:
            _held.pop(self.address, None)

    def say(self, *words: str) -> None:
        """Tell the server, without waiting even for room."""
        self._said.append(words)
        while self._said and not self._ended:
            try:
                said = self._said.popleft()
            except IndexError:  # another thread says it
                return
            try:
                if not self._control.try_send(pickle.dumps(said)):
                    self._said.appendleft(said)
                    return
            except OSError:  # the server is gone
                return

    def close(self) -> None:
        """End the session in good order.  Locks stay as they are."""
        _held.pop(self.address, None)
        _sessions.pop(self.address, None)
        self.say("bye")

    def end(self) -> None:
        """The server is gone; or, in a forked process, the session is the parent's."""
        self._ended = True
        self._control.close()
        for line in getattr(self._of_thread, "lines", []):
            line.close()

    def __del__(self) -> None:
        if hasattr(self, "_control") and self.pid == os.getpid():
            self.say("bye")

    def gone(self) -> ConnectionClosed:
        """The error of whoever finds the server gone."""
        process = self.process and self.process()
        return ConnectionClosed(self.address.server, how_it_ended(process) if process else None)


class Reference:
    """Keeps an object of a manager while this is alive.  Made and dropped without waiting."""

    def __init__(self, session: Session, ident: str) -> None:
        self._session = session
        self._ident = ident
        session.got_reference()
        session.say("incref", ident)

    def __del__(self) -> None:
        if self._session.pid == os.getpid():
            self._session.let_go(self._ident)


class TravellingToken(Token):
    """A token that keeps its object while it is on its way to another process, where that is known.

    In multiprocessing the object may be gone before the process has a proxy of its own.
    """

    def __reduce__(self) -> tuple[Any, ...]:
        address: Any = self.address
        known = _sessions.get(address)
        if known is not None:
            handles.keep_until_released(Reference(known, str(self.id)))
        return type(self), (self.typeid, address, self.id)


def _hand_over(carrier: Channel, *about: str) -> LocalChannel:
    """A new channel to the server, which has the other end and said so."""
    ours, theirs = LocalChannel.pair()
    # Taken back below: if nobody takes it out, its end is the end of ours.
    with collecting_grants(reusable=False) as grants:
        invitation = pickle.dumps((*about, theirs))
    theirs.close()
    try:
        carrier.send(invitation)
        while not ours.poll(_LOOK_AGAIN):
            if carrier.poll(0):  # nothing ever comes there but the end
                raise ConnectionClosed()
        ours.recv().release()
    finally:
        grants.release()
    return ours


class Request:
    """Connection to the server, as multiprocessing's proxies and managers see it."""

    def __init__(self, address: ManagerAddress) -> None:
        self._address = address
        self._opened: Session | None = None
        self._under_way: list[tuple[Line, str, str | None]] = []

    @property
    def _session(self) -> Session:
        if self._opened is None or self._opened.pid != os.getpid():  # forked
            self._opened = session(self._address)
        return self._opened

    def send(self, request: tuple[str | None, str, tuple[Any, ...], dict[str, Any]]) -> None:
        """Begin a call of an object's method, or of the server's own if the id is None."""
        ident, method, args, _ = request
        if ident is None and method == "decref":
            known = _sessions.get(self._address)
            if known is not None:  # a finalizer may be what asks: it waits for nothing
                known.let_go(*args)
            return
        line = self._session.line()
        line.busy = True
        try:
            line.ask(request)
        except BrokenPipeError as error:
            self._session.give_up(line)
            raise self._session.gone() from error
        except reduction.REFUSALS as error:
            line.busy = False
            raise reduction.blame({f"the arguments of {method}()": request}, error) from error
        except BaseException:
            self._session.replace(line)  # it may have been sent or not
            raise
        self._under_way.append((line, method, ident))

    def recv(self) -> tuple[str, Any]:
        """Return how the last call ended."""
        if not self._under_way:
            return "#RETURN", None  # letting go has no answer
        line, method, ident = self._under_way.pop()
        try:
            kind, result = line.answer()
        except ConnectionClosed as error:
            if isinstance(error, Unreachable):
                raise  # something in the answer
            self._session.give_up(line)
            raise self._session.gone() from error
        except BaseException as error:
            # What came and does not unpickle stays with who asked.  All else is a signal's handler.
            if method in _ACQUIRING or not (line.came and isinstance(error, Exception)):
                line.take_back()
            raise
        finally:
            line.busy = False
        return self._understood(kind, result, method, ident)

    def _understood(
        self, kind: str, result: Any, method: str, ident: str | None
    ) -> tuple[str, Any]:
        if kind == "#PROXY":
            return "#RETURN", proxy_of(self._session, *result)
        if kind == "#WARNING":
            text, acquired = result
            self._warn(text, ident)
            return "#RETURN", acquired
        if kind == "#RETURN" and ident is None and method in ("create", "incref"):
            self._session.got_reference()
        return kind, result

    def _warn(self, text: str, ident: str | None) -> None:
        try:
            warnings.warn(text, RuntimeWarning, stacklevel=6)
        except BaseException:  # made an error by a filter: then it is not acquired
            self.send((ident, "release", (), {}))
            self.recv()
            raise

    def close(self) -> None:
        """Do nothing: the thread keeps its lines."""


_sessions: weakref.WeakValueDictionary[ManagerAddress, Session] = weakref.WeakValueDictionary()
_held: dict[ManagerAddress, Session] = {}
"""Sessions that have references."""


def session(address: ManagerAddress) -> Session:
    """Return this process's session with the server at ``address``."""
    found = _sessions.get(address)
    if found is None:
        made = Session(address)
        found = _sessions.setdefault(address, made)  # or another thread was faster
        _close_at_exit()
    return found


def connect(address: ManagerAddress, authkey: bytes | None = None) -> Request:
    """multiprocessing's ``Client`` for a manager's server.

    The key is not asked for: only who was given the address can have it.
    """
    return Request(address)


def proxy_of(session: Session, make: Any, token: Token, exposed: tuple[str, ...]) -> Any:
    """The proxy of what a method has returned.

    multiprocessing asks the manager's registry for its class, which only one process has.
    """
    from fiber._managers import SERIALIZER

    session.got_reference()
    try:
        return make(token, SERIALIZER, exposed=exposed)
    finally:
        session.let_go(str(token.id))


def forget(address: ManagerAddress) -> None:
    """The server has been shut down."""
    session = _sessions.pop(address, None)
    _held.pop(address, None)
    if session is not None:
        session.end()


_owners = itertools.count()


def new_owner() -> str:
    """The name of one who has acquired nothing yet, for this process's servers."""
    return str(next(_owners))


def introduction() -> str:
    """Return a description of this process."""
    return f"process {current_process().name!r} (pid {os.getpid()} on host {host()!r})"


def thread_name() -> str:
    """Return the name of this thread, for the threads of the server."""
    name = current_process().name
    return name if current_thread() is main_thread() else f"{name}|{current_thread().name}"


_closing_in = 0


def _close_at_exit() -> None:
    global _closing_in
    if _closing_in != os.getpid():
        _closing_in = os.getpid()
        util.Finalize(None, _close_all, exitpriority=_BEFORE_EXIT)


def _close_all() -> None:
    for one in list(_sessions.values()):
        one.close()


def _forget() -> None:
    """Forget the sessions in a forked process: they belong to its parent."""
    for one in list(_sessions.values()):
        one.end()
    _sessions.clear()
    _held.clear()


os.register_at_fork(after_in_child=_forget)
