"""``python -m fiber.launcher``: the process that runs a program in a pod for ``fiber run``.

It is process 1 of the pod.  It waits until ``fiber run`` brings the program's files, starts the
program, passes on signals and output, and ends with the program's exit status.  It listens on the
loopback of the pod, which only an account with the right to open port-forwards reaches.

It is configured by its environment:

``FIBER_LAUNCHER_COMMAND``  the command to run, as a JSON list
``FIBER_LAUNCHER_FOLDER``   the folder for the program's files
``FIBER_LAUNCHER_PORT``     the port to listen at
``FIBER_LAUNCHER_WAIT``     seconds to wait for the program's files

``fiber run`` speaks HTTP with it:

``PUT /program``            start the program; the body is an archive of its files (tar and gzip),
                            and the header ``Fiber-Layout`` has JSON: the working directory and the
                            entries of ``PYTHONPATH``, relative to the folder
``GET /output/POSITION``    the records of the output from that position on, until the end
``POST /signal/NUMBER``     send a signal to the program

A record of the output has a head of a byte and four bytes: what it is, and its length.  1 is
standard output, 2 is standard error, 3 says how many bytes were dropped before, and 4 is the
program's exit status.  A position counts the bytes of output.

Exit status: that of the program, 128 and the number of the signal that ended it, or 125 if the
program could not be started.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import struct
import subprocess
import sys
import tempfile
import threading
from collections import deque
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import IO, Any

from fiber._agent.zygote import unpack

FAILED = 125
STDOUT, STDERR, DROPPED, EXIT = 1, 2, 3, 4
RECORD = struct.Struct(">BI")

_KEPT = 16 << 20
"""Bytes of output that are kept for readers.  The pod's log has what is dropped."""

_PIECE = 64 << 10
_LINGER = 10.0
"""Seconds that the last output waits for a reader."""


class Output:
    """Output of the program, for readers that come and go.  Any thread."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._pieces: deque[tuple[int, bytes]] = deque()
        self._begin = self._end = 0
        """Positions of the oldest byte that is kept, and after the newest."""
        self._status: int | None = None
        self._was_read = False

    def add(self, kind: int, data: bytes) -> None:
        """Add output."""
        with self._changed:
            self._pieces.append((kind, data))
            self._end += len(data)
            while self._end - self._begin > _KEPT:
                self._begin += len(self._pieces.popleft()[1])
            self._changed.notify_all()

    def end(self, status: int) -> None:
        """Note that the program has ended, and that all its output was added."""
        with self._changed:
            self._status = status
            self._changed.notify_all()

    def read(self, position: int) -> Iterator[bytes]:
        """Yield the records from ``position`` on, and wait for more until the program has ended."""
        while True:
            with self._changed:
                while self._end <= position and self._status is None:
                    self._changed.wait()
                begin, pieces = self._begin, list(self._pieces)
                status = self._status
            if position < begin:
                yield RECORD.pack(DROPPED, 4) + struct.pack(">I", begin - position)
                position = begin
            at = begin
            for kind, data in pieces:
                if at + len(data) > position:
                    rest = data[max(position - at, 0) :]
                    yield RECORD.pack(kind, len(rest)) + rest
                    position = at + len(data)
                at += len(data)
            if status is not None:
                yield RECORD.pack(EXIT, 4) + struct.pack(">i", status)
                return

    def was_read(self) -> None:
        """Note that a reader has got everything."""
        with self._changed:
            self._was_read = True
            self._changed.notify_all()

    def wait_for_reader(self, seconds: float) -> None:
        """Wait until a reader has got everything."""
        with self._changed:
            self._changed.wait_for(lambda: self._was_read, seconds)


class Launcher:
    """Runner of one program."""

    def __init__(self, command: list[str], folder: str) -> None:
        self.output = Output()
        self._command = command
        self._folder = folder
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._copies: list[threading.Thread] = []
        self.started = threading.Event()
        """Set once the program runs, or cannot be started."""

    def start(self, archive: IO[bytes], layout: dict[str, Any]) -> None:
        """Unpack the archive and start the program.

        A repeated call does nothing: the answer to the first may have been lost.
        """
        with self._lock:
            if self._process is not None:
                return
            unpack(archive.fileno(), self._folder)
            self._process = self._popen(layout)
            for kind, pipe in ((STDOUT, self._process.stdout), (STDERR, self._process.stderr)):
                copy = threading.Thread(target=self._copy, args=(kind, pipe), daemon=True)
                copy.start()
                self._copies.append(copy)
            self.started.set()

    def _popen(self, layout: dict[str, Any]) -> subprocess.Popen[bytes]:
        environment = {k: v for k, v in os.environ.items() if not k.startswith("FIBER_LAUNCHER_")}
        paths = [os.path.join(self._folder, path) for path in layout.get("path", [])]
        if before := environment.get("PYTHONPATH"):
            paths.append(before)
        if paths:
            environment["PYTHONPATH"] = os.pathsep.join(paths)
        directory = os.path.join(self._folder, layout.get("directory", ""))
        os.makedirs(directory, exist_ok=True)
        return subprocess.Popen(
            self._command,
            cwd=directory,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )

    def _copy(self, kind: int, pipe: IO[bytes]) -> None:
        while data := os.read(pipe.fileno(), _PIECE):
            self.output.add(kind, data)
            with contextlib.suppress(OSError):  # the log of the pod
                os.write(kind, data)

    def signal(self, number: int) -> None:
        """Send a signal to the processes of the program, as a terminal does."""
        if self._process is not None and self._process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, number)

    def wait(self) -> int:
        """Return the program's exit status once it has ended and its output was added."""
        assert self._process is not None
        returned = self._process.wait()
        for copy in self._copies:
            copy.join(1.0)  # a process that the program left behind may hold the pipe
        status = 128 - returned if returned < 0 else returned
        self.output.end(status)
        return status


def _handler(launcher: Launcher) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.0"

        def do_PUT(self) -> None:
            layout = json.loads(self.headers.get("Fiber-Layout") or "{}")
            try:
                with tempfile.TemporaryFile() as archive:
                    self._receive(archive)
                    launcher.start(archive, layout)
            except Exception as error:  # `fiber run` reports it
                self.send_error(500, " ".join(str(error).split()) or type(error).__name__)
            else:
                self._answer()

        def do_POST(self) -> None:
            launcher.signal(int(self.path.rpartition("/")[2]))
            self._answer()

        def do_GET(self) -> None:
            self._answer()
            for record in launcher.output.read(int(self.path.rpartition("/")[2])):
                self.wfile.write(record)
            launcher.output.was_read()

        def _receive(self, file: IO[bytes]) -> None:
            left = int(self.headers["Content-Length"])
            while left:
                piece = self.rfile.read(min(left, _PIECE))
                if not piece:
                    raise ConnectionResetError("the connection broke")
                file.write(piece)
                left -= len(piece)
            file.seek(0)

        def _answer(self) -> None:
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            """Write nothing: the log is the program's."""

    return Handler


def main() -> int:
    """Run the program; return the exit status."""
    launcher = Launcher(
        json.loads(os.environ["FIBER_LAUNCHER_COMMAND"]), os.environ["FIBER_LAUNCHER_FOLDER"]
    )
    server = ThreadingHTTPServer(
        ("127.0.0.1", int(os.environ["FIBER_LAUNCHER_PORT"])), _handler(launcher)
    )
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, daemon=True).start()
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda received, _: launcher.signal(received))
    if not launcher.started.wait(float(os.environ["FIBER_LAUNCHER_WAIT"])):
        print("fiber run: the program's files did not arrive in time", file=sys.stderr)
        return FAILED
    status = launcher.wait()
    launcher.output.wait_for_reader(_LINGER)
    return status


if __name__ == "__main__":
    sys.exit(main())
