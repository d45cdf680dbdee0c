"""Answers of a program to its monitors.

Each answer begins with ``{"program": …}``, the facts of the program.  The request's ``ask`` says
what follows:

``state``     ``{"totals": …}`` of the program, ``{"pool": …}`` for each pool (``PoolState``),
              ``{"child": …}`` for each child with its memory in bytes and its seconds of processor
              time, and ``{"death": …}`` for the last children that ended by themselves
``activity``  ``{"activity": …}``, a snapshot of ``Activity``; with ``since``, what has changed
              after the snapshot of that revision
``stacks``    ``{"stack": …}`` for the program itself and for each child, as the answers come.  With
              ``worker``, only for the child of that name or pid, or for the children on that host
"""

from __future__ import annotations

import contextlib
import os
import queue
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from types import FrameType
from typing import Any, TypeVar, cast

from fiber._engine.activity import Activity, ChildRecord
from fiber._monitor.server import AnswerLines
from fiber._output_files import program_name
from fiber._runtime.activity_reading import on_loop, snapshot
from fiber._runtime.children import Child, Children
from fiber._runtime.pool_state import WatchedPool
from fiber._transport.loop import Loop
from fiber.config import Config
from fiber.errors import FiberError

T = TypeVar("T")

_MEASURE_PATIENCE = 1.0
"""Seconds in which agents measure their children.  Later answers are shown the next time."""

_STACK_PATIENCE = 8.0
"""Seconds in which all children have shown their stacks.  A child's agent gives up earlier."""

_LONGEST_COMMAND = 1000


class Monitor:
    """Source of what a monitor wants to know.  Runs on the thread of a client."""

    def __init__(
        self,
        loop: Loop,
        activity: Activity,
        children: Children,
        pools: Iterable[WatchedPool],
        backend: str,
        config: Config,
    ) -> None:
        self._loop = loop
        self._activity = activity
        self._children = children
        self._pools = pools
        self._backend = backend
        self._config = config

    def answer(self, request: dict[str, Any]) -> Iterator[AnswerLines]:
        """Yield the lines of the answer."""
        yield {"program": self._program()}
        ask = request.get("ask")
        if ask == "state":
            self._measure()
            yield self._on_loop(self._state)
        elif ask == "activity":
            yield {"activity": self._on_loop(partial(self._snapshot, request.get("since", 0)))}
        elif ask == "stacks":
            yield from self._stacks(request.get("worker"))
        elif ask is not None:
            raise FiberError(f"this version of Fiber has no answer to {ask!r}")

    def _program(self) -> dict[str, Any]:
        return {
            **program_facts(),
            "backend": self._backend,
            "namespace": self._config.namespace,
            "log_to": self._config.log_to,
            "children": len(self._children),
        }

    def _on_loop(self, function: Callable[[], T]) -> T:
        return on_loop(self._loop, function)

    def _measure(self) -> None:
        """Have all children measured; wait for the answers, though not for late ones."""
        answers: queue.SimpleQueue[None] = queue.SimpleQueue()
        asked = self._on_loop(partial(self._ask_for_usage, lambda: answers.put(None)))
        deadline = time.monotonic() + _MEASURE_PATIENCE
        with contextlib.suppress(queue.Empty):
            for _ in range(asked):
                answers.get(timeout=max(0.0, deadline - time.monotonic()))

    def _ask_for_usage(self, then: Callable[[], None]) -> int:
        running = [child for child in self._children if child.handle and child.handle.pid]
        for child in running:
            child.measure(then)
        return len(running)

    def _state(self) -> list[dict[str, Any]]:
        pools = [{"pool": pool.describe()._asdict()} for pool in list(self._pools)]
        children = [{"child": facts} for facts in self._describe_children()]
        deaths = [{"death": self._death(record)} for record in self._activity.deaths]
        return [{"totals": self._activity.totals()}, *pools, *children, *deaths]

    def _death(self, record: ChildRecord) -> dict[str, Any]:
        ago = self._loop.now() - (record.ended or 0.0)
        return {
            "time": time.time() - ago,
            "name": record.name,
            "host": record.host,
            "pid": record.pid,
            "reason": record.reason,
        }

    def _snapshot(self, since: int) -> dict[str, Any]:
        return snapshot(self._activity, self._children, self._loop.now(), since)

    def _describe_children(self) -> list[dict[str, Any]]:
        return [_facts(child) for child in self._children]

    def _stacks(self, worker: str | None) -> Iterator[dict[str, Any]]:
        if worker is None:
            yield {"stack": {"name": "program", "pid": os.getpid(), "text": own_stacks()}}
        answers: queue.SimpleQueue[tuple[int, str]] = queue.SimpleQueue()
        asked = self._on_loop(lambda: self._ask_for_stacks(worker, answers))
        if worker is not None and not asked:
            names = [facts["name"] for facts in self._on_loop(self._describe_children)]
            yield {"unknown": worker, "names": names}
        deadline = time.monotonic() + _STACK_PATIENCE
        while asked:
            try:
                number, text = answers.get(timeout=max(0.0, deadline - time.monotonic()))
            except queue.Empty:
                break
            yield {"stack": {**asked.pop(number), "text": text}}
        for facts in asked.values():
            yield {"stack": {**facts, "text": "Its host does not answer."}}

    def _ask_for_stacks(
        self, worker: str | None, answers: queue.SimpleQueue[tuple[int, str]]
    ) -> dict[int, dict[str, Any]]:
        """Ask children for their stacks; return the facts of those that were asked."""
        asked = {}
        for number, child in enumerate(self._children):
            facts = _facts(child)
            if worker is None or worker in (facts["name"], str(facts["pid"]), facts["host"]):
                asked[number] = facts
                child.ask_for_stack(partial(_put, answers, number))
        return asked


def _put(answers: queue.SimpleQueue[tuple[int, str]], number: int, text: str) -> None:
    answers.put((number, text))


def _facts(child: Child) -> dict[str, Any]:
    handle = child.handle
    record = child.owner.record
    assert handle is not None
    return {
        "name": handle.name,
        "host": handle.host,
        "node": handle.node,
        "pid": handle.pid,
        "state": child.owner.state,
        "memory": record and record.memory,
        "cpu": record and record.cpu,
    }


def program_facts() -> dict[str, Any]:
    """Return the facts of this process."""
    return {
        "name": program_name(),
        "pid": os.getpid(),
        "started": _start_time(),
        "command": _command(),
        "directory": _directory(),
        "python": sys.version.split()[0],
        "fiber": cast("Any", sys.modules["fiber"]).__version__,
    }


def _directory() -> str:
    try:
        return os.getcwd()
    except OSError:  # it was deleted
        return ""


def _command() -> str:
    try:
        with open("/proc/self/cmdline", "rb") as file:
            words = file.read(_LONGEST_COMMAND).decode(errors="replace").split("\0")
    except OSError:
        words = sys.orig_argv
    return " ".join(words).strip()


def _start_time() -> float:
    """Return the unix time at which this process started."""
    with open("/proc/self/stat") as stat, open("/proc/uptime") as uptime:
        ticks = int(stat.read().rpartition(")")[2].split()[19])
        since_boot = float(uptime.read().split()[0])
    return time.time() - since_boot + ticks / os.sysconf("SC_CLK_TCK")


def own_stacks() -> str:
    """Return the stacks of this program's threads, without Fiber's, as faulthandler writes them."""
    names = {thread.ident: thread.name for thread in threading.enumerate()}
    stacks = [
        _stack(names.get(ident, str(ident)), frame)
        for ident, frame in sys._current_frames().items()
        if not names.get(ident, "").startswith("fiber-")
    ]
    return "\n\n".join(stacks)


def _stack(name: str, frame: FrameType) -> str:
    calls = ((call.f_code, line) for call, line in traceback.walk_stack(frame))
    lines = [f'  File "{code.co_filename}", line {line} in {code.co_name}' for code, line in calls]
    return "\n".join([f"Thread {name} (most recent call first):", *lines])
