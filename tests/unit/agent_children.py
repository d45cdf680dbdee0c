"""Functions of the children in test_agent.py, and their observers."""

from __future__ import annotations

import os
import pickle
import threading
from collections.abc import Callable
from typing import Any, NoReturn

from fiber._agent import child
from fiber._agent.interface import ExitReport
from fiber._agent.usage import Usage
from fiber._transport.link import LinkObserver
from fiber._transport.link_protocol import Lane
from fiber._wire import messages, packet
from fiber._wire.memory_files import BytesLike
from patience import PATIENCE


class Recorder:
    """A ``ChildObserver`` that a test can wait for."""

    def __init__(self) -> None:
        self.events: list[str] = []
        self.words: list[Any] = []
        self.usages: list[Usage] = []
        self.unread: list[int] | None = None
        self.pid: int | None = None
        self.report: ExitReport | None = None
        self._changed = threading.Condition()

    def started(self, pid: int) -> None:
        self.pid = pid
        self._note("started")

    def received(self, message: packet.Message) -> None:
        self.words.append(packet.loads(message))
        self._note("received")

    def recalled(self, seqs: list[int]) -> None:
        self.unread = seqs
        self._note("taken back")

    def measured(self, usage: Usage) -> None:
        self.usages.append(usage)
        self._note("measured")

    def showed_stack(self, text: str) -> None:
        self.words.append(text)
        self._note("showed stack")

    def draining(self) -> None:
        self._note("draining")

    def exited(self, report: ExitReport) -> None:
        self.report = report
        self._note("exited")

    def _note(self, event: str) -> None:
        with self._changed:
            self.events.append(event)
            self._changed.notify_all()

    def wait_for_start(self) -> int:
        self._wait("started")
        assert self.pid is not None
        return self.pid

    def wait_for_exit(self) -> ExitReport:
        self._wait("exited")
        assert self.report is not None
        return self.report

    def wait_for_recall(self) -> list[int]:
        self._wait("taken back")
        assert self.unread is not None
        return self.unread

    def wait_for_words(self, count: int) -> list[Any]:
        with self._changed:
            assert self._changed.wait_for(lambda: len(self.words) >= count, PATIENCE), self.events
        return self.words

    def _wait(self, event: str) -> None:
        with self._changed:
            assert self._changed.wait_for(lambda: event in self.events, PATIENCE), self.events


def run_forever() -> NoReturn:
    while True:
        threading.Event().wait()


def read_never() -> NoReturn:
    """A worker that says it is in task 4 of batch 17 and reads nothing."""
    place = child.progress()
    place[0] = 0
    place[1] = 4
    place[0] = 17
    child.task_channel().send(pickle.dumps("ready"))
    run_forever()


def answer_sums() -> None:
    """A worker that answers each number with it plus the size of what came beside it."""
    channel = child.task_channel()
    while True:
        message = channel.recv()
        seq = int.from_bytes(message.payload[:8], "little")
        value = pickle.loads(message.payload[8:])
        size = sum(buffer.nbytes for buffer in message.buffers)
        message.release()
        if value == "stop":
            return
        channel.send(pickle.dumps((seq, value + size)))


def talk_nonsense(packet_of_it: bytes) -> NoReturn:
    """A worker whose message is none."""
    child.task_channel().sock.send(packet_of_it)
    run_forever()


class Handle:
    """Becomes, in the child, descriptor ``index`` of those that came with the start message."""

    def __init__(self, index: int) -> None:
        self._index = index

    def __reduce__(self) -> tuple[Any, ...]:
        return child.take_descriptor, (self._index,)


def write_own_index(fds: list[int]) -> None:
    for index, fd in enumerate(fds):
        os.write(fd, str(index).encode())


class ReadLink:
    """A link whose frames leave at once, and are kept for the test to read."""

    def __init__(self) -> None:
        self.sent: list[messages.LinkMessage] = []

    def attach(self, observer: LinkObserver) -> None:
        pass

    def send(
        self, *frame: BytesLike, lane: Lane = None, on_left: Callable[[], None] | None = None
    ) -> None:
        self.sent.append(messages.decode(b"".join(frame)))
        if on_left is not None:
            on_left()
