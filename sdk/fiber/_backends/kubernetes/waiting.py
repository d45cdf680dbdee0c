"""Those that wait for a pod: told what for while they do, and not kept for ever."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from fiber._backends.agent_set import AgentSet
from fiber._backends.kubernetes.api import Api
from fiber._backends.kubernetes.problems import PoolName, failure, new_problems, overdue, summary
from fiber._backends.kubernetes.progress import Progress
from fiber._backends.output import Output
from fiber._transport.link import Timer
from fiber.errors import FiberError


class Waiting:
    """The children of one FiberPool that have no agent yet.  On the loop's thread.

    ``on_begin`` is called as somebody begins to wait while there is no agent at all.
    """

    def __init__(
        self,
        agents: AgentSet,
        output: Output,
        api: Api,
        timeout: float,
        *,
        on_begin: Callable[[], None],
    ) -> None:
        self.pool = PoolName("", "")
        """What they wait for, once that has a name."""
        self.status: Mapping[str, Any] = {}
        """The pool's, as it is now."""
        self.attached = False
        """Whether the pool is there, and this program its master."""
        self._output = output
        self._api = api
        self._agents = agents
        self._placement = agents.placement
        self._timeout = timeout
        self._on_begin = on_begin
        self._patience: Timer | None = None
        self._told_of_limit = False
        self._progress = Progress(agents.loop, output, self._describe)

    def stop(self) -> None:
        """Nobody waits any more."""
        self._progress.stop()
        self._wait_no_more()

    def _wait_no_more(self) -> None:
        if self._patience is not None:
            self._patience.cancel()
            self._patience = None

    def on_status(self, status: Mapping[str, Any]) -> None:
        """Say what is new in the pool's status, and end the wait if nobody will come."""
        before, self.status = self.status, status
        for problem in new_problems(self.pool, before, status):
            self._output.write("fiber", problem)
        error = failure(self.pool, status, len(self._placement.loads))
        if error is not None:
            self.refuse(error)

    def refuse(self, error: Exception) -> None:
        """Nobody is to wait any longer."""
        self._progress.stop()  # first: whoever is refused may write where its line stands
        if self._has_processes:
            # Whoever started it has gone on.  Pools raise it to their callers.
            self._output.write("fiber", str(error))
        self._agents.refuse_waiting(error)

    def look(self, most: int) -> None:
        """Somebody has come or gone; there are to be at most so many pods."""
        placement = self._placement
        alone = bool(placement.waiting) and not placement.loads
        known = self._agents.error or failure(self.pool, self.status, 0)
        if alone and known is not None:
            self.refuse(known)  # it was heard before they came
            return
        if self.pool.name:
            self._look_at_limit(most)
        # A pool works with the workers that it has: nobody waits for the others.
        if alone or (len(placement.loads) < most and self._has_processes):
            self._progress.start()
        else:
            self._progress.stop()
        if not alone:
            self._wait_no_more()
        elif self._patience is None:
            self._patience = self._agents.loop.call_later(self._timeout, self._give_up)
            self._on_begin()

    @property
    def _has_processes(self) -> bool:
        """Whether others than workers of pools wait: nobody else does what they are to do."""
        return not all(child.is_worker for child in self._placement.waiting)

    def _look_at_limit(self, most: int) -> None:
        """Processes for which there is no room in ``most`` pods until others end are spoken of,
        once: these may wait for them.
        """
        placement = self._placement
        too_many = placement.children + len(placement.waiting) > most * placement.slots
        if not too_many:
            self._told_of_limit = False
        elif not self._told_of_limit and self._has_processes:
            self._told_of_limit = True
            self._output.write(
                "fiber",
                f"{len(placement.waiting)} processes wait until others end: there are to be no "
                f"more than {most} pods with {placement.slots} processes each. Raise max_pods, for "
                "a pool of somebody else's its maxReplicas, or processes_per_pod",
            )

    def _give_up(self) -> None:
        self._patience = None
        if self.pool.name:
            self.refuse(overdue(self.pool, self.status, self._timeout, time.time()))
        else:
            self.refuse(
                FiberError(
                    f"no pod could be asked for within {self._timeout:g} s: {self._api_state()}. "
                    "Look with `kubectl get fiberpools` whether it answers, and whether its login "
                    "waits for somebody"
                )
            )

    def _describe(self) -> str:
        state = summary(self.status, time.time()) if self.attached else self._api_state()
        return f"waiting for pods: {state}"

    def _api_state(self) -> str:
        trouble = self._api.trouble
        if trouble is None:
            return f"the API server {self._api.server} has not answered yet"
        return f"the API server {self._api.server} is asked again and again: {trouble}"
