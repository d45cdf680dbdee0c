"""Packages that only the paper's experiments need, and what to install where one is missing."""

from __future__ import annotations

import importlib
from typing import Any

WALKER = "BipedalWalker-v3"
HARDCORE = "BipedalWalkerHardcore-v3"
BREAKOUT = "ALE/Breakout-v5"


class Missing(Exception):
    """A package or a game is missing; the text is one line that says what to install."""


def walker(name: str, **options: Any) -> Any:
    """Make an environment of Box2D's; `Missing` without Box2D."""
    gymnasium = _import("gymnasium", name, "gymnasium[box2d]")
    try:
        return gymnasium.make(name, disable_env_checker=True, **options)
    except gymnasium.error.DependencyNotInstalled:
        raise _missing("Box2D", name, "gymnasium[box2d]") from None


def breakout() -> Any:
    """Make Atari's Breakout with grey frames; `Missing` without ale-py or without its game."""
    gymnasium = _import("gymnasium", BREAKOUT, "gymnasium ale-py")
    ale = _import("ale_py", BREAKOUT, "ale-py")
    ale.ALEInterface.setLoggerMode(ale.LoggerMode.Error)
    gymnasium.register_envs(ale)
    try:
        return gymnasium.make(BREAKOUT, obs_type="grayscale", disable_env_checker=True)
    except (gymnasium.error.Error, OSError) as error:
        words = str(error).splitlines()[0]
        raise Missing(
            f"{BREAKOUT} has no game ({words}): pip install --upgrade 'ale-py>=0.10', which has it"
        ) from None


def _import(module: str, what: str, install: str) -> Any:
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError:
        raise _missing(module, what, install) from None


def _missing(package: str, what: str, install: str) -> Missing:
    return Missing(f"{what} needs {package}, which is not installed: pip install '{install}'")
