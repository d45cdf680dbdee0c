"""``python -m fiber.launcher``: the process that runs a program in a pod for ``fiber run``.

It is process 1 of the pod.  It waits until ``fiber run`` brings the program's files, starts the
program, passes on signals and output, and ends with the program's exit status.  It listens on the
loopback of the pod, which only an account with the right to open port-forwards reaches.

It is configured by its environment:

``FIBER_LAUNCHER_COMMAND``  the command to run, as a JSON list
``FIBER_LAUNCHER_FOLDER``   the folder for the program's files
``FIBER_LAUNCHER_PORT``     the port to listen at; 0 takes a free one, and the log begins with it
``FIBER_LAUNCHER_WAIT``     seconds to wait for the program's files

``fiber run`` speaks HTTP with it:

``PUT /program``            start the program; the body is an archive of its files (tar and gzip).
                            The header ``Fiber-Layout`` has JSON: the working directory and the
                            entries of ``PYTHONPATH``, relative to the folder.  With the header
                            ``Fiber-Follows`` a reader of the output is going to come.  The answer
                            has the header ``Fiber-Failure`` if the program could not be started
``GET /output/POSITION``    the records of the output from that position on, until the end
``POST /monitor``           ask the monitors of the program's processes (``fiber._monitor``); the
                            body is the request, and the answer has the lines of them all
``POST /signal/NUMBER``     send a signal to the program, or end if it does not run yet

A record of the output has a head of a byte and four bytes: what it is, and its length.  0 says that
the launcher is alive, 1 is standard output, 2 is standard error, 3 says how many bytes were dropped
before, and 4 is the program's exit status.  A position counts the bytes of output.  A reader closes
its connection once it has the exit status; the pod may end only then.

Exit status: that of the program, 128 and the number of the signal that ended it, 127 if there is no
such command, 126 if it cannot be executed, or 125 if its files did not arrive or were refused.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import itertools
import json
import os
import select
import signal
import socketserver
import struct
import subprocess
import sys
import tempfile
import termios
import threading
import time
from collections import deque
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler
from typing import IO, Any

from fiber._agent.zygote import unpack
from fiber._monitor import client

FAILED, NOT_EXECUTABLE, NO_COMMAND = 125, 126, 127
ALIVE, STDOUT, STDERR, DROPPED, EXIT = range(5)
RECORD = struct.Struct(">BI")
NUMBER = struct.Struct(">Q")
"""Content of a record DROPPED."""
STATUS = struct.Struct(">i")
"""Content of a record EXIT."""

FOLLOWS, FAILURE = "Fiber-Follows", "Fiber-Failure"
LAYOUT = "Fiber-Layout"

LISTENS = "fiber run: listens at port "
"""Begin of the log if the port was left to the system.  The number ends the line."""

HEARTBEAT = 10.0
"""Seconds of silence after which a reader is told that the launcher is alive."""

_KEPT = 16 << 20
"""Bytes of output that are kept for readers.  A program waits for a reader that is further behind,
and the pod's log has what is dropped for the others."""

_PIECE = 64 << 10
_BATCH = 256 << 10
"""Bytes after which records are sent."""

_LONGEST_QUESTION = 1 << 16
"""Bytes of a request to a monitor."""

_PIECE_COST = 256
"""Bytes that a piece of output takes beside its contents, or a little more."""

_LINGER = 10.0
"""Seconds that a reader has to come, to come again, and to take a part of the output."""


class Output:
    """Output of the program, for readers that come and go.  Any thread."""

    def __init__(self, kept: int = _KEPT, linger: float = _LINGER) -> None:
        self._kept, self._linger = kept, linger
        self._changed = threading.Condition()
        self._pieces: deque[tuple[int, bytearray]] = deque()
        self._begin = self._end = 0
        """Positions of the oldest byte that is kept, and after the newest."""
        self._status: int | None = None
        self._positions: dict[object, int] = {}
        """Positions of the readers that take what they are given."""
        self._expected_until = 0.0
        self._answering = 0
        """Requests that are being answered."""

    def expect_reader(self) -> None:
        """Note that a reader is going to come."""
        with self._changed:
            self._expected_until = time.monotonic() + self._linger

    @contextlib.contextmanager
    def answering(self) -> Iterator[None]:
        """Keep the pod until a request is answered, which may be what ends it."""
        with self._changed:
            self._answering += 1
        try:
            yield
        finally:
            with self._changed:
                self._answering -= 1
                self._changed.notify_all()

    def add(self, kind: int, data: bytes) -> None:
        """Add output.  Waits for readers that would lose output, while they come and take some."""
        with self._changed:
            self._append(kind, data)
            self._changed.notify_all()
            while self._is_full():
                if (self._is_awaited() and self._wait_for_progress()) or self._wait_for_reader():
                    continue
                self._begin += len(self._pieces.popleft()[1])

    def _append(self, kind: int, data: bytes) -> None:
        last = self._pieces[-1] if self._pieces else None
        if last is not None and last[0] == kind and len(last[1]) + len(data) <= _PIECE:
            last[1].extend(data)
        else:
            self._pieces.append((kind, bytearray(data)))
        self._end += len(data)

    def _is_full(self) -> bool:
        size = self._end - self._begin + _PIECE_COST * len(self._pieces)
        return size > self._kept and len(self._pieces) > 1

    def _is_awaited(self) -> bool:
        """Return whether a reader has not got the oldest piece."""
        oldest = self._begin + len(self._pieces[0][1])
        return any(position < oldest for position in self._positions.values())

    def _wait_for_reader(self) -> bool:
        """Wait for an expected reader if there is none, and return whether one came."""
        left = self._expected_until - time.monotonic()
        if self._positions or left <= 0:
            return False
        return self._changed.wait_for(lambda: bool(self._positions), left)

    def _wait_for_progress(self) -> bool:
        """Wait until a reader gets on, and return whether one did; leave the slowest behind."""
        before = dict(self._positions)
        if self._changed.wait_for(lambda: self._positions != before, self._linger):
            return True
        slowest = min(before.values(), default=0)
        for reader in [each for each, position in before.items() if position == slowest]:
            del self._positions[reader]
        return False

    def end(self, status: int) -> None:
        """Note that the program has ended, and that all its output was added."""
        with self._changed:
            self._status = status
            self._changed.notify_all()

    @contextlib.contextmanager
    def reading(self, position: int, heartbeat: float = HEARTBEAT) -> Iterator[Iterator[bytes]]:
        """Yield the records from ``position`` on, which wait for more until the program has ended.

        To leave without an error means that the reader has everything.
        """
        reader = object()
        with self._changed:
            self._positions[reader] = position
            self._changed.notify_all()
        try:
            yield self._records(reader, position, heartbeat)
        except BaseException:
            self._leave(reader, self._linger)
            raise
        self._leave(reader, 0.0)

    def _leave(self, reader: object, linger: float) -> None:
        with self._changed:
            self._positions.pop(reader, None)
            self._expected_until = time.monotonic() + linger
            self._changed.notify_all()

    def _records(self, reader: object, position: int, heartbeat: float) -> Iterator[bytes]:
        while True:
            with self._changed:
                self._got(reader, position)
                came = self._wait_for_news(position, heartbeat)
                begin, status = self._begin, self._status
                found, next_position = self._next(max(position, begin))
            if not came:
                yield RECORD.pack(ALIVE, 0)
                continue
            if position < begin:
                yield RECORD.pack(DROPPED, NUMBER.size) + NUMBER.pack(begin - position)
            if found:
                yield found
            elif status is not None:
                yield RECORD.pack(EXIT, STATUS.size) + STATUS.pack(status)
                return
            position = next_position

    def _wait_for_news(self, position: int, seconds: float) -> bool:
        return self._changed.wait_for(
            lambda: self._end > position or self._status is not None, seconds
        )

    def _got(self, reader: object, position: int) -> None:
        if self._positions.get(reader) != position:
            self._positions[reader] = position
            self._changed.notify_all()

    def _next(self, position: int) -> tuple[bytes, int]:
        """Return some records from ``position`` on, and the position after them."""
        at, first = self._end, len(self._pieces)
        for _, data in reversed(self._pieces):  # a reader is near the end as a rule
            if at <= position:
                break
            first -= 1
            at -= len(data)
        found = bytearray()
        for kind, data in itertools.islice(self._pieces, first, None):
            rest = data[position - at :]
            found += RECORD.pack(kind, len(rest)) + rest
            at = position = at + len(data)
            if len(found) >= _BATCH:
                break
        return bytes(found), position

    def wait_for_readers(self) -> None:
        """Wait until the readers that are there, or are expected, have got everything."""
        with self._changed:
            while True:
                if self._positions:
                    self._wait_for_progress()
                elif self._answering:
                    self._changed.wait_for(lambda: not self._answering)
                elif (left := self._expected_until - time.monotonic()) > 0:
                    self._changed.wait(left)
                else:
                    return


class ProgramLauncher:
    """Runner of one program."""

    def __init__(self, command: list[str], folder: str, output: Output) -> None:
        self.output = output
        self.started = threading.Event()
        """Set once the program runs, or never will."""
        self.failure = ""
        """Reason why the program could not be started."""
        self.received = 0
        """Bytes of archives that have arrived."""
        self._status: int | None = None
        """Exit status, if the program was not started."""
        self._command = command
        self._folder = folder
        self._starting = threading.Lock()
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._copies: list[threading.Thread] = []
        self._ended, self._ended_in = os.pipe2(os.O_CLOEXEC)
        """Pipe whose end says that the program has ended."""

    def start(self, archive: IO[bytes], layout: dict[str, Any]) -> None:
        """Unpack the archive and start the program.

        A repeated call does nothing: the answer to the first may have been lost.
        """
        with self._starting:
            if self.started.is_set():
                return
            try:
                unpack(archive.fileno(), self._folder)
                self._begin(layout)
            except Exception as error:  # `fiber run` and the log report it
                self._fail(FAILED, f"the program's files cannot be unpacked: {_words(error)}")
            self.started.set()

    def _begin(self, layout: dict[str, Any]) -> None:
        directory = os.path.join(self._folder, layout.get("directory", ""))
        os.makedirs(directory, exist_ok=True)
        try:
            process = self._popen(directory, self._environment(layout))
        except OSError as error:
            missing = error.errno in (errno.ENOENT, errno.ENOTDIR)
            reason = "there is no such command in the image or the program's folder"
            self._fail(
                NO_COMMAND if missing else NOT_EXECUTABLE,
                f"cannot run {self._command[0]!r}: {reason if missing else _words(error)}",
            )
            return
        for kind, pipe in ((STDOUT, process.stdout), (STDERR, process.stderr)):
            copy = threading.Thread(
                target=self._copy, args=(kind, pipe), name="fiber-output-copy", daemon=True
            )
            copy.start()
            self._copies.append(copy)
        with self._lock:
            self._process = process

    def _environment(self, layout: dict[str, Any]) -> dict[str, str]:
        environment = {k: v for k, v in os.environ.items() if not k.startswith("FIBER_LAUNCHER_")}
        paths = [os.path.join(self._folder, path) for path in layout.get("path", [])]
        if before := environment.get("PYTHONPATH"):
            paths.append(before)
        if paths:
            environment["PYTHONPATH"] = os.pathsep.join(paths)
        return environment

    def _popen(self, directory: str, environment: dict[str, str]) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            self._command,
            cwd=directory,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )

    def _fail(self, status: int, reason: str) -> None:
        self.failure = reason
        self._status = status
        line = f"fiber run: {reason}\n".encode()
        self.output.add(STDERR, line)
        _log(STDERR, line)

    def _copy(self, kind: int, pipe: IO[bytes]) -> None:
        """Copy output until its end or, if other processes hold the pipe, the program's end."""
        poller = select.poll()
        poller.register(pipe.fileno(), select.POLLIN)
        poller.register(self._ended, select.POLLIN)
        left = None
        while left is None or left > 0:
            ready = {descriptor for descriptor, _ in poller.poll()}
            if left is None and self._ended in ready:
                poller.unregister(self._ended)
                left = _waiting_in(pipe)
                continue
            data = os.read(pipe.fileno(), _PIECE)
            if not data:
                return
            left = None if left is None else left - len(data)
            self.output.add(kind, data)
            _log(kind, data)

    def signal(self, number: int) -> None:
        """Send a signal to the processes of the program, as a terminal does."""
        with self._lock:
            if self._process is not None and self._process.returncode is None:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(self._process.pid, number)

    def end_by(self, number: int) -> None:
        """Pass on a signal, or end if the program does not run yet."""
        if not self.started.is_set():
            self._status = 128 + number
            self.started.set()
        self.signal(number)

    def wait(self) -> int:
        """Return the program's exit status once it has ended and its output was added."""
        status = self._status
        if self._process is not None:
            status = self._reap(self._process)
            os.close(self._ended_in)
            for copy in self._copies:
                copy.join()
        assert status is not None
        self.output.end(status)
        return status

    def _reap(self, process: subprocess.Popen[bytes]) -> int:
        """Wait for the program and, as process 1 has to, for all orphans that end before."""
        while True:
            found = os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOWAIT)
            assert found is not None
            with self._lock:  # the number must not be another process's when it gets a signal
                _, code = os.waitpid(found.si_pid, 0)
                status = os.waitstatus_to_exitcode(code)
                if found.si_pid == process.pid:
                    process.returncode = status
                    return 128 - status if status < 0 else status


def _waiting_in(pipe: IO[bytes]) -> int:
    """Return the number of bytes that can be read at once."""
    return int.from_bytes(fcntl.ioctl(pipe.fileno(), termios.FIONREAD, bytes(4)), sys.byteorder)


def _log(descriptor: int, data: bytes) -> None:
    """Write to the log of the pod."""
    with contextlib.suppress(OSError):
        left = memoryview(data)
        while left:
            left = left[os.write(descriptor, left) :]


def _words(error: BaseException) -> str:
    """Return the error's message in one line."""
    return " ".join(str(error).split()) or type(error).__name__


class _LauncherServer(socketserver.ThreadingTCPServer):
    """Server of the launcher.  It looks up no name, as ``http.server`` would."""

    daemon_threads = True
    allow_reuse_address = True
    block_on_close = False

    def __init__(self, port: int, launcher: ProgramLauncher) -> None:
        self.launcher = launcher
        super().__init__(("127.0.0.1", port), _Handler)

    def handle_error(self, request: object, client_address: object) -> None:
        """Write nothing: readers break off, and the log is the program's."""


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.0"
    server: _LauncherServer

    def do_PUT(self) -> None:
        try:
            size = int(self.headers["Content-Length"])
            layout = json.loads(self.headers.get(LAYOUT) or "{}")
        except (TypeError, ValueError):
            self.send_error(400)
            return
        with tempfile.TemporaryFile() as archive:
            self._receive(archive, size)
            with self._launcher.output.answering():
                self._launcher.start(archive, layout)
                self._answer_start(self._launcher.failure)

    def do_POST(self) -> None:
        if self.path == "/monitor":
            self._ask_monitors()
        else:
            self._send_signal()

    def _ask_monitors(self) -> None:
        try:
            request = json.loads(self.rfile.read(self._question_size()))
        except ValueError:
            self.send_error(400)
            return
        self._answer()
        for line in client.ask_all(os.environ.get("FIBER_RUNTIME_DIRECTORY"), request):
            self.wfile.write(json.dumps(line).encode() + b"\n")

    def _question_size(self) -> int:
        size = int(self.headers.get("Content-Length", "none"))
        if not 0 <= size <= _LONGEST_QUESTION:
            raise ValueError(size)
        return size

    def _send_signal(self) -> None:
        number = self._number()
        if number not in signal.valid_signals():
            self.send_error(400)
            return
        with self._launcher.output.answering():
            self._launcher.end_by(number)
            self._answer()
            self._wait_for_close()

    def do_GET(self) -> None:
        if (position := self._number()) < 0:
            self.send_error(404)
            return
        with self._launcher.output.reading(position) as records:
            self._answer()
            for record in records:
                self.wfile.write(record)
            self._wait_for_close()

    def _answer_start(self, failure: str) -> None:
        if failure or self.headers.get(FOLLOWS):
            self._launcher.output.expect_reader()
        self._answer(**({FAILURE: failure.encode("ascii", "replace").decode()} if failure else {}))
        self._wait_for_close()

    def _wait_for_close(self) -> None:
        """Wait until the client closes the connection: it has got the answer."""
        self.connection.settimeout(_LINGER)
        self.rfile.read(1)

    @property
    def _launcher(self) -> ProgramLauncher:
        return self.server.launcher

    def _number(self) -> int:
        last = self.path.rpartition("/")[2]
        return int(last) if last.isascii() and last.isdigit() else -1

    def _receive(self, file: IO[bytes], left: int) -> None:
        while left > 0:
            piece = self.rfile.read(min(left, _PIECE))
            if not piece:
                raise ConnectionResetError("the connection broke")
            file.write(piece)
            left -= len(piece)
            self._launcher.received += len(piece)
        file.flush()
        file.seek(0)

    def _answer(self, **headers: str) -> None:
        self.send_response(200)
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()

    def log_message(self, *_: object) -> None:
        """Write nothing: the log is the program's."""


def _pass_on_signals(launcher: ProgramLauncher) -> None:
    """Pass on signals to the program, on a thread.

    Python's handlers run on the main thread, between two steps: not while that waits.
    """
    received, wake = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
    os.set_blocking(received, True)
    signal.set_wakeup_fd(wake)
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda *_: None)  # the kernel must not end the launcher

    def pass_on() -> None:
        while True:
            launcher.end_by(os.read(received, 1)[0])

    threading.Thread(target=pass_on, name="fiber-signals", daemon=True).start()


def _wait_for_files(launcher: ProgramLauncher, seconds: float) -> bool:
    """Wait until the program was started; return False if nothing arrives for so long."""
    received = 0
    while not launcher.started.wait(seconds):
        if received == launcher.received:
            return False
        received = launcher.received
    return True


def main(linger: float = _LINGER) -> int:
    """Run the program; return the exit status.

    ``linger``: seconds that a reader has to come, to come again, and to take a part of the output.
    """
    try:
        command = json.loads(os.environ["FIBER_LAUNCHER_COMMAND"])
        folder = os.environ["FIBER_LAUNCHER_FOLDER"]
        port = int(os.environ["FIBER_LAUNCHER_PORT"])
        seconds = float(os.environ["FIBER_LAUNCHER_WAIT"])
    except (KeyError, ValueError) as error:
        print(f"fiber.launcher is for the pods of `fiber run`: {error}", file=sys.stderr)
        return FAILED
    launcher = ProgramLauncher(command, folder, Output(linger=linger))
    _pass_on_signals(launcher)
    try:
        server = _LauncherServer(port, launcher)
    except OSError as error:
        print(f"fiber run: cannot listen at port {port}: {_words(error)}", file=sys.stderr)
        return FAILED
    if not port:
        print(f"{LISTENS}{server.server_address[1]}", file=sys.stderr, flush=True)
    threading.Thread(target=server.serve_forever, name="fiber-serve", daemon=True).start()
    if not _wait_for_files(launcher, seconds):
        print("fiber run: the program's files did not arrive in time", file=sys.stderr)
        return FAILED
    status = launcher.wait()
    launcher.output.wait_for_readers()
    return status


if __name__ == "__main__":
    status = main()
    sys.stderr.flush()
    os._exit(status)  # a thread may be in the middle of a write
