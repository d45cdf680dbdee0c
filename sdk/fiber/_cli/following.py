"""Follow a program in its pod: bring its files, show its output, pass on Ctrl-C.

Output comes from the launcher, which keeps standard output and errors apart and remembers what was
shown, so a broken connection goes on where it was.  If the pod is lost, the rest comes from its
log.
"""

from __future__ import annotations

import contextlib
import http.client
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import TypeVar

from fiber._cli.failures import INTERRUPTED, CommandError
from fiber._cli.programs import (
    Launcher,
    ProgramPod,
    find_job,
    find_pod,
    number_in,
)
from fiber._cli.session import Session
from fiber.launcher import DROPPED, EXIT, FAILED, STDERR
from fiber_api.rest import JOBS, PODS, ApiError, Forbidden, NotFound

T = TypeVar("T")

_LOOK_AGAIN = 0.5
"""Seconds between two looks at a pod that does not run yet."""

_PAUSE_MIN, _PAUSE_MAX = 0.3, 5.0
"""Seconds until the next attempt to connect; growing."""

_ENDS_WITHIN = 20.0
"""Seconds from the end of a program to the end of its container."""


def follow(
    session: Session,
    name: str,
    archive: bytes | None = None,
    layout: str = "",
    detach: bool = False,
) -> int:
    """Follow the program until it ends; return its exit status.

    With an ``archive`` the program is started first.  ``detach``: return once it runs.
    """
    following = _Following(session, name)
    with _interrupts(following):
        pod = following.wait_for_pod()
        if archive is not None:
            following.start(pod, archive, layout)
        if detach:
            print(f"the program {name!r} runs: `fiber run --attach {name}` follows it, and")
            print(f"`fiber logs {name}` and `fiber stop {name}` look at it and end it")
            return 0
        return following.show(pod)


class _Following:
    """State of one program that is followed."""

    def __init__(self, session: Session, name: str) -> None:
        self._session = session
        self._name = name
        self._position = 0
        """Bytes of output that were shown."""
        self._said = ""
        self.pod: ProgramPod | None = None
        self.interrupted = 0

    def say(self, line: str) -> None:
        """Write a line about the program, once in a row."""
        if line != self._said:
            self._said = line
            print(f"[fiber] {line}", file=sys.stderr, flush=True)

    def wait_for_pod(self) -> ProgramPod:
        """Return the program's pod once it runs or has ended."""
        began = time.monotonic()
        while True:
            pod = find_pod(self._session, self._name)
            if pod is not None and (pod.runs or pod.exit_status is not None):
                self.pod = pod
                return pod
            self._check_job()
            if time.monotonic() - began > 2.0:
                where = "no pod yet" if pod is None else f"its pod {pod.state}"
                self.say(f"waiting for the program {self._name!r}: {where}")
            time.sleep(_LOOK_AGAIN)

    def _check_job(self) -> None:
        """Raise CommandError if the Job will make no pod."""
        job = find_job(self._session, self._name)
        for condition in (job.get("status") or {}).get("conditions") or ():
            if condition.get("type") == "Failed" and condition.get("status") == "True":
                raise CommandError(
                    f"the program {self._name!r} did not start",
                    str(condition.get("message") or condition.get("reason")),
                    f"see `kubectl describe job {self._name} -n {self._session.namespace}`",
                    FAILED,
                )

    def start(self, pod: ProgramPod, archive: bytes, layout: str) -> None:
        """Bring the files of the program to its pod."""
        self._repeat(lambda: Launcher(self._session, pod.name).start(archive, layout))

    def show(self, pod: ProgramPod) -> int:
        """Show the output until the program ends; return its exit status."""
        status = self._repeat(lambda: self._show_from_here(pod)) if pod.runs else None
        return self._ended() if status is None else status

    def _show_from_here(self, pod: ProgramPod) -> int:
        for kind, data in Launcher(self._session, pod.name).output(self._position):
            if kind == EXIT:
                return number_in(kind, data)
            if kind == DROPPED:
                dropped = number_in(kind, data)
                self._position += dropped
                self.say(
                    f"{dropped} bytes of output came while nothing followed the program; "
                    f"`fiber logs {self._name}` has them"
                )
            else:
                self._write(kind, data)
        raise ConnectionResetError("the connection to the program's pod broke")

    def _write(self, kind: int, data: bytes) -> None:
        stream = sys.stderr if kind == STDERR else sys.stdout
        stream.flush()
        view = memoryview(data)
        while view:
            view = view[os.write(stream.fileno(), view) :]
        self._position += len(data)

    def _repeat(self, act: Callable[[], T]) -> T | None:
        """Call ``act`` until no connection breaks; return None if the program's pod has ended."""
        pause = _PAUSE_MIN
        while True:
            try:
                return act()
            except Forbidden as error:
                raise CommandError(
                    f"cannot follow the program {self._name!r}",
                    error.message,
                    "ask an administrator for the role fiber-user in this namespace",
                    FAILED,
                ) from error
            except (ApiError, OSError, http.client.HTTPException) as error:
                trouble = str(error)
            with contextlib.suppress(CommandError):  # the API server does not answer
                self.pod = find_pod(self._session, self._name)
                if self.pod is None or not self.pod.runs:
                    return None
            self.say(f"the connection to the program broke ({trouble}); trying again")
            time.sleep(pause)
            pause = min(2 * pause, _PAUSE_MAX)

    def _ended(self) -> int:
        """Show what the log has beyond the output that was shown; return the exit status."""
        pod = self._end_of_pod()
        if pod is None:
            raise CommandError(
                f"the program {self._name!r} was lost",
                "its pod was deleted, or its node is gone",
                "start it again; results that it stored on volumes are still there",
                FAILED,
            )
        self._show_log(pod)
        if pod.disaster:
            raise CommandError(
                f"the program {self._name!r} was ended by the cluster",
                pod.disaster,
                "start it again, with more --memory if that was too little",
                pod.exit_status or FAILED,
            )
        return FAILED if pod.exit_status is None else pod.exit_status

    def _end_of_pod(self) -> ProgramPod | None:
        deadline = time.monotonic() + _ENDS_WITHIN
        while time.monotonic() < deadline:
            pod = find_pod(self._session, self._name)
            if pod is None or pod.exit_status is not None or pod.phase in ("Failed", "Succeeded"):
                return pod
            time.sleep(_LOOK_AGAIN)
        return find_pod(self._session, self._name)

    def _show_log(self, pod: ProgramPod) -> None:
        seen = self._position
        path = PODS.path(self._session.namespace, pod.name)
        with contextlib.suppress(ApiError):  # the log may be gone with its node
            for piece in self._session.api.log(path, {}):
                if seen < len(piece):
                    sys.stdout.flush()
                    os.write(sys.stdout.fileno(), piece[seen:])
                seen = max(seen - len(piece), 0)

    # -- Ctrl-C

    def interrupt(self) -> None:
        """Interrupt the program; the second time end it."""
        self.interrupted += 1
        if self.interrupted == 1 and self.pod is not None:
            self.say("interrupting the program; Ctrl-C again ends it")
            self._in_background(lambda pod: Launcher(self._session, pod).signal(signal.SIGINT))
        else:
            self.say("ending the program")
            stop(self._session, self._name)
            raise CommandError(f"the program {self._name!r} was ended", status=INTERRUPTED)

    def _in_background(self, act: Callable[[str], None]) -> None:
        pod = self.pod.name if self.pod else ""

        def run() -> None:
            with contextlib.suppress(ApiError, OSError):
                act(pod)

        threading.Thread(target=run, name="fiber-interrupt", daemon=True).start()


def stop(session: Session, name: str) -> None:
    """Delete the Job of a program, and with it its pod."""
    with contextlib.suppress(NotFound):
        session.api.delete(JOBS.path(session.namespace, name), timeout=5.0)


@contextlib.contextmanager
def _interrupts(following: _Following) -> Iterator[None]:
    before = signal.signal(signal.SIGINT, lambda *_: following.interrupt())
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
