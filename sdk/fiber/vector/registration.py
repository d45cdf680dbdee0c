"""Vector environments by the ids of Gymnasium's registry."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import gymnasium
from gymnasium.envs.registration import EnvSpec

from fiber.vector.vector_env import VectorEnv


def make_vec(
    id: str | EnvSpec,
    num_envs: int = 1,
    *,
    vector_kwargs: dict[str, Any] | None = None,
    wrappers: Sequence[Callable[[gymnasium.Env[Any, Any]], gymnasium.Env[Any, Any]]] = (),
    **kwargs: Any,
) -> VectorEnv:
    """A ``VectorEnv`` of a registered environment: as ``gymnasium.make_vec`` would make it, if it
    had a vectorization mode for Fiber.

    ``vector_kwargs`` are ``VectorEnv``'s options, ``wrappers`` are put around each environment, and
    ``kwargs`` are those of ``gymnasium.make``.
    """
    make = partial(_make, id, tuple(wrappers), kwargs)
    return VectorEnv([make] * num_envs, **(vector_kwargs or {}))


def register(id: str, **vector_kwargs: Any) -> None:
    """Have ``gymnasium.make_vec`` make a ``VectorEnv`` of this environment.

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
