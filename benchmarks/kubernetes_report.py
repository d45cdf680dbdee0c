"""The page about pods: one for all of its measures, with their budgets above."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType

from benchmarks import (
    budgets,
    executors,
    figures,
    kubernetes_es,
    kubernetes_start,
    large_messages,
    latency,
    overhead,
    pipes,
    throughput,
    vector,
)
from benchmarks.model import Case, Run
from benchmarks.report import budget_table, failures, group_table, origin, reading

MEASURES: dict[str, ModuleType] = {
    "overhead": overhead,
    "throughput": throughput,
    "latency": latency,
    "executors": executors,
    "pipes": pipes,
    "large_messages": large_messages,
    "vector": vector,
    "kubernetes_es": kubernetes_es,
    "kubernetes_start": kubernetes_start,
}
PAGE, PICTURE, RESULTS = "kubernetes.md", "kubernetes.png", "kubernetes.json"
NOTES = "kubernetes-notes.md"
"""By hand."""
_OF_ONE_HOST = {
    "throughput": ("map, chunksize 1", "map, default chunks", *throughput.ARRAY_KINDS),
    "executors": (executors.SUBMIT, executors.MAP, executors.SLEEPING),
    "pipes": (pipes.environments(8),),
    "vector": (
        *(vector.cart_poles(count) for count in (8, 64)),
        *(vector.uneven(64, first_ready=first) for first in (False, True)),
    ),
}
"""Of measures that have more cases: those that say something of pods."""
_ABOUT = """\
Fiber with its processes in pods, beside multiprocessing on the same machine and beside Ray's and
Dask's own clusters of as many workers as processes on it. Vector environments and executors are
beside Fiber's own, and Gymnasium's or concurrent.futures', with processes of this machine. The
program runs outside of the cluster, and each pod of Fiber's has one worker, if not said otherwise.
Every pod is on this machine: what
differs from one host is the way, through Kubernetes' network, encrypted, and not the distance."""


def cases(size: float) -> list[Case]:
    """What is measured."""
    return [
        case
        for name, measure in MEASURES.items()
        for case in measure.cases(size)
        if case.name in _OF_ONE_HOST.get(name, (case.name,))
    ]


def write(folder: Path, runs: Mapping[str, Run]) -> None:
    """The results, the page and the picture."""
    folder.mkdir(parents=True, exist_ok=True)
    data = {name: run.as_json() for name, run in runs.items()}
    (folder / RESULTS).write_text(json.dumps(data, separators=(",", ":")) + "\n", encoding="utf-8")
    figures.DRAW["overhead"](runs["overhead"], folder / PICTURE)
    text = page(runs, notes=(folder / NOTES).exists())
    (folder / PAGE).write_text(text, encoding="utf-8")


def page(runs: Mapping[str, Run], *, notes: bool = False) -> str:
    """Every measure with a table for each of its groups."""
    first = runs["overhead"]
    of_all = cases(first.about["size"])
    parts = [
        "<!-- Written by benchmarks/kubernetes_run.py; changes made by hand are lost. -->",
        "# Pods",
        _ABOUT,
        "`make bench-kubernetes` writes this page.",
        "## Budgets",
        budget_table(budgets.verdicts(runs, budgets.ON_PODS)),
        *([f"Why one is missed, and what was tried: [notes]({NOTES})."] if notes else []),
        reading(first, of_all),
        f"![Overhead]({PICTURE})",
    ]
    for name, run in runs.items():
        mine = [case for case in of_all if case.measure == name]
        parts += _section(MEASURES[name], run, mine)
    return "\n\n".join([*parts, f"## Made on\n\n{origin(first.about)}"]) + "\n"


def _section(measure: ModuleType, run: Run, of_measure: Sequence[Case]) -> list[str]:
    groups = {
        case.group: [each for each in of_measure if each.group == case.group] for case in of_measure
    }
    tables = [group_table(run, members) for members in groups.values()]
    missing = failures(run).replace("## Not measured", "Not measured:")
    return [f"## {measure.TITLE}", measure.ABOUT, *tables, *filter(None, [missing])]
