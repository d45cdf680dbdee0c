"""What workers call with an environment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from gymnasium import Env


def call(env: Env[Any, Any], name: str, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    """What a method returns, or the value of an attribute."""
    attribute = env.get_wrapper_attr(name)
    return attribute(*args, **kwargs) if callable(attribute) else attribute


def set_wrapper_attr(env: Env[Any, Any], name: str, value: Any) -> None:
    """Set an attribute where a wrapper or the environment has it."""
    env.set_wrapper_attr(name, value)
