"""Trial of ``fiber doctor``, seen from outside: one task on one worker, by a separate program.

The program has its own errors and its own FiberPool, which this module finds by the program's
identity.  It watches how far the worker comes, ends the program if waiting cannot help, and sees to
it that nothing is left.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import queue
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from fiber._backends.kubernetes.api import Api
from fiber._cli.pool_access import is_of_program
from fiber.config import Config
from fiber_api import names
from fiber_api.names import Reason
from fiber_api.rest import PODS, POOLS, ApiError, Body, NotFound, NotServed

_LOOK_AGAIN = 0.2
_CALL = 5.0
_TO_END = 15.0
"""Seconds that the program has to remove its FiberPool."""

_TO_GO = 5.0
"""Seconds that the cluster has to remove the pods, before this command no longer waits for it."""

LONGEST_START = 180.0
"""Seconds that a worker may take to start, unless the configuration allows less."""

_HOPELESS = frozenset(
    {
        Reason.CONTAINER_FAILED,
        Reason.RUN_CONTAINER_ERROR,
        Reason.INVALID_IMAGE_NAME,
        Reason.IMAGE_NEVER_PULL,
        Reason.INVALID_TEMPLATE,
        Reason.NAME_TAKEN,
    }
)
"""Reasons of problems that end the trial at once.  A program waits longer, since it may have other
workers, and a person may mend the image meanwhile."""

_MISMATCH = re.compile(r"\b(Python|Fiber protocol) version mismatch: .*", re.DOTALL)


def mismatch_in(text: str) -> str:
    """Return the words of a ``VersionMismatch`` in a message; empty if there are none."""
    found = _MISMATCH.search(text)
    return "" if found is None else found[0]


@dataclass
class TrialCourse:
    """Course of a trial."""

    steps: dict[str, float] = field(default_factory=dict)
    """Seconds from the start of the program, by step."""
    answer: Mapping[str, Any] | None = None
    """Answer of the task: versions of Python and Fiber, and the names of its packages."""
    error: Mapping[str, str] | None = None
    """Error of the program: ``kind``, ``reason`` and ``message``."""
    refusal: str = ""
    """Reason why an agent was refused, since its versions differ."""
    problem: Mapping[str, Any] | None = None
    """Worst problem in the FiberPool's status."""
    relay: bool = False
    """True if the worker came by a relay."""
    left: str = ""
    """FiberPool that could not be removed."""
    said: list[str] = field(default_factory=list)
    """Lines of the program on stderr."""


def settings_of(config: Config) -> dict[str, Any]:
    """Return the configuration as keys of ``fiber.init``, for a program on Kubernetes."""
    found = {key: value for key, value in dataclasses.asdict(config).items() if value is not None}
    found["backend"] = "kubernetes"
    found["pod_timeout"] = min(config.pod_timeout, LONGEST_START)
    return found


def attempt(api: Api, namespace: str, config: Config, tell: Callable[[str], None]) -> TrialCourse:
    """Run the trial; ``tell`` is called with each line that the program writes to stderr."""
    return _Attempt(api, namespace, config, tell).run()


class _Attempt:
    def __init__(
        self, api: Api, namespace: str, config: Config, tell: Callable[[str], None]
    ) -> None:
        self._api = api
        self._namespace = namespace
        self._config = config
        self._tell = tell
        self._trial = TrialCourse()
        self._lines: queue.SimpleQueue[tuple[str, str]] = queue.SimpleQueue()
        self._started = time.monotonic()
        self._pool: Body | None = None

    def run(self) -> TrialCourse:
        try:
            with tempfile.TemporaryDirectory(prefix="fiber-doctor-") as folder:
                self._run_in(folder)
        finally:
            self._remove_what_is_left()
        self._await_the_end_of_pods()
        self._note("removed")
        return self._trial

    def _run_in(self, folder: str) -> None:
        """Run the program in an empty folder, as nothing is to be sent to the worker."""
        command = [sys.executable, "-m", "fiber._cli.doctor_trial"]
        pipe = subprocess.PIPE
        # Ctrl-C is for this process alone, which asks the program to end.
        with subprocess.Popen(
            command, stdin=pipe, stdout=pipe, stderr=pipe, cwd=folder, text=True, process_group=0
        ) as process:
            try:
                self._follow(process)
            finally:
                self._end(process)

    def _follow(self, process: subprocess.Popen[str]) -> None:
        assert process.stdin is not None
        with self._reading(process):
            with contextlib.suppress(BrokenPipeError):
                process.stdin.write(json.dumps(settings_of(self._config)))
                process.stdin.close()
            while process.poll() is None:
                self._take_lines()
                self._look(f"{socket.gethostname()}:{process.pid}:")
                if self._trial.answer is None and self._is_hopeless():
                    self._end(process)
        self._take_lines()

    @contextlib.contextmanager
    def _reading(self, process: subprocess.Popen[str]) -> Iterator[None]:
        readers = [
            threading.Thread(target=self._read, args=(kind, stream), daemon=True)
            for kind, stream in (("out", process.stdout), ("err", process.stderr))
        ]
        for reader in readers:
            reader.start()
        try:
            yield
        finally:
            self._end(process)
            for reader in readers:
                reader.join(_CALL)  # a child that outlives the program may hold the pipe

    def _read(self, kind: str, stream: Any) -> None:
        for line in stream:
            self._lines.put((kind, line.rstrip("\n")))

    def _take_lines(self) -> None:
        """Take the lines that are there, and wait for one a moment."""
        with contextlib.suppress(queue.Empty):
            self._take(*self._lines.get(timeout=_LOOK_AGAIN))
            while True:
                self._take(*self._lines.get_nowait())

    def _take(self, kind: str, line: str) -> None:
        if kind == "err":
            self._trial.said.append(line)
            self._tell(line)
            self._trial.refusal = mismatch_in(line) or self._trial.refusal
            return
        with contextlib.suppress(ValueError):
            said = json.loads(line)
            if "answer" in said:
                self._trial.answer = said["answer"]
                self._note("task")
            self._trial.error = said.get("error") or self._trial.error

    def _note(self, step: str) -> None:
        self._trial.steps.setdefault(step, time.monotonic() - self._started)

    # -- The FiberPool

    def _look(self, identity: str) -> None:
        """Look at the FiberPool and at its pod."""
        with contextlib.suppress(ApiError):
            if self._trial.answer is not None:
                return
            self._pool = self._find(identity) or self._pool
            if self._pool is None:
                return
            self._note("pool")
            self._trial.relay |= bool(self._pool["spec"].get("relay"))
            problems = (self._pool.get("status") or {}).get("problems") or ()
            self._trial.problem = next(iter(problems), self._trial.problem)
            self._look_at_pods(str(self._pool["metadata"]["uid"]))

    def _find(self, identity: str) -> Body | None:
        pools = self._api.list(POOLS.path(self._namespace), timeout=_CALL).get("items") or ()
        for pool in pools:
            if str((pool["spec"].get("master") or {}).get("identity")).startswith(identity):
                return dict(pool)
        return None

    def _look_at_pods(self, uid: str) -> None:
        selector = {"labelSelector": f"{names.LABEL_POOL_UID}={uid}"}
        pods = self._api.list(PODS.path(self._namespace), selector, timeout=_CALL)
        for pod in pods.get("items") or ():
            self._note("pod")
            if (pod.get("status") or {}).get("phase") == "Running":
                self._note("running")

    def _is_hopeless(self) -> bool:
        reason = (self._trial.problem or {}).get("reason")
        return bool(self._trial.refusal) or reason in _HOPELESS

    def _end(self, process: subprocess.Popen[str]) -> None:
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(_TO_END)
            except subprocess.TimeoutExpired:
                process.kill()

    def _remove_what_is_left(self) -> None:
        """Delete the FiberPool if the program could not."""
        if self._pool is None or not is_of_program(self._pool):
            return
        name, uid = self._pool["metadata"]["name"], str(self._pool["metadata"]["uid"])
        path = POOLS.path(self._namespace, name)
        try:
            found = self._api.get(path, timeout=_CALL)
            if found["metadata"]["uid"] == uid and "deletionTimestamp" not in found["metadata"]:
                self._api.delete(path, uid=uid, timeout=_CALL)
        except (NotFound, NotServed):
            pass
        except ApiError as error:
            self._trial.left = f"the FiberPool {name!r} ({error.message})"

    def _await_the_end_of_pods(self) -> None:
        """Wait a moment for the pods, which go with their FiberPool."""
        if self._pool is None or not is_of_program(self._pool) or self._trial.left:
            return
        selector = {"labelSelector": f"{names.LABEL_POOL_UID}={self._pool['metadata']['uid']}"}
        deadline = time.monotonic() + _TO_GO
        while time.monotonic() < deadline:
            with contextlib.suppress(ApiError):
                pods = self._api.list(PODS.path(self._namespace), selector, timeout=_CALL)
                if not pods.get("items"):
                    return
            time.sleep(_LOOK_AGAIN)
