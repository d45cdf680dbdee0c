"""Spaces: those of gymnasium."""

from gymnasium.spaces import *  # noqa: F403
