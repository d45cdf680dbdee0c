"""Table of Gaussian noise, one per host, shared by all of the processes there.

The trick of Salimans et al. (2017): a perturbation is a slice of a big table that all processes
have, so that a task and its result name it by one integer. The table is a file, mapped into memory
read-only. The kernel keeps one copy of it for all processes.
"""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

BLOCK = 1 << 20  # floats made at a time, so that making the table takes little memory


@dataclass(frozen=True)
class NoiseTable:
    """Name of a table of `length` floats; any process that has it can `open` the table.

    `key` tells tables of different runs apart. The contents depend on `seed` and `length` alone, so
    they are the same on every host.
    """

    key: str
    seed: int
    length: int

    @property
    def path(self) -> Path:
        """Path of the table on this host."""
        return Path(tempfile.gettempdir()) / f"fiber-es-noise-{self.key}.f32"

    def open(self) -> npt.NDArray[np.float32]:
        """Return the table, read-only. The first process on this host to ask makes it."""
        if not self.path.exists():
            self._make()
        return np.memmap(self.path, dtype=np.float32, mode="r", shape=(self.length,))

    def remove(self) -> None:
        """Delete the table on this host; processes that have it open keep it until they close
        it."""
        # The pattern also matches files of processes that were killed while they made the table.
        for path in self.path.parent.glob(f"{self.path.stem}*"):
            path.unlink(missing_ok=True)

    def _make(self) -> None:
        """Write the table under another name, then give it its name in one atomic step.

        There is no lock, so no process can die holding one. If several start at once, the first to
        finish names the table and the others delete theirs. It is a link and not a rename, because
        a rename would replace a table that others have opened, and there would be two.
        """
        handle, partial = tempfile.mkstemp(prefix=f"{self.path.stem}-", dir=self.path.parent)
        try:
            with os.fdopen(handle, "wb") as file:
                self._write(file)
            os.link(partial, self.path)
        except FileExistsError:
            pass  # another process was faster, and its table is the same
        finally:
            os.unlink(partial)

    def _write(self, file: BinaryIO) -> None:
        rng = np.random.default_rng(self.seed)
        for start in range(0, self.length, BLOCK):
            count = min(BLOCK, self.length - start)
            file.write(rng.standard_normal(count, dtype=np.float32).data)
