"""Vector environments on Fiber's processes, for Gymnasium.

Needs the extra ``rl``.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fiber.vector.registration import make_vec as make_vec
    from fiber.vector.registration import register as register
    from fiber.vector.vector_env import VectorEnv as VectorEnv

_HOMES = {
    "VectorEnv": "vector_env",
    "make_vec": "registration",
    "register": "registration",
}

__all__ = ["VectorEnv", "make_vec", "register"]


def __getattr__(name: str) -> Any:
    # Of Gymnasium and NumPy as little is imported as is asked for.
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return __all__
