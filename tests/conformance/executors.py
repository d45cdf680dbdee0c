"""Runs CPython's own tests of process pool executors against ``fiber.Executor``.

    python tests/conformance/executors.py --backend local
    python tests/conformance/executors.py --backend loopback -k shutdown

Exits with 1 when a test fails that `exclusions` does not list, or when a listed one passes.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from conformance.cpython_suite.tiers import EXECUTORS_NOT_APPLICABLE
from conformance.exclusions import EXECUTORS
from conformance.runner import Target, list_cases, run_groups
from conformance.verdict import Verdict

BACKENDS = ("local", "loopback", "kubernetes")
LIMIT = 60.0  # seconds for one test
JOBS = 3


def available() -> bool:
    """Return whether this Python has these tests: some installations leave them out."""
    return importlib.util.find_spec("test.test_concurrent_futures") is not None


def run_once(backend: str, substring: str = "") -> Verdict:
    """All of them, or those with ``substring`` in their id, with one backend."""
    environment = (("FIBER_BACKEND", backend), ("MP_CASES", "executor_cases"))
    target = Target("fiber", "forkserver", frozenset(("core",)), LIMIT, environment)
    started = time.monotonic()
    groups: dict[str, list[str]] = {}
    for case in list_cases(target):
        id_ = f"{case['class_name']}.{case['method']}"
        if substring in id_ and case["tier"] in target.tiers:
            groups.setdefault(case["class_name"], []).append(id_)
    with ExitStack() as stack:
        if backend == "kubernetes":
            from conformance.warm_pools import warm_pools  # needs the operator's work

            pools = stack.enter_context(warm_pools(JOBS, target.variables()))
            target = replace(target, lend=pools.lend)
        report = run_groups(target, list(groups.values()), JOBS)
    title = f"fiber.Executor, {backend}"
    seconds = time.monotonic() - started
    return Verdict(title, report, EXECUTORS[backend], seconds, EXECUTORS_NOT_APPLICABLE)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("--backend", choices=BACKENDS, default="local")
    parser.add_argument("-k", dest="substring", default="", help="only ids with this in them")
    options = parser.parse_args(arguments)
    if not available():
        print(f"{sys.executable} has no test.test_concurrent_futures: nothing is run")
        return 0
    verdict = run_once(options.backend, options.substring)
    print(verdict.text())
    return 0 if verdict.ok else 1


if __name__ == "__main__":
    sys.exit(main())
