"""Promises of a pool: compares the user's results with the true history of each task.

The oracle knows what no executor can know: when each simulated worker began and ended each task.
"""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING

from fiber._engine.tasks import Limits
from simulation.schedule import Act, Job, Schedule
from simulation.workers import NO_OP, Ref, Worker

if TYPE_CHECKING:
    from simulation.agents import Child


class Violation(AssertionError):
    """A promise was broken."""


def require(condition: bool, otherwise: str) -> None:
    """Violation unless ``condition`` holds."""
    if not condition:
        raise Violation(otherwise)


def limits_of(plan: Job) -> Limits:
    """Return how often a task of a job may run again; few disruptions, so that all are used up."""
    return Limits(plan.retries, 2 if plan.retries else 0)


class Account:
    """The truth about one job."""

    def __init__(self, number: int, plan: Job) -> None:
        self.number = number
        self.plan = plan
        self.fed = 0
        self.closed = False
        self.cancelled = False
        self.broken = False
        """True if the job's function does not unpickle."""
        self.refused = False
        """Not all of it could be asked for."""
        self.finished = False
        self.delivered = 0
        """Bits: one for each task whose result the user has got."""
        self.runs: dict[int, list[Worker]] = defaultdict(list)
        self.forgiven: dict[int, int] = defaultdict(int)
        """Runs of each task that ended in an error which the pool must retry."""
        self.charges: dict[int, int] = defaultdict(int)
        self.disruptions: dict[int, int] = defaultdict(int)

    @property
    def everything(self) -> int:
        """A bit for each task that was fed."""
        return (1 << self.fed) - 1


class Oracle:
    """Watches one run."""

    def __init__(self, schedule: Schedule) -> None:
        self.accounts = [Account(number, plan) for number, plan in enumerate(schedule.jobs)]
        self._left = schedule.left
        self._lost: set[Worker] = set()

    # True events

    def begins(self, ref: Ref, worker: Worker) -> None:
        """Note that ``worker`` begins a task, for the first time or after a run that was lost."""
        if ref == NO_OP or worker in self._lost:  # cut off: the master cannot know its result
            return
        account = self.accounts[ref.job]
        runs = account.runs[ref.task]
        living = sum(earlier not in self._lost for earlier in runs)
        if living > account.forgiven[ref.task]:
            raise Violation(f"{ref} runs again, though {runs[-1].name} was not lost")
        if runs and not account.plan.retries:
            raise Violation(f"{ref} runs again, though it has no retries")
        if account.plan.everywhere and not runs:
            others = (run for index in account.runs for run in account.runs[index])
            if worker in others:
                raise Violation(f"job {ref.job} runs twice on {worker.name}")
        runs.append(worker)

    def runs(self, ref: Ref) -> int:
        """Return how often a task was begun."""
        return 0 if ref == NO_OP else len(self.accounts[ref.job].runs[ref.task])

    def lost(self, worker: Worker) -> None:
        """The master knows, or believes, that a worker is gone."""
        self._lost.add(worker)
        if self._left is not None and worker.units > self._left:
            raise Violation(f"{worker.name} ran {worker.units} units, more than {self._left}")

    def stopped(self, worker: Worker, unread: int) -> None:
        """A worker obeys a request to stop."""
        if unread:
            raise Violation(f"{worker.name} is stopped with {unread} unread batches")

    # The user's view

    def fed(self, number: int, count: int) -> None:
        """The user gave ``count`` more tasks."""
        self.accounts[number].fed += count

    def delivered(self, ref: Ref, outcome: Act | str) -> None:
        """The user sees how a task ended."""
        account = self.accounts[ref.job]
        bit = 1 << ref.task
        if account.delivered & bit:
            raise Violation(f"{ref} is delivered twice")
        # Calls that could not be sent never were part of the job: their caller gets an error in any
        # case.
        if account.cancelled and outcome != "unsendable":
            raise Violation(f"{ref} is delivered, though its job was cancelled")
        if account.finished:
            raise Violation(f"{ref} is delivered after its job was finished")
        account.delivered |= bit
        if isinstance(outcome, Act) and not account.runs[ref.task]:
            raise Violation(f"{ref} has a result, but never ran")
        if outcome is Act.RETRIED and self._tries(account, ref) < account.plan.retries:
            raise Violation(f"{ref} fails, though it could have been tried again")

    def died(self, ref: Ref, deaths: int, disruptions: int) -> None:
        """Note that the user gets the error of a task that has lost its last worker."""
        account = self.accounts[ref.job]
        limits = limits_of(account.plan)
        used_up = deaths == limits.retries + 1, disruptions == limits.disruptions + 1
        if sum(used_up) != 1 or deaths > limits.retries + 1:
            raise Violation(f"{ref} is given up after {deaths}, {disruptions} of {limits}")
        if disruptions > limits.disruptions + 1:
            raise Violation(f"{ref} is given up after {disruptions} disruptions")
        if self._tries(account, ref) < deaths or account.disruptions[ref.task] < disruptions:
            raise Violation(f"{ref} is blamed for losses that it was no part of")
        self.delivered(ref, "died")

    def tried_again(self, ref: Ref) -> None:
        """A task is tried again after an error."""
        account = self.accounts[ref.job]
        account.forgiven[ref.task] += 1
        if self._tries(account, ref) > account.plan.retries:
            raise Violation(f"{ref} is tried again more than {account.plan.retries} times")

    def _tries(self, account: Account, ref: Ref) -> int:
        return account.forgiven[ref.task] + account.charges[ref.task]

    def closed(self, number: int) -> None:
        """The user has no more tasks for a job."""
        self.accounts[number].closed = True

    def finished(self, number: int) -> None:
        """Note that the user gets the end of a job."""
        account = self.accounts[number]
        if account.finished or account.cancelled:
            raise Violation(f"job {number} is finished twice or after it was cancelled")
        if not account.closed or account.delivered != account.everything:
            raise Violation(f"job {number} is finished before all of its tasks are")
        account.finished = True

    # Blame

    def blamed(self, child: Child, seq: int, offset: int, ref: Ref, disrupted: bool) -> None:
        """A task is charged for the end of the worker that held it."""
        if not child.agent.lost and not self._is_suspect(child.worker, seq, offset):
            raise Violation(f"{ref} is blamed for the end of {child.name}, which was not in it")
        account = self.accounts[ref.job]
        (account.disruptions if disrupted else account.charges)[ref.task] += 1

    def spared(self, child: Child, ref: Ref) -> None:
        """A task that a lost worker held is not charged."""
        if child.agent.lost and self.accounts[ref.job].plan.retries:
            return  # the worker's progress is unknown
        if child.worker.running == ref:
            raise Violation(f"{ref} is not blamed for the end of {child.name}, which was in it")

    @staticmethod
    def _is_suspect(worker: Worker, seq: int, offset: int) -> bool:
        if worker.has_lied:
            return True  # its true work was not reported
        if worker.work is None or worker.work.seq != seq:
            return False  # never read, or answered in full
        if worker.board is None or worker.board[0] != seq:
            return True  # it died before it noted anything
        return worker.board[1] <= offset < worker.board[1] + worker.work.stride

    # At the end

    def check_end(self) -> None:
        """Check the promises once no event is left."""
        for account in self.accounts:
            if not account.cancelled and not account.finished:
                missing = account.everything & ~account.delivered
                indexes = [index for index in range(account.fed) if missing >> index & 1]
                raise Violation(f"job {account.number} never ends; it waits for tasks {indexes}")
