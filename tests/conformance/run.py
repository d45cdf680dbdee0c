"""Runs CPython's own multiprocessing tests against Fiber.

    python tests/conformance/run.py --backend local
    python tests/conformance/run.py --backend loopback --method spawn -k TestPool
    KUBECONFIG=… FIBER_IMAGE=… python tests/conformance/run.py --backend kubernetes
    python tests/conformance/run.py --module multiprocessing      (checks the harness itself)

Exits with 1 when a test fails that `exclusions` does not list, or when a listed one passes.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from conformance.cpython_suite.tiers import reason_of
from conformance.exclusions import EXCLUSIONS
from conformance.runner import Target, list_cases, run_groups
from conformance.verdict import Verdict
from conformance.warm_pools import warm_pools

CLASSES = (
    "TestProcess",
    "TestSubclassingProcess",
    "TestQueue",
    "TestSimpleQueue",
    "TestConnection",
    "TestPicklingConnections",
    "TestPoll",
    "TestWait",
    "TestPool",
    "TestPoolWorkerErrors",
    "TestPoolWorkerLifetime",
    "TestStartMethod",
    "TestInitializers",
    "TestStdinBadfiledescriptor",
    "TestTimeouts",
    "TestIgnoreEINTR",
    "TestLogging",
    "TestLock",
    "TestSemaphore",
    "TestEvent",
    "TestCondition",
    "TestBarrier",
    "TestValue",
    "TestArray",
    "TestSharedCTypes",
    "TestSharedMemory",
    "TestListener",
    "TestListenerClient",
    "OtherTest",
    "TestSyncManagerTypes",
    "TestManagerRestart",
)
# An agent on another host cannot share a pid or a file with the master.
TIERS = {
    "local": ("core", "prompt", "local"),
    "loopback": ("core", "prompt"),
    "kubernetes": ("core",),
}
# Agents start children by the same code behind a link: there one method is enough.
METHODS = {"local": ("spawn", "forkserver"), "loopback": ("spawn",), "kubernetes": ("spawn",)}
_TIER_SAYS = {
    "core": "part of every run",
    "prompt": "needs processes that start at once",
    "local": "needs one host",
    "ext": "promised to nobody",
    "na": "not applicable",
}
LIMIT = 300.0  # seconds for one test: a thousand barriers between hosts take 30, or many times that
# on a busy machine
JOBS = 2


def run_once(
    backend: str,
    method: str,
    *,
    module: str = "fiber",
    substring: str = "",
    limit: float = LIMIT,
    jobs: int = JOBS,
) -> Verdict:
    """Make one pass over the selected classes with one backend and one start method."""
    target = Target(module, method, frozenset(TIERS[backend]), limit, (("FIBER_BACKEND", backend),))
    started = time.monotonic()
    groups, left_out = select(target, substring)
    with ExitStack() as stack:
        if backend == "kubernetes":
            pools = stack.enter_context(warm_pools(jobs, target.variables()))
            target = replace(target, lend=pools.lend)
        report = run_groups(target, groups, jobs)
    listed = EXCLUSIONS[backend] if module == "fiber" else {}
    title = f"{module}, {backend}, {method}" if module == "fiber" else f"{module}, {method}"
    return Verdict(title, report, listed, time.monotonic() - started, left_out)


def select(target: Target, substring: str = "") -> tuple[list[list[str]], dict[str, str]]:
    """The ids to run, one list per class; and those of the same classes that are left out, each
    with the reason.
    """
    groups: dict[str, list[str]] = {}
    left_out: dict[str, str] = {}
    for case in list_cases(target):
        id_ = f"{case['class_name']}.{case['method']}"
        wanted = case["type"] == "manager" or (
            case["base_name"] in CLASSES and case["type"] in ("processes", None)
        )
        if not wanted or substring not in id_:
            continue
        if case["tier"] in target.tiers:
            groups.setdefault(case["class_name"], []).append(id_)
        else:
            reason = reason_of(case["base_name"], case["method"], case["type"])
            left_out[id_] = f"{_TIER_SAYS[case['tier']]}: {reason}"
    # The largest first, so that no long class is left for one job at the end.
    return sorted(groups.values(), key=len, reverse=True), left_out


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("--backend", choices=sorted(TIERS), default="local")
    parser.add_argument("--method", help="default: every method that the backend is tested with")
    parser.add_argument("--module", default="fiber", help="the module under test")
    parser.add_argument("--limit", type=float, default=LIMIT, help="seconds for one test")
    parser.add_argument("--jobs", type=int, default=JOBS, help="classes run at a time")
    parser.add_argument("-k", dest="substring", default="", help="only ids with this in them")
    options = parser.parse_args(arguments)
    verdicts = []
    for method in [options.method] if options.method else METHODS[options.backend]:
        verdict = run_once(
            options.backend,
            method,
            module=options.module,
            substring=options.substring,
            limit=options.limit,
            jobs=options.jobs,
        )
        print(verdict.text(), end="\n\n", flush=True)
        verdicts.append(verdict)
    for verdict in verdicts:
        print(verdict.closing_line())
    return 0 if all(verdict.ok for verdict in verdicts) else 1


if __name__ == "__main__":
    sys.exit(main())
