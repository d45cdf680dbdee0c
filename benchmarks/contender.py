"""Process that stands for one contender: `python -m benchmarks.contender NAME`.

It reads one JSON object a line, runs the named measure, and answers with one line, until its input
ends. So measures of different contenders never share an interpreter, and a contender that hangs can
be killed.
"""

from __future__ import annotations

import gc
import importlib
import json
import os
import sys
import traceback
from functools import cached_property
from typing import Any, TextIO

from benchmarks import peers
from benchmarks.tasks import no_op


def give_back(item: Any) -> Any:
    """Do what `no_op` does, as a function that the main module defines."""
    return item


class Bench:
    """Contender's pool and context, with which a measure runs."""

    no_op = staticmethod(no_op)
    of_main = staticmethod(give_back)
    by_value = staticmethod(lambda item: item)

    def __init__(self, contender: str, *, light: bool) -> None:
        self.contender = contender
        self.light = light

    @cached_property
    def pool(self) -> peers.Adapter:
        """Warm pool of five workers that lives as long as this process."""
        pool = peers.start(self.contender)
        pool.map(no_op, range(200), None)
        return pool

    @cached_property
    def processes(self) -> Any:
        """Namespace with the contender's Process, Pipe and Pool."""
        return peers.processes_of(self.contender)

    def close(self) -> None:
        """Stop the pool, if there is one."""
        if "pool" in self.__dict__:
            self.pool.close()


def main(contender: str, kind: str) -> None:
    """Serve until standard input ends, and close the pool in any case."""
    requests, replies = _private_streams()
    bench = Bench(contender, light=kind == "light")
    try:
        for line in requests:
            replies.write(json.dumps(_answer(bench, json.loads(line))) + "\n")
            replies.flush()
    finally:
        bench.close()


def _private_streams() -> tuple[TextIO, TextIO]:
    """Return standard input and output, which libraries and their children cannot reach."""
    requests, replies = os.fdopen(os.dup(0)), os.fdopen(os.dup(1), "w")
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, 0)
    os.close(null)
    os.dup2(2, 1)
    return requests, replies


def _answer(bench: Bench, request: dict[str, Any]) -> dict[str, Any]:
    measure = importlib.import_module(f"benchmarks.{request['measure']}")
    gc.collect()
    try:
        return {"values": measure.run(bench, **request["params"])}
    except Exception as error:
        # Any exception of a contender is its result for this case; the run goes on with the others.
        traceback.print_exc()
        words = str(error).strip().splitlines() or ["no message"]
        return {"error": f"{type(error).__name__}: {words[0]}"}


if __name__ == "__main__":
    main(*sys.argv[1:3])
