"""Person with a kubeconfig, who types commands, also in a terminal."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from types import TracebackType

from e2e.program import Programs
from e2e.scene import Scene
from fiber_api import names
from patience import PATIENCE
from terminal import Terminal

FIBER = Path(sys.executable).with_name("fiber")
COUNT = """
import sys, time
import fiber as mp
import helper

if __name__ == "__main__":
    print("to stdout", *sys.argv[1:], flush=True)
    print("to stderr", file=sys.stderr, flush=True)
    with mp.Pool(2) as pool:
        print(pool.map(helper.square, range(5)), flush=True)
    sys.exit(7)
"""
HELPER = "def square(number):\n    return number * number\n"
WAIT = """
import signal, sys, time

def interrupted(*_):
    print("interrupted", flush=True)
    sys.exit(9)

signal.signal(signal.SIGINT, interrupted)
for number in range(10_000):
    print(number, flush=True)
    time.sleep(0.01)
"""
HANG = """
import collections, itertools
import fiber as mp

def hang(_):
    collections.deque(itertools.repeat(None), maxlen=0)

if __name__ == "__main__":
    with mp.Pool(1) as pool:
        pool.map(hang, [0])
"""


class Command(subprocess.Popen[str]):
    """Command that runs.  A test that fails kills it: to wait for its end would hide the error."""

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is not None:
            self.kill()
        super().__exit__(kind, error, trace)


class Person:
    """A person with a kubeconfig, who may run programs in one namespace."""

    def __init__(
        self,
        scene: Scene,
        programs: Programs,
        folder: Path,
        image: str | None,
        fiber: Path = FIBER,
    ) -> None:
        self.scene = scene
        self.folder = folder
        self._fiber = fiber
        self._environment = {
            **{key: value for key, value in os.environ.items() if not key.startswith("FIBER_")},
            "KUBECONFIG": str(programs.kubeconfig),
            "FIBER_NAMESPACE": scene.namespace,
            **({"FIBER_IMAGE": image} if image else {}),
        }
        (folder / "count.py").write_text(COUNT, encoding="utf-8")
        (folder / "helper.py").write_text(HELPER, encoding="utf-8")
        (folder / "wait.py").write_text(WAIT, encoding="utf-8")
        (folder / "hang.py").write_text(HANG, encoding="utf-8")

    def start(self, *words: str, **variables: str) -> Command:
        return Command(
            [self._fiber, *words],
            cwd=self.folder,
            env={**self._environment, **variables},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def terminal(self, *words: str) -> Terminal:
        """Start a command in a window."""
        return Terminal([str(self._fiber), *words], self.folder, self._environment)

    def runs(
        self, *words: str, seconds: float = PATIENCE, **variables: str
    ) -> subprocess.CompletedProcess[str]:
        with self.start(*words, **variables) as process:
            output, errors = process.communicate(timeout=seconds)
        return subprocess.CompletedProcess(words, process.returncode, output, errors)

    def lists(self, *states: str) -> list[str]:
        """Wait until the programs have these states; return their names."""
        found: list[dict[str, str]] = []

        def so() -> bool:
            words = ("ps", "--namespace", self.scene.namespace, "--output", "json")
            found[:] = json.loads(self.runs(*words).stdout)
            return [row["state"] for row in found] == list(states)

        self.scene.wait(f"programs are {states}", so, PATIENCE, poll=0.5)
        return [row["name"] for row in found]

    def pod(self, name: str) -> str:
        """Return the name of a program's pod once it is there."""

        def found() -> str | None:
            for pod in self.scene.now["pods"].values():
                if pod["metadata"]["labels"].get(names.LABEL_PROGRAM) == name:
                    return str(pod["metadata"]["name"])
            return None

        return self.scene.wait(f"{name} has a pod", found) or ""
