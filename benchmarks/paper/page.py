"""Generated parts of docs/paper.md: tables between markers, made from the results alone."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from benchmarks import overhead, report
from benchmarks.contenders import BY_NAME, ON_HOSTS
from benchmarks.model import Case, Metric, Run
from benchmarks.paper import breakout, evolution, populations_results, walker
from benchmarks.paper.parts import PARTS
from benchmarks.rounds import LONG
from benchmarks.samples import Summary, in_words, ratio, summary, times
from benchmarks.session import ROOT

FOLDER = ROOT / "docs" / "paper"
PAGE = ROOT / "docs" / "paper.md"
RESULTS = "results.json"
PODS = "pods"
"""Folder, beside the results, of runs with a cluster on the same machine."""
ONCE = "¹"
"""Mark of a value that was measured once, while others were measured in each round."""
_MARKED = re.compile(r"(<!-- (\w+): begin[^>]*-->\n)(.*?)(<!-- \2: end -->)", re.DOTALL)

_RATIO = (
    "A ratio is the median of the ratios of the rounds. It can differ from the ratio of the "
    "medians."
)


def load(folder: Path) -> dict[str, Run]:
    """Return the runs of earlier calls, by part, so that one part can be measured alone."""
    return report.load(folder, RESULTS)


def write(folder: Path, runs: Mapping[str, Run]) -> Path:
    """Fill the page from the results of its folders; beside other results, write tables.md."""
    if folder in (FOLDER, FOLDER / PODS):
        texts = generated(FOLDER, load(FOLDER))
        PAGE.write_text(filled(PAGE.read_text(encoding="utf-8"), texts), encoding="utf-8")
        return PAGE
    texts = generated(folder, runs)
    path = folder / "tables.md"
    path.write_text("\n\n".join(texts.values()) + "\n", encoding="utf-8")
    return path


def generated(folder: Path, runs: Mapping[str, Run]) -> dict[str, str]:
    """Return the generated text of each part that has results."""
    texts = {name: _TEXTS[name](runs[name]) for name in PARTS if name in runs}
    on_pods = load(folder / PODS)
    texts |= {f"{name}_{PODS}": _TEXTS[name](on_pods[name]) for name in PARTS if name in on_pods}
    if (folder / walker.RESULTS).exists():
        texts["walker"] = _walker(walker.load(folder))
    if (folder / populations_results.RESULTS).exists():
        texts["populations"] = populations_results.text(populations_results.load(folder))
    return texts


def filled(page: str, texts: Mapping[str, str]) -> str:
    """Return the page with these texts between their markers; other text stays."""

    def fill(found: re.Match[str]) -> str:
        begin, name, old, end = found.groups()
        return f"{begin}\n{texts[name]}\n\n{end}" if name in texts else begin + old + end

    return _MARKED.sub(fill, page)


def _overhead(run: Run) -> str:
    cases = PARTS["overhead"].cases(run.about["size"])
    names = _present(run, cases)
    head = ["framework", *(_short(case) for case in cases), "1 ms, times Fiber"]
    rows = []
    for name in names:
        cells = [_cell(run, case, name, overhead.TIME) for case in cases]
        rows.append([BY_NAME[name].label, *cells, _times(run, cases[-1], name, "fiber")])
    return _text(run, report.table(head, rows), _RATIO)


def _short(case: Case) -> str:
    return overhead.DURATIONS[case.params["duration"]]


def _evolution(run: Run) -> str:
    cases = _measured(run, evolution.cases(run.about["size"]))
    names = _present(run, cases)
    head = ["workers", "bound", *(BY_NAME[name].label for name in names)]
    rows = [
        [
            f"{case.params['workers']:,}",
            in_words(evolution.bound(**case.params), "s"),
            *(_with_efficiency(run, case, name) for name in names),
        ]
        for case in cases
    ]
    iterations = cases[0].params["iterations"]
    note = (
        f"{iterations} iteration{'s' * (iterations != 1)} of {cases[0].params['population']:,} "
        "episodes. In parentheses: the bound divided by the time (1 is the best possible)."
    )
    return _text(run, report.table(head, rows), note + _own_times(run, cases))


def _own_times(run: Run, cases: Sequence[Case]) -> str:
    """Return a sentence on the processor time of the program itself, with pretended hosts."""
    used = {
        f"{case.params['workers']:,}": in_words(found.median / case.params["iterations"], "s")
        for case in cases
        if (found := _found(run, case, ON_HOSTS.name, evolution.OWN))
    }
    if not used:
        return ""
    return (
        f" {ON_HOSTS.label}: for an iteration with {', '.join(used)} workers, the program itself "
        f"used {', '.join(used.values())} of processor time."
    )


def _with_efficiency(run: Run, case: Case, name: str) -> str:
    cell = _cell(run, case, name, evolution.TIME)
    found = _found(run, case, name, evolution.TIME)
    if not found:
        return cell
    return f"{cell} ({evolution.bound(**case.params) / found.median:.2f})"


def _breakout(run: Run) -> str:
    cases = _measured(run, breakout.cases(run.about["size"]))
    names = _present(run, cases)
    head = ["case", *(BY_NAME[name].label for name in names)]
    rows = []
    for case in cases:
        cells = []
        for name in names:
            cell = _cell(run, case, name, breakout.TIME)
            versus = _times(run, case, name, breakout.BASELINE)
            cells.append(f"{cell} ({versus})" if versus and name != breakout.BASELINE else cell)
        rows.append([case.name, *cells])
    note = (
        f"Time of all steps with learning, of which the steps are {_collection(run)}. In "
        f"parentheses: the ratio to SubprocVecEnv with multiprocessing. {_RATIO}"
    )
    return _text(run, report.table(head, rows), note)


def _collection(run: Run) -> str:
    """Return the least and the greatest share of the steps, of all cases and contenders."""
    shares = [
        100 * collection / time
        for by_contender in run.values.values()
        for values in by_contender.values()
        for collection, time in zip(
            values[breakout.COLLECTION.name], values[breakout.TIME.name], strict=True
        )
        if collection and time
    ]
    return f"{min(shares):.0f} % to {max(shares):.0f} %" if shares else "not known"


def _measured(run: Run, cases: Sequence[Case]) -> list[Case]:
    """Return the cases in which a contender took part."""
    return [case for case in cases if run.values.get(case.name) or run.failures.get(case.name)]


def _present(run: Run, cases: Sequence[Case]) -> list[str]:
    """Return the contenders that have a value or a failure in one of the cases."""
    return [
        name
        for name in BY_NAME
        if any(
            name in run.failures.get(case.name, {}) or name in run.values.get(case.name, {})
            for case in cases
        )
    ]


def _cell(run: Run, case: Case, name: str, metric: Metric) -> str:
    if name in run.failures.get(case.name, {}):
        return "✗"
    found = _found(run, case, name, metric)
    if not found:
        return "not run"
    once = ONCE if found.rounds == 1 < run.about["rounds"] else ""
    return in_words(found.median, metric.unit) + once


def _found(run: Run, case: Case, name: str, metric: Metric) -> Summary | None:
    return summary(run.values.get(case.name, {}).get(name, {}).get(metric.name, []))


def _times(run: Run, case: Case, name: str, other: str) -> str:
    metric = case.metrics[0].name
    values = run.values.get(case.name, {})
    found = ratio(values.get(name, {}).get(metric, []), values.get(other, {}).get(metric, []))
    return times(found.median) if found else ""


def _text(run: Run, table: str, note: str = "") -> str:
    shares = ", ".join(f"{100 * share:.0f} %" for share in run.in_use)
    sentences = [
        "One round."
        if run.about["rounds"] == 1
        else f"Median of at most {run.about['rounds']} rounds.",
        f"{ONCE} Measured once, because it took over {LONG:g} s with its start."
        if ONCE in table
        else "",
        note,
        f"Before the rounds, other programs used {shares} of the processors' time."
        if shares
        else "",
        f"The load was {run.about['load']:g} at the beginning and {run.about['load after']:g} at "
        "the end.",
    ]
    how = " ".join(each for each in sentences if each)
    parts = [table, how, _failures(run), report.origin(run.about)]
    return "\n\n".join(part for part in parts if part)


def _failures(run: Run) -> str:
    lines = [
        f"* ✗ {BY_NAME[name].label}, {case}: {why}"
        for case, failed in run.failures.items()
        for name, why in failed.items()
    ]
    lines += [
        f"* not installed: {BY_NAME[name].label} ({what})"
        for name, what in run.about["skipped"].items()
    ]
    return "\n".join(lines)


def _walker(found: walker.Results) -> str:
    first, last = found.tests[0], max(found.tests, key=lambda test: test.mean)
    rows = [
        ("environment", walker.ENVIRONMENT),
        (f"generations of {walker.POPULATION} episodes", f"{found.generations:,}"),
        ("steps", f"{found.steps:,}"),
        ("time", f"{found.minutes:.1f} minutes, {found.workers} workers"),
        ("return before training", f"{first.mean:.0f}"),
        ("best return", f"{last.mean:.0f}, in generation {last.generation}"),
        ("load before and after", f"{found.load_before:g} and {found.load_after:g}"),
        ("command", f"`{found.command}`"),
    ]
    return report.table(("", ""), rows)


_TEXTS: Mapping[str, Callable[[Run], str]] = {
    "overhead": _overhead,
    "evolution": _evolution,
    "breakout": _breakout,
}
