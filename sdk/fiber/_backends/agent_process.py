"""The process of an agent on this machine, and the thread that starts them."""

from __future__ import annotations

import contextlib
import errno
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping

from fiber._agent.zygote_process import interpreter_arguments
from fiber._transport.credentials import Credentials
from fiber._transport.loop import Loop

_PAUSE_MIN, _PAUSE_MAX = 0.1, 5.0
"""Seconds from one attempt to start a process to the next, growing."""

_MAY_PASS = (errno.EAGAIN, errno.ENOMEM, errno.EMFILE, errno.ENFILE)
"""Errors of a system that can start no process until others have ended."""

_STATEMENT = "import runpy; runpy.run_module('fiber.agent', run_name='__main__')"


class AgentProcess:
    """Process of an agent, from before its start to after its end.

    ``on_end`` is called once, on the loop's thread: with how the process ended or why it never
    began, and whether a signal or a lack of resources was the reason.
    """

    def __init__(
        self, loop: Loop, on_end: Callable[[str, bool], None], directory: str | None = None
    ) -> None:
        """``directory``: the one to start it in, if that is not this program's."""
        self._loop = loop
        self._directory = directory
        self._on_end = on_end
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._unwanted = False

    @property
    def pid(self) -> int | None:
        """Id of the process, once it has begun."""
        return None if self._process is None else self._process.pid

    def start(self, environment: Mapping[str, str], credentials: Credentials) -> None:
        """Start it, with the credentials on a descriptor that only it inherits; or OSError."""
        with self._lock:
            if self._unwanted:
                return
            descriptor = credentials.to_descriptor()
            try:
                process = subprocess.Popen(
                    interpreter_arguments(sys.executable, _STATEMENT),
                    env={**environment, "FIBER_AGENT_CREDENTIALS": f"fd:{descriptor}"},
                    stdin=subprocess.DEVNULL,
                    pass_fds=(descriptor,),
                    cwd=self._directory,
                    process_group=0,
                )
            finally:
                os.close(descriptor)
            try:
                self._watched = os.pidfd_open(process.pid)
            except OSError:  # nobody would see its end, and the next attempt has its name
                process.kill()
                process.wait()
                raise
            self._process = process
        self._loop.register(self._watched, self._ended)

    def fail(self, reason: str, *, may_pass: bool) -> None:
        """Note that the process will not be started."""
        self._loop.call_soon(self._on_end, reason, may_pass)

    def kill(self) -> None:
        """Kill the process, which is out of reach though it may run."""
        self._end(signal.SIGKILL)

    def terminate(self) -> None:
        """Tell the agent to end.  It removes its directory first."""
        self._end(signal.SIGTERM)

    def _end(self, signum: int) -> None:
        with self._lock:
            self._unwanted = True
            if self._process is not None:
                with contextlib.suppress(ProcessLookupError):
                    self._process.send_signal(signum)

    def wait(self, timeout: float) -> None:
        """Wait for its end, by force after ``timeout`` seconds.  It must not be started later."""
        process = self._process
        if process is None:
            return
        try:
            process.wait(timeout)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    def _ended(self) -> None:
        assert self._process is not None
        status = self._process.poll()
        if status is None:
            return
        self._loop.unregister(self._watched)
        os.close(self._watched)
        self._on_end(f"its process ended with status {status}", status < 0)


class AgentLauncher:
    """A thread that starts agents, one after the other.

    Starting a process takes milliseconds and may fail, so the loop does not do it; nor would a
    thread of its own for each be there when the system has no more of them to give.
    """

    def __init__(self, timeout: float, on_trouble: Callable[[str], None]) -> None:
        """``on_trouble`` is told, on the thread, what keeps one from starting that is tried again
        for ``timeout`` seconds.
        """
        self._timeout = timeout
        self._on_trouble = on_trouble
        self._wanted: queue.SimpleQueue[tuple[AgentProcess, Credentials, Mapping[str, str]] | None]
        self._wanted = queue.SimpleQueue()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="fiber-launch", daemon=True)
        self._thread.start()

    def launch(
        self, process: AgentProcess, credentials: Credentials, environment: Mapping[str, str]
    ) -> None:
        """Start it as soon as possible.  Any thread; returns at once."""
        self._wanted.put((process, credentials, environment))

    def close(self) -> None:
        """Start nothing more."""
        self._closing.set()
        self._wanted.put(None)
        self._thread.join()

    def _run(self) -> None:
        while (wanted := self._wanted.get()) is not None and not self._closing.is_set():
            self._start(*wanted)

    def _start(
        self, process: AgentProcess, credentials: Credentials, environment: Mapping[str, str]
    ) -> None:
        deadline = time.monotonic() + self._timeout
        pause = _PAUSE_MIN
        while True:
            try:
                process.start(environment, credentials)
                return
            except OSError as error:
                reason = f"its process cannot be started: {error}"
                may_pass = error.errno in _MAY_PASS
                if not may_pass or time.monotonic() + pause > deadline:
                    process.fail(reason, may_pass=may_pass)
                    return
            self._on_trouble(
                f"agent {credentials.name} has to wait, {reason}; next attempt in {pause:g} s"
            )
            if self._closing.wait(pause):
                return
            pause = min(2 * pause, _PAUSE_MAX)
