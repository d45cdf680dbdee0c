"""Cost of the backend kubernetes for a master with many pods that come within seconds.

    PYTHONPATH=tests python -m benchmarks.kubernetes_scale --pods 1000

Other processes (`scripted_cluster`) play the API server, the operator, the nodes and the agents;
the master is real. It makes a pool of as many workers, lets each work, ends the pool, removes all
pods, and prints a line of JSON for each half. `stalls` are the longest times, in milliseconds, that
its loop was away from a timer of one millisecond. `turns` are the largest processor times of the
loop thread from one look at that timer to the next.
"""

from __future__ import annotations

import argparse
import heapq
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from benchmarks.tasks import no_op

import fiber
from fiber._backends.kubernetes import api
from fiber._runtime.state import runtime, shutdown
from unit.kubernetes_rig import kubeconfig

_TICK = 0.001
_PATIENCE = 120.0
_WORST = 5


class Stalls:
    """Watch that measures how long a loop is away from a timer that is due."""

    def __init__(self, loop: Any) -> None:
        self._loop = loop
        self._late: list[float] = []
        self._turns: list[float] = []
        self._used = 0.0
        loop.call_soon(self._tick, time.perf_counter())

    def worst(self) -> dict[str, list[float]]:
        """Return the stalls since the last call, the longest first, in milliseconds."""
        late, self._late = self._late, []
        turns, self._turns = self._turns, []
        return {"stalls": _longest(late), "turns": _longest(turns)}

    def _tick(self, due: float) -> None:
        now, used = time.perf_counter(), time.thread_time()
        self._late.append(now - due)
        self._turns.append(used - self._used)
        self._used = used
        self._loop.call_later(_TICK, lambda: self._tick(now + _TICK))


def _longest(seconds: list[float]) -> list[float]:
    return [round(1000 * one, 1) for one in heapq.nlargest(_WORST, seconds)]


class Watched:
    """Events that watches brought, and their bytes."""

    def __init__(self) -> None:
        self.events = self.bytes = self.largest = 0
        self._lines = api._lines
        api._lines = self._counted

    def _counted(self, response: Any) -> Iterator[bytes]:
        for line in self._lines(response):
            self.events += 1
            self.bytes += len(line) + 1
            self.largest = max(self.largest, len(line))
            yield line


@contextmanager
def scripted_cluster(agents: int) -> Iterator[subprocess.Popen[str]]:
    """Cluster's process; KUBECONFIG names it."""
    command = [sys.executable, "-m", "benchmarks.scripted_cluster", str(agents)]
    with (
        tempfile.TemporaryDirectory() as folder,
        subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as cluster,
    ):
        assert cluster.stdout is not None
        assert cluster.stdin is not None
        os.environ["KUBECONFIG"] = str(kubeconfig(Path(folder), cluster.stdout.readline().strip()))
        try:
            yield cluster
        finally:
            cluster.stdin.close()


def _asked(cluster: subprocess.Popen[str]) -> dict[str, Any]:
    assert cluster.stdin is not None
    assert cluster.stdout is not None
    cluster.stdin.write("\n")
    cluster.stdin.flush()
    found: dict[str, Any] = json.loads(cluster.stdout.readline())
    return found


def main() -> None:
    """Measure once."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--pods", type=int, default=1000)
    pods = parser.parse_args().pods
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    with scripted_cluster(pods) as cluster:
        fiber.init(backend="kubernetes", max_pods=pods, idle_timeout=1.0)
        stalls, watched = Stalls(runtime().loop), Watched()
        began, used = time.perf_counter(), time.process_time()

        def say(half: str) -> None:
            figures = {
                "half": half,
                "seconds": round(time.perf_counter() - began, 2),
                "cpu": round(time.process_time() - used, 2),
                **stalls.worst(),
                "events": watched.events,
                "watched": watched.bytes,
                "largest event": watched.largest,
                **_asked(cluster),
            }
            print(json.dumps(figures), flush=True)

        with fiber.Pool(pods) as pool:
            pool.wait_until_workers_up(_PATIENCE)
            say("up")
            pool.broadcast(no_op, 0)
        while _asked(cluster)["pods"]:
            time.sleep(0.1)
        say("down")
        shutdown()


if __name__ == "__main__":
    main()
