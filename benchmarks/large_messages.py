"""Large messages: how fast they pass, and how long a small task beside one takes."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from benchmarks.model import MANY_ROUNDS, Case, Metric
from benchmarks.samples import percentile
from benchmarks.tasks import content, keep, kept, no_op

if TYPE_CHECKING:
    from benchmarks.contender import Bench

TITLE = "Large messages"
ABOUT = """\
One message of so many bytes: as the argument of a task, as its result, through a `Pipe` and
through a `Queue` from this process to another and back, of which half the time counts. All
messages are `bytes` that were made before. Meanwhile a thread calls one no-op task after the other
on another worker. With loopback agents that worker has the same agent, and so the same link. The
time of such a task is the 95th percentile."""

RATE = Metric("rate", "bytes a second", "B/s")
BESIDE = Metric("beside", "small task beside it, p95", "s")
WAYS = ("argument", "result", "Pipe", "Queue")
SIZES = {"64 MB": 64 << 20, "256 MB": 256 << 20, "2 GB": 2 << 30, "4 GB": 4 << 30}
_MANY = 1 << 30
_NEEDED = 4
"""Memory that a message takes on this machine, in multiples of its size, with some left for
others."""
_CONTENDERS = ("fiber", "fiber-loopback", "fiber-kubernetes", "multiprocessing")
_LIMIT = 180.0


def case_name(size: str, way: str) -> str:
    """Return the name of the case of a message of this size that goes this way."""
    return f"{size}, {way}"


CASES = [case_name(size, way) for way in WAYS for size in SIZES]


def cases(size: float) -> list[Case]:
    """Return the full measure at size 1; below, smaller messages in their places."""
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return [
        _case(label, way, max(1, round(nbytes * size)), memory)
        for way in WAYS
        for label, nbytes in SIZES.items()
    ]


def _case(label: str, way: str, nbytes: int, memory: int) -> Case:
    too_large = f"it takes {_NEEDED * nbytes >> 30} GB of memory"
    return Case(
        measure="large_messages",
        name=case_name(label, way),
        group=way,
        needs="large messages",
        params={"way": way, "nbytes": nbytes},
        metrics=(RATE, BESIDE),
        limit=_LIMIT,
        fresh=True,
        rounds=MANY_ROUNDS if nbytes >= _MANY else None,
        not_run=dict.fromkeys(_CONTENDERS, too_large) if _NEEDED * nbytes > memory else {},
    )


def run(bench: Bench, way: str, nbytes: int) -> dict[str, float]:
    """Return bytes a second of one message, and the time of small tasks beside it."""
    if bench.contender == "fiber-loopback":
        bench.processes.init(agents=1)
    elif bench.contender == "fiber-kubernetes":
        bench.processes.init(processes_per_pod=3)
    with bench.processes.Pool(1) as pool, bench.processes.Pool(1) as other:
        pool.apply(no_op, (1,))
        other.apply(no_op, (1,))
        if way in ("argument", "result"):
            seconds, beside = _in_a_task(pool, way, nbytes, other)
        else:
            seconds, beside = _there_and_back(bench.processes, way, nbytes, other)
    return {RATE.name: nbytes / seconds, BESIDE.name: percentile(beside, 95)}


def _in_a_task(pool: Any, way: str, nbytes: int, other: Any) -> tuple[float, list[float]]:
    if way == "result":
        pool.apply(keep, (nbytes,))
        return _timed(lambda: pool.apply(kept), other)
    data = content(nbytes)
    return _timed(lambda: pool.apply(len, (data,)), other)


def _there_and_back(processes: Any, way: str, nbytes: int, other: Any) -> tuple[float, list[float]]:
    if way == "Pipe":
        ours, theirs = processes.Pipe()
        child = processes.Process(target=_echo_pipe, args=(theirs,))
        send, receive = ours.send, ours.recv
    else:
        requests, replies = processes.Queue(), processes.Queue()
        child = processes.Process(target=_echo_queue, args=(requests, replies))
        send, receive = requests.put, replies.get
    child.start()
    send(b"ready")
    receive()
    data = content(nbytes)

    def trip() -> None:
        send(data)
        receive()

    seconds, beside = _timed(trip, other)
    child.join()
    return seconds / 2, beside


def _timed(message: Callable[[], object], other: Any) -> tuple[float, list[float]]:
    """Return the seconds of the message, and those of each small task beside it."""
    over, times = threading.Event(), list[float]()

    def small_tasks() -> None:
        while not over.is_set() or not times:
            begin = time.perf_counter()
            other.apply(no_op, (1,))
            times.append(time.perf_counter() - begin)

    beside = threading.Thread(target=small_tasks)
    begin = time.perf_counter()
    beside.start()
    try:
        message()
        return time.perf_counter() - begin, times
    finally:
        over.set()
        beside.join()


def _echo_pipe(connection: Any) -> None:
    for _ in range(2):
        connection.send(connection.recv())


def _echo_queue(requests: Any, replies: Any) -> None:
    for _ in range(2):
        replies.put(requests.get())
