"""Steps that the tests of the ledger are made of."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from fiber._engine.chunks import TaskPace
from fiber._engine.ledger import Ledger
from fiber._engine.tasks import Batch, Job, WorkerEntry


def known(seconds: float, largest: int = 10**4) -> TaskPace:
    pace = TaskPace()
    pace.observe(largest, seconds * largest)
    return pace


def ledger_with(workers: int, left: int | None = None) -> tuple[Ledger, list[WorkerEntry]]:
    ledger = Ledger()
    return ledger, [ledger.add(f"w{n}", 0.0, left) for n in range(workers)]


def job_of(ledger: Ledger, items: Sequence[Any], **options: Any) -> Job:
    job = ledger.open(**options)
    ledger.feed(job, items)
    ledger.close(job)
    return job


def assign_all(ledger: Ledger, now: float = 0.0) -> list[Batch]:
    batches = []
    while (batch := ledger.assign(now)) is not None:
        batches.append(batch)
    return batches


def answer(ledger: Ledger, batch: Batch, now: float = 0.0) -> list[int]:
    """The whole batch is done; returns the tasks whose results counted."""
    size = len(batch.items) - batch.received
    receipt = ledger.receive(
        batch.worker, batch.seq, batch.received, size, now, seconds=1e-3 * size
    )
    return list(range(receipt.start, receipt.start + receipt.size)) if receipt else []


def run_to_end(ledger: Ledger) -> list[int]:
    """Work everything off; returns the tasks in the order in which they were done."""
    done = []
    while batches := list(ledger.batches.values()) or assign_all(ledger):
        done += answer(ledger, batches[0])
        assign_all(ledger)
    return done
