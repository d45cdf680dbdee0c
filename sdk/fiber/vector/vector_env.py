"""``VectorEnv``: Gymnasium's vector environment, many environments to a Fiber process.

``make_vec`` makes one by the id of an environment in Gymnasium's registry.
"""

from __future__ import annotations

import contextlib
import operator
from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from functools import partial
from typing import Any, TypeAlias, TypeVar

import gymnasium
import gymnasium.vector
import numpy as np
import numpy.typing as npt
from gymnasium import logger
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import AlreadyPendingCallError, ClosedEnvironmentError, NoAsyncCallError
from gymnasium.vector import AutoresetMode
from gymnasium.vector.async_vector_env import AsyncState
from gymnasium.vector.utils import iterate

from fiber.vector.arrays import ObservationMode
from fiber.vector.slot import MakeEnv, Note
from fiber.vector.sub_environments import SubEnvironments

_Result = TypeVar("_Result")

Numbers: TypeAlias = npt.NDArray[np.int64]
Step: TypeAlias = tuple[
    Any, npt.NDArray[np.float64], npt.NDArray[np.bool_], npt.NDArray[np.bool_], dict[str, Any]
]
"""Observations, rewards, terminations, truncations, infos."""


class VectorEnv(gymnasium.vector.VectorEnv[Any, Any, npt.NDArray[Any]]):
    """Vector environment whose environments are in Fiber processes: on this host, or on pods.

    It returns what Gymnasium's ``SyncVectorEnv`` of the same ``env_fns`` returns, for the same
    seeds and actions.  It has the methods of ``AsyncVectorEnv``, such as ``step_async``.  With
    ``send`` and ``recv`` a learner does not wait for the slowest environment.

    * ``num_workers`` processes, by default ``fiber.cpu_count()``, share the environments.
    * ``shared_memory``: on one host actions and observations lie in memory that the processes
      share.  Other hosts get them in messages, one for each worker.
    * ``copy``: observations are the caller's.  Otherwise the next step overwrites them.
    * On Kubernetes a worker's pod has the resources that ``fiber.meta`` sets for its ``env_fns``:
      of each resource the most that one of them asks for.
    * ``context`` is a start method, as of ``fiber.get_context()``.
    * ``observation_mode`` and ``autoreset_mode`` are ``AsyncVectorEnv``'s.
    * ``on_error="restart"``: an environment that raises, takes longer than ``timeout`` or whose
      worker dies is replaced, with a RuntimeWarning, and the others' step goes on.  Its episode is
      reported as truncated, with reward 0 and ``infos["restarted"]`` saying why, and goes on as
      after any end of an episode.  By default the error is raised: it is what the environment
      raised, ``WorkerDied`` or ``multiprocessing.TimeoutError``, and names the environment and its
      worker.  Environments whose pod the cluster ends, by a drain for instance, are replaced on
      another one in either case, at most ``disruptions`` times in a row (``fiber.init``).
    * ``timeout``: seconds that the making, a step or a reset of one environment may take.  It is
      kept by an alarm in the worker (SIGALRM).  If native code blocks the interpreter in a step or
      a reset, the worker is killed a little later.  The making is waited for without a limit
      then.
    """

    def __init__(
        self,
        env_fns: Sequence[MakeEnv],
        *,
        num_workers: int | None = None,
        shared_memory: bool = True,
        copy: bool = True,
        context: str | None = None,
        observation_mode: ObservationMode = "same",
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        on_error: str = "raise",
        timeout: float | None = None,
    ) -> None:
        self.closed = True  # until the workers exist
        self.copy = copy
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self._sub_environments = sub_environments = SubEnvironments(
            env_fns,
            owner=type(self).__name__,
            num_workers=num_workers,
            shared_memory=shared_memory,
            context=context,
            observation_mode=observation_mode,
            autoreset=self.autoreset_mode,
            on_error=on_error,
            timeout=timeout,
        )
        self.num_envs = len(env_fns)
        self.metadata = sub_environments.metadata | {"autoreset_mode": self.autoreset_mode}
        self.render_mode = sub_environments.render_mode
        self.single_observation_space = sub_environments.spaces.single_observation_space
        self.observation_space = sub_environments.spaces.observation_space
        self.single_action_space = sub_environments.spaces.single_action_space
        self.action_space = sub_environments.spaces.action_space
        self._arrays = sub_environments.arrays
        self._dispatcher = sub_environments.dispatcher
        self._state = AsyncState.DEFAULT
        self._received: Sequence[int] | None = None
        """Environments of the last ``recv``; None for all."""
        self.closed = False

    # Gymnasium's interface

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """Seed of each environment."""
        return self.get_attr("np_random_seed")

    @property  # type: ignore[misc]  # it cannot be set here, as in AsyncVectorEnv
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """Copy of each environment's generator."""
        return self.get_attr("np_random")

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Reset all environments, or those of ``options["reset_mask"]``.

        Return observations and infos.  If ``seed`` is a number, the first environment gets it, and
        each next environment gets one more.
        """
        with self._given_up_if_interrupted():
            self.reset_async(seed, options)
            return self.reset_wait()

    def reset_async(
        self,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> None:
        """Begin to reset.  ``reset_wait`` or ``recv`` returns the result."""
        self._check_idle("reset_async")
        seeds = self._seeds(seed)
        mask, options = _without_mask(options, self.num_envs)
        numbers = None if mask is None else np.flatnonzero(mask).tolist()
        if numbers is not None:
            seeds = [seeds[number] for number in numbers]
        with self._given_up_if_interrupted():
            self._dispatcher.reset(numbers, seeds, [options] * len(seeds))
            self._state = AsyncState.WAITING_RESET

    def reset_wait(self, timeout: float | None = None) -> tuple[Any, dict[str, Any]]:
        """Return the result of ``reset``; TimeoutError after ``timeout`` seconds."""
        self._finish(AsyncState.WAITING_RESET, timeout)
        return self._observations(), self._infos(self._dispatcher.notes())

    def step(self, actions: Any) -> Step:
        """Step all environments; return observations, rewards, terminations, truncations, infos.

        After an interruption (Ctrl-C), the results of the step are dropped.
        """
        with self._given_up_if_interrupted():
            self.step_async(actions)
            return self.step_wait()

    def step_async(self, actions: Any) -> None:
        """Begin to step.  ``step_wait`` returns the result."""
        self._check_idle("step_async")
        with self._given_up_if_interrupted():
            self._sub_environments.step(None, actions, self._each_action, together=True)
            self._state = AsyncState.WAITING_STEP

    def step_wait(self, timeout: float | None = None) -> Step:
        """Return the result of ``step``; TimeoutError after ``timeout`` seconds."""
        self._finish(AsyncState.WAITING_STEP, timeout)
        arrays = self._arrays
        return (
            self._observations(),
            arrays.rewards.copy(),
            arrays.terminations.copy(),
            arrays.truncations.copy(),
            self._infos(self._dispatcher.notes()),
        )

    # Environments that are ready first

    def send(self, actions: Any, env_ids: Sequence[int] | Numbers | None = None) -> None:
        """Begin to step the environments ``env_ids``, with one action for each.

        The default is those of the last ``recv``, or all after ``reset`` or ``step``.
        """
        self._check_running()
        numbers = self._chosen(env_ids)
        with self._given_up_if_interrupted():
            self._sub_environments.step(numbers, actions, self._each_action, together=False)

    def recv(self, batch_size: int | None = None, timeout: float | None = None) -> Step:
        """Return the results of ``step`` of the ``batch_size`` environments that are ready first.

        ``infos["env_id"]`` has their numbers.  All arrays have their rows in the same order.  By
        default it waits for all environments that are stepping or resetting.  TimeoutError after
        ``timeout`` seconds: no result is lost, and the next ``recv`` continues.
        """
        self._check_running()
        under_way = self._dispatcher.under_way()
        count = under_way if batch_size is None else batch_size
        if not 0 < count <= under_way:
            raise ValueError(
                f"recv({batch_size}) would wait for ever: {under_way} environments are stepping or "
                "resetting, or were not received yet. Call reset_async() or send() first"
            )
        self._state = AsyncState.DEFAULT
        with self._given_up_if_interrupted():
            numbers = self._dispatcher.wait_for(count, timeout)
        self._received = numbers
        arrays = self._arrays
        infos = self._infos(self._dispatcher.notes(numbers), numbers)
        return (
            arrays.observations.batch(numbers),
            arrays.rewards[numbers],
            arrays.terminations[numbers],
            arrays.truncations[numbers],
            infos | {"env_id": np.array(numbers)},
        )

    # Calls

    def render(self) -> tuple[Any, ...]:
        """Return a frame of each environment."""
        return self.call("render")

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call a method of each environment, or read an attribute; return the results."""
        with self._given_up_if_interrupted():
            self.call_async(name, *args, **kwargs)
            return self.call_wait()

    def call_async(self, name: str, /, *args: Any, **kwargs: Any) -> None:
        """Begin a call.  ``call_wait`` returns the results."""
        self._check_idle("call_async")
        if name in ("reset", "step", "close"):
            raise ValueError(f"call {name}() of the vector environment, not of each environment")
        self._call("call", [(name, args, kwargs)] * self.num_envs)

    def call_wait(self, timeout: float | None = None) -> tuple[Any, ...]:
        """Return the results of ``call``; TimeoutError after ``timeout`` seconds."""
        self._check_waiting(AsyncState.WAITING_CALL)
        return tuple(self._awaited(lambda: self._dispatcher.results(timeout)))

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Return an attribute of each environment."""
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute: a list or tuple has a value for each environment."""
        self._check_idle("set_attr")
        if not isinstance(values, list | tuple):
            values = [values] * self.num_envs
        if len(values) != self.num_envs:
            raise ValueError(
                "Values must be a list or tuple with length equal to the number of environments. "
                f"Got `{len(values)}` values for {self.num_envs} environments."
            )
        with self._given_up_if_interrupted():
            self._call("set_wrapper_attr", [(name, value) for value in values])
            self.call_wait()

    def close_extras(self, timeout: float | None = None, terminate: bool = False) -> None:
        """Close the environments and end their processes.

        Processes that have not ended after ``timeout`` seconds are killed.  ``terminate``: kill all
        at once.
        """
        state = self._state
        if state is not AsyncState.DEFAULT:
            logger.warn(
                f"Calling `close` while waiting for a pending call to `{state.value}` to complete."
            )
        self._sub_environments.close(0 if terminate else timeout)

    def __del__(self) -> None:
        # Without them, ``__init__`` has raised.
        if not self.closed and hasattr(self, "_sub_environments"):
            self._sub_environments.discard()

    # Parts of all of them

    def _call(self, method: str, arguments: Sequence[tuple[Any, ...]]) -> None:
        with self._given_up_if_interrupted():
            self._dispatcher.call(range(self.num_envs), method, arguments)
            self._state = AsyncState.WAITING_CALL

    def _each_action(self, actions: Any) -> list[Any]:
        return list(iterate(self.action_space, actions))

    def _observations(self) -> Any:
        batch = self._arrays.observations.batch(slice(None))
        return deepcopy(batch) if self.copy else batch

    def _infos(
        self, notes: Sequence[tuple[int, Note]], numbers: Sequence[int] | None = None
    ) -> dict[str, Any]:
        """Return the infos of environments as Gymnasium has them, a row for each of ``numbers``."""
        infos: dict[str, Any] = {}
        if not notes:
            return infos
        batch: gymnasium.vector.VectorEnv[Any, Any, Any] = self
        if numbers is not None:
            batch = gymnasium.vector.VectorEnv()
            batch.num_envs = len(numbers)
        order = range(self.num_envs) if numbers is None else numbers
        rows = {number: row for row, number in enumerate(order)}
        for number, note in notes:
            try:
                infos = _with_note(batch, infos, note, rows[number])
            except Exception as error:  # infos of one name and different types
                error.add_note(f"an info of {self._dispatcher.name(number)}")
                raise
        return infos

    def _seeds(self, seed: int | Sequence[int | None] | None) -> Sequence[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, int | np.integer):
            return [int(seed) + number for number in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise ValueError(
                "If seeds are passed as a list the length must match "
                f"num_envs={self.num_envs} but got length={len(seed)}."
            )
        return seed

    def _chosen(self, env_ids: Sequence[int] | Numbers | None) -> Sequence[int]:
        if env_ids is None:
            numbers = range(self.num_envs) if self._received is None else self._received
        else:
            numbers = [operator.index(number) for number in env_ids]
        odd = [number for number in numbers if not 0 <= number < self.num_envs]
        if odd or len(set(numbers)) != len(numbers):
            raise ValueError(
                f"env_ids has {odd[0]}, and environments are 0 to {self.num_envs - 1}"
                if odd
                else "env_ids has an environment twice"
            )
        busy = self._dispatcher.busy(numbers)
        if busy is not None:
            raise AlreadyPendingCallError(
                f"environment {busy} has a command whose result was not received yet: send its "
                "next action once recv() has returned it",
                "send",
            )
        return numbers

    def _check_running(self) -> None:
        if self.closed:
            raise ClosedEnvironmentError(f"this {type(self).__name__} is closed")
        self._sub_environments.check_owner()

    # The messages of these two are Gymnasium's: its tests check the words.

    def _check_idle(self, doing: str) -> None:
        self._check_running()
        pending = "" if self._state is AsyncState.DEFAULT else str(self._state.value)
        if not pending and self._dispatcher.under_way():
            pending = "send"
        if pending:
            raise AlreadyPendingCallError(
                f"Calling `{doing}` while waiting for a pending call to `{pending}` to complete.",
                pending,
            )

    def _check_waiting(self, state: AsyncState) -> None:
        self._check_running()
        if self._state is not state:
            raise NoAsyncCallError(
                f"Calling `{state.value}_wait` without any prior call to `{state.value}_async`.",
                str(state.value),
            )

    def _finish(self, state: AsyncState, timeout: float | None) -> None:
        self._check_waiting(state)
        self._awaited(lambda: self._dispatcher.wait(timeout))
        self._received = None

    def _awaited(self, wait: Callable[[], _Result]) -> _Result:
        """Return the result of ``wait``.  If it fails, the command is given up."""
        try:
            result = wait()
        except BaseException:
            self._give_up()
            raise
        self._state = AsyncState.DEFAULT
        return result

    @contextlib.contextmanager
    def _given_up_if_interrupted(self) -> Iterator[None]:
        """Give up the command if the block is interrupted, since its state is unknown then."""
        try:
            yield
        except (KeyboardInterrupt, SystemExit):
            self._give_up()
            raise

    def _give_up(self) -> None:
        self._dispatcher.abandon()
        self._state = AsyncState.DEFAULT


def _with_note(
    batch: gymnasium.vector.VectorEnv[Any, Any, Any], infos: dict[str, Any], note: Note, row: int
) -> dict[str, Any]:
    """Return the infos of a batch with those of one more environment, in its row."""
    if note.final is not None:
        ending = {"final_obs": note.final.observation, "final_info": note.final.info}
        infos = batch._add_info(infos, ending, row)
    if note.lost is not None:
        infos = batch._add_info(infos, {"restarted": note.lost}, row)
    return batch._add_info(infos, note.info, row)


def _without_mask(
    options: dict[str, Any] | None, count: int
) -> tuple[npt.NDArray[np.bool_] | None, dict[str, Any] | None]:
    """Return ``options["reset_mask"]``, and the options without it."""
    if options is None or "reset_mask" not in options:
        return None, options
    mask = options["reset_mask"]
    # The words are Gymnasium's: its tests check them.
    if not isinstance(mask, np.ndarray):
        raise TypeError(f"`options['reset_mask']` must be a numpy array, got {type(mask)}")
    if mask.shape != (count,):
        raise ValueError(f"`options['reset_mask']` must have shape `({count},)`, got {mask.shape}")
    if mask.dtype != np.bool_:
        raise TypeError(f"`options['reset_mask']` must have `dtype=np.bool_`, got {mask.dtype}")
    if not mask.any():
        raise ValueError(
            "`options['reset_mask']` must contain a boolean array with at least one True value, "
            f"got reset_mask={mask}"
        )
    return mask, {key: value for key, value in options.items() if key != "reset_mask"}


def make_vec(
    id: str | EnvSpec,
    num_envs: int = 1,
    *,
    vector_kwargs: dict[str, Any] | None = None,
    wrappers: Sequence[Callable[[gymnasium.Env[Any, Any]], gymnasium.Env[Any, Any]]] = (),
    **kwargs: Any,
) -> VectorEnv:
    """Return a ``VectorEnv`` of a registered environment, as ``gymnasium.make_vec`` would.

    ``vector_kwargs`` are ``VectorEnv``'s options, ``wrappers`` are put around each environment, and
    ``kwargs`` are those of ``gymnasium.make``.
    """
    make = partial(_make, id, tuple(wrappers), kwargs)
    return VectorEnv([make] * num_envs, **(vector_kwargs or {}))


def register(id: str, **vector_kwargs: Any) -> None:
    """Make ``gymnasium.make_vec`` return a ``VectorEnv`` for this environment.

    From then on ``gymnasium.make_vec(id, num_envs)`` and its ``vectorization_mode=
    "vector_entry_point"`` do so in this process, also if the environment came with another vector
    entry point.  ``vector_kwargs`` are the options of ``VectorEnv``: with a vector entry point
    ``gymnasium.make_vec`` takes none.
    """
    gymnasium.spec(id).vector_entry_point = partial(_make_registered, id, vector_kwargs)


def _make_registered(
    id: str, vector_kwargs: dict[str, Any], *, num_envs: int, **kwargs: Any
) -> VectorEnv:
    return make_vec(id, num_envs, vector_kwargs=vector_kwargs, **kwargs)


def _make(
    id: str | EnvSpec,
    wrappers: Sequence[Callable[[gymnasium.Env[Any, Any]], gymnasium.Env[Any, Any]]],
    kwargs: dict[str, Any],
) -> gymnasium.Env[Any, Any]:
    """Make one environment, in its worker."""
    env = gymnasium.make(id, **kwargs)
    for wrapper in wrappers:
        env = wrapper(env)
    return env
