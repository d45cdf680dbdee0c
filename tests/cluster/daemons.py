"""The cluster's processes: started so that they outlive the command, found again, and ended.

What is needed to start one again is kept beside its process, so that a test can stop it and another
command can bring it back. Each is the child of a shell that waits for it and writes down how it
ended, since nobody else will be there to be told. Once the cluster is up, that shell also starts a
daemon again that ends by itself, as the supervisors of other clusters do.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from cluster import memory, places
from cluster.shell import ClusterError, wait_for

_SYSTEM_PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
_QUOTED = 15
_ENDED = "fiber-cluster: this daemon has ended by itself"
# $0 is the record: what the kernel says of this shell, and what it has counted up to now. It is
# there before the standard output is closed, which is what the starter waits for.
_KEEPER = (
    'cat "/proc/$$/stat" /proc/vmstat > "$0.new" && mv "$0.new" "$0" && exec >&2 || exit\n'
    "while :; do\n"
    '"$@"; echo $? > "$0.status"; [ -e "$0.kept" ] || exit\n'
    f'echo "{_ENDED}, with status $(cat "$0.status"), and is started again"\n'
    "sleep 1\n"
    "done"
)


class Daemon:
    """Process by its name, running or not."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.log = places.STATE / "log" / f"{name}.log"
        self._command_file = places.STATE / "daemons" / f"{name}.json"
        self._record = places.STATE / "daemons" / f"{name}.process"
        self._status_file = places.STATE / "daemons" / f"{name}.process.status"
        self._kept_file = places.STATE / "daemons" / f"{name}.process.kept"

    def start(self, *command: str | Path, namespace: str = "") -> None:
        """Start it with this command in a network namespace; do nothing if it runs."""
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
        """Start it with the command that it had; do nothing if it runs."""
        if not self.runs():
            self._spawn(self.command)

    def keep(self) -> None:
        """From now on, start it again whenever it ends by itself."""
        self._kept_file.touch()

    @property
    def command(self) -> list[str]:
        """Command of its last start."""
        words: list[str] = json.loads(self._command_file.read_text())
        return words

    def _spawn(self, words: list[str]) -> None:
        # The process is the child of a child, so this process need not wait for it, and the tests
        # do not take it for a leak. It inherits no environment variables from the caller.
        environment = {"PATH": f"{places.programs()}:{_SYSTEM_PATH}", "HOME": "/root"}
        self._forget()
        with self.log.open("ab") as log:
            subprocess.run(
                ["setsid", "--fork", "sh", "-c", _KEEPER, str(self._record), *words],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=log,
                env=environment,
                cwd="/",
                check=True,
            )
        if not self._record.exists():
            raise ClusterError(f"{self.name} could not be started; {self.last_words()}")

    def runs(self) -> bool:
        return self._keeper() is not None

    def _keeper(self) -> int | None:
        """The shell that waits for it; None where it has ended.

        Known by when it began: the number alone may be another's by now, and what it executes
        cannot be seen at every moment, a process that is about to execute a program has no words.
        """
        recorded = _Process.read(self._record)
        if recorded is None:
            return None
        found = _Process.of(recorded.pid)
        alive = found is not None and found.lives and found.began == recorded.began
        return recorded.pid if alive else None

    def kill(self) -> None:
        """End it, and what it has started in its session, at once and without farewell."""
        if (leader := self._keeper()) is not None:
            try:
                os.killpg(leader, signal.SIGKILL)
            except ProcessLookupError:  # it has just ended
                pass
            wait_for(f"the end of {self.name}", lambda: not any(_group(leader)), seconds=30)
        self._forget()

    def _forget(self) -> None:
        self._record.unlink(missing_ok=True)
        self._status_file.unlink(missing_ok=True)

    def status(self) -> int | None:
        """Return its exit status as a shell counts (128 and more: a signal); None if unrecorded."""
        try:
            return int(self._status_file.read_text())
        except (OSError, ValueError):
            return None

    def killed_meanwhile(self) -> int:
        """Return how many processes the kernel killed for lack of memory since this one began."""
        return memory.kills() - memory.kills(self._record)

    def last_words(self) -> str:
        """The end of its log."""
        lines = self._lines()[-_QUOTED:]
        if not lines:
            return f"its log, {self.log}, is empty"
        return "\n".join([f"the end of its log, {self.log}:", *lines])

    def ends(self) -> list[str]:
        """Each time that it ended by itself and was started again: the last lines of its log."""
        lines = self._lines()
        ends = [number for number, line in enumerate(lines) if line.startswith(_ENDED)]
        return ["\n".join(lines[max(end - _QUOTED, 0) : end + 1]) for end in ends]

    def _lines(self) -> list[str]:
        try:
            return self.log.read_text(errors="replace").splitlines()
        except OSError:
            return []


def all_daemons() -> list[Daemon]:
    """Every one that was ever started, by name."""
    return [Daemon(file.stem) for file in sorted((places.STATE / "daemons").glob("*.json"))]


class _Process(NamedTuple):
    """State of a process from /proc/PID/stat."""

    pid: int
    lives: bool
    group: int
    began: int
    """Start time in ticks since the machine began."""

    @classmethod
    def read(cls, file: Path) -> _Process | None:
        try:
            number, _, rest = file.read_text().partition("\n")[0].partition(" (")
            state, _, group, *others = rest.rpartition(") ")[2].split()
            return cls(int(number), state not in "ZX", int(group), int(others[16]))
        except (OSError, ValueError, IndexError):  # it has ended, or the file is incomplete
            return None

    @classmethod
    def of(cls, pid: int) -> _Process | None:
        return cls.read(Path(f"/proc/{pid}/stat"))


def _group(leader: int) -> Iterator[_Process]:
    """The living processes of a process group."""
    for file in Path("/proc").glob("[0-9]*/stat"):
        found = _Process.read(file)
        if found is not None and found.lives and found.group == leader:
            yield found
