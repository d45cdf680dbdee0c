"""Answers of a program to its monitors.

Each answer begins with ``{"program": …}``, the facts of the program.  The request's ``ask`` says
what follows:

``state``     ``{"pool": …}`` for each pool (``PoolState``), ``{"child": …}`` for each child, and
              ``{"death": …}`` for the last children that ended by themselves
``activity``  ``{"activity": …}``, a snapshot of ``Activity``; with ``since``, what has changed
              after the snapshot of that revision
``stacks``    ``{"stack": …}`` for the program itself and for each child, as the answers come.  With
              ``worker``, only for the child of that name or pid, or for the children on that host
"""

from __future__ import annotations

import os
import queue
import re
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
from fiber._runtime.children import Child, Children
from fiber._runtime.pool_state import WatchedPool
from fiber._transport.loop import Loop
from fiber.config import Config
from fiber.errors import FiberError

T = TypeVar("T")

_LOOP_PATIENCE = 5.0
"""Seconds in which the loop answers."""

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
            "children": len(self._children),
        }

    def _on_loop(self, function: Callable[[], T]) -> T:
        """Return the result of a function that runs on the loop thread."""
        answers: queue.SimpleQueue[T] = queue.SimpleQueue()
        self._loop.call_soon(lambda: answers.put(function()))
        try:
            return answers.get(timeout=_LOOP_PATIENCE)
        except queue.Empty:
            raise FiberError(
                f"the program's event loop has not answered within {_LOOP_PATIENCE:.0f} s"
            ) from None

    def _state(self) -> list[dict[str, Any]]:
        pools = [{"pool": pool.describe()._asdict()} for pool in list(self._pools)]
        children = [{"child": facts} for facts in self._describe_children()]
        deaths = [{"death": self._death(record)} for record in self._activity.deaths]
        return [*pools, *children, *deaths]

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
        """Return the program's activity; ``start`` is the unix time of its beginning."""
        now = self._loop.now()
        start = time.time() - (now - self._activity.start)
        return {"start": start, **self._activity.snapshot(now, since)}

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
    assert handle is not None
    return {
        "name": handle.name,
        "host": handle.host,
        "node": handle.node,
        "pid": handle.pid,
        "state": child.owner.state,
    }


def program_facts() -> dict[str, Any]:
    """Return the facts of this process."""
    return {
        "name": f"{_stem()}-{os.getpid()}",
        "pid": os.getpid(),
        "started": _start_time(),
        "command": _command(),
        "directory": _directory(),
        "python": sys.version.split()[0],
        "fiber": cast("Any", sys.modules["fiber"]).__version__,
    }


def _stem() -> str:
    """Return the name of the program's script or module, as a part of a name."""
    main = sys.modules.get("__main__")
    spec = getattr(main, "__spec__", None)
    path = getattr(main, "__file__", None)
    name = spec.name.removesuffix(".__main__") if spec else os.path.basename(path or "python")
    stem = re.sub("[^a-z0-9]+", "-", name.removesuffix(".py").lower()).strip("-")
    return stem[:40] or "python"


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
