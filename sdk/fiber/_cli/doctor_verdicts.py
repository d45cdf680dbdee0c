"""Verdict of one check of ``fiber doctor``."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from enum import StrEnum
from typing import Any, NamedTuple


class State(StrEnum):
    """Outcome of a check."""

    OK = "ok"
    NOTE = "note"
    FAULT = "fault"
    UNKNOWN = "unknown"


MARKS = {State.OK: "✓", State.NOTE: "!", State.FAULT: "✗", State.UNKNOWN: "-"}


class Verdict(NamedTuple):
    """Outcome in words: what was found and, for a fault or a note, why and what to do."""

    state: State
    what: str
    why: str = ""
    do: str = ""
    check: str = ""
    """Name of the check; ``examine`` fills it in."""

    @property
    def line(self) -> str:
        """Line for people."""
        return f"{MARKS[self.state]} {self.check}: {self.what}"

    def document(self) -> dict[str, Any]:
        """Return the verdict for JSON."""
        return {
            "check": self.check,
            "state": str(self.state),
            "what": self.what,
            "why": self.why,
            "do": self.do,
        }


def ok(what: str) -> Verdict:
    """Return the verdict of a check that found no fault."""
    return Verdict(State.OK, what)


def note(what: str, why: str, do: str) -> Verdict:
    """Return the verdict of a check that found what only some users have to mend."""
    return Verdict(State.NOTE, what, why, do)


def fault(what: str, why: str, do: str) -> Verdict:
    """Return the verdict of a check that found a fault."""
    return Verdict(State.FAULT, what, why, do)


def unknown(what: str) -> Verdict:
    """Return the verdict of a check that could not look."""
    return Verdict(State.UNKNOWN, what)


def lines_of(verdicts: Iterable[Verdict]) -> Iterator[str]:
    """Yield the lines for people.  Verdicts with one reason and remedy have these once, below."""
    found = list(verdicts)
    for verdict, following in zip(found, [*found[1:], None], strict=True):
        yield verdict.line
        if following is None or verdict[2:] != following[2:]:
            if verdict.why:
                yield f"    why:  {verdict.why}"
            if verdict.do:
                yield f"    do:   {verdict.do}"
