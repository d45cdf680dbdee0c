"""Classes of environments, by the name of their module."""

from gym import Env as Env
from gym import Wrapper as Wrapper
