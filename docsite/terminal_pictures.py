"""Pictures of a terminal for the documentation: ``python -m docsite.terminal_pictures``.

A command runs in a pseudo-terminal while a program works, and rich draws its last screen.
"""

from __future__ import annotations

import os
import pty
import re
import select
import signal
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Callable
from contextlib import closing
from fcntl import ioctl
from io import StringIO
from pathlib import Path

from rich.console import Console
from rich.text import Text

from docsite import ROOT

_WIDTH, _HEIGHT = 110, 18
_PATIENCE = 60.0
"""Seconds in which a screen must show what is waited for."""

_TRAINING = """
import random, time
import fiber

def rollout(task):
    seed, environment = task
    time.sleep(random.Random(seed).uniform(0.1, 1.2))
    if seed % 41 == 40:
        raise ValueError(f"seed {seed} has no episode")
    return seed

if __name__ == "__main__":
    tasks = [(seed, "BipedalWalker-v3") for seed in range(400)]
    with fiber.Pool(6) as pool:
        result = pool.map_async(rollout, tasks, chunksize=1, progress="generation 7")
        result.wait()
"""


def main() -> None:
    """Draw all pictures into ``docs/images``."""
    folder = ROOT / "build" / "terminal-pictures"
    folder.mkdir(parents=True, exist_ok=True)
    script = folder / "train.py"
    script.write_text(_TRAINING)
    with _Terminal([sys.executable, script.name], folder) as program:
        progress = program.wait_for(lambda screen: bool(re.search(r"3[0-9]%", screen)))
        _draw("progress", "$ python train.py", progress)
        words = [sys.executable, "-m", "fiber._cli.main", "top", f"train-{program.pid}"]
        with _Terminal([*words, "--interval", "2"], folder) as top:
            shown = top.wait_for(lambda screen: bool(re.search(r"a second: \d", screen)))
            _draw("top", "$ fiber top", shown.replace(sys.executable, "python"))


class _Terminal:
    """Command in a pseudo-terminal, and the screen that it has drawn."""

    def __init__(self, words: list[str], folder: Path) -> None:
        self._main, end = pty.openpty()
        ioctl(end, termios.TIOCSWINSZ, struct.pack("HHHH", _HEIGHT, _WIDTH, 0, 0))
        self._command = subprocess.Popen(
            words,
            cwd=folder,
            stdin=end,
            stdout=end,
            stderr=end,
            env={**os.environ, "TERM": "xterm-256color", "PYTHONPATH": ""},
            start_new_session=True,
        )
        os.close(end)
        self.pid = self._command.pid
        self._text = ""

    def __enter__(self) -> _Terminal:
        return self

    def __exit__(self, *_: object) -> None:
        os.killpg(self.pid, signal.SIGINT)
        with closing(os.fdopen(self._main, "rb")):
            try:
                self._command.wait(_PATIENCE)
            except subprocess.TimeoutExpired:
                os.killpg(self.pid, signal.SIGKILL)
                self._command.wait()

    def wait_for(self, is_there: Callable[[str], bool]) -> str:
        """Read until the last screen is as wanted, and return it."""
        deadline = time.monotonic() + _PATIENCE
        while time.monotonic() < deadline:
            if select.select([self._main], [], [], 0.5)[0]:
                self._text += os.read(self._main, 1 << 16).decode(errors="replace")
            screen = _last_screen(self._text)
            if is_there(screen):
                return screen
        raise SystemExit(f"the screen never showed it; its last text:\n{self._text[-2000:]}")


def _last_screen(text: str) -> str:
    """Return what a terminal shows after this text, of commands that only redraw from the left."""
    screen = re.split(r"\x1b\[H", text)[-1]
    screen = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", screen).replace("\r\n", "\n")
    return "\n".join(line.rstrip("\r").split("\r")[-1].rstrip() for line in screen.split("\n"))


def _draw(name: str, command: str, screen: str) -> None:
    console = Console(record=True, width=_WIDTH, file=StringIO(), legacy_windows=False)
    console.print(Text(f"{command}\n{screen.strip()}\n"))
    svg = console.export_svg(title="terminal", unique_id=name)
    for loaded in (r"\s*@font-face \{.*?\}", r"Fira Code, ?", r"<!--.*?-->\n"):
        svg = re.sub(loaded, "", svg, flags=re.DOTALL)  # the pages load nothing from elsewhere
    path = ROOT / "docs" / "images" / f"{name}.svg"
    path.write_text(svg, encoding="utf-8")
    print(path.relative_to(ROOT))


if __name__ == "__main__":
    main()
