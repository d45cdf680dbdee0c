"""Spaces of many environments, and the arrays of one step: actions, observations, rewards, ends.

``Columns`` keep the values of one space, with a row for each environment.  Numbers, and arrays of
one shape, are rows of a NumPy array, which may be in memory that processes share.
Values without a fixed size (text, graphs, sequences, unknown spaces) are kept as objects, which
travel in messages. A Dict or Tuple is a tree of these.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, Protocol, TypeAlias, TypeVar, cast

import numpy as np
import numpy.typing as npt
from gymnasium import Space, spaces
from gymnasium.spaces.utils import is_space_dtype_shape_equiv
from gymnasium.vector.utils import batch_differing_spaces, batch_space

from fiber import reduction
from fiber._hub import client, handles, heap
from fiber._hub.handles import BlockHandle
from fiber._hub.protocol import ObjectKind

Array: TypeAlias = npt.NDArray[Any]
Rows: TypeAlias = Sequence[int] | slice
"""Rows of a column; a slice if they are adjacent."""

Allocate: TypeAlias = Callable[[tuple[int, ...], Any], Array]
"""Function that makes an array of a shape and type."""

ALIGNMENT = 64
"""Alignment of arrays in shared memory, in bytes: each begins in another line of the cache."""


class Columns(Protocol):
    """Interface of all kinds of columns."""

    def put(self, row: int, value: Any) -> None:
        """Set one environment's value."""

    def take_back(self, row: int) -> None:
        """Restore the value before the last ``put``, for all parts that might not pickle."""

    def get(self, row: int) -> Any:
        """Return the value of one environment, which later steps do not change."""

    def fits(self, batch: Any, count: int) -> bool:
        """Return whether ``fill`` takes this batch of ``count`` values without a conversion."""

    def fill(self, rows: Rows, batch: Any) -> None:
        """Set the values of many environments from a batch of them."""

    def batch(self, rows: Rows) -> Any:
        """Return the values of ``rows`` as Gymnasium batches them.

        They are views of the arrays if ``rows`` is a slice, else copies.
        """

    def pack(self, rows: Rows, *, shared: bool) -> Any:
        """Return the message by which another process gets these values.

        ``shared``: that process has the same arrays, so None stands for them.
        """

    def unpack(self, rows: Rows, packed: Any) -> None:
        """Set the values that another process has packed."""

    def part(self, first: int, count: int) -> Columns:
        """Return the columns of ``count`` environments from ``first`` on, in the same arrays."""


class ArrayColumn:
    """Numbers, or arrays of one shape."""

    def __init__(self, array: Array) -> None:
        self._array = array
        self._shape = array.shape[1:]
        # Views of single rows are made once: that takes as long as to write to one.
        self._views = list(array) if self._shape else None

    def put(self, row: int, value: Any) -> None:
        if not hasattr(value, "shape"):
            value = np.asarray(value)
        if value.shape != self._shape:
            raise ValueError(
                f"an observation has the shape {value.shape}, but its space has {self._shape}"
            )
        if self._views is None:
            self._array[row] = value
        else:
            self._views[row][...] = value

    def take_back(self, row: int) -> None:
        pass  # numbers are always pickled

    def get(self, row: int) -> Any:
        return self._array[row] if self._views is None else self._views[row].copy()

    def fits(self, batch: Any, count: int) -> bool:
        return (
            isinstance(batch, np.ndarray)
            and batch.dtype == self._array.dtype
            and batch.shape == (count, *self._shape)
        )

    def fill(self, rows: Rows, batch: Array) -> None:
        self._array[rows] = batch

    def batch(self, rows: Rows) -> Array:
        return self._array[rows]

    def pack(self, rows: Rows, *, shared: bool) -> Array | None:
        return None if shared else self._array[rows]

    def unpack(self, rows: Rows, packed: Array | None) -> None:
        if packed is not None:
            self._array[rows] = packed

    def part(self, first: int, count: int) -> ArrayColumn:
        return ArrayColumn(self._array[first : first + count])


class ObjectColumn:
    """Values of any kind."""

    def __init__(self, values: Array) -> None:
        self._values = values
        self._before = values.copy()

    def put(self, row: int, value: Any) -> None:
        if value is not self._values[row]:  # else the value is put again
            self._before[row] = self._values[row]
            self._values[row] = value

    def take_back(self, row: int) -> None:
        self._values[row] = self._before[row]

    def get(self, row: int) -> Any:
        return self._values[row]

    def fits(self, batch: Any, count: int) -> bool:
        return False  # objects must be sent in any case

    def fill(self, rows: Rows, batch: Iterable[Any]) -> None:
        numbers = range(len(self._values))[rows] if isinstance(rows, slice) else rows
        # One by one: NumPy would look into values that are sequences.
        for row, value in zip(numbers, batch, strict=True):
            self._values[row] = value

    def batch(self, rows: Rows) -> tuple[Any, ...]:
        return tuple(self._values[rows].tolist())

    def pack(self, rows: Rows, *, shared: bool) -> tuple[Any, ...]:
        return in_band(self.batch(rows))

    def unpack(self, rows: Rows, packed: tuple[Any, ...]) -> None:
        self.fill(rows, packed)

    def part(self, first: int, count: int) -> ObjectColumn:
        return ObjectColumn(self._values[first : first + count])


class DictColumns:
    """Dictionaries with the same keys."""

    def __init__(self, columns: dict[str, Columns]) -> None:
        self._columns = columns

    def put(self, row: int, value: Any) -> None:
        for key, column in self._columns.items():
            column.put(row, value[key])

    def take_back(self, row: int) -> None:
        for column in self._columns.values():
            column.take_back(row)

    def get(self, row: int) -> dict[str, Any]:
        return {key: column.get(row) for key, column in self._columns.items()}

    def fits(self, batch: Any, count: int) -> bool:
        return isinstance(batch, dict) and all(
            key in batch and column.fits(batch[key], count) for key, column in self._columns.items()
        )

    def fill(self, rows: Rows, batch: Any) -> None:
        for key, column in self._columns.items():
            column.fill(rows, batch[key])

    def batch(self, rows: Rows) -> dict[str, Any]:
        return {key: column.batch(rows) for key, column in self._columns.items()}

    def pack(self, rows: Rows, *, shared: bool) -> list[Any] | None:
        return _packed([column.pack(rows, shared=shared) for column in self._columns.values()])

    def unpack(self, rows: Rows, packed: list[Any] | None) -> None:
        if packed is not None:
            for column, part in zip(self._columns.values(), packed, strict=True):
                column.unpack(rows, part)

    def part(self, first: int, count: int) -> DictColumns:
        return DictColumns({key: part.part(first, count) for key, part in self._columns.items()})


class TupleColumns:
    """Tuples of the same length."""

    def __init__(self, columns: Sequence[Columns]) -> None:
        self._columns = columns

    def put(self, row: int, value: Any) -> None:
        for column, part in zip(self._columns, value, strict=True):
            column.put(row, part)

    def take_back(self, row: int) -> None:
        for column in self._columns:
            column.take_back(row)

    def get(self, row: int) -> tuple[Any, ...]:
        return tuple(column.get(row) for column in self._columns)

    def fits(self, batch: Any, count: int) -> bool:
        return (
            isinstance(batch, tuple)
            and len(batch) == len(self._columns)
            and all(
                column.fits(part, count) for column, part in zip(self._columns, batch, strict=True)
            )
        )

    def fill(self, rows: Rows, batch: Any) -> None:
        for column, part in zip(self._columns, batch, strict=True):
            column.fill(rows, part)

    def batch(self, rows: Rows) -> tuple[Any, ...]:
        return tuple(column.batch(rows) for column in self._columns)

    def pack(self, rows: Rows, *, shared: bool) -> list[Any] | None:
        return _packed([column.pack(rows, shared=shared) for column in self._columns])

    def unpack(self, rows: Rows, packed: list[Any] | None) -> None:
        if packed is not None:
            for column, part in zip(self._columns, packed, strict=True):
                column.unpack(rows, part)

    def part(self, first: int, count: int) -> TupleColumns:
        return TupleColumns([column.part(first, count) for column in self._columns])


def columns_of(space: Space[Any], count: int, allocate: Allocate) -> Columns:
    """Return columns for ``count`` values of a space."""
    if isinstance(space, spaces.Dict):
        return DictColumns(
            {key: columns_of(part, count, allocate) for key, part in space.spaces.items()}
        )
    if isinstance(space, spaces.Tuple):
        return TupleColumns([columns_of(part, count, allocate) for part in space.spaces])
    if isinstance(space, spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary):
        return ArrayColumn(allocate((count, *(space.shape or ())), space.dtype))
    return ObjectColumn(np.empty(count, object))


class Carver:
    """Allocator of arrays in given memory.  Without memory it only adds up their sizes."""

    def __init__(self, memory: memoryview | None = None) -> None:
        self._memory = memory
        self.size = 0

    def __call__(self, shape: tuple[int, ...], dtype: Any) -> Array:
        """Return the next array."""
        length = int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
        begin, self.size = self.size, self.size + -(-length // ALIGNMENT) * ALIGNMENT
        if self._memory is None:
            # All elements share one place, so this takes no memory.
            return np.broadcast_to(np.zeros((), dtype), shape)
        return np.ndarray(shape, dtype, self._memory[begin : begin + length])


def _packed(parts: list[Any]) -> list[Any] | None:
    return None if all(part is None for part in parts) else parts


_Value = TypeVar("_Value")


class _InBand:
    def __init__(self, value: Any) -> None:
        self._value = value

    def __reduce__(self) -> tuple[Any, ...]:
        return pickle.loads, (reduction.dumps(self._value, protocol=5),)


def in_band(value: _Value) -> _Value:
    """Return a stand-in for ``value`` in a message.  The receiver gets its own copy of the arrays.

    Otherwise large arrays lie beside the pickle, and the learner reads them where the worker wrote
    them (``Connection._recv_pickled``).  That is right for arrays that the learner copies at once,
    and wrong for values that its user may keep.
    """
    return cast(_Value, _InBand(value))


Packed: TypeAlias = tuple[Any, Array | None, Array | None, Array | None]
"""Results to send: observations, rewards, terminations, truncations."""


class ArrayLayout(NamedTuple):
    """Spaces and numbers that determine the arrays."""

    observation_space: Space[Any]
    """Observation space of one environment."""
    action_space: Space[Any]
    """Action space of one environment."""
    num_envs: int
    """Number of environments."""
    workers: int
    """Number of workers."""

    def size(self) -> int:
        """Bytes of shared memory that the arrays take."""
        carver = Carver()
        StepArrays(self, carver)
        return carver.size


class StepArrays:
    """Arrays of ``shape.num_envs`` environments, a row for each."""

    def __init__(self, shape: ArrayLayout, allocate: Allocate) -> None:
        self.actions = columns_of(shape.action_space, shape.num_envs, allocate)
        self.observations = columns_of(shape.observation_space, shape.num_envs, allocate)
        self.rewards = allocate((shape.num_envs,), np.float64)
        self.terminations = allocate((shape.num_envs,), np.bool_)
        self.truncations = allocate((shape.num_envs,), np.bool_)
        self.at_work = allocate((shape.workers,), np.int64)
        """Row that each worker is busy with, plus one; 0 if none.  It names a dead worker's row."""

    @classmethod
    def private(cls, shape: ArrayLayout) -> StepArrays:
        """Return arrays of this process alone."""
        return cls(shape, np.zeros)

    @classmethod
    def of_memory(cls, shape: ArrayLayout, memory: memoryview) -> StepArrays:
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
        if reward is None:  # NumPy would store it as NaN
            raise TypeError("a reward is a number, not None")
        self.observations.put(row, observation)
        self.rewards[row] = reward
        self.terminations[row] = terminated
        self.truncations[row] = truncated

    def pack(self, rows: Rows, *, shared: bool) -> Packed | None:
        """Return the message with the results in ``rows``; None if none is needed.

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


class ArrayMemory:
    """Block of the heap that other processes of this host share."""

    def __init__(self, block: heap.Block) -> None:
        self._block = block
        self.view = block.view
        self.host = client.host()

    @classmethod
    def allocate(cls, size: int) -> ArrayMemory:
        """Return memory of ``size`` bytes, all zero."""
        return cls(heap.allocate(size))

    def __reduce__(self) -> tuple[Any, ...]:
        return _attach, (handles.handle_for_block(ObjectKind.MEMORY, self._block),)


def _attach(handle: BlockHandle) -> ArrayMemory:
    return ArrayMemory(handle.block())


_NOT_EQUIVALENT = (
    "the sub-environments observation spaces are not equivalent. {}. If this is intentional, use "
    "`observation_mode='different'` instead."
)
_NOT_ALIKE = (
    "the sub-environments observation spaces do not share a common shape and dtype, which one "
    "batch of them needs. {}."
)

ObservationMode: TypeAlias = str | tuple[Space[Any], Space[Any]]
"""``same``, ``different``, or the space of a batch and that of one environment."""


class Spaces(NamedTuple):
    """Spaces by their names in ``gymnasium.vector.VectorEnv``."""

    single_observation_space: Space[Any]
    observation_space: Space[Any]
    single_action_space: Space[Any]
    action_space: Space[Any]

    @classmethod
    def of(
        cls,
        pairs: Sequence[tuple[Space[Any], Space[Any]]],
        mode: ObservationMode,
        name: Callable[[int], str],
    ) -> Spaces:
        """Batch the observation and action space of each environment.

        RuntimeError: the spaces differ too much.  ``name`` returns the name of an environment for
        the message.
        """
        observations, actions = zip(*pairs, strict=True)
        single = mode[1] if isinstance(mode, tuple) else observations[0]
        equivalent = _equal if mode == "same" else _alike
        for number, (observation, action) in enumerate(pairs):
            # The spaces of one worker are often one object.
            if observation is not single and not equivalent(observation, single):
                differs = f"{name(number)}, has {observation}, not {single}"
                message = _NOT_EQUIVALENT if mode == "same" else _NOT_ALIKE
                raise RuntimeError(message.format(differs))
            if action is not actions[0] and action != actions[0]:
                raise RuntimeError(
                    "the sub-environments action spaces are not equivalent, but one batch of "
                    f"actions is for all. {name(number)}, has {action}, not {actions[0]}"
                )
        batch = _batch_space(observations, mode)
        return cls(single, batch, actions[0], batch_space(actions[0], len(actions)))


def check_mode(mode: ObservationMode) -> None:
    """Raise TypeError or ValueError if there is no such mode."""
    if isinstance(mode, tuple):
        kinds = [type(part) for part in mode]
        if not all(issubclass(kind, Space) for kind in kinds):
            raise TypeError(f"Expected both elements of observation_mode to be Spaces, got {kinds}")
    elif mode not in ("same", "different"):
        raise ValueError(
            "Invalid `observation_mode`, expected: 'same' or 'different' or tuple of single and "
            f"batch observation space, actual got {mode}"
        )


def _batch_space(observations: Sequence[Space[Any]], mode: ObservationMode) -> Space[Any]:
    if isinstance(mode, tuple):
        return mode[0]
    first = observations[0]
    # Equal spaces of any kind can be batched; in the mode "same" they are equal.
    if mode == "same" or all(each is first or each == first for each in observations):
        return batch_space(first, len(observations))
    return batch_differing_spaces(list(observations))


def _equal(one: Space[Any], other: Space[Any]) -> bool:
    return one == other


def _alike(one: Space[Any], other: Space[Any]) -> bool:
    # Gymnasium compares the shapes of its own classes only.
    return one == other or is_space_dtype_shape_equiv(one, other)
