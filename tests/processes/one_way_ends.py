"""Ends of one-way channels for tests, and what tests do with them."""

from __future__ import annotations

from collections.abc import Callable

from fiber._hub.one_way import ReceivingEnd, SendingEnd

MORE_THAN_A_SOCKET = 1000
"""Small messages that no socket holds."""

Ends = tuple[ReceivingEnd, SendingEnd]


def overflow(sender: SendingEnd, count: int = MORE_THAN_A_SOCKET) -> None:
    for number in range(count):
        assert sender.try_send(b"%d" % number)
    assert sender.backlog


def drain(receiver: ReceivingEnd) -> list[bytes]:
    taken = []
    while (message := receiver.try_recv()) is not None:
        taken.append(message.tobytes())
    return taken


def numbers(count: int) -> list[bytes]:
    return [b"%d" % number for number in range(count)]


def filled(send: Callable[[], bool]) -> int:
    """Return how often ``send`` succeeded until it did not."""
    count = 0
    while send():
        count += 1
    return count
