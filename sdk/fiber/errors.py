"""Errors that Fiber raises, and those that it shares with multiprocessing.

    Exception
    ├── ProcessError              multiprocessing's own class, as are the next three
    │   ├── AuthenticationError   credentials that the other side refuses
    │   ├── BufferTooShort        Connection.recv_bytes_into() got more than fits
    │   ├── TimeoutError          a result or a task that took too long
    │   └── FiberError            everything below is Fiber's
    │       ├── AdoptionError     a module that fiber.adopt() cannot rebind
    │       ├── AgentLost         an agent that is out of reach
    │       ├── ConfigError       a key or value that is wrong (also ValueError)
    │       ├── ConnectionClosed  the other end of a link is gone (also EOFError)
    │       ├── FiberPoolError    a FiberPool on Kubernetes that cannot serve
    │       ├── FileTooLarge      shared memory above the limit of file sizes (also OSError)
    │       ├── LinkError         no link between program and agent, a port in use for instance
    │       ├── MemberLost        a process of a ring that has ended
    │       ├── ProgramTooLarge   the program's folder is too large to be sent to other hosts
    │       ├── StartError        a process that does not start, an initializer that fails
    │       ├── TooManyOpenFiles  the limit of file descriptors is reached (also OSError)
    │       ├── UnpicklableError  an object that cannot travel (also PicklingError, TypeError)
    │       ├── VersionMismatch   two sides that differ in a version
    │       └── WorkerDied        a task whose worker died at each try
    └── MaybeEncodingError        multiprocessing.pool's: a result that does not pickle

Each message says what happened, why, and what to do. Errors cross processes: every class
here pickles with all its attributes. Subclasses of FiberError do, too, with any signature of
`__init__`.
"""

from __future__ import annotations

import errno
import pickle
import resource
import signal
from collections.abc import Mapping, Sequence
from multiprocessing import AuthenticationError, BufferTooShort, ProcessError, TimeoutError
from typing import TYPE_CHECKING, Any

__all__ = [
    "AdoptionError",
    "AgentLost",
    "AuthenticationError",
    "BufferTooShort",
    "ConfigError",
    "ConnectionClosed",
    "FiberError",
    "FiberPoolError",
    "FileTooLarge",
    "LinkError",
    "MaybeEncodingError",
    "MemberLost",
    "ProcessError",
    "ProgramTooLarge",
    "StartError",
    "TimeoutError",
    "TooManyOpenFiles",
    "UnpicklableError",
    "VersionMismatch",
    "WorkerDied",
]


MaybeEncodingError: type[Exception]


if not TYPE_CHECKING:  # a type checker would accept any name

    def __getattr__(name: str) -> object:
        # multiprocessing.pool is most of the import time that this module would have.
        if name == "MaybeEncodingError":
            from multiprocessing import pool

            return vars(pool)[name]
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


class FiberError(ProcessError):
    """Base of Fiber's errors.

    When: never itself. `except fiber.FiberError` catches all of them.

    What to do: read the message. It ends with what to do.
    """

    def __reduce__(self) -> tuple[Any, ...]:
        # BaseException would call type(self)(*args). That fails for an __init__ that takes more
        # than the message, and then the pool that sends the error fails, too.
        return _rebuild, (type(self), self.args), self.__dict__ or None


def _rebuild(kind: type[FiberError], args: tuple[Any, ...]) -> FiberError:
    error = kind.__new__(kind, *args)
    # The builtin's initializer after FiberError: OSError fills errno and strerror there.
    super(FiberError, error).__init__(*args)
    return error


class ConfigError(FiberError, ValueError):
    """A key that does not exist or a value that does not fit; names the key and its source.

    When: `fiber.init()`, or the first process, pool, pipe or queue, reads the configuration.

    What to do: correct the key in the source that the message names.
    """


class AdoptionError(FiberError):
    """`fiber.adopt()` cannot rebind a module, and has left it unchanged; says why.

    When: the import of the module fails, it has no name of multiprocessing, or it keeps objects
    that cannot be rebound.

    What to do: name the module that imports multiprocessing. Replace the objects that the message
    names before the call, or leave the module on multiprocessing.
    """


class AgentLost(FiberError):
    """The agent of a host does not answer; the processes that it runs are lost.

    When: its pod or host is gone, or the network to it is cut for longer than `lost_after`.

    What to do: look at the agent's last output, and whether the host can be reached. Tasks of
    pools run elsewhere by themselves.
    """

    def __init__(self, agent: str, host: str, reason: str) -> None:
        super().__init__(
            f"lost agent {agent!r} on host {host!r}: {reason}. Its processes count as dead. "
            "Look at the agent's last output and whether the host can be reached."
        )
        self.agent = agent
        self.host = host
        self.reason = reason


class ConnectionClosed(EOFError, FiberError):
    """The other end of a link was closed, or its last holder died.

    It is an EOFError, as in multiprocessing. In addition `peer` names the holder of the other
    end, and `reason` says how its process ended, where Fiber knows.

    When: `recv()`, `send()`, or a call of a manager's proxy, after the other process has ended.

    What to do: if the other side ended as planned, catch it as the end of the messages. Otherwise
    look for the cause in `reason`, and start that process again.
    """

    def __init__(self, peer: str | None = None, reason: str | None = None) -> None:
        message = "the other end of the connection is closed"
        if peer or reason:
            message += f": {peer or 'its process'} is gone"
        if reason:
            message += f" ({reason})"
        super().__init__(message)
        self.peer = peer
        self.reason = reason


class FiberPoolError(FiberError):
    """A FiberPool that cannot be made, or whose pods cannot run.

    `reason` is one word: the problem in the pool's status (`ImagePullError`), or Kubernetes'
    reason for a call that it refuses (`Forbidden`).

    When: on Kubernetes, at the first process or pool, or in a waiting call.

    What to do: follow the message. `fiber doctor` looks at each step up to a worker, and
    `kubectl describe fiberpool NAME` shows the pool's problems and events.
    """

    def __init__(self, message: str, *, pool: str, namespace: str, reason: str) -> None:
        super().__init__(message)
        self.pool = pool
        self.namespace = namespace
        self.reason = reason


class FileTooLarge(FiberError, OSError):
    """Shared memory would exceed the limit of file sizes (errno EFBIG); says the limit.

    When: a large message, or an array, in a process with `ulimit -f`.

    What to do: raise that limit, or send less at a time.
    """

    def __init__(self, doing: str) -> None:
        soft, _ = resource.getrlimit(resource.RLIMIT_FSIZE)
        super().__init__(
            errno.EFBIG,
            f"file too large while {doing}: large messages travel in shared memory, which counts "
            f"as a file, and this process may write files of {soft} bytes. Raise the limit "
            "with `ulimit -f` in the shell that starts the program, LimitFSIZE= in its systemd "
            "unit, or resource.setrlimit() in the program; or send less at a time",
        )
        self.doing = doing
        self.limit = soft


class LinkError(FiberError):
    """A link between a master and an agent cannot be made, or the other side refused it.

    When: `listen_port` is in use, `listen_host` is no address of this machine, or something else
    than Fiber answers at the other end.

    What to do: choose another port or address, or leave out the key: Fiber finds both.
    """


class MemberLost(FiberError):
    """A member of a ring has ended; `rank` is its number, `how` says how it ended.

    When: the other members send to it, receive from it, or wait for it.

    What to do: remove the cause that `how` names, and run the ring again from saved state.
    """

    def __init__(self, rank: int, how: str) -> None:
        super().__init__(
            f"member {rank} of the ring is lost: {how}. It sends and receives no more messages. "
            "Run the ring again, from saved state."
        )
        self.rank = rank
        self.how = how


class ProgramTooLarge(FiberError):
    """The program's files are too large to be sent to other hosts.

    `folder` is the program's, `largest` are its largest parts: paths and sizes, as text.

    When: the first process on another host.

    What to do: name files that workers do not need in `.fiberignore`. Data that they need belongs
    into their image or on a volume.
    """

    def __init__(self, folder: str, size: str, limit: str, largest: Mapping[str, str]) -> None:
        lines = [f"{size:>12}  {in_one_line(path)}" for path, size in largest.items()]
        super().__init__(
            f"the program in {folder!r} cannot be sent to its workers: it has {size}, and at most "
            f"{limit} are sent.\n{block('Its largest parts:', lines)}\n"
            f"Name files that workers do not need in {folder}/.fiberignore, one line each, as in "
            ".gitignore, or move them out of the folder. Put data that workers need into their "
            "image or on a volume."
        )
        self.folder = folder
        self.largest = dict(largest)


class StartError(FiberError):
    """A process cannot start, or its initializer fails.

    `cause` is the output or traceback of that process, as text: this process may be unable to
    import the class of the exception.

    When: `Process.start()`, or a call of a pool whose workers cannot start: an initializer raises,
    a module is missing, memory or processes run out.

    What to do: correct what `cause` shows. In a pod, a missing module belongs into the image.
    """

    def __init__(self, who: str, reason: str, cause: str = "", attempts: int = 1) -> None:
        tries = f" after {attempts} attempts" if attempts > 1 else ""
        message = f"{who} did not start{tries}: {reason}"
        if cause:
            message += f"\n{block('Its output:', cause.splitlines())}"
        super().__init__(message)
        self.who = who
        self.reason = reason
        self.cause = cause
        self.attempts = attempts


class TooManyOpenFiles(FiberError, OSError):
    """No file descriptor is left (errno EMFILE); says the limit and how to raise it.

    When: too many open files: processes, pipes, queues and files need more descriptors than
    `ulimit -n` allows.

    What to do: raise that limit, use fewer processes, or close what is not needed.
    """

    def __init__(self, doing: str) -> None:
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        ceiling = "no hard limit" if hard == resource.RLIM_INFINITY else f"the hard limit is {hard}"
        super().__init__(
            errno.EMFILE,
            f"too many open files while {doing}: this process may hold {soft} ({ceiling}). "
            "Raise it with `ulimit -n` in the shell that starts the program, LimitNOFILE= in "
            "its systemd unit, or resource.setrlimit() in the program; or use fewer processes",
        )
        self.doing = doing
        self.limit = soft
        self.hard_limit = hard


class UnpicklableError(FiberError, pickle.PicklingError, TypeError):
    """An object cannot be sent to another process.

    `what` is its role ("argument 2 of task f"), `path` the path from there to the culprit
    ("['options'].lock", empty when unknown), `reason` the pickler's text.

    When: an argument of a task or process, or an item of a queue, cannot be pickled: it holds a
    lock of `threading`, an open file, a socket, a generator.

    What to do: send the data that the object is made from, and build it in the other process. Or
    give its class a `__reduce__` method.
    """

    def __init__(self, what: str, reason: str, path: str = "") -> None:
        at = f" (at {path})" if path else ""
        super().__init__(
            f"{what} cannot be pickled{at}: {reason}. Objects travel to other processes as "
            "pickles. Pass the data that it is made from and build it there, or give its class a "
            "__reduce__ method."
        )
        self.what = what
        self.reason = reason
        self.path = path


class VersionMismatch(FiberError):
    """The two sides of a link differ in a version that must be equal.

    `what` says which one: "Fiber protocol" or "Python", for instance.

    When: there is a version mismatch. The image of workers has another fiberpool or Python than the
    program.

    What to do: rebuild the image with the program's versions: `fiber image build`.
    """

    def __init__(self, what: str, *, ours: str, theirs: str, peer: str) -> None:
        super().__init__(
            f"{what} version mismatch: {peer} has {theirs}, this process has {ours}. "
            "Install the same fiberpool and Python on both sides; for workers in containers, "
            "rebuild their image."
        )
        self.what = what
        self.ours = ours
        self.theirs = theirs
        self.peer = peer


class WorkerDied(FiberError):
    """The worker died while it ran a task, and no attempt is left.

    The attributes describe the last attempt. `task` and `worker` are names. `exitcode` follows
    multiprocessing (negative: the signal; None: unknown). `log` holds the last lines that the
    worker wrote, `stack` the Python stacks of its threads if native code crashed. `attempts`
    counts the runs of the task in which its worker died, `disruptions` those that the cluster
    ended: by a drain, an eviction, a preemption, a lost node. On Kubernetes `pod` and `node`
    name the worker's pod and its node; elsewhere they are None. If the pod has ended, `reason`
    begins with Kubernetes' word for it ("OOMKilled: ...").

    When: a task's worker died in each of its 1 + `retries` runs, or the cluster ended more than
    `disruptions` of them.

    What to do: read the message. Its end depends on how the worker ended.
    """

    def __init__(
        self,
        *,
        task: str,
        worker: str,
        host: str,
        pid: int | None,
        exitcode: int | None,
        reason: str,
        log: Sequence[str] = (),
        stack: str = "",
        attempts: int = 1,
        disruptions: int = 0,
        pod: str | None = None,
        node: str | None = None,
    ) -> None:
        self.task = task
        self.worker = worker
        self.host = host
        self.pid = pid
        self.exitcode = exitcode
        self.reason = reason
        self.log = tuple(log)
        self.stack = stack
        self.attempts = attempts
        self.disruptions = disruptions
        self.pod = pod
        self.node = node
        super().__init__(self._message())

    def _message(self) -> str:
        lines = [
            f"worker {self.worker!r} died while it ran {self.task}",
            f"Why: {self.reason} ({self._place()}).",
        ]
        if self.disruptions:
            lines.append(
                f"The task was tried {_times(self.attempts + self.disruptions)}: its worker died "
                f"{_times(self.attempts)}, and the cluster ended it {_times(self.disruptions)}."
            )
        elif self.attempts > 1:
            lines.append(f"The task was tried {self.attempts} times; each time its worker died.")
        lines.append(f"What to do: {_advice(self.exitcode, self.reason, self.stack)}")
        if self.stack:
            lines.append(block("Where it was:", self.stack.splitlines()))
        if self.log:
            lines.append(block("Its last output:", self.log))
        return "\n".join(lines)

    def _place(self) -> str:
        place = f"on host {self.host!r}"
        if self.pod:
            place = f"in pod {self.pod!r}" + (f" on node {self.node!r}" if self.node else "")
        return place + ("" if self.pid is None else f", pid {self.pid}")


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


_CRASHES = frozenset({signal.SIGSEGV, signal.SIGBUS, signal.SIGILL, signal.SIGFPE, signal.SIGABRT})


_ADVICE_BY_WORD = {
    "Deleted": "find out who deletes the pods. If you cannot prevent it, make tasks shorter, or "
    "allow more disruptions (disruptions=).",
    "Drained": "its host ended before the task did. Make tasks shorter, or allow more "
    "disruptions (disruptions=); on Kubernetes a pod may have a longer "
    "terminationGracePeriodSeconds.",
    "Evicted": "the pod used more than it requested and its node ran short, or the node is "
    "drained. Request what a task needs with @fiber.meta(memory=, cpu=), or allow more "
    "disruptions (disruptions=).",
    "NodeLost": "look at the node; if nodes come and go, allow more disruptions (disruptions=).",
    "OOMKilled": "request more memory for each process with @fiber.meta(memory=), or make tasks "
    "that use less.",
    "Preempted": "pods of a higher priority took its place. Give workers a priorityClassName in "
    "the template of fiber.init(), make tasks shorter, or allow more disruptions "
    "(disruptions=).",
    "WrongAnswer": "only Fiber may write to the channel of a worker. Look for code in the task or "
    "its libraries that writes to file descriptors which it did not open.",
}
"""Advice by the first word of the reason, which is Kubernetes' or Fiber's."""


def _advice(exitcode: int | None, reason: str, stack: str) -> str:
    by_word = _ADVICE_BY_WORD.get(reason.partition(":")[0])
    if by_word:
        return by_word
    if exitcode is None:
        return "look at the host and its agent; how the worker itself ended is not known."
    if exitcode == -signal.SIGKILL:
        return (
            "a SIGKILL mostly comes from the kernel, out of memory (see `dmesg`). "
            "Use fewer workers or smaller tasks, or request more with @fiber.meta(memory=)."
        )
    if -exitcode in _CRASHES:
        crashed = "native code crashed: an extension module or a library under it. "
        if stack:
            return f"{crashed}The first line below that is not in Python's library called it."
        return f"{crashed}Run with PYTHONFAULTHANDLER=1 to see the Python line that called it."
    if exitcode < 0:
        return "find out who sends this signal to the program's processes."
    ended_itself = (
        "the task ended its process: by os._exit(), or by native code. "
        "Let it return, or raise an exception, instead."
    )
    if exitcode == 1:  # also Python's, for an exception before the first task
        return (
            "if its last output shows an error, correct that; a module that is missing in a pod "
            f"belongs in its image. Otherwise {ended_itself}"
        )
    return ended_itself


def in_one_line(path: str) -> str:
    """Return a path for messages: quoted if it has line breaks or bytes that are no text."""
    return path if path.isprintable() else repr(path)


def block(title: str, lines: Sequence[str]) -> str:
    """Return quoted lines as a part of a message."""
    return "\n".join([title, *(f"  | {line}" for line in lines)])
