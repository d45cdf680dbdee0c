"""Arrays of one step of many environments: actions, observations, rewards, endings."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

import numpy as np
from gymnasium import Space

from fiber._hub import client, handles, heap
from fiber._hub.handles import BlockHandle
from fiber._hub.protocol import ObjectKind
from fiber.vector.columns import Allocate, Array, Carver, Rows, columns_of

Packed: TypeAlias = tuple[Any, Array | None, Array | None, Array | None]
"""Results to send: observations, rewards, terminations, truncations."""


class Shape(NamedTuple):
    """Spaces and numbers on which the arrays depend."""

    observation_space: Space[Any]
    """Observation space of one environment."""
    action_space: Space[Any]
    """Action space of one environment."""
    num_envs: int
    """Number of environments."""
    workers: int

    def size(self) -> int:
        """Bytes of shared memory that the arrays take."""
        carver = Carver()
        StepArrays(self, carver)
        return carver.size


class StepArrays:
    """Arrays of ``shape.num_envs`` environments, a row for each."""

    def __init__(self, shape: Shape, allocate: Allocate) -> None:
        self.actions = columns_of(shape.action_space, shape.num_envs, allocate)
        self.observations = columns_of(shape.observation_space, shape.num_envs, allocate)
        self.rewards = allocate((shape.num_envs,), np.float64)
        self.terminations = allocate((shape.num_envs,), np.bool_)
        self.truncations = allocate((shape.num_envs,), np.bool_)
        self.at_work = allocate((shape.workers,), np.int64)
        """Row that each worker is busy with, plus one; 0 if none.  It shows where a worker died."""

    @classmethod
    def private(cls, shape: Shape) -> StepArrays:
        """Return arrays of this process alone."""
        return cls(shape, np.zeros)

    @classmethod
    def of_memory(cls, shape: Shape, memory: memoryview) -> StepArrays:
        """Return arrays in memory that other processes share."""
        return cls(shape, Carver(memory))

    def part(self, first: int, count: int) -> StepArrays:
        """Return the arrays of ``count`` environments from ``first`` on, in the same memory."""
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
        """Store the results of a step of one environment."""
        self.observations.put(row, observation)
        self.rewards[row] = reward
        self.terminations[row] = terminated
        self.truncations[row] = truncated

    def pack(self, rows: Rows, *, shared: bool) -> Packed | None:
        """Return what must be sent of the results in ``rows``; None if nothing must.

        ``shared``: the receiver has the same arrays.
        """
        observations = self.observations.pack(rows, shared=shared)
        if shared:
            return None if observations is None else (observations, None, None, None)
        return observations, self.rewards[rows], self.terminations[rows], self.truncations[rows]

    def unpack(self, rows: Rows, packed: Packed | None) -> None:
        """Store the results that another process has packed."""
        if packed is None:
            return
        observations, rewards, terminations, truncations = packed
        self.observations.unpack(rows, observations)
        if rewards is not None:
            self.rewards[rows] = rewards
            self.terminations[rows] = terminations
            self.truncations[rows] = truncations


class SharedMemory:
    """Block of the heap that other processes of this host share."""

    def __init__(self, block: heap.Block) -> None:
        self._block = block
        self.view = block.view
        self.host = client.host()

    @classmethod
    def allocate(cls, size: int) -> SharedMemory:
        """Return memory of ``size`` bytes, all zero."""
        return cls(heap.allocate(size))

    def __reduce__(self) -> tuple[Any, ...]:
        return _attach, (handles.handle_for_block(ObjectKind.MEMORY, self._block),)


def _attach(handle: BlockHandle) -> SharedMemory:
    return SharedMemory(handle.block())
