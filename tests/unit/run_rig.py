"""The command ``fiber`` as a process, against an API server whose pods run real launchers."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from fakes.program_nodes import ProgramNodes
from fakes.served import Served, served
from fakes.store import Body
from fiber_api import names
from patience import PATIENCE
from unit.kubernetes_rig import NAMESPACE, kubeconfig
from unit.pool_command_rig import Outcome

COMMAND = [sys.executable, "-m", "fiber._cli.main"]

WAITS = """
import signal, sys, time
try:
    print("begun", flush=True)
    while True:  # one long wait would miss a signal that came just before it
        time.sleep(0.1)
except KeyboardInterrupt:
    print("interrupted", flush=True)
    {then}
"""


class Site:
    """Folder with programs, a cluster, and the commands that run."""

    def __init__(self, server: Served, nodes: ProgramNodes, folder: Path) -> None:
        self.server = server
        self.nodes = nodes
        self.folder = folder
        self.environment = {
            **os.environ,
            "KUBECONFIG": str(kubeconfig(folder.parent, server.api.url)),
            "COLUMNS": "200",
            "FIBER_IMAGE": "worker:1",
            "FIBER_RUNTIME_DIRECTORY": str(folder),  # not where other tests have their programs
        }
        self._commands: list[subprocess.Popen[bytes]] = []

    def write(self, name: str, program: str) -> None:
        """Write a file of the program."""
        path = self.folder / name
        path.parent.mkdir(exist_ok=True, parents=True)
        path.write_text(program)

    def waits(self, then: str = "sys.exit(9)") -> None:
        """Write the program ``train.py``, which waits for Ctrl-C."""
        self.write("train.py", WAITS.format(then=then))

    def spawn(self, *words: str, **settings: Any) -> subprocess.Popen[bytes]:
        """Start a command."""
        settings = {
            "stdin": subprocess.DEVNULL,
            "stdout": subprocess.PIPE,
            "stderr": subprocess.PIPE,
            **settings,
        }
        command = subprocess.Popen(
            [*COMMAND, *words], cwd=self.folder, env=self.environment, **settings
        )
        self._commands.append(command)
        return command

    def fiber(self, *words: str) -> Outcome:
        """Run a command to its end."""
        return self.end(self.spawn(*words))

    def end(self, command: subprocess.Popen[bytes]) -> Outcome:
        """Wait for the end of a command."""
        out, err = command.communicate(timeout=PATIENCE)
        return Outcome(command.returncode, out.decode(), err.decode())

    def begin(self, *words: str, until: bytes = b"begun", **settings: Any) -> Any:
        """Start a command and wait for a line of its output."""
        command = self.spawn(*(words or ("run", "train.py")), **settings)
        assert command.stdout is not None
        read_line(command.stdout, until)
        return command

    def job(self) -> Body:
        """The only Job."""
        (job,) = self.nodes.jobs()
        return job

    def pod(self) -> str:
        """The only pod."""
        (pod,) = self.nodes.pods()
        return pod

    def container(self) -> Body:
        """The program's container in the Job."""
        containers = self.job()["spec"]["template"]["spec"]["containers"]
        return next(c for c in containers if c["name"] == names.PROGRAM_CONTAINER)

    def variables(self) -> dict[str, str]:
        return {each["name"]: each["value"] for each in self.container()["env"]}

    def set_job(self, **status: Any) -> None:
        """Replace the status of the only Job."""
        name = self.job()["metadata"]["name"]
        self.server.do(self.server.store.set_status, "jobs", NAMESPACE, name, status)

    def remove(self, plural: str, name: str) -> None:
        self.server.do(self.server.store.remove, plural, NAMESPACE, name)

    def close(self) -> None:
        for command in self._commands:
            if command.poll() is None:
                command.kill()
            command.wait()
            for stream in (command.stdout, command.stderr):
                if stream is not None:
                    stream.close()
        self.nodes.close()


def read_line(stream: IO[bytes], until: bytes) -> bytes:
    """Read lines until one has these bytes, and return it."""
    for line in stream:
        if until in line:
            return line
    raise AssertionError(f"no line with {until!r}")


def interrupt(command: subprocess.Popen[bytes]) -> None:
    """Press Ctrl-C."""
    command.send_signal(signal.SIGINT)


@contextlib.contextmanager
def run_site(folder: Path) -> Iterator[Site]:
    """Yield a site that ends with the test."""
    project = folder / "project"
    project.mkdir()
    (folder / "nodes").mkdir()
    with served() as server:
        server.do(server.store.follow_the_machine)
        site = Site(server, ProgramNodes(server, folder / "nodes"), project)
        try:
            yield site
        finally:
            server.api.down = False
            site.close()
