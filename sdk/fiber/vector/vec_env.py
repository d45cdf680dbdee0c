"""``VecEnv``: stable-baselines3's vector environment, many environments to a Fiber process."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from copy import deepcopy
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.error import AlreadyPendingCallError, ClosedEnvironmentError, NoAsyncCallError
from gymnasium.vector import AutoresetMode
from stable_baselines3.common import vec_env

from fiber.resources import resources_of, with_resources
from fiber.vector.slot import MakeEnv, Note
from fiber.vector.sub_environments import SubEnvironments

Indices = int | Sequence[int] | None


class VecEnv(vec_env.VecEnv):
    """Vector environment whose environments are in Fiber processes: on this host, or on pods.

    It returns what stable-baselines3's ``DummyVecEnv`` of the same ``env_fns`` returns, for the
    same seeds and actions.  It replaces ``SubprocVecEnv``, also as ``vec_env_cls`` of
    ``make_vec_env``.

    * ``start_method``: as of ``fiber.get_context()``.
    * ``num_workers`` processes, by default ``fiber.cpu_count()``, share the environments.
    * ``shared_memory``: on one host actions and observations lie in memory that the processes
      share.  Other hosts get them in messages, one for each worker.
    * ``on_error`` and ``timeout`` are those of ``fiber.vector.VectorEnv``: an environment that was
      replaced reports the end of an episode, and ``info["restarted"]`` says why.
    """

    def __init__(
        self,
        env_fns: Sequence[MakeEnv],
        start_method: str | None = None,
        *,
        num_workers: int | None = None,
        shared_memory: bool = True,
        on_error: str = "raise",
        timeout: float | None = None,
    ) -> None:
        self.closed = True  # until the workers exist
        self.waiting = False
        self._sub_environments = SubEnvironments(
            [with_resources(partial(_make, make), resources_of(make)) for make in env_fns],
            owner=type(self).__name__,
            num_workers=num_workers,
            shared_memory=shared_memory,
            context=start_method,
            observation_mode="different",  # as in DummyVecEnv, the first space is used for all
            autoreset=AutoresetMode.SAME_STEP,
            on_error=on_error,
            timeout=timeout,
        )
        self._arrays = self._sub_environments.arrays
        self._dispatcher = self._sub_environments.dispatcher
        self.closed = False
        spaces = self._sub_environments.spaces
        super().__init__(len(env_fns), spaces.single_observation_space, spaces.single_action_space)
        self.metadata = self._sub_environments.metadata

    def reset(self) -> Any:
        """Reset all environments; return observations.  A step in progress is given up."""
        self._give_up()
        options = [each or None for each in self._options]
        self._dispatcher.reset(None, self._seeds, options)
        self._wait()
        self.reset_infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for number, note in self._dispatcher.notes():
            self.reset_infos[number] = _info(note, note.info)
        # Seeds and options are for one reset.
        self._reset_seeds()
        self._reset_options()
        return self._observations()

    def step_async(self, actions: Any) -> None:
        """Begin to step all environments.  ``step_wait`` returns the result."""
        self._check_open()
        if self.waiting:
            raise AlreadyPendingCallError("step_async() before the last one's step_wait()", "step")
        self._waited(lambda: self._sub_environments.step(None, actions, list, together=True))
        self.waiting = True

    def step_wait(
        self,
    ) -> tuple[Any, npt.NDArray[np.float32], npt.NDArray[np.bool_], list[dict[str, Any]]]:
        """Return observations, rewards, ends of episodes, and infos."""
        if not self.waiting:
            raise NoAsyncCallError("step_wait() without a step_async() before", "step")
        self._wait()
        self.waiting = False
        arrays = self._arrays
        dones = arrays.terminations | arrays.truncations
        cut_short = arrays.truncations & ~arrays.terminations
        notes = dict(self._dispatcher.notes())
        infos = []
        for number, truncated in enumerate(cut_short.tolist()):
            note = notes.get(number)
            info: dict[str, Any] = {}
            if note is not None:
                info = _info(note, note.final.info if note.final else note.info)
            info["TimeLimit.truncated"] = truncated
            if note is not None and note.final is not None:
                info["terminal_observation"] = note.final.observation
                self.reset_infos[number] = note.info
            elif dones[number]:
                self.reset_infos[number] = {}
            infos.append(info)
        return self._observations(), arrays.rewards.astype(np.float32), dones, infos

    def close(self) -> None:
        """Close the environments and end their processes."""
        if not self.closed:
            self._sub_environments.close(None)
            self.closed = True  # last: Ctrl-C may interrupt the close

    def __del__(self) -> None:
        if not getattr(self, "closed", True):
            self._sub_environments.discard()

    def get_images(self) -> Sequence[npt.NDArray[np.uint8] | None]:
        """Return a frame of each environment, if its render mode is rgb_array."""
        if self.render_mode != "rgb_array":
            warnings.warn(
                f"The render mode is {self.render_mode}, but images need `rgb_array`", stacklevel=2
            )
            return [None for _ in range(self.num_envs)]
        return self.env_method("render")

    def has_attr(self, attr_name: str) -> bool:
        """Return whether all environments have an attribute."""
        return all(self._call("has_attr", None, attr_name))

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Return an attribute of each environment, or of those of ``indices``."""
        return self._call("get_attr", indices, attr_name)

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Set an attribute of each environment, or of those of ``indices``."""
        self._call("set_attr", indices, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of each environment, or of those of ``indices``; return the results."""
        return self._call("call", indices, method_name, method_args, method_kwargs)

    def env_is_wrapped(
        self, wrapper_class: type[gymnasium.Wrapper[Any, Any, Any, Any]], indices: Indices = None
    ) -> list[bool]:
        """Return for each environment whether a wrapper of this class is around it."""
        return self._call("is_wrapped", indices, wrapper_class)

    def _call(self, method: str, indices: Indices, *arguments: Any) -> list[Any]:
        self._check_open()
        if self.waiting:
            raise AlreadyPendingCallError("a call before step_wait()", "step")
        # Negative indices count from the end.
        numbers = [range(self.num_envs)[index] for index in self._get_indices(indices)]
        self._dispatcher.call(numbers, method, [arguments] * len(numbers))
        results: list[Any] = self._waited(self._dispatcher.results)
        return results

    def _observations(self) -> Any:
        return deepcopy(self._arrays.observations.batch(slice(None)))

    def _wait(self) -> None:
        self._waited(self._dispatcher.wait)

    def _waited(self, wait: Callable[[], Any]) -> Any:
        """Return the result of ``wait``.  If it fails or is interrupted, give up the command."""
        try:
            return wait()
        except BaseException:
            self._give_up()
            raise

    def _give_up(self) -> None:
        self._check_open()
        self._dispatcher.abandon()
        self.waiting = False

    def _check_open(self) -> None:
        if self.closed:
            raise ClosedEnvironmentError(f"this {type(self).__name__} is closed")
        self._sub_environments.check_owner()


def _info(note: Note, info: dict[str, Any]) -> dict[str, Any]:
    return info if note.lost is None else info | {"restarted": note.lost}


def _make(make: Callable[[], Any]) -> gymnasium.Env[Any, Any]:
    """Make an environment, in its worker."""
    env: Any = make()
    if not isinstance(env, gymnasium.Env):
        # An environment of the old gym.  The import takes seconds, because it loads torch.
        from stable_baselines3.common.vec_env.patch_gym import _patch_env

        env = _patch_env(env)
    made: gymnasium.Env[Any, Any] = env
    return made
