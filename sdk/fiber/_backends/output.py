"""What remote children write, on the master's stderr with the writer's name in front."""

from __future__ import annotations

import contextlib
import queue
import sys
import threading


class Output:
    """Lines on their way to stderr.  A slow or broken stderr holds up nobody but their writer."""

    def __init__(self) -> None:
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None

    def write(self, who: str, text: str) -> None:
        """Lines of ``who``; returns at once."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="fiber-output", daemon=True)
            self._thread.start()
        self._lines.put("".join(f"[{who}] {line}\n" for line in text.split("\n")))

    def close(self) -> None:
        """Write what is left."""
        if self._thread is not None:
            self._lines.put(None)
            self._thread.join(timeout=2)

    def _run(self) -> None:
        while (lines := self._lines.get()) is not None:
            # A full disk or a closed terminal must not cost more than the lines.
            with contextlib.suppress(OSError, ValueError):
                sys.stderr.write(lines)
                sys.stderr.flush()
