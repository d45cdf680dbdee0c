"""Sends the program to agents that have not its file system: once to each, by its content."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterable, Mapping
from itertools import islice
from typing import Any, NamedTuple

from fiber._agent.program_folder import ProgramPaths
from fiber._backends.ignore_rules import INCLUDING
from fiber._backends.program_archive import pack
from fiber._backends.program_files import Entry, LeftOut, Why, select
from fiber._backends.program_layout import Layout, find_layout, main_file
from fiber._wire.blob import Blob
from fiber.errors import ProgramTooLarge, in_one_line

_SHOWN = 10
"""Entries that a warning lists."""


class Program(NamedTuple):
    """The program's files, as they were when they were looked at last."""

    archive: Blob
    paths: ProgramPaths


class Shipping:
    """Files of this program to send.  Any thread may look."""

    def __init__(self) -> None:
        self._latest: tuple[dict[str, Entry], Program] | None = None
        self._left_out: frozenset[str] = frozenset()
        self._said: set[str] = set()
        """Warnings, and the paths that were in one."""

    @property
    def main_is_sent(self) -> bool:
        """True if children can import the main module."""
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
            files, left_out = select(layout)
            self._tell(layout, left_out)
            latest = self._latest
            if latest is not None and latest[0] == files:
                return files, latest[1]._replace(paths=layout.paths)
            packed = pack(layout, files)
        except ProgramTooLarge as error:
            if not layout.session:
                raise
            self._left_out |= layout.session
            self._warn(
                f"{error} Until then workers have of the working directory only what was imported "
                "from it."
            )
            return self._look(preparation)
        self._tell_torn(packed.torn)
        archive = Blob(packed.archive)
        if latest is not None and latest[1].archive.digest == archive.digest:
            archive = latest[1].archive  # touched, and the same
        return files, Program(archive, layout.paths)

    def _tell(self, layout: Layout, left_out: Iterable[LeftOut]) -> None:
        """Say once of each path that a person would not expect it to be left out."""
        news = [left for left in left_out if left.path not in self._said]
        self._said.update(left.path for left in news)
        for why, sentence in _SENTENCES.items():
            entries = [left for left in news if left.why is why]
            if entries:
                shown = _shown(f"{left.path} ({left.detail})" for left in entries)
                more = f"  and {len(entries) - _SHOWN} more: fiber.shipping.listing()"
                shown += [more] * (len(entries) > _SHOWN)
                self._warn("\n".join((sentence, *shown, _advice(layout, entries[0].path))))

    def _tell_torn(self, torn: list[str]) -> None:
        """Say once of each file that it changed each time that it was read."""
        news = [path for path in torn if path not in self._said]
        self._said.update(news)
        if news:
            self._warn("\n".join((_TORN, *_shown(news))))

    def _warn(self, message: str) -> None:
        if message not in self._said:
            self._said.add(message)
            warnings.warn(message, RuntimeWarning, stacklevel=2)


_SENTENCES = {
    Why.SECRET: "workers on other machines do not get these, which look like secrets:",
    Why.LINK: "workers on other machines do not get these links, which lead out of their folder:",
}


_TORN = (
    "these files changed each time that they were read, so workers on other machines may have them "
    "half written. Write to another file and rename it, or name it in .fiberignore if workers do "
    "not need it:"
)


def _shown(lines: Iterable[str]) -> list[str]:
    return [f"  {in_one_line(line)}" for line in islice(lines, _SHOWN)]


def _advice(layout: Layout, path: str) -> str:
    place = layout.places.place_of(path) or os.path.dirname(path)
    rules = os.path.join(place, INCLUDING)
    # In a line of .fiberignore these would be patterns, the end of the line, or nothing.
    name = re.sub(r"[^\w./@+~:,%= -]| $", "?", path[len(place) :])
    return (
        f"To send one that workers need, write a line with its name into {rules}, "
        f"for example {'!' + name!r}. The line {name!r} leaves it out without this warning."
    )
