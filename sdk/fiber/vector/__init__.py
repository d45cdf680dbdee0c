"""Vector environments on Fiber's processes: for Gymnasium and for stable-baselines3.

Needs the extra ``vector``.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from fiber._installation import explained_if_missing

if TYPE_CHECKING:
    from fiber.vector.vec_env import VecEnv as VecEnv
    from fiber.vector.vector_env import VectorEnv as VectorEnv
    from fiber.vector.vector_env import make_vec as make_vec
    from fiber.vector.vector_env import register as register

_HOMES = {
    "VecEnv": "vec_env",
    "VectorEnv": "vector_env",
    "make_vec": "vector_env",
    "register": "vector_env",
}

__all__ = ["VecEnv", "VectorEnv", "make_vec", "register"]


if not TYPE_CHECKING:  # a type checker would accept any name

    def __getattr__(name: str) -> object:
        # stable-baselines3, and with it torch, is imported by those who ask for VecEnv.
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        with explained_if_missing(f"{__name__}.{name}"):
            return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return __all__
