"""What one step of many environments takes and gives: actions, observations, rewards, endings."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

import numpy as np
from gymnasium import Space

from fiber._hub import client, handles, heap
from fiber._hub.handles import BlockHandle
from fiber._hub.protocol import ObjectKind
from fiber.vector.columns import Allocate, Array, Carver, Rows, columns_of

Packed: TypeAlias = tuple[Any, Array | None, Array | None, Array | None]
"""What travels of results: observations, rewards, terminations, truncations."""


class Shape(NamedTuple):
    """What the arrays depend on."""

    observation_space: Space[Any]
    """Of one environment."""
    action_space: Space[Any]
    """Of one environment."""
    num_envs: int
    """How many environments."""
    workers: int

    def size(self) -> int:
        """Bytes of shared memory that the arrays take."""
        carver = Carver()
        StepArrays(self, carver)
        return carver.size


class StepArrays:
    """The arrays of ``shape.num_envs`` environments, a row for each."""

    def __init__(self, shape: Shape, allocate: Allocate) -> None:
        self.actions = columns_of(shape.action_space, shape.num_envs, allocate)
        self.observations = columns_of(shape.observation_space, shape.num_envs, allocate)
        self.rewards = allocate((shape.num_envs,), np.float64)
        self.terminations = allocate((shape.num_envs,), np.bool_)
        self.truncations = allocate((shape.num_envs,), np.bool_)
        self.at_work = allocate((shape.workers,), np.int64)
        """One more than the row that each worker is busy with; what tells it if the worker dies."""

    @classmethod
    def private(cls, shape: Shape) -> StepArrays:
        """Arrays of this process alone."""
        return cls(shape, np.zeros)

    @classmethod
    def of_memory(cls, shape: Shape, memory: memoryview) -> StepArrays:
        """Arrays in memory that others have, too."""
        return cls(shape, Carver(memory))

    def part(self, first: int, count: int) -> StepArrays:
        """Those of the environments from ``first`` on: the same memory."""
        part = object.__new__(StepArrays)
        part.actions = self.actions.part(first, count)
        part.observations = self.observations.part(first, count)
        rows = slice(first, first + count)
        part.rewards = self.rewards[rows]
        part.terminations = self.terminations[rows]
        part.truncations = self.truncations[rows]
        part.at_work = self.at_work
        return part

    def put(
        self, row: int, observation: Any, reward: Any, terminated: bool, truncated: bool
    ) -> None:
        """Note what a step of one environment gave."""
        self.observations.put(row, observation)
        self.rewards[row] = reward
        self.terminations[row] = terminated
        self.truncations[row] = truncated

    def pack(self, rows: Rows, *, shared: bool) -> Packed | None:
        """What travels of the results in ``rows``, to someone who has the same arrays if they are
        ``shared``; None if nothing has to.
        """
        observations = self.observations.pack(rows, shared=shared)
        if shared:
            return None if observations is None else (observations, None, None, None)
        return observations, self.rewards[rows], self.terminations[rows], self.truncations[rows]

    def unpack(self, rows: Rows, packed: Packed | None) -> None:
        """Set what another process has packed."""
        if packed is None:
            return
        observations, rewards, terminations, truncations = packed
        self.observations.unpack(rows, observations)
        if rewards is not None:
            self.rewards[rows] = rewards
            self.terminations[rows] = terminations
            self.truncations[rows] = truncations


class SharedMemory:
    """A block of the heap that goes to other processes of this host."""

    def __init__(self, block: heap.Block) -> None:
        self._block = block
        self.view = block.view
        self.host = client.host()

    @classmethod
    def allocate(cls, size: int) -> SharedMemory:
        """Memory of ``size`` bytes, all zero."""
        return cls(heap.allocate(size))

    def __reduce__(self) -> tuple[Any, ...]:
        return _attach, (handles.handle_for_block(ObjectKind.MEMORY, self._block),)


def _attach(handle: BlockHandle) -> SharedMemory:
    return SharedMemory(handle.block())
