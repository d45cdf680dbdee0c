"""Pages from runs: one page of tables for each measure, and an index with the budgets."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks import budgets, figures
from benchmarks.contenders import BY_NAME
from benchmarks.model import MANY, MANY_ROUNDS, Case, Metric, Run
from benchmarks.rounds import LONG, SERVER_ROUNDS
from benchmarks.samples import Summary, in_words, is_idle, ratio, summary, times
from benchmarks.suite import MEASURES

RESULTS = "results.json"
_OTHER_PAGES = {
    "kubernetes.md": "[Pods](kubernetes.md): the same with processes in pods",
    "operator.md": "[Operator](operator.md): thousands of pods",
    "notes.md": "[Notes](notes.md): why a budget is missed and what was tried",
}
"""Pages that other commands or people write, and what the index says of each."""
_GENERATED = (
    "<!-- Written by benchmarks/run.py from results.json; changes made by hand are lost. -->"
)


def load(folder: Path, results: str = RESULTS) -> dict[str, Run]:
    """Return the runs of an earlier report, by measure, so that one measure can be run again
    alone."""
    path = folder / results
    if not path.exists():
        return {}
    return {
        name: Run.from_json(data)
        for name, data in json.loads(path.read_text(encoding="utf-8")).items()
    }


def write(folder: Path, runs: Mapping[str, Run], new: Iterable[str]) -> None:
    """Write the results, a page and a picture for each measure in `new`, and the index over all."""
    folder.mkdir(parents=True, exist_ok=True)
    data = {name: runs[name].as_json() for name in MEASURES if name in runs}
    (folder / RESULTS).write_text(json.dumps(data, separators=(",", ":")) + "\n", encoding="utf-8")
    for name in new:
        figures.DRAW[name](runs[name], folder / f"{name}.png")
        (folder / f"{name}.md").write_text(page(name, runs[name]), encoding="utf-8")
    there = [line for name, line in _OTHER_PAGES.items() if (folder / name).exists()]
    (folder / "README.md").write_text(index(runs, there), encoding="utf-8")


def page(name: str, run: Run) -> str:
    """Return the page of one measure."""
    measure = MEASURES[name]
    cases = measure.cases(run.about["size"])
    groups = {case.group: [each for each in cases if each.group == case.group] for case in cases}
    sections = [
        f"## {group[0].upper()}{group[1:]}\n\n{group_table(run, members)}"
        for group, members in groups.items()
    ]
    parts = [
        _GENERATED,
        f"# {measure.TITLE}",
        measure.ABOUT,
        f"![{measure.TITLE}]({name}.png)",
        reading(run, cases),
        *sections,
        failures(run),
        f"## Made on\n\n{origin(run.about)}",
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def index(runs: Mapping[str, Run], others: Iterable[str] = ()) -> str:
    """Return the index: the pages, these others too, and every budget with its verdict."""
    pages = [f"[{MEASURES[name].TITLE}]({name}.md)" for name in MEASURES if name in runs]
    found = budgets.verdicts(runs)
    met = sum(v.kept is True for v in found)
    parts = [
        _GENERATED,
        "# Benchmarks",
        "`make bench` writes these pages. A ratio is taken within each round. The tables show its "
        "median over the rounds.",
        "\n".join(f"* {page}" for page in (*pages, *others)),
        "## Budgets",
        f"{met} of {len(found)} met. The contender is Fiber with local processes, unless a row "
        "says otherwise.",
        budget_table(found),
    ]
    return "\n\n".join(parts) + "\n"


def budget_table(found: Iterable[budgets.Verdict]) -> str:
    """Return a row for each budget."""
    rows = [
        (v.budget.what, _against(v.budget), v.budget.in_words(), v.measured, v.verdict)
        for v in found
    ]
    return table(("what", "against", "budget", "measured", "verdict"), rows)


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _against(budget: budgets.Budget) -> str:
    if budget.unit:
        return "—"
    return budget.to_case or BY_NAME[budget.against].label


def group_table(run: Run, cases: Sequence[Case]) -> str:
    """Return a row for each case, metric and contender, with its ratio, budget and verdict."""
    several = len({metric.label for case in cases for metric in case.metrics}) > 1
    head = (
        "case",
        *(["what"] if several else []),
        "contender",
        "median",
        "least to greatest",
        "ratio",
        "budget",
        "verdict",
    )
    rows = []
    for case in cases:
        for metric in case.metrics:
            title = [case.name, *([metric.label] if several else [])]
            for row in _rows(run, case, metric):
                rows.append((*title, *row))
                title = [""] * len(title)
    return table(head, rows)


def _rows(run: Run, case: Case, metric: Metric) -> list[tuple[str, ...]]:
    baseline = run.series(case.name, case.baseline, metric.name)
    rows: list[tuple[str, ...]] = []
    for name, contender in BY_NAME.items():
        values = run.series(case.name, name, metric.name)
        found = summary(values)
        if not found:
            if why := case.not_run.get(name):
                rows.append((contender.label, f"not run: {why}", "", "", "", ""))
            continue
        to_baseline = ratio(values, baseline) if name != case.baseline else None
        spread = f"{in_words(found.least, metric.unit)} to {in_words(found.greatest, metric.unit)}"
        if found.rounds == 1:
            spread = "one round"
        verdict = _verdict(run, case, metric, name)
        rows.append(
            (
                contender.label,
                in_words(found.median, metric.unit),
                spread,
                ratio_in_words(to_baseline),
                *verdict,
            )
        )
    return rows


def ratio_in_words(found: Summary | None) -> str:
    """Return the median of a ratio, and its least and greatest value."""
    if not found:
        return "—"
    if found.rounds == 1:
        return times(found.median)
    return f"{times(found.median)} ({times(found.least)} to {times(found.greatest)})"


def _verdict(run: Run, case: Case, metric: Metric, contender: str) -> tuple[str, str]:
    """Return bounds and verdicts of the row, of which most have one or none."""
    found = [
        (f"{budget.in_words()}{_to_whom(budget, case)}", budgets.judge(budget, {case.measure: run}))
        for budget in budgets.of(case.measure, case.name, metric.name, contender)
    ]
    return "; ".join(bound for bound, _ in found), "; ".join(v.verdict for _, v in found)


def _to_whom(budget: budgets.Budget, case: Case) -> str:
    """Return the contender whose value the bound is a multiple of, if it is not the baseline."""
    if budget.unit or (budget.against == case.baseline and not budget.to_case):
        return ""
    return f" {_against(budget)}"


def reading(run: Run, cases: Sequence[Case]) -> str:
    """Return how to read the tables, and whether the machine was idle."""
    rounds = run.about["rounds"]
    measured = [
        case.baseline
        for case in cases
        if any(run.series(case.name, case.baseline, metric.name) for metric in case.metrics)
    ]
    baselines = " or ".join(dict.fromkeys(BY_NAME[name].label for name in measured))
    text = (
        f"Median of {rounds} round{'s' if rounds > 1 else ''}. Contenders with servers take part "
        f"in at most {SERVER_ROUNDS}. Cases with {MANY:,} workers and more are measured in at most "
        f"{MANY_ROUNDS} rounds, and other cases that take more than {LONG:g} s in one."
    )
    if baselines:
        text += f" The ratio is to {baselines} in the same round: its median, least and greatest."
    if run.in_use:
        text += f"\n\n{_company(run.in_use)}"
    if run.about["size"] < 1:
        size = f"{run.about['size']:g}"
        text += f"\n\n**Run at {size} of the full size, which only shows that everything works.**"
    return text


def _company(in_use: Sequence[float]) -> str:
    shares = ", ".join(f"{100 * share:.0f} %" for share in in_use)
    verdict = (
        "the machine was idle."
        if is_idle(in_use)
        else "**the machine was not idle**, which affects short times most."
    )
    return f"Before each round others used {shares} of the processors' time: {verdict}"


def failures(run: Run) -> str:
    """Return which contenders failed in which cases, and why; empty if none did."""
    rows = [
        (case, BY_NAME[contender].label, why.replace("|", "\\|").replace("\n", " "))
        for case, failed in run.failures.items()
        for contender, why in failed.items()
    ]
    skipped = [
        (BY_NAME[name].label, "all", f"skipped, not installed: {what}")
        for name, what in _skipped(run)
    ]
    if not rows and not skipped:
        return ""
    rows += [(case, contender, why) for contender, case, why in skipped]
    return "## Not measured\n\n" + table(("case", "contender", "reason"), rows)


def _skipped(run: Run) -> list[tuple[str, str]]:
    return sorted(run.about.get("skipped", {}).items())


def origin(about: Mapping[str, Any]) -> str:
    """Return where, when and with what a run was made."""
    versions = ", ".join(f"{name} {version}" for name, version in about["versions"].items())
    rows = {
        "machine": f"{about['cores']} cores ({about['processor']}), {about['memory']} of memory",
        "system": about["system"],
        "Python": about["python"],
        "versions": versions or "—",
        "date": about["date"],
        "load before": f"{about['load']} (1 minute average of running processes)",
        "command": f"`{about['command']}`",
    }
    return table(("", ""), rows.items())
