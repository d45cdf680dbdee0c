"""Model of the live page: what a program has said of itself, merged.

Pure: the values come from the program's monitor, and times are seconds after its beginning.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

_MOST_SAMPLES = 600
"""Samples that are kept.  If there are more, each second one goes."""

_SAME_START = 1.0
"""Seconds by which two computations of one beginning may differ."""

Facts = dict[str, Any]


def same_start(one: float, other: float) -> bool:
    """Return whether two records have one beginning.

    A program begins a new record if its runtime starts again.
    """
    return abs(one - other) < _SAME_START


class SampleHistory:
    """Samples of a program's state over its whole run, in bounded memory.

    The samples that are kept are ``spacing`` seconds apart at least, which grows with the run.
    The last sample is always there, so it may be closer.
    """

    def __init__(self) -> None:
        self.spacing = 0.0
        self._samples: list[Facts] = []

    def add(self, sample: Facts) -> None:
        """Add the newest sample."""
        kept = self._samples
        if len(kept) > 1 and kept[-1]["at"] - kept[-2]["at"] < self.spacing:
            kept.pop()
        kept.append(sample)
        if len(kept) > _MOST_SAMPLES:
            self._samples = kept[::2]
            first, last = self._samples[0]["at"], self._samples[-1]["at"]
            self.spacing = (last - first) / len(self._samples)

    def all(self) -> list[Facts]:
        """Return the samples, the oldest first."""
        return self._samples


class ProcessorShares:
    """Processors that each child uses, from two readings of its processor time."""

    def __init__(self) -> None:
        self._before: dict[tuple[Any, ...], tuple[float, float]] = {}

    def add_to(self, children: list[Facts], now: float) -> None:
        """Set ``share`` of each child; None if it is not known."""
        found: dict[tuple[Any, ...], tuple[float, float]] = {}
        for child in children:
            child["share"] = None
            seconds = child.get("cpu")
            if seconds is None:
                continue
            process = (child["name"], child["host"], child["pid"])
            found[process] = (now, seconds)
            then, before = self._before.get(process, (now, seconds))
            if now > then:
                child["share"] = max(0.0, seconds - before) / (now - then)
        self._before = found


class ProgramModel:
    """Merged record of one program, complete for a page that is opened now."""

    def __init__(self) -> None:
        self.program: Facts | None = None
        self._activity: Facts = {}
        self._children: dict[int, Facts] = {}
        self._state: Facts = {"pools": [], "children": [], "deaths": []}
        self._history = SampleHistory()
        self._shares = ProcessorShares()

    def merge_activity(self, snapshot: Facts) -> None:
        """Take a snapshot of the program's ``Activity``: all of it, or what has changed."""
        if snapshot["complete"]:
            self._children = {}
        if not same_start(snapshot["start"], self._activity.get("start", 0.0)):
            self._history, self._shares = SampleHistory(), ProcessorShares()
        for child in snapshot["children"]:
            known = self._children.get(child["id"])
            spans = [] if known is None else known["spans"]
            self._children[child["id"]] = {**child, "spans": _followed(spans, child["spans"])}
        self._activity = {key: value for key, value in snapshot.items() if key != "children"}

    def merge_state(self, state: Facts) -> Facts:
        """Take the program's pools, children and deaths; return the sample that they make."""
        now = self._activity["now"]
        self._shares.add_to(state["children"], now)
        self._state = state
        sample = _sample(state, now)
        self._history.add(sample)
        return sample

    def complete(self) -> Facts:
        """Return all that a new page needs."""
        if self.program is None:
            return {}
        children = list(self._children.values())
        return {
            "program": self.program,
            "activity": {**self._activity, "complete": True, "children": children},
            "state": self._state,
            "samples": self._history.all(),
        }


def _followed(spans: list[Any], later: list[Any]) -> list[Any]:
    """Return the spans that begin before the first later one, and the later ones."""
    if not later:
        return spans
    begin = later[0][0]
    at = len(spans)
    while at and spans[at - 1][0] >= begin:
        at -= 1
    return spans[:at] + later


def _sample(state: Facts, now: float) -> Facts:
    """Return the figures of a state that the page draws over time."""
    children = state["children"]
    return {
        "at": now,
        "waiting": sum(pool["waiting"] for pool in state["pools"]),
        "held": sum(pool["held"] for pool in state["pools"]),
        "states": Counter(child["state"] for child in children),
        "memory": _sum(child.get("memory") for child in children),
        "share": _sum(child["share"] for child in children),
    }


def _sum(values: Any) -> float | None:
    """Return the sum of the values that are known; None if none is."""
    known = [value for value in values if value is not None]
    return sum(known) if known else None
