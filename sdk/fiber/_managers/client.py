"""The client's side: a session with each manager's server that this process uses.

::

    proxies ── ManagerConnection ── CallChannel, for each thread ──► a thread of the server
                    └──────────── control channel ────────────────►  notices of this process

A call channel has one call in progress at a time.  Notices on the control channel have no answer,
so a finalizer may send one wherever the garbage collector runs.  A notice opens a call channel, or
changes a reference count.  The end of the control channel tells the server that this process ended.
"""

from __future__ import annotations

import errno
import os
import pickle
import struct
import time
import weakref
from collections import Counter, deque
from multiprocessing import util
from multiprocessing.managers import Token
from multiprocessing.process import BaseProcess, current_process
from threading import current_thread, main_thread
from typing import Any, NamedTuple, TypeAlias

from fiber import reduction
from fiber._hub import handles
from fiber._hub.client import ObjectUnreachable
from fiber._hub.handles import HubHandle, collecting_grants
from fiber._hub.local import LocalChannel
from fiber._managers import primitives
from fiber._transport.channels import Channel
from fiber._wire import packet
from fiber.connection import how_it_ended
from fiber.errors import ConnectionClosed

NUMBER = struct.Struct("<Q")
"""Number of a call, before the call on its channel and in its answer.

A number that a channel skips belongs to a call that was interrupted while it was sent.
"""

TAKE_BACK = "take_back"
"""Method of the server: undo the last call of a channel, whose caller was interrupted."""

JOIN, OPEN_CHANNEL, INCREF, DECREF = "join", "channel", "incref", "decref"
"""First words of the notices to a server.  The values are part of the wire format."""

Request: TypeAlias = tuple[str | None, str, tuple[Any, ...], dict[str, Any]]
"""Id of an object, or None for the server, the name of a method, and its arguments."""

_LOOK_AGAIN = 0.5
"""Seconds between checks that the server is alive, while it has not taken a new channel."""

_FILES_AGAIN = 0.05
"""Seconds between attempts to receive a channel when this process may open no more files."""

_BEFORE_EXIT = -50
"""Exit priority: after the managers of this process have been shut down."""


class ManagerAddress(NamedTuple):
    """Value of ``manager.address`` where none was chosen.  Any process of the program may use it.

    A process that has it may use every object of the manager, so its repr does not show it.
    """

    server: str
    """Description of the server's process."""
    listener: HubHandle

    def __repr__(self) -> str:
        return f"<address of {self.server}>"


def receive_notice(channel: Channel) -> Any:
    """Return the next notice on a channel; skip notices of processes that have ended."""
    while True:
        notice = channel.recv().tobytes()
        while True:
            try:
                return pickle.loads(notice)
            except OSError as error:
                if error.errno not in (errno.EMFILE, errno.ENFILE):
                    break
                time.sleep(_FILES_AGAIN)  # the sender waits for an answer
            except Exception:
                break


class CallChannel:
    """Channel to a thread of the server, for the calls of one thread of this process."""

    def __init__(self, channel: LocalChannel) -> None:
        self._channel = channel
        self._asked = 0
        self._draining = False
        self.busy = False
        self.answered = False
        """True if the server has answered the last request."""

    def ask(self, request: tuple[Any, ...]) -> None:
        """Send a request."""
        payload, buffers = reduction.encode(request)
        self._asked += 1
        self._channel.send(NUMBER.pack(self._asked) + payload, buffers)

    def answer(self) -> tuple[str, Any]:
        """Return the answer to the last request."""
        self.answered = False
        while True:
            message = self._channel.recv_answer()
            self.answered = True
            number, kind, result = packet.loads(message)
            if number == self._asked:  # any other answers an earlier call, which was interrupted
                return kind, result
            self.answered = False

    def take_back(self) -> None:
        """Have the server undo the last request, whose answer the caller does not read."""
        self._draining = True
        self.ask((None, TAKE_BACK, (), {}))

    def is_free(self) -> bool:
        """Tell whether a call may begin."""
        while self._draining and self._channel.poll(0):
            try:
                number, *_ = self._channel.recv_object()
            except ConnectionClosed:
                return False
            except Exception:  # the answer does not unpickle, and its caller is gone
                continue
            self._draining = number != self._asked
        return not (self.busy or self._draining)

    def close(self) -> None:
        """Close the channel."""
        self._channel.close()


class ManagerSession:
    """Session of this process with the server of one manager."""

    def __init__(self, address: ManagerAddress) -> None:
        self.address = address
        self.pid = os.getpid()
        self.process: weakref.ref[BaseProcess] | None = None
        """The server's process, if it is a child of this one."""
        self._locks: dict[str, Any] = {}
        self._references: Counter[str] = Counter()
        self._ended = False
        self._notices: deque[tuple[str, ...]] = deque()
        self._of_thread: Any = util.ForkAwareLocal()
        try:
            listener = handles.channel(address.listener)
            try:
                self._control = _open_channel(listener, JOIN)
            finally:
                listener.close()
        except (ConnectionClosed, BrokenPipeError) as error:
            raise self.closed_error() from error

    def open_channel(self) -> LocalChannel:
        """Open a channel to a new thread of the server."""
        try:
            return _open_channel(self._control, OPEN_CHANNEL, thread_name())
        except (ConnectionClosed, BrokenPipeError) as error:
            raise self.closed_error() from error

    def free_channel(self) -> CallChannel:
        """Return a channel of this thread that has no call in progress."""
        if self._ended:
            raise self.closed_error()
        channels: list[CallChannel] | None = getattr(self._of_thread, "channels", None)
        if channels is None:
            channels = self._of_thread.channels = []
        for channel in channels:
            if channel.is_free():
                return channel
        channel = CallChannel(self.open_channel())
        channels.append(channel)
        return channel

    def give_up(self, channel: CallChannel) -> None:
        """Close a channel whose answer is not read."""
        channel.close()
        channels: list[CallChannel] = getattr(self._of_thread, "channels", [])
        if channel in channels:
            channels.remove(channel)

    def add_reference(self, ident: str, *, lock: Any = None) -> None:
        """Count a new reference to an object of the manager; keep the lock if it is one."""
        self._references[ident] += 1
        if lock is not None:
            self._locks[ident] = lock
            _disown_at_exit()
        _referenced[self.address] = self

    def drop_reference(self, ident: str) -> None:
        """Drop a reference to an object.  May be called from anywhere, also from a finalizer."""
        self.notify(DECREF, ident)
        self._references[ident] -= 1
        if self._references[ident] <= 0:
            del self._references[ident]
            if lock := self._locks.pop(ident, None):
                primitives.disown(lock)
        if not self._references:
            _referenced.pop(self.address, None)

    def disown_locks(self) -> None:
        """Let other processes release what this process has acquired: it ends."""
        for lock in list(self._locks.values()):
            primitives.disown(lock)

    def notify(self, *notice: str) -> None:
        """Send the server a notice, without waiting even for room."""
        self._notices.append(notice)
        while self._notices and not self._ended:
            try:
                first = self._notices.popleft()
            except IndexError:  # another thread sends it
                return
            try:
                if not self._control.try_send(pickle.dumps(first)):
                    self._notices.appendleft(first)
                    return
            except OSError:  # the server has ended
                return

    def lock_of(self, request: Request) -> Any:
        """Return the lock on which the client itself makes a call, or None."""
        ident, method, _, _ = request
        return self._locks.get(str(ident)) if method in primitives.METHODS else None

    def call_lock(self, lock: Any, request: Request) -> Any:
        """Make a call of a lock without the server."""
        _, method, args, kwds = request
        # A lock that is held when the manager ends has to be released all the same.
        if method != "release" and (self._ended or self._control.poll(0)):
            raise self.closed_error()
        return primitives.call(lock, method, args, kwds)

    def end(self) -> None:
        """Close all channels: the server has ended, or this process is a fork of their owner."""
        self._ended = True
        self._control.close()
        for channel in getattr(self._of_thread, "channels", []):
            channel.close()

    def closed_error(self) -> ConnectionClosed:
        """Return the error for a caller that finds the server's process ended."""
        process = self.process and self.process()
        return ConnectionClosed(self.address.server, how_it_ended(process) if process else None)


class Reference:
    """Reference to an object of a manager.  Made and dropped without waiting."""

    def __init__(self, session: ManagerSession, ident: str) -> None:
        self._session = session
        self._ident = ident
        session.add_reference(ident)
        session.notify(INCREF, ident)

    def __del__(self) -> None:
        if self._session.pid == os.getpid():
            self._session.drop_reference(self._ident)


class TravellingToken(Token):
    """Token that keeps its object while the token is on its way to another process.

    That works where Fiber knows when the token has arrived.  In multiprocessing the object may be
    gone before the process has a proxy.
    """

    def __reduce__(self) -> tuple[Any, ...]:
        address: Any = self.address
        known = _sessions.get(address)
        if known is not None:
            handles.keep_until_released(Reference(known, str(self.id)))
        return type(self), (self.typeid, address, self.id)


def _open_channel(carrier: Channel, *notice: str) -> LocalChannel:
    """Send one end of a new channel to the server; return the other once the server has it."""
    ours, theirs = LocalChannel.pair()
    # The grant is taken back below.  If no server receives it, the pipe ends, and so does the wait.
    with collecting_grants(reusable=False) as grants:
        invitation = pickle.dumps((*notice, theirs))
    theirs.close()
    try:
        carrier.send(invitation)
        while not ours.poll(_LOOK_AGAIN):
            if carrier.poll(0):  # the server sends nothing there, so this is the end
                raise ConnectionClosed()
        ours.recv().release()
    finally:
        grants.release()
    return ours


class ManagerConnection:
    """Connection to a manager's server, with the methods that multiprocessing's proxies call."""

    def __init__(self, address: ManagerAddress) -> None:
        self._address = address
        self._opened: ManagerSession | None = None
        self._calls: list[tuple[Any, Request]] = []
        """Channels of the calls in progress, or their locks."""

    @property
    def _session(self) -> ManagerSession:
        if self._opened is None or self._opened.pid != os.getpid():  # this process was forked
            self._opened = session(self._address)
        return self._opened

    def send(self, request: Request) -> None:
        """Begin a call of an object's method, or of the server's own if the id is None."""
        ident, method, args, _ = request
        if ident is None and method == "accept_connection":
            return  # this thread gets its channel with its first call
        if ident is None and method == "decref":
            known = _sessions.get(self._address)
            if known is not None:  # a finalizer may call this, so it must not wait
                known.drop_reference(*args)
            return
        lock = self._session.lock_of(request)
        if lock is not None:
            self._calls.append((lock, request))
            return
        channel = self._session.free_channel()
        channel.busy = True
        try:
            channel.ask(request)
        except BrokenPipeError as error:
            self._session.give_up(channel)
            raise self._session.closed_error() from error
        except reduction.REFUSALS as error:
            channel.busy = False
            raise reduction.blame({f"the arguments of {method}()": request}, error) from error
        except BaseException:
            self._session.give_up(channel)  # the request may have been sent or not
            raise
        self._calls.append((channel, request))

    def recv(self) -> tuple[str, Any]:
        """Return how the last call ended."""
        if not self._calls:
            return "#RETURN", None  # the last request was not for the server
        channel, request = self._calls.pop()
        if not isinstance(channel, CallChannel):
            return "#RETURN", self._session.call_lock(channel, request)
        try:
            kind, result = channel.answer()
        except ConnectionClosed as error:
            if isinstance(error, ObjectUnreachable):
                channel.busy = False
                raise  # an object in the answer is unreachable, not the server
            self._session.give_up(channel)
            raise self._session.closed_error() from error
        except BaseException as error:
            # An answer that came and does not unpickle is the caller's.  Any other error is raised
            # by a signal's handler.
            if not (channel.answered and isinstance(error, Exception)):
                channel.take_back()
            # If a second interrupt prevents this, no later call waits behind the unanswered one.
            channel.busy = False
            raise
        channel.busy = False
        return self._interpret(kind, result, request)

    def _interpret(self, kind: str, result: Any, request: Request) -> tuple[str, Any]:
        ident, method, args, _ = request
        if kind == "#PROXY":
            return "#RETURN", proxy_of(self._session, *result)
        if kind == "#RETURN" and ident is None:
            if method == "create":
                self._session.add_reference(result[0])
            elif method == "incref":
                self._session.add_reference(*args, lock=result)
        return kind, result

    def close(self) -> None:
        """Do nothing: the thread keeps its channels."""


_sessions: weakref.WeakValueDictionary[ManagerAddress, ManagerSession] = (
    weakref.WeakValueDictionary()
)
_referenced: dict[ManagerAddress, ManagerSession] = {}
"""Sessions with references to objects, which keep them alive."""


def session(address: ManagerAddress) -> ManagerSession:
    """Return this process's session with the server at ``address``."""
    found = _sessions.get(address)
    if found is None:
        made = ManagerSession(address)
        found = _sessions.setdefault(address, made)  # another thread may have been faster
    return found


def connect(address: ManagerAddress, authkey: bytes | None = None) -> ManagerConnection:
    """Connect to a manager's server, as multiprocessing's ``Client`` does.

    No key is checked: only a process that received the address can have it.
    """
    return ManagerConnection(address)


def proxy_of(session: ManagerSession, make: Any, token: Token, exposed: tuple[str, ...]) -> Any:
    """Return the proxy of an object that a method has returned.

    multiprocessing asks the manager's registry for its class, which only one process has.
    """
    from fiber._managers import SERIALIZER

    session.add_reference(str(token.id))
    try:
        return make(token, SERIALIZER, exposed=exposed)
    finally:
        session.drop_reference(str(token.id))


def forget(address: ManagerAddress) -> None:
    """End the session with a server that has been shut down."""
    session = _sessions.pop(address, None)
    _referenced.pop(address, None)
    if session is not None:
        session.end()


def thread_name() -> str:
    """Return the name of this thread, for the threads of the server."""
    name = current_process().name
    return name if current_thread() is main_thread() else f"{name}|{current_thread().name}"


_disowns_in = 0


def _disown_at_exit() -> None:
    global _disowns_in
    if _disowns_in != os.getpid():
        _disowns_in = os.getpid()
        util.Finalize(None, _disown_all, exitpriority=_BEFORE_EXIT)


def _disown_all() -> None:
    for one in list(_sessions.values()):
        one.disown_locks()


def _after_fork() -> None:
    """Forget the sessions in a forked process: they belong to its parent."""
    for one in list(_sessions.values()):
        one.end()
    _sessions.clear()
    _referenced.clear()


os.register_at_fork(after_in_child=_after_fork)
