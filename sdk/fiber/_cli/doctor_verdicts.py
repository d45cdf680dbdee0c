"""Verdict of one check of ``fiber doctor``."""

from __future__ import annotations

from enum import StrEnum
from typing import Any, NamedTuple


class State(StrEnum):
    """Outcome of a check."""

    OK = "ok"
    FAULT = "fault"
    UNKNOWN = "unknown"


MARKS = {State.OK: "✓", State.FAULT: "✗", State.UNKNOWN: "-"}


class Verdict(NamedTuple):
    """Outcome in words: what was found and, for a fault, why it is one and what to do."""

    state: State
    what: str
    why: str = ""
    do: str = ""
    check: str = ""
    """Name of the check; ``examine`` fills it in."""

    def lines(self) -> list[str]:
        """Return the lines for people."""
        found = [f"{MARKS[self.state]} {self.check}: {self.what}"]
        if self.why:
            found.append(f"    why:  {self.why}")
        if self.do:
            found.append(f"    do:   {self.do}")
        return found

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


def fault(what: str, why: str, do: str) -> Verdict:
    """Return the verdict of a check that found a fault."""
    return Verdict(State.FAULT, what, why, do)


def unknown(what: str) -> Verdict:
    """Return the verdict of a check that could not look."""
    return Verdict(State.UNKNOWN, what)
