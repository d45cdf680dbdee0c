"""Compares outcomes with the list of exclusions, and prints the difference."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from conformance.runner import Outcome, Report

_GOOD = ("pass", "skip")


@dataclass(frozen=True)
class Verdict:
    """Comparison of one run with one list of exclusions (id -> reason), and the tests left out."""

    title: str
    report: Report
    exclusions: Mapping[str, str]
    seconds: float
    left_out: Mapping[str, str] = field(default_factory=dict)

    @property
    def failures(self) -> list[Outcome]:
        """Tests that did not pass and are not listed."""
        return [o for o in self.report.outcomes if self.judge(o) == "failed"]

    @property
    def stale(self) -> list[Outcome]:
        """Tests that are listed and passed."""
        return [o for o in self.report.outcomes if o.result == "pass" and o.id in self.exclusions]

    @property
    def ok(self) -> bool:
        return bool(self.report.outcomes) and not self.failures and not self.stale

    def judge(self, outcome: Outcome) -> str:
        if outcome.result in _GOOD:
            return "passed" if outcome.result == "pass" else "skipped"
        return "excluded" if outcome.id in self.exclusions else "failed"

    def text(self) -> str:
        """The whole report, the closing line last."""
        parts = [self.title, self._table(), self._lists(), self._details(), self.closing_line()]
        return "\n\n".join(filter(None, parts))

    def closing_line(self) -> str:
        counts = Counter(map(self.judge, self.report.outcomes))
        words = ", ".join(f"{counts[word]} {word}" for word in _COLUMNS)
        stale = f", {len(self.stale)} listed but passing" if self.stale else ""
        result = "ok" if self.ok else "FAILED"
        return f"{self.title}: {result}: {words}{stale} in {self.seconds:.0f} s"

    def _table(self) -> str:
        rows = [f"{'class':44}" + "".join(f"{word:>9}" for word in (*_COLUMNS, "seconds"))]
        for name in dict.fromkeys(o.class_name for o in self.report.outcomes):
            mine = [o for o in self.report.outcomes if o.class_name == name]
            counts = Counter(map(self.judge, mine))
            seconds = sum(o.seconds for o in mine)
            cells = "".join(f"{counts[word]:>9}" for word in _COLUMNS)
            rows.append(f"{name:44}{cells}{seconds:>9.1f}")
        return "\n".join(rows)

    def _lists(self) -> str:
        excluded = [o for o in self.report.outcomes if self.judge(o) == "excluded"]
        skipped = [o for o in self.report.outcomes if o.result == "skip"]
        return "\n".join(
            [
                *_listing("Known not to pass", ((o.id, self.exclusions[o.id]) for o in excluded)),
                *_listing("Left out", self.left_out.items()),
                *_listing("Skipped by CPython", ((o.id, o.detail) for o in skipped)),
                *_listing("Listed but passing; strike them off", ((o.id, "") for o in self.stale)),
                *_listing("Answered by the standard library", _named(self.report.fallbacks)),
                *_listing("Names not there", _named(self.report.missing)),
            ]
        )

    def _details(self) -> str:
        return "\n\n".join(f"=== {o.result}: {o.id}\n{_shortened(o.detail)}" for o in self.failures)


def _shortened(detail: str) -> str:
    """Return whole lines, except those in which a test prints the megabyte that it sent."""
    lines = (line if len(line) <= 300 else f"{line[:300]} ..." for line in detail.splitlines())
    return "\n".join(lines).strip()


_COLUMNS = ("passed", "skipped", "excluded", "failed")


def _named(names: Iterable[str]) -> Iterable[tuple[str, str]]:
    return ((", ".join(sorted(names)), ""),) if names else ()


def _listing(title: str, entries: Iterable[tuple[str, str]]) -> list[str]:
    lines = [f"  {name}{': ' if reason else ''}{reason}" for name, reason in entries]
    return [f"{title}:", *lines] if lines else []
