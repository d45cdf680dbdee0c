"""Sharing: queues, managers, locks, values, arrays and barriers between processes."""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable
from contextlib import ExitStack
from statistics import median
from typing import TYPE_CHECKING, Any

from benchmarks.model import Case, Metric
from benchmarks.tasks import ones

if TYPE_CHECKING:
    from benchmarks.contender import Bench

TITLE = "Sharing"
ABOUT = """\
Queue: an int goes to another process by one `Queue` and comes back by a second. A stream of 20,000
ints comes from another process as fast as it can be read, and one of 5,000 goes to another process.
Arrays of 1 MB, and of 0.8 MB from two processes at a time, come by a `Queue` too, and one byte of
each page is read. Pipe: 5,000 ints come from another process. Manager call: one
`get` of a dict of `Manager()`. Lock, Value: `with lock`, and
`with value.get_lock(): value.value += 1`, by this process alone, and by four processes at a time
(the time divided by the number of all steps). Array: another process writes all of an `Array` by
NumPy and says so, and this process reads all of it. Barrier: five or eight processes, this one
included, wait at one barrier. Loopback agents stand for other hosts: with them each of these steps
is a request to this process, and arrays are sent."""

CALL = Metric("call", "time of one", "s")
RATE = Metric("rate", "items", "1/s")
BYTES = Metric("bytes", "bytes", "B/s")
QUEUES, CALLS, ARRAYS, BARRIERS = "queue", "lock, value, manager", "array", "barrier"
STREAM_OF_ARRAYS = "queue, stream of 1 MB arrays"
TWO_PRODUCERS = "queue, two producers of 0.8 MB"
ROUND_TRIP, STREAM = "queue, round trip of an int", "queue, stream of ints"
STREAM_AWAY = "queue, stream of ints to another process"
PIPE = "pipe, stream of ints"
MANAGER, LOCK, VALUE = "manager call", "with lock", "Value += 1"
CONTENDED = "Value += 1, four processes"
BARRIERS_OF = {5: "barrier of 5", 8: "barrier of 8"}
MEGABYTES = (1, 10, 100)
_PAGE = 4096
_WRITERS = 4


def array(megabytes: int) -> str:
    """Return the name of the case with an array of so many megabytes."""
    return f"array of {megabytes} MB"


def cases(size: float) -> list[Case]:
    """Return the full measure at size 1; below, fewer of each."""
    kinds: list[tuple[str, str, Metric, dict[str, Any], int]] = [
        (QUEUES, ROUND_TRIP, CALL, {"what": "round_trip"}, 3000),
        (QUEUES, STREAM, RATE, {"what": "stream"}, 20_000),
        (QUEUES, STREAM_AWAY, RATE, {"what": "stream_away"}, 5000),
        (QUEUES, PIPE, RATE, {"what": "pipe"}, 5000),
        (QUEUES, STREAM_OF_ARRAYS, BYTES, {"what": "arrays", "nbytes": 1_000_000}, 300),
        (
            QUEUES,
            TWO_PRODUCERS,
            BYTES,
            {"what": "arrays", "nbytes": 800_000, "producers": 2},
            150,
        ),
        (CALLS, MANAGER, CALL, {"what": "manager"}, 2000),
        (CALLS, LOCK, CALL, {"what": "lock"}, 20_000),
        (CALLS, VALUE, CALL, {"what": "value"}, 20_000),
        (CALLS, CONTENDED, CALL, {"what": "contended"}, 2000),
        *(
            (ARRAYS, array(n), CALL, {"what": "array", "megabytes": n}, max(3, 100 // n))
            for n in MEGABYTES
        ),
        *(
            (BARRIERS, name, CALL, {"what": "barrier", "parties": parties}, 300)
            for parties, name in BARRIERS_OF.items()
        ),
    ]
    return [
        Case(
            measure="sharing",
            name=name,
            group=group,
            needs="sharing",
            params={**params, "count": max(5, round(count * size))},
            metrics=(metric,),
            limit=60,
            fresh=True,
        )
        for group, name, metric, params, count in kinds
    ]


def run(bench: Bench, what: str, count: int, **params: int) -> dict[str, float]:
    """Return one value of one case."""
    with ExitStack() as stack:
        return _MEASURES[what](bench.processes, stack, count, **params)


def _start(processes: Any, stack: ExitStack, target: Callable[..., None], *args: Any) -> None:
    process = processes.Process(target=target, args=args, daemon=True)
    process.start()
    stack.callback(process.join)
    stack.callback(process.terminate)


def _median_time(action: Callable[[], object], count: int) -> dict[str, float]:
    times = []
    for _ in range(count):
        begin = time.perf_counter()
        action()
        times.append(time.perf_counter() - begin)
    return {CALL.name: median(times)}


def _mean_time(action: Callable[[], object], count: int) -> dict[str, float]:
    """Return seconds for each of `count` calls that are shorter than the clock can tell."""
    action()
    begin = time.perf_counter()
    for _ in range(count):
        action()
    return {CALL.name: (time.perf_counter() - begin) / count}


def _pass_on(source: Any, target: Any) -> None:
    while True:
        target.put(source.get())


def _round_trip(processes: Any, stack: ExitStack, count: int) -> dict[str, float]:
    there, back = processes.Queue(), processes.Queue()
    _start(processes, stack, _pass_on, there, back)

    def trip() -> None:
        there.put(1)
        back.get()

    trip()
    return _median_time(trip, count)


def _pour(queue: Any, go: Any, count: int) -> None:
    go.recv()
    for item in range(count):
        queue.put(item)
    go.recv()


def _rate(receive: Callable[[], object], count: int) -> dict[str, float]:
    begin = time.perf_counter()
    for _ in range(count):
        receive()
    return {RATE.name: count / (time.perf_counter() - begin)}


def _stream(processes: Any, stack: ExitStack, count: int) -> dict[str, float]:
    queue = processes.Queue()
    go, there = processes.Pipe()
    _start(processes, stack, _pour, queue, there, count)
    go.send(None)
    queue.get()
    return _rate(queue.get, count - 1)


def _take_all(queue: Any, done: Any, count: int) -> None:
    queue.get()
    done.send(None)
    for _ in range(count):
        queue.get()
    done.send(None)


def _stream_away(processes: Any, stack: ExitStack, count: int) -> dict[str, float]:
    queue = processes.Queue()
    done, there = processes.Pipe()
    _start(processes, stack, _take_all, queue, there, count)
    queue.put(0)
    done.recv()
    begin = time.perf_counter()
    for item in range(count):
        queue.put(item)
    done.recv()
    return {RATE.name: count / (time.perf_counter() - begin)}


def _send_all(connection: Any, count: int) -> None:
    connection.recv()
    for item in range(count):
        connection.send(item)
    connection.recv()


def _pipe(processes: Any, stack: ExitStack, count: int) -> dict[str, float]:
    here, there = processes.Pipe()
    _start(processes, stack, _send_all, there, count)
    here.send(None)
    here.recv()
    return _rate(here.recv, count - 1)


def _pour_arrays(queue: Any, go: Any, count: int, nbytes: int) -> None:
    array = ones(nbytes)
    go.recv()
    for _ in range(count):
        queue.put(array)
    go.recv()


def _arrays(
    processes: Any, stack: ExitStack, count: int, nbytes: int, producers: int = 1
) -> dict[str, float]:
    queue = processes.Queue()
    pipes = [processes.Pipe() for _ in range(producers)]
    for _, there in pipes:
        _start(processes, stack, _pour_arrays, queue, there, count, nbytes)
    for go, _ in pipes:
        go.send(None)
    for _ in range(producers):
        queue.get()
    left = producers * (count - 1)
    begin = time.perf_counter()
    for _ in range(left):
        queue.get()[::_PAGE].max()
    return {BYTES.name: left * nbytes / (time.perf_counter() - begin)}


def _manager(processes: Any, stack: ExitStack, count: int) -> dict[str, float]:
    shared = stack.enter_context(processes.Manager()).dict({1: 1})
    shared.get(1)
    return _median_time(lambda: shared.get(1), count)


def _lock(processes: Any, _stack: ExitStack, count: int) -> dict[str, float]:
    lock = processes.Lock()

    def hold() -> None:
        with lock:
            pass

    return _mean_time(hold, count)


def _add(value: Any) -> None:
    with value.get_lock():
        value.value += 1


def _value(processes: Any, _stack: ExitStack, count: int) -> dict[str, float]:
    value = processes.Value("i", 0)
    return _mean_time(lambda: _add(value), count)


def _add_often(value: Any, barrier: Any, count: int) -> None:
    barrier.wait()
    for _ in range(count):
        _add(value)
    barrier.wait()


def _contended(processes: Any, stack: ExitStack, count: int) -> dict[str, float]:
    value, barrier = processes.Value("i", 0), processes.Barrier(_WRITERS + 1)
    for _ in range(_WRITERS):
        _start(processes, stack, _add_often, value, barrier, count)
    barrier.wait()
    begin = time.perf_counter()
    barrier.wait()
    seconds = time.perf_counter() - begin
    if value.value != _WRITERS * count:
        raise AssertionError(f"{_WRITERS * count} additions came to {value.value}")
    return {CALL.name: seconds / (_WRITERS * count)}


def _fill(shared: Any, connection: Any) -> None:
    numpy = importlib.import_module("numpy")
    view = numpy.frombuffer(shared, numpy.uint8)
    while True:
        view.fill(connection.recv())
        connection.send(None)


def _array(processes: Any, stack: ExitStack, count: int, megabytes: int) -> dict[str, float]:
    numpy = importlib.import_module("numpy")
    shared = processes.RawArray("B", megabytes << 20)
    view = numpy.frombuffer(shared, numpy.uint8)
    here, there = processes.Pipe()
    _start(processes, stack, _fill, shared, there)
    number = 0

    def write_and_read() -> None:
        nonlocal number
        number = (number + 1) % 100
        here.send(number)
        here.recv()
        if view.max() != number or view.min() != number:
            raise AssertionError("what was written is not what is read")

    write_and_read()
    return _median_time(write_and_read, count)


def _meet(barrier: Any, count: int) -> None:
    for _ in range(count):
        barrier.wait()


def _barrier(processes: Any, stack: ExitStack, count: int, parties: int) -> dict[str, float]:
    barrier = processes.Barrier(parties)
    for _ in range(parties - 1):
        _start(processes, stack, _meet, barrier, count + 1)
    barrier.wait()
    return _median_time(barrier.wait, count)


_MEASURES: dict[str, Callable[..., dict[str, float]]] = {
    "round_trip": _round_trip,
    "stream": _stream,
    "stream_away": _stream_away,
    "pipe": _pipe,
    "arrays": _arrays,
    "manager": _manager,
    "lock": _lock,
    "value": _value,
    "contended": _contended,
    "array": _array,
    "barrier": _barrier,
}
