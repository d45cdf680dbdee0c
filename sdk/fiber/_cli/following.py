"""Follow a program in its pod: bring its files, show its output, pass on Ctrl-C.

Output comes from the launcher, which keeps standard output and errors apart and remembers what was
shown, so a broken connection goes on where it was.  If the pod is lost, the rest comes from its
log.
"""

from __future__ import annotations

import contextlib
import http.client
import re
import signal
import time
from collections.abc import Callable
from typing import TypeVar

from fiber._cli import streams
from fiber._cli.failures import INTERRUPTED, CommandError, ProgramEnded, explained
from fiber._cli.interrupts import Interrupts
from fiber._cli.programs import LauncherClient, ProgramPod, number_in, read_pod, stop
from fiber._cli.session import Session
from fiber.launcher import ALIVE, DROPPED, EXIT, FAILED, STDERR
from fiber_api import names
from fiber_api.rest import (
    EVENTS,
    JOBS,
    PODS,
    ApiError,
    Body,
    Conflict,
    Forbidden,
    NotFound,
    Transient,
    Unauthorized,
)

T = TypeVar("T")

_LOOK_AGAIN = 0.5
"""Seconds between two looks at a pod that does not run yet."""

_QUIET_LOOKS = 4
"""Looks at a pod that starts, and failed connections, before the user is told."""

_REFUSED = 30.0
"""Seconds for which a right or a login may be missing that was there before.  A starting API server
refuses everything for a while."""

_PAUSE_MIN, _PAUSE_MAX = 0.3, 5.0
"""Seconds until the next attempt to connect; growing."""

_ENDS_WITHIN = 20.0
"""Seconds from the end of a program to the end of its container."""

_BY_CLUSTERS = (128 + signal.SIGKILL, 128 + signal.SIGTERM)
"""Exit statuses that a program has if the cluster ends it."""

_BROKEN = (ApiError, OSError, http.client.HTTPException)
"""Errors of a connection to the launcher."""

_AGAIN = "start it again; results that it stored on volumes are still there"

_BROKEN_PIPE = 128 + signal.SIGPIPE


def start(session: Session, job: Body, archive: bytes, layout: str, *, detach: bool) -> int:
    """Start the program of a new Job and follow it to its end; return its exit status.

    ``detach``: return once it runs.
    """
    following = _Following(session, str(job["metadata"]["name"]), job)

    def act() -> int:
        following.create(job)
        pod = following.wait_for_pod()
        if following.bring(pod, archive, layout, follows=not detach) and detach:
            following.tell_how_to_follow()
            return 0
        return following.show(pod)

    return _interruptible(following, act)


def attach(session: Session, job: Body) -> int:
    """Follow the program of a Job to its end; return its exit status."""
    following = _Following(session, str(job["metadata"]["name"]))
    following.job = job
    return _interruptible(following, lambda: following.show(following.wait_for_pod()))


def _interruptible(following: _Following, act: Callable[[], int]) -> int:
    try:
        with Interrupts(following.interrupt) as following.interrupts:
            return act()
    except KeyboardInterrupt:
        following.give_up()
        raise ProgramEnded(
            f"the program {following.name!r} was ended", status=INTERRUPTED
        ) from None
    except streams.OutputClosed:
        following.end_without_reader()
        return _BROKEN_PIPE


class _Following:
    """State of one program that is followed."""

    def __init__(self, session: Session, name: str, own: Body | None = None) -> None:
        self._session = session
        self.name = name
        self._own = own
        """Job that this command makes; None if it only follows."""
        self.job: Body | None = None
        """Job as the API server has it."""
        self._position = 0
        """Bytes of output that were shown."""
        self._was_served = False
        """True once the API server has led this command to the pod."""
        self._said: set[str] = set()
        self._pod: ProgramPod | None = None
        self._is_to_end = False
        """Flag: the user has interrupted the program."""
        self.interrupts: Interrupts

    def say(self, line: str) -> None:
        """Write a line about the program, once while nothing changes."""
        if line not in self._said:
            self._said.add(line)
            streams.say(f"[fiber] {line}")

    # -- Start

    def create(self, job: Body) -> None:
        """Make the Job."""
        path = JOBS.path(self._session.namespace)
        with explained(f"start the program {self.name!r}"):
            try:
                self.job = self._session.api.create(path, job, strict=True)
            except Conflict as error:
                self.job = self._made() if error.repeated else None
                if self.job is None:
                    raise CommandError(
                        f"there is a program {self.name!r} already",
                        "a program that has ended keeps its name for an hour",
                        f"choose another name, follow it with `fiber run --attach {self.name}`, or "
                        f"delete it with `fiber stop {self.name} --now`",
                    ) from error

    def _made(self) -> Body | None:
        """Return the Job of this name if it is the one that this command makes."""
        assert self._own is not None
        found = self._session.api.get(self._path, timeout=5.0)
        ours = self._own["metadata"]["annotations"][names.ANNOTATION_RUN]
        theirs = (found["metadata"].get("annotations") or {}).get(names.ANNOTATION_RUN)
        return found if ours == theirs else None

    @property
    def _path(self) -> str:
        return JOBS.path(self._session.namespace, self.name)

    def wait_for_pod(self) -> ProgramPod:
        """Return the program's pod once it runs or has ended."""
        looks = 0
        while True:
            with explained(f"wait for the pod of {self.name!r}"):
                try:
                    pod = read_pod(self._session, self.name)
                    if pod is not None and (pod.runs or pod.has_ended):
                        self._pod = pod
                        return pod
                    if pod is None:
                        self._check_job(self._read_job())
                        state = self._why_no_pod()
                    else:
                        self._check_pod(pod)
                        state = f"its pod {pod.state}"
                except Transient as error:
                    state = f"the API server does not answer ({error.message})"
            looks += 1
            if looks > _QUIET_LOOKS:
                self.say(f"waiting for the program {self.name!r}: {state}")
            time.sleep(_LOOK_AGAIN)

    def _check_job(self, job: Body) -> None:
        """Raise CommandError if the Job will make no pod."""
        if not job:
            raise self._deleted(FAILED)
        self._raise_if_overdue(job, FAILED)
        over = _condition(job, "Failed") or _condition(job, "Complete")
        if over:
            raise CommandError(
                f"the program {self.name!r} has no pod"
                + (" any longer" if over["type"] == "Complete" else ""),
                " ".join(str(over.get("message") or over.get("reason") or "it ended").split()),
                f"see `kubectl describe job {self.name} -n {self._session.namespace}`",
            )

    def _why_no_pod(self) -> str:
        """Return why the Job has no pod, in words: a quota, for example, or a missing account."""
        about = f"involvedObject.kind=Job,involvedObject.name={self.name},reason=FailedCreate"
        path = EVENTS.path(self._session.namespace)
        with contextlib.suppress(ApiError):  # many accounts may not read events
            found = self._session.api.list(path, {"fieldSelector": about}, timeout=5.0)
            for event in found.get("items") or ():
                said = " ".join(str(event.get("message")).split())
                # Each attempt has a pod with another name.
                return "no pod yet: " + re.sub(f'"{self.name}-[a-z0-9]*"', self.name, said)
        return "no pod yet"

    def _check_pod(self, pod: ProgramPod) -> None:
        """Raise CommandError if the pod will never run."""
        if pod.state.startswith("waits: InvalidImageName"):
            self.give_up()
            raise CommandError(
                f"the program {self.name!r} cannot start",
                f"its pod {pod.state}",
                "correct the name of the image: --image, or `image` of the configuration",
            )

    def _read_job(self) -> Body:
        """Return the Job; empty if it is gone."""
        try:
            return self._session.api.get(self._path, timeout=5.0)
        except NotFound:
            return {}

    def bring(self, pod: ProgramPod, archive: bytes, layout: str, *, follows: bool) -> bool:
        """Bring the files of the program to its pod; return whether it has started."""
        launcher = LauncherClient(self._session, pod.name)
        try:
            failure = self._repeat(lambda: launcher.start(archive, layout, follows=follows))
        except CommandError:
            self.give_up()  # nobody else would bring them
            raise
        return failure == ""

    def tell_how_to_follow(self) -> None:
        """Write the program's name to the output, and what to do with it."""
        streams.write(f"{self.name}\n".encode())
        self.say(f"`fiber run --attach {self.name}` follows the program, `fiber logs {self.name}`")
        self.say(f"shows its output, and `fiber stop {self.name}` ends it")

    # -- Output

    def show(self, pod: ProgramPod) -> int:
        """Show the output until the program ends; return its exit status."""
        self.interrupts.is_armed = True
        status = self._repeat(lambda: self._show_from_here(pod)) if pod.runs else None
        if status is None:
            return self._show_end()
        if status in _BY_CLUSTERS:
            self._explain(status)
        return status

    def _show_from_here(self, pod: ProgramPod) -> int:
        for kind, data in LauncherClient(self._session, pod.name).output(self._position):
            if kind == EXIT:
                return number_in(kind, data)
            if kind == DROPPED:
                dropped = number_in(kind, data)
                self._position += dropped
                self.say(
                    f"{dropped} bytes of output came while nothing took them; "
                    f"`fiber logs {self.name}` has them, unless they are too old"
                )
            elif kind != ALIVE:
                streams.write(data, to_stderr=kind == STDERR)
                self._position += len(data)
                self._said.clear()
        raise ConnectionResetError("the connection to the program's pod broke")

    def _repeat(self, act: Callable[[], T]) -> T | None:
        """Call ``act`` until no connection breaks; return None if the program's pod has ended."""
        pause, failures = _PAUSE_MIN, 0
        refused: float | None = None
        while True:
            position = self._position
            with explained(f"follow the program {self.name!r}"):
                try:
                    found = act()
                except (Forbidden, Unauthorized) as error:
                    refused = time.monotonic() if refused is None else refused
                    if not self._was_served or time.monotonic() - refused > _REFUSED:
                        raise
                    trouble = error.message
                except _BROKEN as error:
                    refused = None
                    trouble = " ".join(str(error).split())
                else:
                    self._was_served = True
                    return found
                if self._is_over():
                    return None
            if self._position > position:
                self._was_served = True
                pause, failures = _PAUSE_MIN, 0
            failures += 1
            if failures > _QUIET_LOOKS:
                self.say(f"no connection to the program ({trouble}); trying again")
            time.sleep(pause)
            pause = min(2 * pause, _PAUSE_MAX)

    def _is_over(self) -> bool:
        """Return whether the pod is known to have ended."""
        try:
            self._pod = read_pod(self._session, self.name)
        except (Transient, Forbidden, Unauthorized):
            return False
        return self._pod is None or self._pod.has_ended or self._pod.is_lost

    # -- End

    def _show_end(self) -> int:
        """Show what the log has beyond the output that was shown; return the exit status."""
        with explained(f"find out how the program {self.name!r} ended"):
            pod = self._end_of_pod()
            if pod is not None:
                self._show_log(pod)
            status = None if pod is None else pod.exit_status
            self._raise_if_disaster(pod, FAILED if status is None else status)
        return FAILED if status is None else status

    def _explain(self, status: int) -> None:
        """Raise ProgramEnded if the program has this exit status because of the cluster."""
        with contextlib.suppress(ApiError):  # the status is known
            self._raise_if_disaster(self._end_of_pod(), status)

    def _end_of_pod(self) -> ProgramPod | None:
        """Return the pod once it has ended; None if it is gone."""
        deadline = time.monotonic() + _ENDS_WITHIN
        while not self._is_over() and time.monotonic() < deadline:
            time.sleep(_LOOK_AGAIN)
        return self._pod

    def _raise_if_disaster(self, pod: ProgramPod | None, status: int) -> None:
        """Raise ProgramEnded if the cluster has ended the program."""
        job = self._read_job()
        self._raise_if_overdue(job, status)
        if not job:
            raise self._deleted(status)
        if pod is None:
            raise ProgramEnded(
                f"the program {self.name!r} was lost",
                "its pod was deleted, or its node is gone",
                _AGAIN,
                status,
            )
        if reason := "its node does not answer" if pod.is_lost else pod.disaster:
            raise ProgramEnded(
                f"the program {self.name!r} was ended by the cluster",
                reason,
                "start it again, with more --memory" if "OOMKilled" in reason else _AGAIN,
                status,
            )

    def _deleted(self, status: int) -> ProgramEnded:
        what = f"the program {self.name!r} was deleted"
        return ProgramEnded(what, "its Job is gone, as after `fiber stop --now`", _AGAIN, status)

    def _raise_if_overdue(self, job: Body, status: int) -> None:
        """Raise ProgramEnded if the program has reached its longest run time."""
        for kind in ("Failed", "FailureTarget"):
            if _condition(job, kind).get("reason") == "DeadlineExceeded":
                seconds = (job.get("spec") or {}).get("activeDeadlineSeconds")
                raise ProgramEnded(
                    f"the program {self.name!r} was ended by its deadline",
                    f"it had not ended {seconds} s after its start",
                    "start it again with a longer --timeout, or without one",
                    status,
                )

    def _show_log(self, pod: ProgramPod) -> None:
        seen = self._position
        path = PODS.path(self._session.namespace, pod.name)
        with contextlib.suppress(ApiError):  # the log may be gone with its node
            for piece in self._session.api.log(path, {"container": names.PROGRAM_CONTAINER}):
                if seen < len(piece):
                    streams.write(piece[seen:])
                seen = max(seen - len(piece), 0)
        if seen:
            self.say("the last output may be missing: the log does not have it")

    # -- Ctrl-C and other ends of this command

    def interrupt(self) -> None:
        """Interrupt the program, from another thread."""
        self._is_to_end = True
        self.say("interrupting the program; Ctrl-C again ends it")
        try:
            self._signal(signal.SIGINT)
        except _BROKEN as error:
            self.say(f"the program was not interrupted ({error}); Ctrl-C again ends it")

    def _signal(self, number: int) -> None:
        if self._pod is not None:
            LauncherClient(self._session, self._pod.name).signal(number)

    def give_up(self) -> None:
        """Delete the Job, if this command has made it or the user has interrupted it before."""
        try:
            job = self.job or (self._made() if self._own else None)
            if job is not None and (self._own or self._is_to_end):
                self.say("ending the program")
                stop(self._session, job)
        except NotFound:
            pass
        except ApiError as error:
            self.say(f"cannot end the program ({error.message}): `fiber stop {self.name} --now`")

    def end_without_reader(self) -> None:
        """End a program that this command has started, as its closed output would here."""
        if self._own is not None:
            with contextlib.suppress(*_BROKEN):
                self._signal(signal.SIGTERM)


def _condition(job: Body, kind: str) -> Body:
    """Return a condition of the Job that is true; empty if there is none."""
    for condition in (job.get("status") or {}).get("conditions") or ():
        if condition.get("type") == kind and condition.get("status") == "True":
            return dict(condition)
    return {}
