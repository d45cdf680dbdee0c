"""The client's side: a session with each manager's server that this process uses.

::

    proxies ── ManagerConnection ── CallChannel, for each thread ──► a thread of the server
                    └──────────── control channel ────────────────►  notices of this process

A call channel has one call in progress at a time.  Notices on the control channel have no answer,
so a finalizer may send one wherever the garbage collector runs.  A notice opens a call channel, or
changes a reference count.  The end of the control channel tells the server that this process ended.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import os
import pickle
import struct
import time
import warnings
import weakref
from collections import deque
from multiprocessing import util
from multiprocessing.managers import Token
from multiprocessing.process import BaseProcess, current_process
from threading import current_thread, main_thread
from typing import Any, NamedTuple

from fiber import reduction
from fiber._hub import handles
from fiber._hub.client import ObjectUnreachable, host
from fiber._hub.handles import HubHandle, collecting_grants
from fiber._hub.local import LocalChannel
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

JOIN, OPEN_CHANNEL, INCREF, DECREF, LEAVE = "join", "channel", "incref", "decref", "leave"
"""First words of the notices to a server.  The values are part of the wire format."""

_LOOK_AGAIN = 0.5
"""Seconds between checks that the server is alive, while it has not taken a new channel."""

_FILES_AGAIN = 0.05
"""Seconds between attempts to receive a channel when this process may open no more files."""

_ACQUIRING = ("acquire", "wait")
"""Methods whose results are no objects of the user's."""

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
        self._references = 0
        self._ended = False
        self._notices: deque[tuple[str, ...]] = deque()
        self._of_thread: Any = util.ForkAwareLocal()
        try:
            listener = handles.channel(address.listener)
            try:
                self._control = _open_channel(listener, JOIN, process_description())
            finally:
                listener.close()
        except (ConnectionClosed, BrokenPipeError) as error:
            raise self.closed_error() from error

    def open_channel(self, holder: str) -> LocalChannel:
        """Open a channel to a new thread of the server, which acts for the lock holder ``holder``.

        All channels of one holder share the locks that they acquire.
        """
        try:
            return _open_channel(self._control, OPEN_CHANNEL, thread_name(), holder)
        except (ConnectionClosed, BrokenPipeError) as error:
            raise self.closed_error() from error

    def free_channel(self) -> CallChannel:
        """Return a channel of this thread that has no call in progress."""
        if self._ended:
            raise self.closed_error()
        channels: list[CallChannel] | None = getattr(self._of_thread, "channels", None)
        if channels is None:
            self._of_thread.holder = new_holder()
            channels = self._of_thread.channels = []
        for channel in channels:
            if channel.is_free():
                return channel
        return self._new_channel()

    def _new_channel(self) -> CallChannel:
        channel = CallChannel(self.open_channel(self._of_thread.holder))
        self._of_thread.channels.append(channel)
        return channel

    def replace(self, channel: CallChannel) -> None:
        """Replace a channel whose answer is not read.  This thread keeps its locks."""
        with contextlib.suppress(ConnectionClosed):
            self._new_channel()
        self.give_up(channel)

    def give_up(self, channel: CallChannel) -> None:
        """Close a channel whose answer is not read."""
        channel.close()
        channels: list[CallChannel] = getattr(self._of_thread, "channels", [])
        if channel in channels:
            channels.remove(channel)

    def add_reference(self) -> None:
        """Count a new reference to an object of the manager."""
        self._references += 1
        _referenced[self.address] = self

    def drop_reference(self, ident: str) -> None:
        """Drop a reference to an object.  May be called from anywhere, also from a finalizer."""
        self.notify(DECREF, ident)
        self._references -= 1
        if self._references <= 0:
            _referenced.pop(self.address, None)

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

    def close(self) -> None:
        """End the session in order.  The server does not release the locks of this process."""
        _referenced.pop(self.address, None)
        _sessions.pop(self.address, None)
        self.notify(LEAVE)

    def end(self) -> None:
        """Close all channels: the server has ended, or this process is a fork of their owner."""
        self._ended = True
        self._control.close()
        for channel in getattr(self._of_thread, "channels", []):
            channel.close()

    def __del__(self) -> None:
        if hasattr(self, "_control") and self.pid == os.getpid():
            self.notify(LEAVE)

    def closed_error(self) -> ConnectionClosed:
        """Return the error for a caller that finds the server's process ended."""
        process = self.process and self.process()
        return ConnectionClosed(self.address.server, how_it_ended(process) if process else None)


class Reference:
    """Reference to an object of a manager.  Made and dropped without waiting."""

    def __init__(self, session: ManagerSession, ident: str) -> None:
        self._session = session
        self._ident = ident
        session.add_reference()
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
        self._calls: list[tuple[CallChannel, str, str | None]] = []

    @property
    def _session(self) -> ManagerSession:
        if self._opened is None or self._opened.pid != os.getpid():  # this process was forked
            self._opened = session(self._address)
        return self._opened

    def send(self, request: tuple[str | None, str, tuple[Any, ...], dict[str, Any]]) -> None:
        """Begin a call of an object's method, or of the server's own if the id is None."""
        ident, method, args, _ = request
        if ident is None and method == "decref":
            known = _sessions.get(self._address)
            if known is not None:  # a finalizer may call this, so it must not wait
                known.drop_reference(*args)
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
            self._session.replace(channel)  # the request may have been sent or not
            raise
        self._calls.append((channel, method, ident))

    def recv(self) -> tuple[str, Any]:
        """Return how the last call ended."""
        if not self._calls:
            return "#RETURN", None  # a decref has no answer
        channel, method, ident = self._calls.pop()
        try:
            kind, result = channel.answer()
        except ConnectionClosed as error:
            if isinstance(error, ObjectUnreachable):
                raise  # an object in the answer is unreachable, not the server
            self._session.give_up(channel)
            raise self._session.closed_error() from error
        except BaseException as error:
            # An answer that came and does not unpickle is the caller's.  Any other error is raised
            # by a signal's handler.
            if method in _ACQUIRING or not (channel.answered and isinstance(error, Exception)):
                channel.take_back()
            raise
        finally:
            channel.busy = False
        return self._interpret(kind, result, method, ident)

    def _interpret(self, kind: str, result: Any, method: str, ident: str | None) -> tuple[str, Any]:
        if kind == "#PROXY":
            return "#RETURN", proxy_of(self._session, *result)
        if kind == "#WARNING":
            text, acquired = result
            self._warn(text, ident)
            return "#RETURN", acquired
        if kind == "#RETURN" and ident is None and method in ("create", "incref"):
            self._session.add_reference()
        return kind, result

    def _warn(self, text: str, ident: str | None) -> None:
        try:
            warnings.warn(text, RuntimeWarning, stacklevel=6)
        except BaseException:  # a filter made it an error, so the lock is not acquired
            self.send((ident, "release", (), {}))
            self.recv()
            raise

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
        _close_at_exit()
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

    session.add_reference()
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


_holders = itertools.count()


def new_holder() -> str:
    """Return the name of a new lock holder, for the servers that this process uses."""
    return str(next(_holders))


def process_description() -> str:
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


def _after_fork() -> None:
    """Forget the sessions in a forked process: they belong to its parent."""
    for one in list(_sessions.values()):
        one.end()
    _sessions.clear()
    _referenced.clear()


os.register_at_fork(after_in_child=_after_fork)
