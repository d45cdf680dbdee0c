"""What the user of the real dispatcher sees, told to the oracle."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from fiber._runtime.requests import Request

from fiber._runtime.outcome import Encoded, Failure
from fiber._wire import work
from fiber.errors import StartError, TimeoutError, WorkerDied
from simulation.oracle import Account, Violation
from simulation.schedule import Act
from simulation.wire import value_of
from simulation.workers import Ref

if TYPE_CHECKING:
    from simulation.dispatcher_master import DispatcherMaster


class BrokenInput(Exception):
    """What an iterable raises instead of its next item."""


class Outcomes:
    """Where the dispatcher puts the outcomes of one job, or of one call of it; a ``Sink``."""

    def __init__(self, master: DispatcherMaster, account: Account, call: int | None = None) -> None:
        self.account = account
        self.call = call
        self.request: Request | None = None
        self._master = master
        self._oracle = master.world.oracle
        self._ended = False

    def put(self, start: int, outcomes: list[Any], mixed: bool = True) -> None:
        """Outcomes of tasks from ``start`` on."""
        for index, outcome in enumerate(outcomes, start if self.call is None else self.call):
            self._put(Ref(self.account.number, index), outcome)
        if self.request is not None and self.request.reader is not None:
            # The user takes them a little later.
            self._master.stage.soon(self.request.reader.consume, len(outcomes))

    def _put(self, ref: Ref, outcome: Any) -> None:
        error = outcome.error if type(outcome) is Failure else None
        if isinstance(error, BrokenInput):
            if self.request is None or ref.task != self.request.job.fed:
                raise Violation(f"the error of the input takes the place of {ref}")
        elif isinstance(error, WorkerDied):
            self._oracle.died(ref, error.attempts)
        elif isinstance(error, TimeoutError):
            self._oracle.delivered(ref, "too late")
        elif error is not None:
            if self._master.world.task(ref).act is not Act.UNSENDABLE:
                raise Violation(f"{ref} cannot be sent: {error}")
            self._master.world.note("%s cannot be sent", ref)
            self._oracle.delivered(ref, "unsendable")
        elif type(outcome) is Encoded:
            act = self._master.world.task(ref).act
            if act is Act.UNREADABLE:
                self._oracle.delivered(ref, "unreadable")
            elif (act is Act.RETRIED) is not (outcome.kind == work.AGAIN):
                raise Violation(f"{ref} has the error of another task")
            else:
                self._oracle.delivered(ref, act)
        elif outcome != value_of(ref):
            raise Violation(f"{ref} has the result {outcome!r}")
        else:
            self._oracle.delivered(ref, Act.FINE)

    def end(self) -> None:
        """That was all."""
        if self._ended:
            raise Violation(f"job {self.account.number} ends twice")
        self._ended = True
        if self.call is None or self._master.ended_call(self.account):
            self._master.world.note("job %d is finished", self.account.number)
            self._oracle.finished(self.account.number)

    def abort(self, error: BaseException) -> None:
        """There will be no more."""
        if isinstance(error, StartError) and self._oracle.stillborn < 3:
            raise Violation("the pool gives up though workers can start")
        if isinstance(error, ValueError) and not self.account.broken:
            raise Violation(f"job {self.account.number} is aborted without a reason")
        if self.account.finished:
            raise Violation(f"job {self.account.number} is aborted after it was finished")
        self._master.world.note("job %d is aborted: %s", self.account.number, type(error).__name__)
        self.account.cancelled = True
