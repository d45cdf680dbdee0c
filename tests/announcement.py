"""Plan of `make test`: what it will run, how long that takes, and what it skips here and why.

python -m announcement [VERSION …]     the other versions of Python that were found
"""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Iterator, Mapping, Sequence

from cluster import ability, build
from cluster.ability import Choice

SUPPORTED = ("3.11", "3.12", "3.13")
# Minutes on two idle processors. Correct them where they are far off.
_MODULES, _OTHER_PYTHON, _BESIDE, _CLUSTER = 4, 2, 24, 26


def announcement(others: Sequence[str], environment: Mapping[str, str]) -> str:
    """Return the plan for a person who is about to wait."""
    runs = list(_parts(others, environment))
    lines = [f"make test: about {sum(minutes for _, minutes in runs)} minutes on two processors"]
    lines += [f"  {minutes:2} min  {what}" for what, minutes in runs]
    if left_out := list(_left_out(others, environment)):
        lines += ["left out:", *(f"  {what}" for what in left_out)]
    return "\n".join(
        [
            *lines,
            "`make test-fast` is the first line but for its slowest; `make help` has more.",
        ]
    )


def _parts(others: Sequence[str], environment: Mapping[str, str]) -> Iterator[tuple[str, int]]:
    yield f"style, unit, contract and simulation tests, on Python {_own()}", _MODULES
    for version in others:
        yield f"the essential ones again, on Python {version}", _OTHER_PYTHON
    choice, _ = ability.choose(environment)
    if choice is Choice.OWN and build.missing("kubernetes"):
        yield "building Kubernetes for the operator's scenarios, this time only", build.minutes()
    beside = "faults, processes, examples, the chart, and conformance with each backend"
    if choice is Choice.NONE:
        yield beside, _BESIDE
    else:
        scenarios = f"the operator's scenarios and programs on pods, on {choice.value}"
        yield f"{scenarios}; beside them {beside}", _CLUSTER


def _left_out(others: Sequence[str], environment: Mapping[str, str]) -> Iterator[str]:
    for version in SUPPORTED:
        if version not in (_own(), *others):
            yield f"Python {version}: it was not found, or lacks the modules venv and ensurepip"
    choice, reasons = ability.choose(environment)
    if choice is Choice.NONE:
        yield f"the operator's scenarios: {'. '.join(reasons)}"
    else:
        yield "scenarios that wait for a minute and more: `make e2e` runs all"


def _own() -> str:
    return ".".join(platform.python_version_tuple()[:2])


if __name__ == "__main__":
    print(announcement(sys.argv[1:], os.environ), flush=True)
