"""Functions that the processes of the fault tests run."""

from __future__ import annotations

import contextlib
import ctypes
import os
import select
import signal
import sys
import threading
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import fiber


def nothing() -> None:
    pass


def same(value: Any) -> Any:
    return value


def exit_by(way: str) -> None:
    """End this process in one of the ways that a person's code does."""
    if way == "return":
        return
    if way == "raise":
        raise ValueError("on purpose")
    if way == "sys.exit":
        sys.exit(7)
    if way == "sys.exit text":
        sys.exit("a last word")
    if way == "os._exit":
        os._exit(9)
    if way == "abort":
        os.abort()
    if way == "segfault":
        ctypes.string_at(0)
    os.kill(os.getpid(), getattr(signal, way))
    block()


def block() -> NoReturn:
    """Wait for a signal that ends this process."""
    while True:
        threading.Event().wait()


def report_and_block(connection: Any) -> None:
    connection.send(os.getpid())
    block()


def hold(connection: Any) -> None:
    """Keep an end of a pipe until killed."""
    connection.send("held")
    block()


def echo(connection: Any) -> None:
    """Send back each message until the other end is closed."""
    while True:
        try:
            message = connection.recv()
        except EOFError:
            return
        connection.send(message)


def close_every_descriptor(connection: Any) -> None:
    """Close all that this process holds open, and go on."""
    connection.send("closing")
    os.closerange(3, 1 << 16)
    sys.exit(5)


def send_for_ever(connection: Any, size: int) -> NoReturn:
    message = bytes(size)
    while True:
        connection.send_bytes(message)


def ignore_sigterm(connection: Any) -> NoReturn:
    signal.signal(signal.SIGTERM, lambda *_: connection.send("not me"))
    connection.send("ready")
    block()


def ignore_sigint(connection: Any) -> NoReturn:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    connection.send("ready")
    block()


def exit_on_sigterm(connection: Any) -> NoReturn:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(42))
    connection.send("ready")
    block()


def outlive(pid: int, path: str) -> None:
    """Make the file, then wait until that process is gone."""
    fd = os.pidfd_open(pid)
    Path(path).touch()
    select.select([fd], [], [])


def spin() -> NoReturn:
    """Hold the interpreter."""
    while True:
        pass


def shrug_off_signals() -> NoReturn:
    for signum in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(signum, signal.SIG_IGN)
    block()


def get_for_ever(queue: Any) -> NoReturn:
    while True:
        queue.get()


def send_and_die(connection: Any, count: int) -> None:
    for number in range(count):
        connection.send(number)
    os.kill(os.getpid(), signal.SIGKILL)


def read_one_and_block(connection: Any) -> NoReturn:
    connection.send(("read", connection.recv()))
    block()


def read_all_and_report(connection: Any, count: int) -> None:
    connection.send(("read", [connection.recv() for _ in range(count)]))


def make_and_send_a_pipe(connection: Any) -> NoReturn:
    ours, theirs = fiber.Pipe()
    connection.send(theirs)
    theirs.close()
    ours.send("through the inner pipe")
    block()


def square_each(array: Any, connection: Any) -> None:
    with contextlib.suppress(EOFError):
        while True:
            number = connection.recv()
            array[number] *= number
            connection.send(number)


def write_half_and_die(array: Any) -> NoReturn:
    for index in range(len(array) // 2):
        array[index] = index + 1
    os.kill(os.getpid(), signal.SIGKILL)
    raise AssertionError


def make_and_send_an_array(connection: Any) -> NoReturn:
    array = fiber.RawArray("i", [1, 2, 3])
    connection.send(array)
    block()


def write_and_block(array: Any, connection: Any) -> NoReturn:
    array[0] = 1
    connection.send(None)
    block()


def slow_square(number: int) -> int:
    time.sleep(0.01)
    return number * number


def get_one_and_block(queue: Any, connection: Any) -> NoReturn:
    connection.send(queue.get())
    block()


def echo_without(connection: Any, other_end: Any, _: object) -> None:
    """Close the other end here, and send back each message until it is closed elsewhere too."""
    other_end.close()
    echo(connection)


def echo_each(connections: list[Any]) -> NoReturn:
    """Send back one message of each connection, then block."""
    for connection in connections:
        connection.send(connection.recv())
    block()


def echo_bytes(connection: Any) -> None:
    """Send back bytes, until the other end is closed."""
    while True:
        try:
            message = connection.recv_bytes()
        except EOFError:
            return
        connection.send_bytes(message)


def obey(orders: Any) -> None:
    """Run the calls of a manager's queue until killed."""
    kept = []
    while True:
        method, args = orders.get()
        kept.append(args)  # proxies live on
        ORDERS[method](*args)


def _acquire(lock: Any, done: Any) -> None:
    lock.acquire()
    done.set()


def _queue_up(lock: Any, begun: Any) -> None:
    begun.set()
    lock.acquire()


def _get(queue: Any, begun: Any) -> None:
    begun.set()
    queue.get()


def _wait(barrier: Any) -> None:
    barrier.wait()


def _wait_notified(condition: Any, begun: Any) -> None:
    with condition:
        begun.set()
        condition.wait()


def _make(address: Any, proxies: Any) -> None:
    from fiber.managers import SyncManager

    manager = SyncManager(address)
    manager.connect()
    made = manager.list(["made"])
    proxies.put(made)
    block()


ORDERS: dict[str, Callable[..., None]] = {
    "acquire": _acquire,
    "get": _get,
    "make": _make,
    "queue_up": _queue_up,
    "wait": _wait,
    "wait_notified": _wait_notified,
}


def touch_until_it_fails(shared: Any, connection: Any) -> None:
    """Use a proxy until it raises, and send the error."""
    shared.append(1)
    connection.send("touched")
    try:
        while True:
            len(shared)
    except Exception as error:
        connection.send(f"{type(error).__name__}: {error}")


def read_as_told(queue: Any, orders: Any) -> None:
    """Call methods of a queue by name, and send their results."""
    while True:
        orders.send(getattr(queue, orders.recv())())


def read_one(queue: Any, sent: Any) -> None:
    sent.put(queue.get())


def make_a_push_queue(connection: Any) -> None:
    """Send a queue with an item in it, and the same again when asked."""
    from fiber.queues import SimpleQueuePush

    queue: SimpleQueuePush[int] = SimpleQueuePush()
    queue.put(1)
    connection.send(queue)
    connection.recv()
    connection.send(queue)
    block()


def content(size: int) -> bytes:
    """Return bytes whose pieces differ, for pieces of any size."""
    return bytes(range(251)) * (size // 251 + 1)


def checksum(data: bytes) -> int:
    return zlib.crc32(data)


def echo_large(connection: Any, requests: Any, replies: Any) -> None:
    """Send back each message after its checksum, first on a pipe, then on queues."""
    for receive, send, send_large in (
        (connection.recv_bytes, connection.send, connection.send_bytes),
        (requests.get, replies.put, replies.put),
    ):
        data = receive()
        send(checksum(data))
        send_large(data)
        del data


def exchange_large(connection: Any, requests: Any, replies: Any) -> None:
    """Take large messages, and send each back when asked."""
    for receive, send in ((connection.recv, connection.send), (requests.get, replies.put)):
        data = receive()
        connection.send(checksum(data))
        connection.recv()
        send(data)
        del data


def receive_and_block(receive: Any) -> None:
    """Wait for a message, and keep the process that has it."""
    receive()
    block()


def send_and_block(send: Any, size: int) -> None:
    """Send a large message, and keep the process that sent it."""
    send(content(size))
    block()


class NeverPickled:
    """Says that it is being pickled, and does not come to an end."""

    def __init__(self, there: Any) -> None:
        self._there = there

    def __reduce__(self) -> Any:
        self._there.send("pickling")
        return self._there.recv()


def put_what_never_pickles(queue: Any, there: Any) -> None:
    """Put an item whose pickling does not end."""
    queue.put(NeverPickled(there))


def put_bulky_items(queue: Any, count: int, there: Any) -> None:
    """Put more than the channel holds, say so and stay."""
    for _ in range(count):
        queue.put(bytes(1 << 20))
    there.send("put")
    there.recv()


def send_checksum(connection: Any, data: bytes) -> None:
    connection.send(checksum(data))


def acquire_each(*locks: Any) -> None:
    for lock in locks:
        lock.acquire()
