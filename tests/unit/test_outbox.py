"""The outbox: nothing blocks, nothing is lost or overtaken, no descriptor stays."""

from __future__ import annotations

import errno
import os
import socket
import sys
import threading
from collections.abc import Iterator

import pytest

import census
from fiber._transport.channels import Outbox, socketpair
from fiber._transport.loop import Loop
from fiber._wire import packet
from fiber.errors import TooManyOpenFiles
from patience import PATIENCE

FULL = bytes(60_000)
"""A few of these fill a socket's buffer."""


@pytest.fixture
def ends(loop: Loop) -> Iterator[tuple[Outbox, socket.socket]]:
    """An outbox and the socket at the other end of it."""
    ours, theirs = socketpair("a test")
    ours.setblocking(False)
    theirs.settimeout(PATIENCE)
    box = Outbox(loop, ours)
    loop.register(ours.fileno(), lambda: None)
    yield box, theirs
    closed = threading.Event()

    def close() -> None:
        loop.unregister(ours.fileno())
        box.close()
        closed.set()

    loop.call_soon(close)
    assert closed.wait(PATIENCE)
    ours.close()
    theirs.close()
    packet._arena._forget()


def received(sock: socket.socket) -> bytes:
    return packet.receive(sock).tobytes()


def held_by_others(fd: int) -> bool:
    """Return whether another process still holds the writing end of this pipe."""
    os.set_blocking(fd, False)
    try:
        return os.read(fd, 1) != b""
    except BlockingIOError:
        return True


def test_order_is_kept_across_a_full_socket(ends: tuple[Outbox, socket.socket]) -> None:
    box, theirs = ends
    sent = [index.to_bytes(2, "big") + FULL[index:] for index in range(40)]
    for payload in sent:
        box.send(payload)
    assert [received(theirs) for _ in sent] == sent


def test_many_threads_send_at_once(ends: tuple[Outbox, socket.socket]) -> None:
    box, theirs = ends

    def send(me: int) -> None:
        for index in range(50):
            box.send(bytes([me, index]) + FULL[:9000])

    threads = [threading.Thread(target=send, args=(me,)) for me in range(4)]
    for thread in threads:
        thread.start()
    heads = [received(theirs)[:2] for _ in range(200)]
    for thread in threads:
        thread.join()
    for me in range(4):
        assert [head[1] for head in heads if head[0] == me] == list(range(50))


def test_large_messages_and_buffers_wait_too(ends: tuple[Outbox, socket.socket]) -> None:
    box, theirs = ends
    for _ in range(10):
        box.send(FULL)
    data = os.urandom(300_000)
    box.send(b"head", [memoryview(data)])
    for _ in range(10):
        received(theirs)
    message = packet.receive(theirs)
    assert bytes(message.buffers[0]) == data
    assert message.tobytes() == b"head"


def test_descriptors_belong_to_the_outbox_whatever_happens(
    ends: tuple[Outbox, socket.socket],
) -> None:
    box, theirs = ends
    pipes = [os.pipe() for _ in range(3)]
    box.send(b"at once", fds=[pipes[0][1]])
    for _ in range(10):
        box.send(FULL)
    box.send(b"waiting", fds=[pipes[1][1]])
    assert FULL in box.recall()
    box.close()
    box.send(b"too late", fds=[pipes[2][1]])
    message = packet.receive(theirs, descriptors=True)
    assert held_by_others(pipes[0][0]), "the descriptor travels in the packet"
    message.close_descriptors()
    message.release()
    for reader, _ in pipes:
        assert not held_by_others(reader)
        os.close(reader)


def test_recall_returns_unsent_packets_in_order(ends: tuple[Outbox, socket.socket]) -> None:
    box, theirs = ends
    sent = [bytes([index]) + FULL for index in range(20)]
    for payload in sent:
        box.send(payload)
    recalled = box.recall()
    assert recalled
    arrived = [received(theirs) for _ in range(len(sent) - len(recalled))]
    assert [*arrived, *recalled] == sent
    assert box.recall() == []
    box.send(b"afterwards")
    assert received(theirs) == b"afterwards"


def test_descriptors_sent_to_a_closed_peer_are_closed(
    ends: tuple[Outbox, socket.socket],
) -> None:
    box, theirs = ends
    for _ in range(10):
        box.send(FULL)
    theirs.close()
    reader, writer = os.pipe()
    box.send(b"to nobody", fds=[writer])
    assert census.wait_until(lambda: not held_by_others(reader), PATIENCE)
    os.close(reader)


def test_a_message_that_cannot_be_sent_is_refused_to_its_sender_even_when_others_wait(
    ends: tuple[Outbox, socket.socket],
) -> None:
    box, theirs = ends
    for _ in range(10):
        box.send(FULL)
    with pytest.raises(ValueError, match="out-of-band buffers"):
        box.send(b"", [memoryview(b"x")] * 2000)
    box.send(b"after it")
    for _ in range(10):
        received(theirs)
    assert received(theirs) == b"after it"


def test_no_descriptor_for_a_large_message_that_waited_is_shown_once_and_tried_again(
    ends: tuple[Outbox, socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    box, theirs = ends
    refusals: list[int] = []
    shown: list[BaseException] = []
    original = packet.send

    def short_of_descriptors(*args: object, **options: object) -> bool:
        if len(args[2]) and len(refusals) < 3:  # type: ignore[arg-type]
            refusals.append(errno.EMFILE)
            raise TooManyOpenFiles("sending a message")
        return original(*args, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(sys, "excepthook", lambda _kind, error, _trace: shown.append(error))
    for _ in range(10):
        box.send(FULL)
    box.send(b"large", [memoryview(bytes(300_000))])
    monkeypatch.setattr(packet, "send", short_of_descriptors)
    for _ in range(10):
        received(theirs)
    message = packet.receive(theirs)
    assert message.tobytes() == b"large"
    assert len(refusals) == 3
    assert len(shown) <= 1
