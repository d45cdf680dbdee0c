"""The cluster's processes: started so that they outlive the command, found again, and ended.

What is needed to start one again is kept beside its process id, so that a test can stop it and
another command can bring it back.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
from pathlib import Path

from cluster import places
from cluster.shell import wait_for

_SYSTEM_PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"


class Daemon:
    """One process by its name, whether it runs or not."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.log = places.STATE / "log" / f"{name}.log"
        self._command_file = places.STATE / "daemons" / f"{name}.json"
        self._process_file = places.STATE / "daemons" / f"{name}.pid"

    def start(self, *command: str | Path, namespace: str = "") -> None:
        """Start it with this command, in a network namespace; nothing happens when it runs."""
        if self.runs():
            return
        words = [str(word) for word in command]
        if namespace:  # nsenter, since `ip netns exec` would hide /sys/fs/cgroup
            words = ["nsenter", f"--net=/run/netns/{namespace}", "--", *words]
        self._command_file.parent.mkdir(parents=True, exist_ok=True)
        self.log.parent.mkdir(parents=True, exist_ok=True)
        self._command_file.write_text(json.dumps(words))
        self.start_again()

    def start_again(self) -> None:
        """Start it with the command that it had; nothing happens when it runs."""
        if not self.runs():
            self._process_file.unlink(missing_ok=True)
            self._spawn(json.loads(self._command_file.read_text()))

    def _spawn(self, words: list[str]) -> None:
        # The child of a child: nobody here has to wait for it, and it is not taken for a process
        # that a test has left. It knows nothing of the environment of who started it.
        environment = {"PATH": f"{places.programs()}:{_SYSTEM_PATH}", "HOME": "/root"}
        record = 'echo $$ > "$0.new" && mv "$0.new" "$0" && exec "$@"'
        with self.log.open("ab") as log:
            subprocess.run(
                ["setsid", "--fork", "sh", "-c", record, str(self._process_file), *words],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env=environment,
                cwd="/",
                check=True,
            )
        wait_for(f"the process of {self.name}", self._process_file.exists, seconds=10)

    def runs(self) -> bool:
        return self._pid() is not None

    def _pid(self) -> int | None:
        """Its process id, unless it has ended and the number is another's by now."""
        try:
            pid = int(self._process_file.read_text())
            words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
        except (OSError, ValueError):
            return None
        command = json.loads(self._command_file.read_text())
        ours = any(word == command[-1].encode() for word in words)
        return pid if ours else None

    def kill(self) -> None:
        """End it, and what it has started in its session, at once and without farewell."""
        if (pid := self._pid()) is not None:
            try:
                os.killpg(pid, signal.SIGKILL)
            except ProcessLookupError:  # it has just ended
                pass
            wait_for(f"the end of process {pid}, {self.name}", lambda: not _lives(pid), seconds=30)
        self._process_file.unlink(missing_ok=True)

    def complaint(self) -> str | None:
        """Why it is no use to wait for it; None while it runs."""
        if self.runs():
            return None
        lines = self.log.read_text(errors="replace").splitlines()[-15:]
        return "\n".join([f"{self.name} has ended; the end of {self.log}:", *lines])


def all_daemons() -> list[Daemon]:
    """Every one that was ever started, by name."""
    return [Daemon(file.stem) for file in sorted((places.STATE / "daemons").glob("*.json"))]


def _lives(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"
