"""Making the grants that pickled handles carry, and taking them back."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable, Iterator
from typing import NamedTuple

from fiber._hub import access
from fiber._hub.access import Access
from fiber._hub.client import Line, Unreachable
from fiber._hub.protocol import ONE, TWO, Kind, Op, Terms
from fiber._hub.registry import Registry
from fiber._hub.remote import RemoteObject


class Granted(NamedTuple):
    """What a handle is made of."""

    home: Access
    number: int
    grant: int


class GrantSet:
    """Grants that last until they are released, the set is forgotten or this process ends.

    ``reusable``: for what may be unpickled any number of times, as a task that may run again.
    Otherwise each also ends with its first use, as what is given to a new process.
    """

    __slots__ = ("_direct", "_lines", "_terms")

    def __init__(self, *, reusable: bool = True) -> None:
        self._terms = Terms.BOUND | (Terms.REUSABLE if reusable else 0)
        self._direct: list[tuple[Registry, int]] = []
        self._lines: dict[Access, Line] = {}

    def __bool__(self) -> bool:
        """Whether there is anything to release."""
        return bool(self._direct or self._lines)

    def for_local(self, kind: Kind, fd: int) -> Granted:
        """A grant for an object of this host."""
        hub = access.own_hub()
        if hub is not None:
            reusable = bool(self._terms & Terms.REUSABLE)
            number, grant = hub.registry.register(kind, fd, reusable=reusable)
            self._direct.append((hub.registry, grant))
            return Granted(hub.access, number, grant)
        own = access.current()
        return _ask_local(self._line(own), own, kind, fd, self._terms)

    def for_remote(self, end: RemoteObject) -> Granted:
        """A grant for an object of another host."""
        reply = self._line(end.home).ask(Op.GRANT, end.number, self._terms, form=TWO)
        return Granted(end.home, *reply.values)

    def release(self) -> None:
        """Nobody unpickles the handles any more."""
        direct, self._direct = self._direct, []
        lines, self._lines = self._lines, {}
        for registry, grant in direct:
            registry.release(grant)
        for line in lines.values():
            line.close()  # a hub takes back what was granted on a stream when it ends

    def __del__(self) -> None:
        # Whoever lets go of it, or the collector, may be in the middle of anything.
        for registry, grant in self._direct:
            registry.release_soon(grant)
        for line in self._lines.values():
            line.close()

    def _line(self, home: Access) -> Line:
        if home not in self._lines:
            self._lines[home] = Line(home)
        return self._lines[home]


class _SingleUse:
    """Grants for whoever unpickles a handle first; they outlive this process."""

    def __init__(self) -> None:
        self._forget()
        os.register_at_fork(after_in_child=self._forget)

    def _forget(self) -> None:
        self._lock = threading.Lock()
        self._line: Line | None = None
        self._line_to: Access | None = None

    def for_local(self, kind: Kind, fd: int) -> Granted:
        """A grant for an object of this host."""
        hub = access.own_hub()
        if hub is not None:
            number, grant = hub.registry.register(kind, fd, reusable=False)
            _attempt.undo.append(lambda: hub.registry.release(grant))
            return Granted(hub.access, number, grant)
        with self._lock:
            granted = self._register(access.current(), kind, fd)
        _attempt.undo.append(lambda: self._release(granted.grant))
        return granted

    def for_remote(self, end: RemoteObject) -> Granted:
        """A grant for an object of another host."""
        with end.line() as line:
            reply = line.ask(Op.GRANT, end.number, Terms(0), form=TWO)
        granted = Granted(end.home, *reply.values)
        _attempt.undo.append(lambda: _release_remote(end, granted.grant))
        return granted

    def _register(self, own: Access, kind: Kind, fd: int) -> Granted:
        if self._line is None or self._line_to != own:
            self._line, self._line_to = Line(own), own
        try:
            return _ask_local(self._line, own, kind, fd, Terms(0))
        except BaseException:
            # Whatever it was, Ctrl-C or the hub's refusal, the next one begins anew.
            self._line.close()
            self._line = None
            raise

    def _release(self, grant: int) -> None:
        with self._lock:
            if self._line is not None:
                self._line.say(Op.RELEASE, grant, form=ONE)


def _ask_local(line: Line, own: Access, kind: Kind, fd: int, terms: Terms) -> Granted:
    reply = line.ask(Op.REGISTER, kind, terms, form=TWO, fds=[fd])
    return Granted(own, *reply.values)


def _release_remote(end: RemoteObject, grant: int) -> None:
    with end.line() as line:
        line.say(Op.RELEASE, grant, form=ONE)


class _Attempt(threading.local):
    """The pickling that this thread is at."""

    def __init__(self) -> None:
        self.collecting: GrantSet | None = None
        self.undo: list[Callable[[], None]] = []


_attempt = _Attempt()
_single_use = _SingleUse()


def current() -> GrantSet | _SingleUse:
    """What the handle that is being pickled gets its grant from."""
    collecting = _attempt.collecting
    return _single_use if collecting is None else collecting


@contextlib.contextmanager
def collecting_grants(*, reusable: bool = True) -> Iterator[GrantSet]:
    """Handles pickled on this thread within the block work until the yielded set is released.

    If the block raises, it is released.  Not ``reusable``: each works once.
    """
    grants = GrantSet(reusable=reusable)
    before, _attempt.collecting = _attempt.collecting, grants
    try:
        yield grants
    except BaseException:
        grants.release()
        raise
    finally:
        _attempt.collecting = before


def begin_attempt() -> None:
    """This thread begins to pickle something outside of ``collecting_grants``."""
    _attempt.undo.clear()


def granted() -> bool:
    """Whether this attempt granted anything, which works once."""
    return bool(_attempt.undo)


def undo_attempt() -> None:
    """It did not work out: what was granted meanwhile, nobody will ever use."""
    undo, _attempt.undo = _attempt.undo, []
    for step in undo:
        with contextlib.suppress(OSError, Unreachable):  # the hub is gone, and all with it
            step()
