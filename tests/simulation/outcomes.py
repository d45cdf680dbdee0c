"""Outcomes that the user of the real executor sees, reported to the oracle."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from fiber._runtime.answers import Pickled, TaskFailure
from fiber._runtime.work_items import WorkItem
from fiber._wire import work
from fiber.errors import StartError, TimeoutError, UnpicklableError, WorkerDied
from simulation.oracle import Account, Violation
from simulation.schedule import Act
from simulation.wire import value_of
from simulation.workers import Ref

if TYPE_CHECKING:
    from simulation.executor_master import ExecutorMaster
    from simulation.staged import Actor


HEARD = object()
"""Placeholder for an outcome that the oracle knows already."""


class BrokenInput(Exception):
    """Error that an iterable raises instead of its next item."""


class Outcomes:
    """Receiver of the outcomes of one job, or of one of its calls; a ``Future``."""

    def __init__(
        self,
        master: ExecutorMaster,
        account: Account,
        call: int | None = None,
        caller: Actor | None = None,
    ) -> None:
        self.account = account
        self.call = call
        self.item: WorkItem | None = None
        self.limit: int | None = None
        """Tasks that may be read and not consumed."""
        self.consumed = 0
        self._master = master
        self._oracle = master.world.oracle
        self._caller = caller
        """Waiting actor, if any."""
        self._ended = False

    def add_results(self, start: int, outcomes: list[Any], mixed: bool, size: int = 0) -> bool:
        """Outcomes of tasks from ``start`` on, which are sometimes unread for a while."""
        if not mixed and any(type(outcome) in (TaskFailure, Pickled) for outcome in outcomes):
            raise Violation(f"job {self.account.number} has results that are not plain")
        for index, outcome in enumerate(outcomes, start if self.call is None else self.call):
            self._put(Ref(self.account.number, index), outcome)
        if self.limit is not None:
            for _ in outcomes:
                self._master.consume_soon(self)
        return self.item is not None and self._master.holds_back(self.item)

    def has_room(self) -> bool:
        """The user has read enough of them."""
        return True

    def lift_bound(self) -> None:
        """The reader of the results waits for the rest."""
        self._master.waits_for_all(self.account)

    def _put(self, ref: Ref, outcome: Any) -> None:
        error = outcome.error if type(outcome) is TaskFailure else None
        if isinstance(error, BrokenInput):
            job = self.item.job if self.item is not None else None
            if job is None or ref.task != job.fed:
                raise Violation(f"the error of the input takes the place of {ref}")
        elif isinstance(error, WorkerDied):
            self._oracle.died(ref, error.attempts, error.disruptions)
        elif isinstance(error, TimeoutError):
            self._oracle.delivered(ref, "too late")
        elif error is not None:
            if self._master.world.task(ref).act is not Act.UNSENDABLE:
                raise Violation(f"{ref} cannot be sent: {error}")
            self._master.world.note("%s cannot be sent", ref)
            self._oracle.delivered(ref, "unsendable")
        elif type(outcome) is Pickled:
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

    def set_done(self) -> None:
        """Note the end of the outcomes."""
        self._end()
        if self.call is None or self._master.ended_call(self.account):
            self._master.world.note("job %d is finished", self.account.number)
            self._oracle.finished(self.account.number)

    def set_exception(self, error: BaseException) -> None:
        """Note that no more outcomes will come, because of an error."""
        account, number = self.account, self.account.number
        if not self._master.world.loop.on_thread():
            raise Violation(f"job {number} hears on another thread than the loop's that it is over")
        self._end()
        if self.call is not None and isinstance(error, UnpicklableError):
            self._reject(Ref(number, self.call), error)
            return
        late = isinstance(error, ValueError) and str(error) == "Pool not running"
        if late and not self._master.is_closing:
            raise Violation(f"job {number} is refused, though the pool is not closed")
        if isinstance(error, StartError) and not self._master.starved:
            raise Violation("the pool gives up though workers can start")
        if isinstance(error, ValueError) and not (late or account.broken):
            raise Violation(f"job {number} is aborted without a reason")
        if account.finished:
            raise Violation(f"job {number} is aborted after it was finished")
        if late and self.call is not None and not account.cancelled:
            self._master.world.note("call %d of job %d comes too late", self.call, number)
            self._master.refused_call(account, self.call)
        else:
            self._master.world.note("job %d is aborted: %s", number, type(error).__name__)
            account.cancelled = True

    def _reject(self, ref: Ref, error: BaseException) -> None:
        """A call does not pickle."""
        if ref.task < self.account.fed:  # else one before it came too late, and so did this one
            self._put(ref, TaskFailure(error))
        if self._master.ended_call(self.account):
            self._oracle.finished(self.account.number)

    def _end(self) -> None:
        if self._ended:
            raise Violation(f"job {self.account.number} ends twice")
        self._ended = True
        if self._caller is not None:
            self._caller.put(HEARD)

    def get(self) -> object:
        """Wait for the outcome as the caller, and report it to the oracle."""
        assert self._caller is not None
        return self._caller.get()

    def answered(self, outcome: Any) -> None:
        """Report that its worker has answered the caller itself."""
        self._put(Ref(self.account.number, self.call or 0), outcome)
        self._ended = True
        if self._master.ended_call(self.account):
            self._oracle.finished(self.account.number)

    def interrupted(self) -> None:
        """End the caller's wait."""
        self._oracle.delivered(Ref(self.account.number, self.call or 0), "interrupted")
        self._ended = True
        if self._master.ended_call(self.account):
            self._oracle.finished(self.account.number)
