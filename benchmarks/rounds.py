"""Order of a run: every round visits every contender, in an order that rotates."""

from __future__ import annotations

import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from benchmarks import machine
from benchmarks.contenders import Contender
from benchmarks.model import Case, Run
from benchmarks.session import Failed, Session, sweep

SERVER_ROUNDS = 3
LONG = 8.0

Say = Callable[[str], None]


def in_turn(contenders: Sequence[Contender], turn: int) -> list[Contender]:
    """Return the contenders, begun one later at each turn, so that none always follows the same
    one."""
    start = turn % len(contenders) if contenders else 0
    return [*contenders[start:], *contenders[:start]]


def say(text: str) -> None:
    """Print progress on standard error."""
    print(text, file=sys.stderr, flush=True)


class Rounds:
    """Runner of cases with contenders, round by round, which keeps the samples.

    Contenders without servers keep one process for the whole run and take turns within each case,
    so that values whose ratio is taken were measured seconds apart. The others would disturb them
    even when idle. So each of those is started for its turn in a round, does all cases, and is
    stopped.
    """

    def __init__(
        self,
        scratch: Path,
        runs: dict[str, Run],
        say: Say = say,
        in_use: Callable[[], float] = machine.in_use,
    ) -> None:
        self._scratch = scratch
        self._runs = runs
        self._say = say
        self._in_use = in_use
        self._sessions: dict[str, Session] = {}
        self._finished: set[tuple[str, str, str]] = set()

    def play(self, cases: Sequence[Case], contenders: Sequence[Contender], rounds: int) -> None:
        """Run all rounds; afterwards no contender runs."""
        light = [each for each in contenders if not each.servers]
        heavy = [each for each in contenders if each.servers]
        for turn in range(rounds):
            label = f"round {turn + 1}/{rounds}"
            for index, case in enumerate(cases):
                if not index or cases[index - 1].measure != case.measure:
                    self._runs[case.measure].in_use.append(self._in_use())
                for contender in in_turn(light, turn + index):
                    self._visit(case, contender, turn, label)
            for contender in in_turn(heavy, turn) if turn < SERVER_ROUNDS else []:
                for case in cases:
                    self._visit(case, contender, turn, label)
                if contender.name in self._sessions:
                    self._end(contender.name, Session.stop)
        for key in list(self._sessions):
            self._end(key, Session.stop)

    def abandon(self) -> None:
        """Stop every contender that still runs, even in the middle of a case."""
        for session in self._sessions.values():
            session.interrupt()
        self._sessions.clear()
        sweep(set())

    def _visit(self, case: Case, contender: Contender, turn: int, label: str) -> None:
        key = (case.measure, case.name, contender.name)
        if (
            case.needs not in contender.offers
            or contender.name in case.not_run
            or key in self._finished
            or turn >= (case.rounds or turn + 1)
        ):
            return
        where = f"{label}  {case.measure}: {case.name}  {contender.name}"
        run, begin = self._runs[case.measure], time.monotonic()
        try:
            sample = self._sample(case, contender)
        except Failed as failure:
            # Once is enough: another try would only delay the others.
            self._finished.add(key)
            run.fail(case.name, contender.name, str(failure), failure.after)
            self._say(f"{where}  failed: {failure}")
            return
        if case.rounds is None and time.monotonic() - begin > LONG:
            self._finished.add(key)
        run.add(case.name, contender.name, turn, sample)
        self._say(f"{where}  " + "  ".join(f"{name} {value:.6g}" for name, value in sample.items()))

    def _sample(self, case: Case, contender: Contender) -> dict[str, float]:
        key = f"{contender.name} (new process)" if case.fresh else contender.name
        if key not in self._sessions:
            self._sessions[key] = Session(contender, self._scratch)
        try:
            sample = self._sessions[key].run(case)
        except Failed:
            self._end(key, Session.interrupt)
            raise
        if case.fresh:
            self._end(key, Session.stop)
        return sample

    def _end(self, key: str, how: Callable[[Session], None]) -> None:
        # Taken out last, so that an interrupt in between still finds it.
        how(self._sessions[key])
        del self._sessions[key]
        for name in sweep({session.pid for session in self._sessions.values()}):
            self._say(f"{key} left a process behind, killed now: {name}")


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """Make a folder for all that contenders write, and remove it afterwards."""
    folder = Path(tempfile.mkdtemp(prefix="bench-"))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
