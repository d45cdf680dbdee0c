"""Creating pods: carefully at first, then many at a time, and never one twice."""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Callable
from dataclasses import dataclass, field

from fiber_api import names
from fiber_operator.cluster import (
    PODS,
    ApiError,
    Body,
    Cluster,
    Conflict,
    Invalid,
    Refused,
    TooMany,
    Unavailable,
)

Draw = Callable[[], str]
ENOUGH = 1.0
"""Seconds after which no further batch begins, so that the status is not out of date for long."""


def draw_suffix() -> str:
    """What makes a pod's name unique."""
    return secrets.token_hex(names.POD_SUFFIX_LENGTH // 2)


@dataclass
class Pace:
    """How it went with a pool so far, for the next batch."""

    batch: int = 1
    """How many may be created at once."""
    unsure: list[str] = field(default_factory=list)
    """Names of pods of which it is not known whether they were created.  They are used first: one
    that exists after all is refused as a duplicate, so none is created twice."""


@dataclass
class Created:
    """What came of it."""

    names: list[str] = field(default_factory=list)
    refusal: ApiError | None = None
    """403 or 422: the first one."""
    failure: ApiError | None = None
    """What else went wrong: the first one."""
    wait: float = 0.0
    """Seconds that the API server asked to wait."""


class Creator:
    """Creates pods in batches of 1, 2, 4 ... up to a limit."""

    def __init__(self, cluster: Cluster, draw: Draw = draw_suffix) -> None:
        self._cluster = cluster
        self._draw = draw

    async def create(
        self,
        pool: str,
        namespace: str,
        body: Callable[[str], Body],
        count: int,
        limit: int,
        pace: Pace,
        *,
        enough: float = ENOUGH,
    ) -> Created:
        """Create up to ``count`` pods, ``body(name)`` each.

        A batch in which anything fails is the last, and the next time begins with one pod.  Fewer
        than ``count`` without any failure means that it took ``enough`` seconds: come back soon.
        """
        done = Created()
        clock = asyncio.get_running_loop().time
        started = clock()
        while count > 0 and (not done.names or clock() - started < enough):
            size = min(pace.batch, limit, count)
            chosen = [pace.unsure.pop(0) if pace.unsure else self.name(pool) for _ in range(size)]
            results = await asyncio.gather(
                *(self._cluster.create(PODS, namespace, body(name)) for name in chosen),
                return_exceptions=True,
            )
            for name, result in zip(chosen, results, strict=True):
                _sort(name, result, done, pace)
            for result in results:
                if isinstance(result, BaseException) and not isinstance(result, ApiError):
                    raise result
            if done.refusal or done.failure:
                pace.batch = 1
                break
            count -= size
            pace.batch = min(2 * size, limit) if count else 1
        return done

    def name(self, pool: str) -> str:
        """The name of a pod that never was."""
        return names.pod_name(pool, self._draw())


def _sort(name: str, result: Body | BaseException, done: Created, pace: Pace) -> None:
    if isinstance(result, dict):
        done.names.append(name)
    elif isinstance(result, Refused | Invalid):
        done.refusal = done.refusal or result
    elif isinstance(result, Conflict) and result.reason == "AlreadyExists":
        done.names.append(name)  # it was created before, and the answer was lost
    elif isinstance(result, ApiError):
        if isinstance(result, TooMany):
            done.wait = max(done.wait, result.retry_after)
        elif isinstance(result, Unavailable):
            pace.unsure.append(name)
        done.failure = done.failure or result
