"""Process of an agent, from its environment to its exit status.

The agent protects itself from the processes of its tasks, which run as the same user.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib.util
import math
import os
import pickle
import signal
import socket
import sys
import sysconfig
import time
from multiprocessing import current_process
from typing import NoReturn

from fiber import _logs, config
from fiber._agent import zygote_process
from fiber._agent.agent import Agent
from fiber._agent.child import become_subreaper, go_on_without_parent
from fiber._agent.service import AgentService
from fiber._hub.directory import remove_directory
from fiber._hub.hub import Hub
from fiber._transport.authentication import Identity
from fiber._transport.channels import naming_the_limit
from fiber._transport.credentials import Credentials
from fiber._transport.dialer import AgentDialer, EarlierMaster
from fiber._transport.link import Link
from fiber._transport.loop import Loop
from fiber.errors import AuthenticationError, ConfigError, FiberError, LinkError

_ADDRESS = "FIBER_AGENT_ADDRESS"
_CREDENTIALS = "FIBER_AGENT_CREDENTIALS"
_DESCRIPTOR = "fd:"
_PARENT = "FIBER_AGENT_PARENT"
_INHERITS = "FIBER_AGENT_INHERITS"
_DIRECTORY = "FIBER_AGENT_DIRECTORY"
_REPORT = "FIBER_AGENT_REPORT"
_LOST_GRACE = "FIBER_AGENT_LOST_GRACE"
_WAITS_UNTIL = (
    "FIBER_AGENT_WAITS_UNTIL"  # time.monotonic(), from an agent to itself after its restart
)
_SIGNALS = "FIBER_AGENT_SIGNALS"  # descriptor, from an agent to itself after its restart

_TERMINATION_GRACE = "FIBER_AGENT_TERMINATION_GRACE"
_LINKED = "FIBER_AGENT_LINKED"

_DEFAULT_GRACE = 15.0
"""Seconds from SIGTERM to the end by force, if the environment does not say."""

_CLEANING_UP = 5.0
"""Seconds of the grace that are kept for the last results and the ends of children and link; no
more than a quarter of the grace.
"""

_DRAINED = "Drained: its host got SIGTERM"

_OPEN = (
    "the kernel refused prctl(PR_SET_DUMPABLE), so tasks of this pod may read the credentials of "
    "their agent. Allow prctl in the seccomp profile of the container."
)

_UNSEEN = (
    "the kernel refused prctl(PR_SET_CHILD_SUBREAPER) and this agent is not process 1, so it "
    "cannot find all that tasks left behind and serves no other master: it ends, and its pod with "
    "it. Allow prctl in the seccomp profile of the container, or have the agent be process 1."
)

_LEFT_BEHIND = (
    "processes that tasks left behind could not be ended, so this agent serves no other master: it "
    "ends, and its pod with it"
)

_LEFT = 5.0
"""Seconds to end the processes that tasks left behind."""

_REFUSED_PAUSE = 0.5
"""Seconds from the refusal of a master until the agent dials again."""


class Main:
    """Main function of an agent's process: dial, serve, end."""

    def __init__(self) -> None:
        self._environment = dict(os.environ)
        # Children run as the same user and must not read the memory of the agent.
        is_hidden = hide_this_process()
        self._credentials = _read(_required(_CREDENTIALS))  # before any process starts
        self._name = self._credentials.name
        if not is_hidden:
            self._complain(_OPEN)
        self._lost_grace = _seconds(_LOST_GRACE)
        self._inherits_orphans = os.getpid() == 1
        if self._lost_grace is not None and not self._inherits_orphans:
            self._inherits_orphans = become_subreaper()
        self._waits_until = _seconds(_WAITS_UNTIL)
        grace = _seconds(_TERMINATION_GRACE)
        self._grace = _DEFAULT_GRACE if grace is None else grace
        self._cleaning_up = min(_CLEANING_UP, self._grace / 4)
        self._drained_at: float | None = None
        """Time of the first SIGTERM, from which the grace counts."""
        self._linked = os.environ.pop(_LINKED, "")
        self._parent = _pid(_PARENT)
        if self._parent is not None:
            # When the parent dies, this process removes the parent's directory.  If this process is
            # stopped then, the kernel may send SIGHUP before it lets the process go on.
            signal.signal(signal.SIGHUP, signal.SIG_IGN)
            go_on_without_parent()
        self._loop = Loop()
        self._service: AgentService | None = None
        self._status = 0
        self._again = False
        self._terminating = _last_run_took_sigterm()
        # From here on there is a directory, which must be removed at a SIGTERM too.
        signal.signal(signal.SIGTERM, self._on_sigterm)
        parent, directory = config.current().runtime_directory, os.environ.pop(_DIRECTORY, None)
        self._hub = Hub(self._loop, self._name, parent, directory)
        with naming_the_limit("starting an agent"):
            self._agent = Agent(self._loop, self._name, self._hub)

    def run(self) -> int:
        """Serve until the end; return the exit status."""
        current_process().name = self._name  # for log records
        _logs.show(config.current().log_level)
        _logs.debug("agent with pid %d", os.getpid())
        self._dialer = self._dial()
        self._wake_by_signals()
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.pthread_sigmask(signal.SIG_SETMASK, ())  # its last run or the starter blocks some
        self._end_with_parent()
        if self._terminating:
            self._on_sigterm()
        self._loop.run()
        self._dialer.close()
        self._agent.close()
        self._hub.close()
        # From here on a SIGTERM is for the next run, which unblocks the signal once it is ready.
        signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGTERM,))
        if self._again and not self._is_terminating():
            # No process or file of the last master may reach the next one.
            why_not = self._unfit_for_another()
            if why_not is not None:
                self._complain(why_not)
                return 1
            command = _restart_command()
            self._hand_on_credentials()
            # The lines above take seconds, in which another thread may have taken the signal.
            if not self._is_terminating():
                self._hand_on_signals()
                os.execve(sys.executable, command, self._environment)
        signal.set_wakeup_fd(-1)
        for end in self._signals:
            end.close()
        return self._status

    def _unfit_for_another(self) -> str | None:
        """End what tasks left behind; return why that failed."""
        if self._service is not None and not self._inherits_orphans:
            return _UNSEEN
        return None if end_descendants(_LEFT) else _LEFT_BEHIND

    def _hand_on_credentials(self) -> None:
        descriptor = self._dialer.credentials.to_descriptor()
        os.set_inheritable(descriptor, True)
        self._environment[_CREDENTIALS] = f"{_DESCRIPTOR}{descriptor}"

    def _hand_on_signals(self) -> None:
        """Let the next run see a signal that another thread takes until this one is replaced."""
        descriptor = self._signals[0].fileno()
        os.set_inheritable(descriptor, True)
        self._environment[_SIGNALS] = str(descriptor)

    def _dial(self) -> AgentDialer:
        return AgentDialer(
            self._loop,
            _required(_ADDRESS),
            self._credentials,
            Identity.of_this_process(self._name, self._credentials.uid, pid=str(os.getpid())),
            on_link=self._joined,
            on_failed=self._failed,
            timeout=self._timeout(),
        )

    def _timeout(self) -> float | None:
        if self._lost_grace is None:
            return config.current().start_timeout
        if self._waits_until is None:
            return None
        return max(self._waits_until - time.monotonic(), 0.0)

    def _complain(self, what: object) -> None:
        _complain(f"fiber agent {self._name}", what)

    def _joined(self, link: Link) -> None:
        keep_search_path()  # before the first task
        self._service = AgentService(
            self._loop, link, self._agent, self._hub, self._ended, self._dialer.local_host
        )
        self._link = link
        link.attach(self._service)
        if self._linked:
            self._tell_of_link()

    def _tell_of_link(self) -> None:
        try:
            # Tasks may write there.  A named pipe in its place must not hold up the agent.
            flags = os.O_WRONLY | os.O_CREAT | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC
            os.close(os.open(self._linked, flags, 0o666))
        except OSError as error:
            self._complain(f"it is linked, and its pod does not get Ready, because of {error}")

    def _failed(self, error: Exception) -> None:
        self._complain(error)
        # After a lost master, another program may have its address until the next master comes.
        stranger = self._waits_until is not None and isinstance(error, AuthenticationError)
        if self._lost_grace is None or not (stranger or isinstance(error, LinkError)):
            self._status = 1
        elif self._waits_until is None or self._timeout():
            # The master answered and refused: it is ending, or took the name for another agent's.
            if isinstance(error, EarlierMaster) and self._waits_until is None:
                # No later master may come: the epochs begin anew if the pool's status is lost.  The
                # next pod gets its epoch from the operator.
                self._environment[_WAITS_UNTIL] = str(time.monotonic() + self._lost_grace)
            self._again = True
            self._loop.call_later(_REFUSED_PAUSE, self._loop.stop)
            return
        self._loop.stop()

    def _ended(self, reason: str, lost: bool) -> None:
        if lost:
            self._complain(reason)
        if self._lost_grace is not None and not self._terminating:
            self._again = True
            self._environment.pop(_WAITS_UNTIL, None)
            if lost:
                seconds = self._dialer.lost_grace
                grace = self._lost_grace if seconds is None else seconds
                self._environment[_WAITS_UNTIL] = str(time.monotonic() + grace)
        elif lost:
            self._status = 1
        self._link.close(reason, linger=self._linger(), then=self._loop.stop)

    def _linger(self) -> float:
        """Return for how many seconds the link may go on sending results: what the grace leaves."""
        if not self._terminating:
            return 1.0
        began = time.monotonic() if self._drained_at is None else self._drained_at
        return max(began + self._grace - time.monotonic(), self._cleaning_up)

    def _is_terminating(self) -> bool:
        """Return whether SIGTERM came, also if another thread took it and no handler ran yet."""
        try:
            taken = self._signals[0].recv(4096)
        except BlockingIOError:
            taken = b""
        self._terminating |= signal.SIGTERM in taken
        return self._terminating

    def _wake_by_signals(self) -> None:
        """Have signals wake the loop.

        Python only notes a signal that comes just before the loop sleeps, and the loop would sleep
        on.
        """
        reader, writer = socket.socketpair()
        for end in (reader, writer):
            end.setblocking(False)
        self._signals = reader, writer  # keeps both ends open
        self._loop.register(reader.fileno(), lambda: reader.recv(4096))
        signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)

    def _on_sigterm(self, *_: object) -> None:
        self._terminating = True
        if self._drained_at is None:
            self._drained_at = time.monotonic()
        self._loop.call_soon(self._drain)

    def _drain(self) -> None:
        if self._service is None:
            self._loop.stop()
        else:
            self._service.leave(_DRAINED, self._grace - self._cleaning_up)

    def _end_with_parent(self) -> None:
        if self._parent is None:
            return
        try:
            watched = os.pidfd_open(self._parent)
        except ProcessLookupError:
            self._parent_died()
        self._loop.register(watched, self._parent_died)

    def _parent_died(self) -> NoReturn:
        # At once and by force: the parent was the master of this agent.
        directory = os.environ.get(_INHERITS)
        if directory:
            remove_directory(directory)
        os._exit(0)


def _restart_command() -> list[str]:
    """Return the command of an agent that uses no module or setting that a task has written.

    The environment is for its children.  The agent's own interpreter ignores it.
    """
    keep_search_path()
    flags = zygote_process.flags()
    settings = pickle.dumps(config.current())
    statement = (
        f"import sys; sys.path[:] = {sys.path!r}; from fiber._agent import zygote_process; "
        f"zygote_process.interpreter_flags = {flags!r}; "
        f"from fiber import _config_sources; _config_sources.keep({settings!r}); "
        "import runpy; runpy.run_module('fiber.agent', run_name='__main__')"
    )
    return [sys.executable, *flags, "-I", "-B", "-c", statement]


def _read(credentials: str) -> Credentials:
    descriptor = _descriptor_in(credentials)
    if descriptor is not None:
        return Credentials.from_descriptor(descriptor)
    if os.path.isabs(credentials):
        return Credentials.from_file(credentials)
    raise ConfigError(  # without the value, which may be a misplaced secret
        f"{_CREDENTIALS} ({len(credentials)} characters) is neither an absolute path nor fd:N. It "
        "says where the credentials are, a file for instance, and does not hold them."
    )


def _descriptor_in(credentials: str) -> int | None:
    number = credentials.removeprefix(_DESCRIPTOR)
    is_one = number != credentials and number.isascii() and number.isdigit() and len(number) < 10
    return int(number) if is_one else None


def _seconds(variable: str) -> float | None:
    value = os.environ.pop(variable, None)
    if value is None:
        return None
    try:
        seconds = float(value)
    except ValueError:
        seconds = math.nan
    if not (math.isfinite(seconds) and seconds >= 0):
        raise ConfigError(f"{variable}={value!r} is not a number of seconds")
    return seconds


def _last_run_took_sigterm() -> bool:
    """Return whether SIGTERM came after the last run had looked for it, and before this run."""
    value = os.environ.pop(_SIGNALS, None)
    if value is None:
        return False
    descriptor = int(value)
    try:
        return signal.SIGTERM in os.read(descriptor, 4096)
    except BlockingIOError:  # no signal came, and a child of a task still has the other end
        return False
    finally:
        os.close(descriptor)


def _pid(variable: str) -> int | None:
    value = os.environ.get(variable)
    if value is None:
        return None
    if not (value.isascii() and value.isdigit() and 0 < int(value) < 2**31):
        raise ConfigError(f"{variable}={value!r} is not the id of a process")
    return int(value)


def _required(variable: str) -> str:
    # Removed from the environment that the children get: they run foreign code.
    value = os.environ.pop(variable, "")
    if not value:
        raise ConfigError(
            f"{variable} is not set. An agent is started by a Fiber backend, which hands it the "
            "master's address and its credentials."
        )
    return value


def main() -> int:
    """Run one agent to its end; return the exit status."""
    keep_memory()
    try:
        return Main().run()
    except (FiberError, AuthenticationError) as error:
        _complain("fiber agent", error)
        return 1


def _complain(who: str, what: object) -> None:
    print(f"{who}: {what}", file=sys.stderr, flush=True)
    # The master reads the file when this process has ended.
    if (path := os.environ.get(_REPORT)) is not None:
        with contextlib.suppress(OSError), open(path, "w", errors="replace") as file:
            file.write(str(what))


# Protection from the processes of tasks, which run as the same user

_PR_SET_DUMPABLE = 4

_DEPENDENCIES = ("cloudpickle", "cryptography", "pynng")
"""Packages that an agent may import late."""

_PAUSE = 0.01
"""Seconds between two checks of processes that end."""


def hide_this_process() -> bool:
    """Have the kernel hide memory and descriptors of this process from the user's other processes.

    Return whether the kernel does.  A seccomp profile may refuse it.
    """
    refused: int = ctypes.CDLL(None).prctl(_PR_SET_DUMPABLE, 0, 0, 0, 0)
    return not refused


def keep_search_path() -> None:
    """Restrict ``sys.path`` to places that have modules of this process, Python's own first.

    A task may write a module to the working directory or to a folder of ``PYTHONPATH``.
    """
    main = sys.modules["__main__"]  # has a second name, for multiprocessing
    found = [importlib.util.find_spec(name) for name in _DEPENDENCIES]
    files = [spec.origin for spec in found if spec is not None]
    others = [module for module in list(sys.modules.values()) if module is not main]
    files += [getattr(module, "__file__", None) for module in others]
    places = list(dict.fromkeys(map(os.path.abspath, sys.path)))
    used = {_place_of(file, places) for file in files if file is not None}
    own = [sysconfig.get_path(kind) for kind in ("stdlib", "platstdlib", "purelib", "platlib")]
    own += [os.path.join(path, "lib-dynload") for path in own]
    sys.path[:] = sorted(filter(used.__contains__, places), key=lambda place: place not in own)


def _place_of(file: str, places: list[str]) -> str:
    """Return the innermost of the places that the file is in; empty if it is in none."""
    within = [place for place in places if file.startswith(place.rstrip(os.sep) + os.sep)]
    return max(within, key=len, default="")


def end_descendants(timeout: float) -> bool:
    """Kill all descendants; return whether none is left after ``timeout`` seconds.

    This process must be a subreaper, or process 1 of its container.  Then orphaned descendants
    become its children.
    """
    deadline = time.monotonic() + timeout
    while True:
        for pid in _descendants():
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(pid, signal.SIGKILL)
        if not _reap():
            return True
        if time.monotonic() > deadline:
            return False
        time.sleep(_PAUSE)


def _reap() -> bool:
    """Collect children that have ended; return whether there are others."""
    try:
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass
    except ChildProcessError:
        return False
    return True


def _descendants() -> list[int]:
    parents = {}
    for entry in os.listdir("/proc"):
        if entry.isdigit():
            with contextlib.suppress(OSError), open(f"/proc/{entry}/stat", "rb") as file:
                parents[int(entry)] = int(file.read().rpartition(b")")[2].split()[1])
    found = [os.getpid()]
    for pid in found:
        found += [child for child, parent in parents.items() if parent == pid]
    return found[1:]


_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_THRESHOLD = -1, -2, -3  # malloc.h

_MAPPED = 2 << 20
"""Bytes from which on malloc maps a piece separately: more than a datagram has."""

_KEPT = 16 << 20
"""Free bytes that malloc keeps.  Above that, it keeps half as many."""


def keep_memory() -> None:
    """Let malloc keep the memory of large messages.  Does nothing without glibc.

    glibc gives large free pieces back to the kernel at once.  For the next message it gets them
    again, page by page and zeroed: with messages of half a megabyte a page fault for each 4 KiB
    that an agent sends.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _MAPPED)
        mallopt(_M_TRIM_THRESHOLD, _KEPT)
        mallopt(_M_TOP_PAD, _KEPT // 2)  # else a trim would free all of it
