"""Program that benchmarks/dashboard.py watches: many workers, many tasks, and a few deaths.

It prints a line of JSON for each death that it causes and at its end, and waits for its input to
begin and to end.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import sys
import time

import fiber


def work(number: int) -> int:
    """Rest a little, as a simulator that waits for its processor."""
    time.sleep(0.01)
    return number


def processor_seconds() -> float:
    """Return the processor time of this process alone."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def say(**facts: float) -> None:
    """Print one line of JSON."""
    print(json.dumps(facts), flush=True)


def main(workers: int, tasks: int, deaths: int) -> None:
    """Run the tasks, and kill a worker ``deaths`` times."""
    with fiber.Pool(workers) as pool:
        pool.map(work, range(workers), chunksize=1)
        say(ready=1)
        sys.stdin.readline()
        before, began = processor_seconds(), time.monotonic()
        results = pool.map_async(work, range(tasks))
        killed: set[int] = set()
        while len(killed) < deaths:
            time.sleep(1.7)
            busy = {worker.pid for worker in pool.workers() if worker.state == "busy"} - killed
            victim = min(pid for pid in busy if pid is not None)
            os.kill(victim, signal.SIGKILL)
            say(death=time.time())
            killed.add(victim)
        results.wait()
        say(seconds=time.monotonic() - began, processor=processor_seconds() - before)
        sys.stdin.readline()


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
