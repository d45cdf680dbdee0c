"""Sends the program to agents that have not its file system: once to each, by its content."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any, NamedTuple

from fiber._agent.program_folder import ProgramPaths
from fiber._backends.program_archive import Entry, list_files, pack
from fiber._backends.program_layout import find_layout, main_file
from fiber._wire.blob import Blob
from fiber.errors import ProgramTooLarge


class Program(NamedTuple):
    """The program's files, as they were when they were looked at last."""

    archive: Blob
    paths: ProgramPaths


class Shipping:
    """What is sent of this program.  Any thread: of several that look, each sees what is there."""

    def __init__(self) -> None:
        self._latest: tuple[dict[str, Entry], Program] | None = None
        self._left_out: frozenset[str] = frozenset()
        self._said: set[str] = set()

    @property
    def main_is_sent(self) -> bool:
        """Whether children can import the main module."""
        return main_file() is not None

    def program(self, preparation: Mapping[str, Any], *, anew: bool) -> Program:
        """The program for children that ``preparation`` is for; ProgramTooLarge.

        ``anew``: as its files are now, not as they were for the last child.
        """
        if self._latest is None or anew:
            self._latest = self._look(preparation)
        return self._latest[1]

    def _look(self, preparation: Mapping[str, Any]) -> tuple[dict[str, Entry], Program]:
        layout = find_layout(preparation, self._left_out)
        if self.main_is_sent and layout.places.place_of(layout.program) is None:
            self._warn(
                f"the program is in {layout.program!r}, where its user has all kinds of files: "
                "workers on other machines get of them only what it has imported. Put it into a "
                "folder of its own."
            )
        try:
            files = list_files(layout)
            latest = self._latest
            if latest is not None and latest[0] == files:
                return files, latest[1]._replace(paths=layout.paths)
            data = pack(layout, files)
        except ProgramTooLarge as error:
            if not layout.session:
                raise
            self._left_out |= layout.session
            self._warn(
                f"{error} Until then workers have of the working directory only what was imported "
                "from it."
            )
            return self._look(preparation)
        archive = Blob(data)
        if latest is not None and latest[1].archive.digest == archive.digest:
            archive = latest[1].archive  # touched, and the same
        return files, Program(archive, layout.paths)

    def _warn(self, message: str) -> None:
        if message not in self._said:
            self._said.add(message)
            warnings.warn(message, RuntimeWarning, stacklevel=2)
