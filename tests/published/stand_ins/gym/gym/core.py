"""Classes of environments, by the name of their module."""

from gym import Env, Wrapper

__all__ = ["Env", "Wrapper"]
