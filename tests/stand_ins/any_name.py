"""Modules that have every name, and can do nothing."""

from __future__ import annotations

import abc
import importlib.abc
import importlib.machinery
import sys
import types
from collections.abc import Callable, Sequence
from typing import Any


class _AnyName(abc.ABCMeta):
    """Classes with every attribute, which are classes of the same kind."""

    def __getattr__(cls, name: str) -> Any:
        return _class(name)

    def __getitem__(cls, item: object) -> Any:
        return cls


class _Anything(metaclass=_AnyName):
    def __init__(self, *args: Any, **kwargs: Any) -> None:
        pass

    def __call__(self, decorated: Any) -> Any:
        """Do nothing, as a decorator."""
        return decorated


class _Submodule(types.ModuleType):
    def __getattr__(self, name: str) -> Any:
        return attribute(name)


class _Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finds every module below a package."""

    def __init__(self, package: str) -> None:
        self._below = f"{package}."

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: types.ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if name.startswith(self._below):
            return importlib.machinery.ModuleSpec(name, self, is_package=True)
        return None

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> types.ModuleType:
        return _Submodule(spec.name)

    def exec_module(self, module: types.ModuleType) -> None:
        pass


def stand_in(package: str) -> Callable[[str], Any]:
    """Return the ``__getattr__`` with which a module stands in for a package."""
    sys.meta_path.append(_Finder(package))
    return attribute


def attribute(name: str) -> Any:
    """The object of this name."""
    if name.startswith("__"):
        raise AttributeError(name)
    return _class(name)


def _class(name: str) -> Any:
    return _AnyName(name, (_Anything,), {})
