"""Sender of the hub into a one-way channel: how long it waits for room in the socket."""

from __future__ import annotations

import select
from collections import deque
from collections.abc import Callable
from typing import Any, cast

from fiber._hub.hosted import HostedSender
from fiber._hub.one_way import SendingEnd
from fiber._hub.protocol import Status


class Channel:
    """Sending end whose room and patience a test sets."""

    room_events = select.POLLIN

    def __init__(self) -> None:
        self.has_room = False
        self.left: list[tuple[int, float]] = []
        """Answers of ``patience``."""
        self.sent: list[str] = []

    def fileno(self) -> int:
        return 7

    def try_send_directly(self, _payload: bytes, _buffers: object) -> bool:
        if self.has_room:
            self.sent.append("socket")
        return self.has_room

    def patience(self, _begin: float) -> tuple[int, float]:
        return self.left.pop(0)

    def try_send(self, _payload: bytes, _buffers: object) -> bool:
        self.sent.append("backlog")
        return True


class Site:
    """A hosted sender with one waiting request; the loop and the poller are the test's."""

    def __init__(self) -> None:
        self.channel = Channel()
        self.timers: list[tuple[float, Callable[[], None]]] = []
        self.watched = 0
        self.event: Callable[[int], None] = lambda _: None
        self.answers: list[Status] = []
        loop, poller, channel = cast(Any, self), cast(Any, self), cast(SendingEnd, self.channel)
        self.sender = HostedSender(loop, poller, channel)

    def call_later(self, seconds: float, call: Callable[[], None]) -> None:
        self.timers.append((seconds, call))

    def watch(self, _fd: int, mask: int, event: Callable[[int], None]) -> None:
        self.watched, self.event = mask, event

    def answer(self, status: Status, *_: object) -> None:
        self.answers.append(status)

    def refuse(self, error: Exception) -> None:
        raise error

    def send(self) -> None:
        self.sender.send(self, deque([(b"message", ())]))

    def time_passes(self) -> None:
        """Run the calls that wait for their time."""
        timers, self.timers = self.timers, []
        for _, call in timers:
            call()


def test_it_waits_for_room_in_the_socket_first() -> None:
    site = Site()
    site.channel.left = [(select.POLLOUT, 0.05)]
    site.send()
    assert (site.channel.sent, site.answers) == ([], [])
    assert [seconds for seconds, _ in site.timers] == [0.05]
    assert site.watched & select.POLLOUT
    site.channel.has_room = True
    site.event(select.POLLOUT)
    assert (site.channel.sent, site.answers) == (["socket"], [Status.OK])


def test_after_its_patience_the_message_goes_into_the_backlog() -> None:
    site = Site()
    site.channel.left = [(0, 0.001), (0, 0.0)]
    site.send()
    assert site.channel.sent == []
    site.time_passes()
    assert (site.channel.sent, site.answers) == (["backlog"], [Status.OK])


def test_one_timer_runs_at_a_time() -> None:
    site = Site()
    site.channel.left = [(0, 0.001)] * 2
    site.send()
    site.sender._event(select.POLLOUT)
    assert len(site.timers) == 1


def test_a_closed_sender_sends_nothing_later() -> None:
    site = Site()
    site.channel.left = [(0, 0.001)]
    site.send()
    site.forget = site.channel.close = lambda *_: None  # type: ignore[attr-defined]
    site.sender.close()
    site.time_passes()
    assert (site.channel.sent, site.answers) == ([], [])
