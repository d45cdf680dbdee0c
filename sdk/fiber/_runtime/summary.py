"""Summary of a snapshot of the activity: where the time went, and advice.  Pure.

Advice needs proof.  Each rule says what it takes for one.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from statistics import fmean, stdev
from typing import Any, NamedTuple

Facts = dict[str, Any]

_SHOWN = 3
"""Functions and deaths that the text lists."""


@dataclass(frozen=True, slots=True)
class WorkerShares:
    """Shares of the time of all workers, from 0 to 1.  Their sum is 1, or 0 without workers."""

    work: float
    """Work in functions, with unpickling and pickling in the worker."""
    way: float
    """Tasks or results on the way between the program and the worker."""
    unfinished: float
    """Tasks that have not been answered: they run now, or were lost or cancelled."""
    idle: float
    """No tasks. A worker that `Pool.apply` uses is idle between two calls."""
    waiting: float
    """Wait from the request of the process until it ran: for a host, then for its start."""
    starting: float
    """Start of the process, until its initializer had returned."""


@dataclass(frozen=True, slots=True)
class FunctionTime:
    """Time of one function."""

    name: str
    tasks: int
    failed: int
    seconds: float
    """Seconds of work of all tasks."""
    longest: float
    """Seconds of the longest task. Of tasks with one answer, the mean counts: some took longer."""
    together: float
    """Tasks that one answer of a worker had, on average."""
    chunk: int
    """Largest `chunksize` of its maps; 1 without one."""

    @property
    def mean(self) -> float:
        """Seconds of a task, on average."""
        return self.seconds / self.tasks if self.tasks else 0.0


@dataclass(frozen=True, slots=True)
class SlowWorker:
    """Worker that was slower than all others."""

    name: str
    host: str
    function: str
    """Function by which the workers are compared."""
    factor: float
    """Seconds of a task, as a multiple of the other workers' mean."""


@dataclass(frozen=True, slots=True)
class Death:
    """End of a process that the program had not asked for."""

    name: str
    host: str
    seconds: float
    """Seconds after the beginning."""
    reason: str


@dataclass(frozen=True, slots=True, repr=False)
class Summary:
    """Summary of what the processes of a program have done.  ``str()`` is some lines of text."""

    seconds: float
    """Seconds since the first process, pool, pipe or queue was made."""
    workers: int
    """Workers that were ready for tasks at any time."""
    hosts: int
    """Hosts or pods of these workers."""
    tasks: int
    """Tasks that were run, those that failed included."""
    failed: int
    """Tasks that raised an error."""
    retried: int
    """Runs that were repeated after an error."""
    lost: int
    """Runs that were lost with their workers."""
    worker_seconds: float
    """Seconds of all workers, from their requests until their ends or now."""
    shares: WorkerShares
    """Parts of `worker_seconds`."""
    pickling: float
    """Seconds in which the program pickled tasks."""
    bytes_sent: int
    """Bytes of the tasks that the program sent."""
    bytes_received: int
    """Bytes of the results that it received."""
    functions: tuple[FunctionTime, ...]
    """Functions, the one with the most time first."""
    slowest: SlowWorker | None
    """The slowest worker, if it stands out."""
    deaths: tuple[Death, ...]
    forgotten: int
    """Processes that ended long ago, whose time is not in `worker_seconds` and `shares`."""
    advice: tuple[str, ...]
    """Changes that the record proves to be worth it."""

    def __str__(self) -> str:
        return "\n".join(_lines(self))

    __repr__ = __str__


def summarize(snapshot: Facts) -> Summary:
    """Return the summary of a snapshot, one of ``activity_reading``."""
    now, busy = snapshot["now"], dict(snapshot["busy"])
    workers = [child for child in snapshot["children"] if child["ready"] is not None]
    times = [_times(child, now, busy.get(child["id"])) for child in workers]
    totals = [sum(column) for column in zip(*times, strict=True)] or [0.0] * 6
    worker_seconds = sum(totals)
    shares = WorkerShares(*(time / worker_seconds if worker_seconds else 0.0 for time in totals))
    functions = tuple(
        sorted(map(_function, snapshot["functions"]), key=lambda one: one.seconds, reverse=True)
    )
    return Summary(
        seconds=now,
        workers=len(workers),
        hosts=len({child["host"] for child in workers}),
        **{key: snapshot[key] for key in ("tasks", "failed", "retried", "lost", "pickling")},
        bytes_sent=snapshot["bytes_sent"],
        bytes_received=snapshot["bytes_received"],
        worker_seconds=worker_seconds,
        shares=shares,
        functions=functions,
        slowest=_slowest(workers, functions),
        deaths=tuple(_deaths(snapshot["children"])),
        forgotten=snapshot["forgotten"],
        advice=tuple(_advice(snapshot, workers, shares, functions)),
    )


def _times(
    child: Facts, now: float, busy_since: float | None
) -> tuple[float, float, float, float, float, float]:
    """Return the seconds of a worker in the order of ``WorkerShares``."""
    end = now if child["ended"] is None else child["ended"]
    waiting = child["started"] - child["began"]
    starting = child["ready"] - child["started"]
    life = max(0.0, end - child["ready"])
    work = min(child["work"], life)
    way = min(max(0.0, child["held"] - child["work"]), life - work)
    unfinished = sum(span[1] - span[0] for span in child["spans"] if not span[4])
    if busy_since is not None and child["ended"] is None:
        unfinished += end - busy_since
    unfinished = min(max(0.0, unfinished), life - work - way)
    return work, way, unfinished, life - work - way - unfinished, waiting, starting


def _function(facts: Facts) -> FunctionTime:
    answers = facts["answers"]
    return FunctionTime(
        name=facts["name"],
        tasks=facts["tasks"],
        failed=facts["failed"],
        seconds=facts["work"],
        longest=facts["longest"],
        together=facts["tasks"] / answers if answers else 0.0,
        chunk=facts["chunk"],
    )


def _deaths(children: Iterable[Facts]) -> Iterator[Death]:
    dead = (child for child in children if child["reason"])
    for child in sorted(dead, key=lambda child: float(child["ended"])):
        yield Death(child["name"], child["host"], child["ended"], child["reason"])


# ---- the slowest worker -----------------------------------------------------------------------

_ENOUGH_WORKERS = 4
_ENOUGH_TASKS = 20
"""Tasks of a worker from which on its mean says something."""

_FACTOR = 1.3
_DEVIATIONS = 5.0


def _slowest(workers: list[Facts], functions: tuple[FunctionTime, ...]) -> SlowWorker | None:
    """Return the worker whose mean time of a task is beyond chance, for the main function.

    Proof: it is more than five standard deviations above the mean of the others' means, and the
    record still has all tasks of the function by worker.
    """
    if not functions:
        return None
    main = functions[0]
    counted = [(_done(child, main.name, alone=len(functions) == 1), child) for child in workers]
    if sum(done.tasks for done, _ in counted) < main.tasks:
        return None  # spans of several functions were merged, or workers forgotten
    means = [(done.mean, child) for done, child in counted if done.tasks >= _ENOUGH_TASKS]
    if len(means) < _ENOUGH_WORKERS:
        return None
    means.sort(key=lambda pair: pair[0])
    mean, child = means.pop()
    others = [other for other, _ in means]
    usual = fmean(others)
    if not usual or mean < max(_FACTOR * usual, usual + _DEVIATIONS * stdev(others)):
        return None
    return SlowWorker(child["name"], child["host"], main.name, mean / usual)


class _Done(NamedTuple):
    """Work of one worker in one function."""

    tasks: int
    seconds: float

    @property
    def mean(self) -> float:
        return self.seconds / self.tasks


def _done(child: Facts, function: str, *, alone: bool) -> _Done:
    """Return a worker's work in a function; ``alone``: the program has run no other."""
    if alone:
        return _Done(child["tasks"], child["work"])
    spans = [span for span in child["spans"] if span[2] == function]
    return _Done(sum(span[4] for span in spans), sum(span[3] for span in spans))


# ---- advice -----------------------------------------------------------------------------------

_MANY_TASKS = 1000
_SHORT = 1e-3
_FEW_TOGETHER = 8
_LONG = 0.1
_NOTABLE = 0.2
"""Share of the time from which on advice is worth its line."""

_NOTABLE_SECONDS = 1.0


def _advice(
    snapshot: Facts,
    workers: list[Facts],
    shares: WorkerShares,
    functions: tuple[FunctionTime, ...],
) -> Iterator[str]:
    main = functions[0] if functions else None
    if main is not None:
        yield from _larger_messages(main, shares)
        yield from _smaller_chunks(main, workers)
    if snapshot["pickling"] > max(_NOTABLE * snapshot["now"], _NOTABLE_SECONDS):
        yield (
            f"The program pickled tasks for {_seconds(snapshot['pickling'])} of "
            f"{_seconds(snapshot['now'])}. Send data that all tasks need once, by the pool's "
            "initializer."
        )
    if (before := shares.waiting + shares.starting) > 2 * _NOTABLE:
        yield (
            f"The workers waited for hosts and started for {_percent(before)} of their time. Keep "
            "one pool for all work, or do more work in each run."
        )


def _larger_messages(main: FunctionTime, shares: WorkerShares) -> Iterator[str]:
    """Advise larger messages.

    Proof: there were many short tasks and few in each answer, and the workers had tasks on the way
    for longer than they worked.
    """
    is_short = main.tasks >= _MANY_TASKS and main.mean < _SHORT
    if is_short and main.together < _FEW_TOGETHER and shares.way > max(shares.work, _NOTABLE):
        yield (
            f"{main.name}: {main.tasks:,} tasks of {_seconds(main.mean)}, {main.together:.1f} in a "
            f"message, and {_percent(shares.way)} of the workers' time went on the way. Give many "
            "items to one map() without chunksize, or pass a larger chunksize to imap()."
        )


def _smaller_chunks(main: FunctionTime, workers: list[Facts]) -> Iterator[str]:
    """Advise smaller chunks.

    Proof: long tasks had to stay together, by a ``chunksize``, and came back together.  The last
    worker did such tasks while at least half of the workers had done their last one.
    """
    if main.mean < _LONG or main.chunk < 2 or main.together < 2:
        return
    if not any(_did(child, main.name) for child in workers):  # their spans were merged
        return
    ends = [(_last(child, main.name), child) for child in workers if _did(child, main.name)]
    last, slow = max(ends, key=lambda pair: pair[0])
    # Only these could have taken the last tasks.
    able = sorted(
        end
        for end, child in ends
        if child["pool"] == slow["pool"] and (child["ended"] is None or child["ended"] >= last)
    )
    half = able[(len(able) - 1) // 2]
    begin = min(child["ready"] for child in workers)
    if last - half > max(main.mean, _NOTABLE_SECONDS, _NOTABLE * (last - begin)):
        idle = sum(end <= half for end in able)
        yield (
            f"{main.name}: tasks of {_seconds(main.mean)} were in chunks of up to {main.chunk}, "
            f"and {idle} of {len(able)} workers had none in the last {_seconds(last - half)}. "
            "Pass chunksize=1, so that the others share the rest."
        )


def _did(child: Facts, function: str) -> bool:
    return any(span[2] == function for span in child["spans"])


def _last(child: Facts, function: str) -> float:
    """Return the time at which a worker answered its last task of a function."""
    return max(float(span[1]) for span in child["spans"] if span[2] == function)


# ---- text -------------------------------------------------------------------------------------


def _lines(found: Summary) -> Iterator[str]:
    yield (
        f"{'time':<10} {_seconds(found.seconds)}; {_counted(found.workers, 'worker')} on "
        f"{_counted(found.hosts, 'host')}"
    )
    yield (
        f"{'tasks':<10} {found.tasks:,} done, {found.failed:,} of them failed; runs repeated "
        f"{found.retried:,}, lost {found.lost:,}"
    )
    if found.worker_seconds:
        yield f"{'workers':<10} {', '.join(_shares(found.shares))}"
    yield (
        f"{'program':<10} {_seconds(found.pickling)} of pickling; "
        f"{bytes_in_words(found.bytes_sent)} sent, {bytes_in_words(found.bytes_received)} received"
    )
    yield from _labelled("functions", _function_lines(found))
    if found.slowest is not None:
        slow = found.slowest
        yield (
            f"{'slowest':<10} {slow.name} on {slow.host}: its tasks of {slow.function} took "
            f"{slow.factor:.1f} times as long as those of the others"
        )
    yield from _labelled("deaths", _death_lines(found.deaths))
    yield from _labelled("advice", found.advice)


def _labelled(label: str, lines: Iterable[str]) -> Iterator[str]:
    for line in lines:
        yield f"{label:<10} {line}"
        label = ""


def _shares(shares: WorkerShares) -> Iterator[str]:
    named = (
        (shares.work, "at work"),
        (shares.way, "on the way"),
        (shares.unfinished, "with unfinished tasks"),
        (shares.idle, "idle"),
        (shares.waiting, "waiting to start"),
        (shares.starting, "starting up"),
    )
    return (f"{_percent(share)} {name}" for share, name in named if share >= 0.005)


def _function_lines(found: Summary) -> Iterator[str]:
    total = sum(one.seconds for one in found.functions)
    for one in found.functions[:_SHOWN]:
        failed = f", {one.failed:,} failed" if one.failed else ""
        at_least = "at least " if one.together > 1 else ""
        yield (
            f"{one.name}: {_percent(one.seconds / total if total else 0.0)} of the work, "
            f"{_counted(one.tasks, 'task')}{failed}, {_seconds(one.mean)} each, longest "
            f"{at_least}{_seconds(one.longest)}"
        )
    if rest := found.functions[_SHOWN:]:
        share = sum(one.seconds for one in rest) / total if total else 0.0
        yield f"{len(rest)} more: {_percent(share)} of the work"


def _death_lines(deaths: tuple[Death, ...]) -> Iterator[str]:
    if len(deaths) > _SHOWN:
        yield f"{len(deaths)}, of which the last ones are:"
    for one in deaths[-_SHOWN:]:
        yield f"{one.name} on {one.host or 'no host'} after {_seconds(one.seconds)}: {one.reason}"


def _counted(number: int, noun: str) -> str:
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def bytes_in_words(number: int) -> str:
    """Return a number of bytes in the unit that fits."""
    size = float(number)
    for unit in ("B", "kB", "MB", "GB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:,.3g} TB"


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"


def _seconds(seconds: float) -> str:
    """Return a duration with two or three digits and its unit."""
    if seconds >= 3600:
        minutes = round(seconds / 60)
        return f"{minutes // 60} h {minutes % 60} min"
    if seconds >= 100:
        return f"{round(seconds) // 60} min {round(seconds) % 60} s"
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds * 1e6:.3g} µs" if seconds else "0 s"
