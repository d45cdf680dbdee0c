"""First steps of a child: from the fork, or a fresh interpreter, to the user's Process object."""

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
from fiber._agent import last_words
from fiber._agent.last_words import ProgressTable
from fiber._agent.zygote_process import interpreter_arguments
from fiber._exceptions import add_note, advice_on_main
from fiber._hub import client as hub_client
from fiber._hub.pipelined import finish_pipes
from fiber._hub.protocol import HubAddress
from fiber._transport.channels import UnixChannel
from fiber._unconfirmed import flush_all
from fiber._wire.descriptor import Descriptor, contents, own
from fiber._worker_images import INSTALLED, missing_module

_LONGEST_LINE = 1 << 16
"""Bytes of one line that are buffered before they are written."""

_PR_SET_PDEATHSIG = 1
_PR_SET_CHILD_SUBREAPER = 36
_libc = ctypes.CDLL(None, use_errno=True)

_descriptors: list[int] = []
_task_channel: UnixChannel | None = None
_progress: memoryview | None = None
ancestors: tuple[int, ...] = ()
"""Pids of the ancestors whose end also ends this process, its parent first; empty in a program that
Fiber did not start.
"""
host = ""
"""Host that this process belongs to; empty in a program that Fiber did not start."""


class UnguardedMainError(RuntimeError):
    """Error of a main module that starts a process each time it is imported."""


class ProgramPaths(NamedTuple):
    """Paths of the program's folders and files, relative to the folder that holds them."""

    before_library: tuple[str, ...]
    """Entries of ``sys.path`` before the standard library, such as a script's folder."""
    before_installed: tuple[str, ...]
    """Entries after the standard library; here they come before all installed packages."""
    directory: str
    """Working directory."""
    main: str | None
    """File of the main module, if children import that by its path."""


class StartRequest(NamedTuple):
    """Request to a zygote to start a child, which gets it too; descriptors travel beside it."""

    name: str
    host: str
    """Name by which the master knows the host."""
    method: str
    preparation: bytes
    payload: bytes
    slot: int | None
    """Slot of a worker in the progress table; a worker's first descriptor is its task channel."""
    executable: str | None
    open_files: tuple[int, int]
    """Limits of open descriptors, soft and hard: those of the agent's process."""
    hub: HubAddress | None
    """Address of the host's hub."""
    ancestors: tuple[int, ...]
    """Pids of the ancestors whose end also ends the child: its parent, grandparent, and so on."""
    folder: str | None = None
    """Folder of the program's files, if they were sent to this host."""
    has_arguments: bool = False
    """True if the next descriptor brings the arguments of the Process."""
    payload_at: tuple[int, int] | None = None
    """Offset and size of the payload in another descriptor, if it is large."""


def lineage() -> tuple[int, ...]:
    """Return this process's pid, and those of the ancestors whose end also ends it."""
    return os.getpid(), *ancestors


def task_channel() -> UnixChannel:
    """Return the channel that brings tasks and takes results; only in a pool worker."""
    if _task_channel is None:
        raise RuntimeError("this process is not a pool worker")
    return _task_channel


def progress() -> memoryview:
    """Return shared words: number of the batch, index of the running task, whether to stop.

    Only in a pool worker.  Set the sequence number to zero before another batch's index is written,
    and to its value last.  The agent, which reads the words after a crash, must never see one
    batch's number with another's index.
    """
    if _progress is None:
        raise RuntimeError("this process is not a pool worker")
    return _progress


def take_descriptor(index: int) -> int:
    """Return a descriptor that came with the start message, for the handle that refers to it."""
    fd = _descriptors[index]
    if fd < 0:
        raise RuntimeError(f"descriptor {index} of the start message was taken twice")
    _descriptors[index] = -1
    return fd


def duplicate_descriptor(index: int) -> int:
    """Return a duplicate of a descriptor to which several handles refer.

    The descriptor itself stays open until all handles are unpickled.
    """
    return os.dup(_descriptors[index])


def die_with_parent(parent: int) -> None:
    """Have the kernel kill this process when its zygote dies."""
    _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


def go_on_without_parent() -> None:
    """Have the kernel send SIGCONT to this process when its parent dies, as it may be stopped.

    By itself, the kernel continues only process groups that were stopped before the parent's death.
    A stop that takes effect just after the death would last for ever.
    """
    _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGCONT)


def become_subreaper() -> bool:
    """Have the kernel make this process the parent of orphans that its descendants leave behind.

    Return whether the kernel does.  A seccomp profile may refuse it.
    """
    refused: int = _libc.prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    return not refused


def run(
    start: StartRequest, fds: list[int], progress_table: ProgressTable, agent: int, words: int
) -> int:
    """Run the child that ``start`` describes; return its exit code.

    ``words`` is the descriptor to which the stacks of a crash are written.
    """
    if start.method == "spawn":
        _exec(start, fds, progress_table, agent, words)
    # The zygote's imports may have registered exit functions, such as the removal of a folder.
    # Children must not run them.
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
        # Up to Python 3.12, ``_bootstrap`` has run multiprocessing's exit functions already.  Those
        # do nothing when they run again here.
        atexit._run_exitfuncs()
        try:
            flush_all()
            finish_pipes()
        finally:
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
    except BaseException as error:
        import traceback  # rarely needed, and long to import

        if advice := advice_on_main(error):
            add_note(error, advice)
        _tell(traceback.format_exc(), missing_module(error))
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
        if fd >= 0:  # no unpickled handle took it
            os.close(fd)
    _descriptors.clear()
    return process


def _payload(start: StartRequest, payload: Descriptor | None) -> bytes | memoryview:
    """Return the pickled Process."""
    if payload is None or start.payload_at is None:
        return start.payload
    offset, size = start.payload_at
    return memoryview(contents(payload.fileno()))[offset : offset + size]


def read_preparation(start: StartRequest) -> dict[str, Any]:
    """Return the preparation in ``start``, with the paths of this host."""
    data: dict[str, Any] = pickle.loads(start.preparation)
    data |= {"name": start.name, "host": start.host}
    if start.folder is not None:
        data |= places(data["program"], start.folder)
    return data


def places(paths: ProgramPaths, folder: str) -> dict[str, Any]:
    """Return the entries of a child's preparation that hold paths."""

    def here(names: tuple[str, ...]) -> list[str]:
        return [os.path.join(folder, name) for name in names]

    library, installed = _own_path(folder)
    directory = os.path.join(folder, paths.directory)
    data: dict[str, Any] = {
        "sys_path": here(paths.before_library) + library + here(paths.before_installed) + installed,
        "dir": directory,
        "orig_dir": directory,
    }
    if paths.main is not None:
        data["init_main_from_path"] = os.path.join(folder, paths.main)
    return data


def _own_path(folder: str) -> tuple[list[str], list[str]]:
    """Return this interpreter's ``sys.path`` in two parts: standard library, installed packages."""
    own = [path for path in sys.path if path and not path.startswith(folder + os.sep)]
    names = map(os.path.basename, own)
    end = next((index for index, name in enumerate(names) if name in INSTALLED), len(own))
    return own[:end], own[end:]


@contextlib.contextmanager
def inheriting() -> Iterator[None]:
    """Forbid the start of processes in this block, in which a main module without guard is run."""
    mp_process.current_process()._inheriting = True  # type: ignore[attr-defined]
    try:
        yield
    finally:
        del mp_process.current_process()._inheriting  # type: ignore[attr-defined]


def prepare_paths(data: dict[str, Any]) -> None:
    """Make modules importable as in the parent."""
    sys.path[:] = data["sys_path"]
    sys.argv[:] = data["sys_argv"]
    # The parent's working directory may be removed, or forbidden for this process.
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
        # Forked copies of one generator would yield the same numbers.
        numpy_random.seed()


_SPAWN_KEYS = ("name", "authkey", "log_to_stderr", "log_level", "orig_dir")


def _adopt_stdio(fds: list[int]) -> None:
    for target, fd in enumerate(fds[:2], start=1):
        os.dup2(fd, target)
        os.close(fd)
    write_whole_lines()


def write_whole_lines() -> None:
    """Make each line that is printed on stdout and stderr leave this process in one write.

    The processes of a program share its terminal, file or pipe, and the kernel keeps the bytes of
    one write together.  Without this, a full buffer or a part of an unbuffered print is a write
    that ends in mid-line.
    """
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):  # the user closed or replaced the stream
            if stream.fileno() in (1, 2):
                text: Any = stream
                text.reconfigure(line_buffering=True, write_through=False)
                text._CHUNK_SIZE = _LONGEST_LINE


def _tell(problem: str, missing: str = "") -> None:
    """Send ``problem`` to the pool of this worker, which raises it; else write it to stderr.

    ``missing`` is the module that could not be found, if that is the problem.
    """
    if _task_channel is not None:
        from fiber._wire import work

        with contextlib.suppress(OSError):
            _task_channel.send(pickle.dumps((work.INIT_FAILED, problem, missing)))
            return
    sys.stderr.write(problem)


def _exec(
    start: StartRequest, fds: list[int], progress_table: ProgressTable, agent: int, words: int
) -> None:
    """Replace this forked process by a fresh interpreter, which continues in ``spawned``."""
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
    """Run the child, as the entry point of a fresh interpreter."""
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
