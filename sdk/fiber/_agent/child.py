"""A child's first steps: from forked zygote or a fresh interpreter to the user's Process object."""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import multiprocessing.spawn
import os
import pickle
import signal
import sys
from collections.abc import Iterator
from multiprocessing import process as mp_process
from multiprocessing import util
from typing import Any, NamedTuple

from fiber import _logs
from fiber._agent import last_words, program_folder
from fiber._agent.progress import ProgressTable
from fiber._agent.zygote_process import interpreter_arguments
from fiber._hub import client as hub_client
from fiber._hub.protocol import HubAddress
from fiber._transport.unix import UnixChannel
from fiber._wire.descriptor import Descriptor, contents, own

_LONGEST_LINE = 1 << 16
"""Bytes of one line that are collected before they are written."""

_PR_SET_PDEATHSIG = 1
_PR_SET_CHILD_SUBREAPER = 36
_libc = ctypes.CDLL(None, use_errno=True)

_descriptors: list[int] = []
_task_channel: UnixChannel | None = None
_progress: memoryview | None = None
ancestors: tuple[int, ...] = ()
"""Pids of the processes that this one ends with: its parent first; none in a program that Fiber did
not start.
"""
host = ""
"""The host that this process belongs to; empty in a program that Fiber did not start."""


class UnguardedMainError(RuntimeError):
    """The main module starts a process each time it is imported."""


class StartRequest(NamedTuple):
    """What a zygote is told of one child, and the child of itself; descriptors come beside it."""

    name: str
    host: str
    """What the master calls the host."""
    method: str
    preparation: bytes
    payload: bytes
    slot: int | None
    """Its place on the progress table; a worker's first descriptor is its task channel."""
    executable: str | None
    open_files: tuple[int, int]
    """Its limits of descriptors, soft and hard: those of its agent's process."""
    hub: HubAddress | None
    """Where it finds the hub of its host."""
    ancestors: tuple[int, ...]
    """Pids of the processes that it ends with: its parent, its parent's parent, and so on."""
    folder: str | None = None
    """Where the program's files are, if they were sent here."""
    has_arguments: bool = False
    """Whether a descriptor, the next one, brings the arguments of its Process."""
    payload_at: tuple[int, int] | None = None
    """Offset and size of the payload in another descriptor, if it is large."""


def lineage() -> tuple[int, ...]:
    """This process's pid and those of the processes that it ends with."""
    return os.getpid(), *ancestors


def task_channel() -> UnixChannel:
    """In a pool worker: the channel that brings tasks and takes results."""
    if _task_channel is None:
        raise RuntimeError("this process is not a pool worker")
    return _task_channel


def progress() -> memoryview:
    """In a pool worker: two words of shared memory, sequence number and index of the running task.

    Set the sequence number last, to zero before another batch's index is written: whoever reads
    them after a crash must never see one batch's number with another's index.
    """
    if _progress is None:
        raise RuntimeError("this process is not a pool worker")
    return _progress


def take_descriptor(index: int) -> int:
    """A descriptor that came with the start message, for whoever unpickles a handle to it."""
    fd = _descriptors[index]
    if fd < 0:
        raise RuntimeError(f"descriptor {index} of the start message was taken twice")
    _descriptors[index] = -1
    return fd


def duplicate_descriptor(index: int) -> int:
    """A duplicate of one to which several handles refer; it is there until all are unpickled."""
    return os.dup(_descriptors[index])


def die_with_parent(parent: int) -> None:
    """Have the kernel kill this process when its zygote dies."""
    _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


def go_on_without_parent() -> None:
    """Have the kernel let this process go on, if it is stopped, when its parent dies.

    The kernel does so by itself only for process groups that were stopped before that moment.  A
    stop that takes effect just after it would last for ever.
    """
    _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGCONT)


def become_subreaper() -> bool:
    """Have the kernel make this process the parent of what our children leave behind.

    Return whether the kernel does.  A seccomp profile may refuse it.
    """
    refused: int = _libc.prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    return not refused


def run(
    start: StartRequest, fds: list[int], progress_table: ProgressTable, agent: int, words: int
) -> int:
    """Run what was asked for and return the exit code; ``words`` is for the stacks of a crash."""
    if start.method == "spawn":
        _exec(start, fds, progress_table, agent, words)
    # What the zygote's imports registered, say to remove a folder, is not for each child to do.
    atexit._clear()
    atexit.register(util._exit_function)  # type: ignore[attr-defined]
    return _run(start, fds, progress_table, agent, words)


def _run(
    start: StartRequest, fds: list[int], progress_table: ProgressTable, agent: int, words: int
) -> int:
    global _task_channel, _progress, _descriptors, ancestors
    if words >= 0:
        last_words.write_to(words)
    ancestors = start.ancestors
    _adopt_stdio(fds)
    rest = fds[2:]
    if start.slot is not None:
        _task_channel = UnixChannel.from_fd(rest.pop(0))
        _progress = progress_table.slot(start.slot)
    arguments = own(rest.pop(0)) if start.has_arguments else None
    payload = own(rest.pop(0)) if start.payload_at is not None else None
    _descriptors = rest
    try:
        return _load_and_run(start, agent, arguments, payload)
    finally:
        # Up to Python 3.12 ``_bootstrap`` runs multiprocessing's own, which know that they ran.
        atexit._run_exitfuncs()
        util._flush_std_streams()  # type: ignore[attr-defined]


def _load_and_run(
    start: StartRequest, agent: int, arguments: Descriptor | None, payload: Descriptor | None
) -> int:
    try:
        process = _load(start, arguments, payload)
    except UnguardedMainError as error:
        is_worker = _task_channel is not None
        _tell(f"{'' if is_worker else f'fiber: process {start.name!r} did not start: '}{error}\n")
        return 1
    except BaseException:
        import traceback  # rarely needed, and long to import

        _tell(traceback.format_exc())
        return 1
    return int(process._bootstrap(parent_sentinel=agent))


def _load(
    start: StartRequest, arguments: Descriptor | None = None, payload: Descriptor | None = None
) -> Any:
    data = read_preparation(start)
    if start.hub is not None:
        hub_client.set_hub_address(start.hub)
    prepare_paths(data)
    _prepare_environment(data)
    with inheriting():
        prepare_main(data)
        process = pickle.loads(_payload(start, payload))
        if arguments is not None:
            process._args = pickle.loads(contents(arguments.fileno()))
            arguments.close()
    for fd in _descriptors:
        if fd >= 0:  # sent along, but nothing unpickled took it
            os.close(fd)
    _descriptors.clear()
    return process


def _payload(start: StartRequest, payload: Descriptor | None) -> bytes | memoryview:
    """The pickled Process."""
    if payload is None or start.payload_at is None:
        return start.payload
    offset, size = start.payload_at
    return memoryview(contents(payload.fileno()))[offset : offset + size]


def read_preparation(start: StartRequest) -> dict[str, Any]:
    """What ``start`` has the child set up, as it is on this host."""
    data: dict[str, Any] = pickle.loads(start.preparation)
    data |= {"name": start.name, "host": start.host}
    if start.folder is not None:
        data |= program_folder.places(data["program"], start.folder)
    return data


@contextlib.contextmanager
def inheriting() -> Iterator[None]:
    """While main is imported or a Process unpickled, no process may start: main is unguarded."""
    mp_process.current_process()._inheriting = True  # type: ignore[attr-defined]
    try:
        yield
    finally:
        del mp_process.current_process()._inheriting  # type: ignore[attr-defined]


def prepare_paths(data: dict[str, Any]) -> None:
    """Make modules importable as in the parent, as far as its directories exist here."""
    if data["same_host"] or "program" in data:
        sys.path[:] = data["sys_path"]
    else:
        known = set(sys.path)
        sys.path += [p for p in data["sys_path"] if p not in known and os.path.exists(p or ".")]
    sys.argv[:] = data["sys_argv"]
    # A directory that is gone or forbidden is the parent's own situation too.
    with contextlib.suppress(OSError):
        os.chdir(data["dir"])


def prepare_main(data: dict[str, Any]) -> None:
    """Import the parent's main module as ``__mp_main__``, as multiprocessing's spawn does."""
    wanted: Any = {
        key: data[key] for key in ("init_main_from_name", "init_main_from_path") if key in data
    }
    multiprocessing.spawn.prepare(wanted)


def _prepare_environment(data: dict[str, Any]) -> None:
    global host
    host = data["host"]
    environ = data.get("environ")
    if environ is not None and environ != os.environb:
        os.environb.clear()
        os.environb.update(environ)
    given: Any = {key: data[key] for key in _SPAWN_KEYS if key in data}
    multiprocessing.spawn.prepare(given)
    _logs.debug("process %d on host %s", os.getpid(), host)
    for function, arguments in data["calls"]:
        function(*arguments)
    numpy_random = sys.modules.get("numpy.random")
    if numpy_random is not None:
        # Forked copies of one generator would explore the same noise.
        numpy_random.seed()


_SPAWN_KEYS = ("name", "authkey", "log_to_stderr", "log_level", "orig_dir")


def _adopt_stdio(fds: list[int]) -> None:
    for target, fd in enumerate(fds[:2], start=1):
        os.dup2(fd, target)
        os.close(fd)
    write_whole_lines()


def write_whole_lines() -> None:
    """Have each line that is printed on stdout and stderr leave this process in one write.

    The processes of a program share its terminal, file or pipe, and the kernel keeps together the
    bytes of one write.  A full buffer, and each part of an unbuffered print, would end in mid-line.
    """
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):  # closed, or replaced by something of the user's
            if stream.fileno() in (1, 2):
                text: Any = stream
                text.reconfigure(line_buffering=True, write_through=False)
                text._CHUNK_SIZE = _LONGEST_LINE


def _tell(problem: str) -> None:
    """Tell the pool of this worker, which raises it; without a pool, write it to stderr."""
    if _task_channel is not None:
        from fiber._wire import work

        with contextlib.suppress(OSError):
            _task_channel.send(pickle.dumps((work.INIT_FAILED, problem)))
            return
    sys.stderr.write(problem)


def _exec(
    start: StartRequest, fds: list[int], progress_table: ProgressTable, agent: int, words: int
) -> None:
    """Replace this forked process by a fresh interpreter that goes on in ``spawned``."""
    again = os.memfd_create("fiber-start")
    plan = (tuple(start._replace(method="fork")), fds, progress_table.fd, agent, words)
    with os.fdopen(os.dup(again), "wb") as file:
        pickle.dump(plan, file)
    for fd in (*fds, progress_table.fd, agent, again, words):
        if fd >= 0:
            os.set_inheritable(fd, True)
    executable = os.fsdecode(start.executable or sys.executable)
    statement = f"from fiber._agent.child import spawned; spawned({again})"
    try:
        os.execv(executable, interpreter_arguments(executable, statement))
    except OSError as error:
        raise OSError(error.errno, error.strerror, executable) from None


def spawned(plan_fd: int) -> None:
    """Entry point of a child in an interpreter of its own."""
    with os.fdopen(plan_fd, "rb") as file:
        file.seek(0)
        fields, fds, progress_table, agent, words = pickle.load(file)
    for fd in (*fds, progress_table, agent, words):
        if fd >= 0:
            os.set_inheritable(fd, False)
    code = 1
    try:
        code = _run(StartRequest(*fields), fds, ProgressTable(progress_table), agent, words)
    finally:
        os._exit(code)
