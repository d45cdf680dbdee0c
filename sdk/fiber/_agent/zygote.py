"""The zygote: the process from which all children of an agent are forked.

The zygote opens no nng socket, starts no thread and runs no task, so that forking it is safe.  It
imports once what its children need, so that forking is cheap.  As their parent it reaps the
children and sends them signals: no other process can get a pid that only the zygote can reap.  The
zygote and its children end when the agent's process ends.

Packets from the agent:

* ``(SETUP, ancestors, imports, cleanup directory, program's folder)``: first and once, with the
  descriptors of the progress table and, if there is a folder, of the archive to unpack there
* ``(START, child, start request)``
* ``(DESCRIPTORS, child)``: more descriptors for the START of that child, which follows
* ``(SIGNAL, child, signum)``
* ``(QUIT,)``

Packets to the agent:

* ``(STARTED, child, pid)``
* ``(FAILED, child, text)``; ``child`` is None if the request was lost: then it is about the first
  child that is not answered yet
* ``(STACK, child, text)``: the Python stacks of a child that got SHOW (``last_words.py``)
* ``(EXITED, child, exit code)``, and the Python stacks if the child has written them
* ``(FORK_UNSAFE, child, imports)``: this zygote's imports made forking unsafe.  The agent starts
  that child in a zygote that imports ``imports`` alone.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import resource
import select
import signal
import socket
import sys
import time
import warnings
from collections.abc import Iterable
from typing import IO, TYPE_CHECKING, Any, NoReturn

from fiber._agent import child as child_module
from fiber._agent import last_words
from fiber._agent.child import StartRequest
from fiber._agent.last_words import ProgressTable
from fiber._agent.preload import Imports, Unfit, preload
from fiber._wire import packet
from fiber._wire.descriptor import contents
from fiber.errors import TooManyOpenFiles

if TYPE_CHECKING:
    import tarfile

SETUP, START, SIGNAL, DESCRIPTORS, QUIT = range(5)
STARTED, FAILED, EXITED, FORK_UNSAFE, STACK = range(5)

_SHUTDOWN_SIGNALS = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}

GRACE = 0.75
"""Seconds after the death of the agent's process in which children may end by themselves."""


class Zygote:
    """Loop over descriptors: the agent's requests, deaths of children, deaths of ancestors.

    ``ancestors``: pidfds of the agent's process, which comes first, and of its ancestors.
    ``imports``: modules to import before the first fork; None for the program's main module and
    the modules that the first child names.
    """

    def __init__(
        self,
        control: socket.socket,
        progress_table: ProgressTable,
        ancestors: list[int],
        *,
        imports: Imports | None,
        program: tuple[int, str] | None = None,
    ) -> None:
        self._program = program
        """Archive to unpack before the first child, and its folder; None once that is done."""
        self._control = control
        self._progress_table = progress_table
        self._ancestors = ancestors
        self._imports = imports
        self._is_to_import = imports is None or bool(imports.modules)
        self._unfit: Unfit | None = None
        self._pid = os.getpid()
        self._pids: dict[int, int] = {}  # child -> pid
        self._children: dict[int, int] = {}  # pid -> child
        self._words: dict[int, int] = {}  # pid -> file for the stacks of a crash
        self._overdue: dict[int, float] = {}  # pid -> time of its SIGKILL, if it is still alive
        self._requests: dict[int, last_words.StackRequest] = {}  # pid -> request for its stacks
        self._descriptors: tuple[int, list[int]] = (0, [])  # child, descriptors before its START
        self._sigchld, self._sigchld_in = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
        self._poller = select.poll()
        for fd in (control.fileno(), self._sigchld, *ancestors):
            self._poller.register(fd, select.POLLIN)

    def run(self) -> bool:
        """Serve until QUIT or the end of an ancestor, then kill the children.

        Return whether QUIT came.
        """
        self._listen_to_signals()
        while True:
            ready = {fd for fd, _ in self._poller.poll(self._patience())}
            if self._sigchld in ready:
                self._reap()
            self._kill_overdue()
            self._answer_requests()
            try:
                if self._control.fileno() in ready and not self._serve():
                    self._kill_children(0)
                    return True
            except (EOFError, ConnectionError):
                # A dying process closes its descriptors a moment before it counts as dead.
                ready.update(self._ancestors)
            # The zygotes of all generations below a dead ancestor begin GRACE at the same moment.
            if not ready.isdisjoint(self._ancestors):
                self._kill_children(GRACE)
                return False

    def _listen_to_signals(self) -> None:
        # A thread of the program that blocks signals passes its mask on to new processes.
        signal.pthread_sigmask(signal.SIG_SETMASK, ())
        # Ctrl-C in a terminal is for the master alone.  SIGTERM here would orphan the children.
        for signum in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(signum, signal.SIG_IGN)
        # A terminal with `stty tostop` stops background process groups that print.
        signal.signal(signal.SIGTTOU, signal.SIG_IGN)
        # A new child ignores TELL until ``_run_child`` has reset its signal handlers.  It ignores
        # SHOW and SHOW_NATIVE until it handles them.
        signal.signal(last_words.TELL, signal.SIG_IGN)
        signal.signal(last_words.SHOW, signal.SIG_IGN)
        signal.signal(last_words.SHOW_NATIVE, signal.SIG_IGN)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        signal.set_wakeup_fd(self._sigchld_in, warn_on_full_buffer=False)

    def _serve(self) -> bool:
        try:
            message = packet.receive(self._control, descriptors=True)
        except TooManyOpenFiles as error:
            self._reply(FAILED, None, str(error))
            return True
        fds, message.fds = message.fds, []
        request: tuple[Any, ...] = packet.loads(message)
        if request[0] == DESCRIPTORS:
            self._descriptors = (request[1], [*self._early_descriptors(request[1]), *fds])
        elif request[0] == START:
            fds = [*self._early_descriptors(request[1]), *fds]
            self._start(request[1], StartRequest(*request[2]), fds)
        elif request[0] == SIGNAL:
            self._signal(request[1], request[2])
        return bool(request[0] != QUIT)

    def _early_descriptors(self, child: int) -> list[int]:
        """Return the descriptors that came before the START; close those of another child."""
        (owner, fds), self._descriptors = self._descriptors, (0, [])
        if owner == child:
            return fds
        close_all(fds)
        return []

    def _start(self, child: int, start: StartRequest, fds: list[int]) -> None:
        try:
            self._unpack_program()
        except Exception as error:  # the next child may find more room
            self._reply(FAILED, child, f"the program's files could not be unpacked: {error}")
            close_all(fds)
            return
        if start.method == "fork" and not self._is_fork_safe(start):
            self._reply(FORK_UNSAFE, child, self._unfit and self._unfit.safe)
            close_all(fds)
            return
        # The child ignores what the zygote ignores until it resets the handlers.  Blocked, a signal
        # that comes right after the fork waits instead of being lost.
        signal.pthread_sigmask(signal.SIG_BLOCK, _SHUTDOWN_SIGNALS)
        words = last_words.make_file()
        try:
            pid = os.fork()
            if pid == 0:
                self._run_child(start, fds, words)
        except OSError as error:
            if words >= 0:
                os.close(words)
            self._reply(FAILED, child, f"the system refused a new process: {error.strerror}")
            return
        finally:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, _SHUTDOWN_SIGNALS)
            close_all(fds)
        self._pids[child] = pid
        self._children[pid] = child
        if words >= 0:
            self._words[pid] = words
        self._reply(STARTED, child, pid)

    def _unpack_program(self) -> None:
        if self._program is not None:
            archive, folder = self._program
            unpack(archive, folder)
            self._program = None
            os.close(archive)

    def _is_fork_safe(self, start: StartRequest) -> bool:
        """Do the imports at the first call; return whether forking this process is safe."""
        if self._is_to_import:
            self._is_to_import = False
            self._unfit = preload(child_module.read_preparation(start), self._imports)
            self._listen_to_signals()  # an import may have changed the handlers
            # Once for a program: zygotes that its children start would only repeat it.
            is_first = self._imports is None and len(self._ancestors) == 1
            if is_first and self._unfit is not None and self._unfit.reason:
                print(f"fiber: {self._unfit.reason}", file=sys.stderr, flush=True)
        return self._unfit is None

    def _run_child(self, start: StartRequest, fds: list[int], words: int) -> NoReturn:
        """Close the zygote's descriptors in the forked process, and run the child."""
        code = 1
        try:
            signal.set_wakeup_fd(-1)
            for signum in (signal.SIGCHLD, signal.SIGTERM, signal.SIGHUP):
                signal.signal(signum, signal.SIG_DFL)
            signal.signal(signal.SIGINT, signal.default_int_handler)
            signal.pthread_sigmask(signal.SIG_UNBLOCK, _SHUTDOWN_SIGNALS)
            signal.signal(last_words.TELL, signal.SIG_DFL)
            self._control.close()
            os.close(self._sigchld)
            os.close(self._sigchld_in)
            close_all([*self._ancestors[1:], *self._words.values()])
            child_module.die_with_parent(self._pid)
            resource.setrlimit(resource.RLIMIT_NOFILE, start.open_files)
            code = child_module.run(start, fds, self._progress_table, self._ancestors[0], words)
        except BaseException:
            # Errors of the user's code are handled before.  This one is the system's or Fiber's.
            import traceback  # rarely needed, and long to import

            traceback.print_exc()
        finally:
            os._exit(code)

    def _signal(self, child: int, signum: int) -> None:
        pid = self._pids.get(child)
        if signum == last_words.SHOW:
            self._request_stack(child, pid)
            return
        if pid is None:
            return
        if signum == last_words.TELL:
            self._tell(pid)
        _kill(pid, signum)

    def _tell(self, pid: int) -> None:
        """Prepare the death of a child by TELL."""
        if pid not in self._overdue and pid in self._words:
            self._requests.pop(pid, None)  # the answer is the child's end
            last_words.empty(self._words[pid])
        self._overdue[pid] = time.monotonic() + last_words.GRACE

    def _request_stack(self, child: int, pid: int | None) -> None:
        """Ask a child for its stacks, unless it was asked before or is about to die."""
        words = -1 if pid is None else self._words.get(pid, -1)
        if pid is None or pid in self._overdue:
            self._reply(STACK, child, "No stack: it has not started, or it is about to end.")
        elif words < 0:
            self._reply(STACK, child, "No stack: the system had no room for its file.")
        elif pid not in self._requests:
            self._requests[pid] = last_words.StackRequest(pid, words, time.monotonic())

    def _answer_requests(self) -> None:
        now = time.monotonic()
        for pid, request in list(self._requests.items()):
            if request.due <= now and (text := request.look(now)) is not None:
                del self._requests[pid]
                self._reply(STACK, self._children[pid], text)

    def _patience(self) -> float | None:
        """Return the milliseconds until a child is to be killed, or a request to be looked at."""
        due = [*self._overdue.values(), *(request.due for request in self._requests.values())]
        return max(0.0, min(due) - time.monotonic()) * 1000 if due else None

    def _kill_overdue(self) -> None:
        now = time.monotonic()
        for pid, due in list(self._overdue.items()):
            if due <= now:
                self._overdue[pid] = now + last_words.GRACE
                _kill(pid, signal.SIGKILL)

    def _reap(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.read(self._sigchld, 4096)
        while True:
            try:
                pid, status = os.waitpid(-1, os.WNOHANG)
            except ChildProcessError:
                return
            if not pid:
                return
            self._buried(pid, status)

    def _buried(self, pid: int, status: int) -> None:
        child = self._children.pop(pid, None)
        if child is None:
            return
        self._pids.pop(child, None)
        self._requests.pop(pid, None)
        exitcode = os.waitstatus_to_exitcode(status)
        told = self._overdue.pop(pid, None) is not None
        if told and exitcode == -last_words.TELL:
            exitcode = -signal.SIGKILL  # TELL is how the agent begins to kill it
        words = self._words.pop(pid, -1)
        stack = last_words.read(words, told=told) if words >= 0 else ""
        self._reply(EXITED, child, exitcode, *([stack] if stack else []))

    def _reply(self, *answer: Any) -> None:
        # The loop sees the end of the agent on its pidfd.
        with contextlib.suppress(OSError):
            packet.send(self._control, pickle.dumps(answer))

    def _kill_children(self, grace: float) -> None:
        deadline = time.monotonic() + grace
        while self._pids and (left := deadline - time.monotonic()) > 0:
            waiter = select.poll()
            waiter.register(self._sigchld, select.POLLIN)
            waiter.poll(left * 1000)
            self._reap()
        for pid in self._children:
            _kill(pid, signal.SIGKILL)
        while self._children:
            self._buried(*os.waitpid(-1, 0))


def _kill(pid: int, signum: int) -> None:
    # The kernel refuses signals to a child that now runs a set-user-ID program.
    with contextlib.suppress(PermissionError):
        os.kill(pid, signum)


def close_all(fds: Iterable[int]) -> None:
    """Close descriptors."""
    for fd in fds:
        os.close(fd)


def unpack(archive: int, folder: str) -> None:
    """Unpack the file ``archive`` to a new ``folder``: folders, plain files, links within it.

    ValueError: the archive has something else.  After an error there is no folder.
    """
    import shutil
    import tarfile  # needed only if a program was sent

    os.mkdir(folder, 0o700)
    try:
        file: Any = contents(archive)
        with tarfile.open(fileobj=file, mode="r|gz") as members:
            _extract(members, folder)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def _extract(members: tarfile.TarFile, folder: str) -> None:
    links = []
    for member in members:
        path = os.path.join(folder, _within(member.name, member.name))
        if member.isdir():
            os.mkdir(path, 0o700)
        elif member.isreg():
            _write(path, members.extractfile(member), executable=bool(member.mode & 0o100))
        elif member.issym():
            _within(os.path.join(os.path.dirname(member.name), member.linkname), member.name)
            links.append((member.linkname, path))
        else:
            raise ValueError(f"{member.name!r} is neither a file nor a folder nor a link")
    # Links come last, so that no file is written through a link.
    for target, path in links:
        os.symlink(target, path)


def _within(path: str, name: str) -> str:
    normal = os.path.normpath(path)
    if os.path.isabs(normal) or normal.split(os.sep)[0] in (os.pardir, os.curdir):
        raise ValueError(f"{name!r} leads out of the folder")
    return normal


def _write(path: str, source: IO[bytes] | None, *, executable: bool) -> None:
    import shutil

    assert source is not None
    with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        shutil.copyfileobj(source, file)
        if executable:
            os.fchmod(file.fileno(), 0o700)


def main(control: int, agent: int) -> None:
    """Run the zygote's process; ``agent`` is the pid of the process that started it."""
    # Python and JAX warn at a fork beside threads.  The zygote forks after a trial (preload.py).
    warnings.filterwarnings("ignore", message=".*multi-threaded.*fork", category=DeprecationWarning)
    warnings.filterwarnings(
        "ignore", r"os\.fork\(\) was called", RuntimeWarning, r"fiber\._agent\."
    )
    os.set_inheritable(control, False)
    child_module.go_on_without_parent()
    # A program that raised its limit after it started the zygote may send more descriptors.
    most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    if agent == 1:
        # In a container orphans would stay unreaped: process 1, the agent, waits for its own only.
        child_module.become_subreaper()
    # Every child needs this.  Meanwhile the program, which starts zygotes early, does its imports.
    import fiber._agent.worker  # noqa: F401

    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET, fileno=control) as sock:
        try:
            message = packet.receive(sock, descriptors=True)
        except (EOFError, ConnectionError):
            return  # the program needed no zygote
        fds, message.fds = message.fds, []
        _, *setup = packet.loads(message)
        _run_zygote(sock, fds, *setup)


def _run_zygote(
    sock: socket.socket,
    fds: list[int],
    ancestors: tuple[int, ...],
    imports: Imports | None,
    cleanup_directory: str | None,
    folder: str | None,
) -> None:
    """Run a zygote as SETUP asks, and clean up after it.

    ``ancestors``: pids, the agent's first.  ``cleanup_directory``: directory that the zygote
    removes if an ancestor dies.  ``folder``: folder for the program's files, which the zygote makes
    and removes.
    """
    progress_table, *archive = fds
    watched = _pidfds(ancestors)
    ended_by_agent = False
    if watched:
        ended_by_agent = Zygote(
            sock,
            ProgressTable(progress_table),
            watched,
            imports=imports,
            program=None if folder is None else (archive[0], folder),
        ).run()
    removed = folder if ended_by_agent else cleanup_directory
    if removed is not None:
        # Rarely needed; an import above would delay the first child.
        from fiber._hub.directory import remove_directory

        remove_directory(removed)


def _pidfds(ancestors: tuple[int, ...]) -> list[int]:
    """Return the pidfds of ``ancestors``; an empty list if one of them is dead."""
    try:
        watched = [os.pidfd_open(pid) for pid in ancestors]
    except ProcessLookupError:
        return []
    return watched if os.getppid() == ancestors[0] else []  # the pid may be reused
