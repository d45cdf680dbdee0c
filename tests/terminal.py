"""Pseudo-terminal in which a command runs, and what a person sees there."""

from __future__ import annotations

import contextlib
import os
import pty
import re
import select
import subprocess
import termios
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Self

from patience import PATIENCE

ROWS, COLUMNS = 24, 100

_PIECES = re.compile(r"\x1b\[\??(?P<count>[\d;]*)(?P<command>[A-Za-z])|(?s:.)")


class Terminal:
    """Window of a terminal, in which a command runs."""

    CTRL_C = b"\x03"

    def __init__(
        self, command: Sequence[str], folder: Path, environment: Mapping[str, str]
    ) -> None:
        self.shown = ""
        """Output after the words of the last call of ``shows``."""
        self._all = ""
        self._window, inside = pty.openpty()
        termios.tcsetwinsize(inside, (ROWS, COLUMNS))
        self._process = subprocess.Popen(
            ["setsid", "--ctty", *command],
            cwd=folder,
            env=environment,
            stdin=inside,
            stdout=inside,
            stderr=inside,
        )
        os.close(inside)

    def shows(self, words: str) -> None:
        """Wait until the window shows these words, after those of the last call."""
        deadline = time.monotonic() + PATIENCE
        while words not in self.shown:
            assert self._read(deadline), f"ended without {words!r}: {self.shown}"
        self.shown = self.shown.partition(words)[2]

    def press(self, key: bytes) -> None:
        os.write(self._window, key)

    def ends(self) -> int:
        """Wait until the command ends, and return its exit status."""
        deadline = time.monotonic() + PATIENCE
        while self._read(deadline):
            pass
        return self._process.wait(PATIENCE)

    def lines(self) -> list[str]:
        """Return the lines that a person sees now, without their trailing spaces."""
        return drawn(self._all)

    def close(self) -> int:
        """Close the window, which hangs up on the command; return its exit status."""
        if self._window >= 0:
            os.close(self._window)
            self._window = -1
        return self._process.wait(PATIENCE)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    def _read(self, deadline: float) -> bool:
        """Read what comes next; return False at the end of the command."""
        ready, _, _ = select.select([self._window], [], [], max(0.0, deadline - time.monotonic()))
        assert ready, f"nothing more came: {self.shown}"
        with contextlib.suppress(OSError):  # the last process has closed the terminal
            text = os.read(self._window, 65536).decode(errors="replace").replace("\r\n", "\n")
            self.shown += text
            self._all += text
            return bool(text)
        return False


def drawn(text: str) -> list[str]:
    """Return the lines of a terminal that has got this text, without their trailing spaces.

    It knows the control characters that bars use: return, up, and erase.
    """
    lines: list[list[str]] = [[]]
    row = column = 0
    for piece in _PIECES.finditer(text):
        line = lines[row]
        match piece["command"] or piece[0]:
            case "\r":
                column = 0
            case "\n":
                row, column = row + 1, 0
                if row == len(lines):
                    lines.append([])
            case "A":
                row = max(row - int(piece["count"] or 1), 0)
            case "K":
                del line[0 if piece["count"] == "2" else column :]
            case letter if len(letter) == 1 and piece["command"] is None:
                line += " " * (column + 1 - len(line))
                line[column] = letter
                column += 1
    return ["".join(line).rstrip() for line in lines]
