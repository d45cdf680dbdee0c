"""``Ring``: processes that know their rank, each connected to the next, as in all-reduce.

::

    def train(rank, size):
        ring = fiber.ring.current()
        received = ring.exchange(sent)  # to the next member, and from the previous one

    fiber.Ring(4, train).run()
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, Generic, NamedTuple, NoReturn, TypeVar

from fiber._agent.exception_pickles import PickledException
from fiber._exceptions import add_note, fresh
from fiber._runtime import options
from fiber.connection import Connection, Pipe, wait
from fiber.errors import ConnectionClosed, MemberLost
from fiber.process import Process
from fiber.resources import resources_of, with_resources

__all__ = ["Member", "Ring", "current"]

_T = TypeVar("_T")

_member: Member | None = None


def current() -> Member:
    """Return the member of a ring that this process is; RuntimeError if it is no member."""
    if _member is None:
        raise RuntimeError("this process is no member of a ring: fiber.Ring(...).run() starts some")
    return _member


class _End(NamedTuple):
    """Message to members about a member that has ended."""

    rank: int
    lost: bool
    how: str


class Member:
    """A process of a ring: its ``rank``, from 0, among ``size``, and links to its neighbours."""

    def __init__(
        self, rank: int, size: int, to_next: Connection, from_previous: Connection, news: Connection
    ) -> None:
        self.rank = rank
        self.size = size
        self._next = to_next
        self._previous = from_previous
        self._news = news
        self._ends: dict[int, _End] = {}

    @property
    def lost(self) -> dict[int, str]:
        """Ranks of the members that are known to be lost, and how each ended."""
        while self._news.poll():
            self._receive_end()
        return {end.rank: end.how for end in self._ends.values() if end.lost}

    def send(self, obj: Any) -> None:
        """Send to the next member; MemberLost if it has ended.

        Above 256 KiB this waits until the object is received.  If all members send, use
        ``exchange``.
        """
        try:
            self._next.send(obj)
        except (BrokenPipeError, ConnectionClosed):
            self._await_end((self.rank + 1) % self.size)

    def recv(self) -> Any:
        """Receive from the previous member.

        MemberLost if the previous member has ended, or if any member is lost meanwhile.
        """
        while not self._previous.poll():
            for rank, how in self.lost.items():
                raise MemberLost(rank, how)
            wait([self._previous, self._news])
        try:
            return self._previous.recv()
        except ConnectionClosed:
            self._await_end((self.rank - 1) % self.size)

    def exchange(self, obj: Any) -> Any:
        """Send to the next member and receive from the previous one.

        All members must call this at the same step.
        """
        if self.size == 1:
            return obj
        if self.rank % 2 == 0:
            self.send(obj)
            return self.recv()
        received = self.recv()  # half receive first: otherwise all could wait for each other
        self.send(obj)
        return received

    def _await_end(self, rank: int) -> NoReturn:
        """Wait for the message about a member whose connection has closed; raise MemberLost."""
        while rank not in self._ends:
            self._receive_end()
        first = next((end for end in self._ends.values() if end.lost), self._ends[rank])
        raise MemberLost(first.rank, first.how)

    def _receive_end(self) -> None:
        end: _End = self._news.recv()
        self._ends[end.rank] = end


class Ring(Generic[_T]):
    """A number of ``processes``, each of which calls ``func(rank, size)``.

    Before that, each calls ``initializer(member, *initargs)`` with its ``Member``, which
    ``current()`` returns from then on.  On Kubernetes members are in pods, which have the resources
    that ``fiber.meta`` wishes for ``func``.
    """

    def __init__(
        self,
        processes: int,
        func: Callable[[int, int], _T],
        initializer: Callable[..., object] | None = None,
        initargs: Iterable[Any] = (),
    ) -> None:
        size = options.positive("processes", processes)
        if size is None:
            raise TypeError("processes must be a whole number, not None")
        if not callable(func):
            raise TypeError(f"func must be a callable, not {func!r}")
        if initializer is not None and not callable(initializer):
            raise TypeError("initializer must be a callable")
        self.size = size
        self._work = partial(_run, func=func, initializer=initializer, initargs=tuple(initargs))
        self._wishes = resources_of(func)

    def run(self) -> list[_T]:
        """Start the members and wait until all have ended; return their results, by rank.

        When a member raises or is lost, members that wait for it get MemberLost.  Once all have
        ended, ``run`` raises the first error.  Ctrl-C kills the members.
        """
        links = [Pipe(duplex=False) for _ in range(self.size)]
        channels = [Pipe() for _ in range(self.size)]
        processes: list[Process] = []
        ended = False
        try:
            for rank in range(self.size):
                (_, to_next), (from_previous, _) = links[rank], links[rank - 1]
                member = Member(rank, self.size, to_next, from_previous, channels[rank][1])
                work = with_resources(self._work, self._wishes)
                process = Process(target=work, args=(member,), name=f"RingMember-{rank}")
                processes.append(process)  # first, as an interrupt may follow the start at once
                process.start()
            _close([end for link in links for end in link])
            _close([of_member for _, of_member in channels])
            results = _await_all([of_program for of_program, _ in channels])
            ended = True
            return results
        finally:
            try:
                _end([process for process in processes if process._popen], kill=not ended)
            finally:
                _close([end for pair in (*links, *channels) for end in pair])


def _end(processes: list[Process], *, kill: bool) -> None:
    """Wait for the members; with ``kill``, and also if Ctrl-C ends the wait, kill them first."""
    try:
        if kill:
            _kill(processes)
        for process in processes:
            process.join()
    except BaseException:
        _kill(processes)
        raise


def _kill(processes: list[Process]) -> None:
    try:
        for process in processes:
            process.kill()
    except BaseException:  # interrupted: those that are left must not run on
        _kill(processes)
        raise


def _await_all(channels: list[Connection]) -> list[Any]:
    """Wait until all members have ended; report each end to the members that it concerns."""
    running = dict(enumerate(channels))
    results: list[Any] = [None] * len(channels)
    failure: BaseException | None = None
    while running:
        ready = wait(running.values())
        for rank, channel in list(running.items()):
            if channel in ready:
                del running[rank]
                end, results[rank], error = _outcome(rank, channel)
                failure = error if failure is None else failure
                _report(end, running, len(channels))
    if failure is not None:
        raise fresh(failure)
    return results


def _outcome(rank: int, channel: Connection) -> tuple[_End, Any, BaseException | None]:
    """Return how a member ended, its result, and the error to raise."""
    try:
        result, error = channel.recv()
    except ConnectionClosed as closed:
        how = closed.reason or "its process ended"
        return _End(rank, True, how), None, MemberLost(rank, how)
    except Exception as unreadable:  # its class cannot be imported here, for instance
        add_note(unreadable, f"the result of member {rank} of the ring cannot be unpickled here")
        return _End(rank, True, "its result cannot be unpickled"), None, unreadable
    if error is not None:
        add_note(error, f"raised by member {rank} of the ring")
        return _End(rank, True, f"it raised {type(error).__name__}: {error}"), None, error
    return _End(rank, False, "it has returned"), result, None


def _report(end: _End, running: dict[int, Connection], size: int) -> None:
    """Send a loss to all members, and any other end to the neighbours."""
    neighbours = {(end.rank - 1) % size, (end.rank + 1) % size}
    for rank in running if end.lost else neighbours & running.keys():
        with contextlib.suppress(BrokenPipeError, ConnectionClosed):
            running[rank].send(end)


def _close(connections: list[Connection]) -> None:
    for connection in connections:
        connection.close()


def _run(
    member: Member,
    func: Callable[[int, int], Any],
    initializer: Callable[..., object] | None,
    initargs: tuple[Any, ...],
) -> None:
    """Run a member: the target of its process."""
    global _member
    _member = member
    try:
        if initializer is not None:
            initializer(member, *initargs)
        member._news.send((func(member.rank, member.size), None))
    except Exception as error:  # also of a result that does not pickle
        with contextlib.suppress(BrokenPipeError, ConnectionClosed):  # the program is gone
            member._news.send((None, PickledException(error)))
