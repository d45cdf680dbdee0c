"""Page about pods: one for all of its measures, with their budgets above."""

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
"""Page that is written by hand."""
_OF_ONE_HOST = {
    "throughput": (
        "map, chunksize 1",
        "map, default chunks",
        "apply_async",
        *(f"apply_async, {kind}" for kind in throughput.OTHER_KINDS),
        *throughput.ARRAY_KINDS,
    ),
    "executors": (
        executors.SUBMIT,
        *executors.SUBMIT_OF.values(),
        executors.MAP,
        executors.SLEEPING,
    ),
    "pipes": (pipes.environments(8),),
    "vector": (
        vector.pixels(64),
        *(vector.cart_poles(count) for count in (8, 64)),
        *(vector.uneven(64, first_ready=first) for first in (False, True)),
    ),
}
"""Cases that tell something about pods, for measures that have more."""
_ABOUT = """\
Fiber with its processes in pods. It is compared with multiprocessing on the same machine, and with
Ray's and Dask's clusters of as many workers, which are processes of it. Vector environments and
executors are compared with Fiber's, Gymnasium's or concurrent.futures' on processes of this
machine. The program runs outside the cluster. Each pod of Fiber has one worker, unless a section
says otherwise. "Relay" is Fiber on pods that reach the program through a relay, the kubelet and the
API server, as those of a program on a laptop do. Every pod is on this machine: messages pass
through Kubernetes' network and are encrypted, but travel no distance."""


def cases(size: float) -> list[Case]:
    """Return the cases that are measured."""
    return [
        case
        for name, measure in MEASURES.items()
        for case in measure.cases(size)
        if case.name in _OF_ONE_HOST.get(name, (case.name,))
    ]


def write(folder: Path, runs: Mapping[str, Run]) -> None:
    """Write the results, the page and the picture."""
    folder.mkdir(parents=True, exist_ok=True)
    data = {name: run.as_json() for name, run in runs.items()}
    (folder / RESULTS).write_text(json.dumps(data, separators=(",", ":")) + "\n", encoding="utf-8")
    figures.DRAW["overhead"](runs["overhead"], folder / PICTURE)
    text = page(runs, notes=(folder / NOTES).exists())
    (folder / PAGE).write_text(text, encoding="utf-8")


def page(runs: Mapping[str, Run], *, notes: bool = False) -> str:
    """Return the page: every measure with a table for each of its groups."""
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
        apart = run.about["date"] != first.about["date"]
        parts += _section(MEASURES[name], run, mine, apart=apart)
    return "\n\n".join([*parts, f"## Made on\n\n{origin(first.about)}"]) + "\n"


def _section(
    measure: ModuleType, run: Run, of_measure: Sequence[Case], *, apart: bool
) -> list[str]:
    """Return a measure's part of the page; ``apart`` if another command measured it."""
    groups = {
        case.group: [each for each in of_measure if each.group == case.group] for case in of_measure
    }
    tables = [group_table(run, members) for members in groups.values()]
    missing = failures(run).replace("## Not measured", "Not measured:")
    about = [reading(run, of_measure), origin(run.about)] if apart else []
    return [f"## {measure.TITLE}", measure.ABOUT, *about, *tables, *filter(None, [missing])]
