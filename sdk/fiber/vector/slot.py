"""Environment in its worker, with its steps, its automatic resets and its replacement."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

from gymnasium import Env, Wrapper
from gymnasium.vector import AutoresetMode

from fiber.vector.arrays import StepArrays

MakeEnv: TypeAlias = Callable[[], Env[Any, Any]]


class Final(NamedTuple):
    """End of an episode whose environment was reset in the same step."""

    observation: Any
    info: dict[str, Any]


class Note(NamedTuple):
    """Result of a step or reset of one environment, without what is in the arrays."""

    row: int
    info: dict[str, Any]
    final: Final | None = None
    lost: str | None = None
    """Reason why the environment was replaced and its episode ended early."""


class Slot:
    """Environment, with the state of its autoreset.

    After ``lose``, the next step reports the episode of the lost environment as truncated.
    """

    def __init__(self, row: int, make: MakeEnv, mode: AutoresetMode) -> None:
        self.row = row
        self._make = make
        self.env = make()
        self._over = False
        self._lost: str | None = None
        self._step = {
            AutoresetMode.NEXT_STEP: self._step_or_reset,
            AutoresetMode.SAME_STEP: self._step_and_reset,
            AutoresetMode.DISABLED: self._step_only,
        }[mode]
        self._same_step = mode is AutoresetMode.SAME_STEP

    def step(self, action: Any, arrays: StepArrays) -> Note | None:
        """Make one step.  The note is None if there is nothing to report."""
        if self._lost is not None:
            return self._truncate(arrays)
        return self._step(action, arrays)

    def reset(
        self, arrays: StepArrays, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> Note | None:
        """Begin an episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        arrays.put(self.row, observation, 0.0, False, False)
        lost, self._lost = self._lost, None
        self._over = False
        return self._note(info, lost=lost)

    def call(self, name: str, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
        """Return the result of a method of the environment, or the value of an attribute."""
        attribute = self.env.get_wrapper_attr(name)
        return attribute(*args, **kwargs) if callable(attribute) else attribute

    def get_attr(self, name: str) -> Any:
        """Return an attribute of a wrapper or of the environment."""
        return self.env.get_wrapper_attr(name)

    def has_attr(self, name: str) -> bool:
        """Return whether a wrapper or the environment has an attribute."""
        return self.env.has_wrapper_attr(name)

    def set_wrapper_attr(self, name: str, value: Any) -> None:
        """Set an attribute where a wrapper or the environment has it."""
        self.env.set_wrapper_attr(name, value)

    def set_attr(self, name: str, value: Any) -> None:
        """Set an attribute of the outermost wrapper."""
        setattr(self.env, name, value)

    def is_wrapped(self, wrapper_class: type[Wrapper[Any, Any, Any, Any]]) -> bool:
        """Return whether a wrapper of this class is around the environment."""
        env = self.env
        while isinstance(env, Wrapper) and not isinstance(env, wrapper_class):
            env = env.env
        return isinstance(env, wrapper_class)

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def lose(self, why: str) -> None:
        """Note that the episode of the environment is lost."""
        self._lost = why

    def replace_env(self, why: str) -> None:
        """Replace the environment by a new one.  Its episode is lost."""
        try:
            self.env.close()
        except Exception:
            pass  # it had failed before
        self.env = self._make()
        self.lose(why)

    def _step_or_reset(self, action: Any, arrays: StepArrays) -> Note | None:
        if self._over:
            observation, info = self.env.reset()
            self._over = False
            arrays.put(self.row, observation, 0.0, False, False)
        else:
            observation, reward, terminated, truncated, info = self.env.step(action)
            self._over = bool(terminated or truncated)
            arrays.put(self.row, observation, reward, terminated, truncated)
        return self._note(info)

    def _step_and_reset(self, action: Any, arrays: StepArrays) -> Note | None:
        observation, reward, terminated, truncated, info = self.env.step(action)
        final = None
        if terminated or truncated:
            final = Final(observation, info)
            observation, info = self.env.reset()
        arrays.put(self.row, observation, reward, terminated, truncated)
        return self._note(info, final)

    def _step_only(self, action: Any, arrays: StepArrays) -> Note | None:
        assert not self._over, "its episode has ended, and autoreset is disabled: reset it first"
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._over = bool(terminated or truncated)
        arrays.put(self.row, observation, reward, terminated, truncated)
        return self._note(info)

    def _truncate(self, arrays: StepArrays) -> Note | None:
        """End the episode of a lost environment, with the last observation."""
        lost, last = self._lost, arrays.observations.get(self.row)
        if self._same_step:
            observation, info = self.env.reset()
            final = Final(last, {})
        else:
            observation, info, final = last, {}, None
            self._over = True
        arrays.put(self.row, observation, 0.0, False, True)
        self._lost = None
        return self._note(info, final, lost)

    def _note(
        self, info: dict[str, Any], final: Final | None = None, lost: str | None = None
    ) -> Note | None:
        for each in (info,) if final is None else (final.info, info):
            if not isinstance(each, Mapping):
                raise TypeError(f"an info is a dictionary, not {each!r}")
        return Note(self.row, info, final, lost) if info or final or lost else None
