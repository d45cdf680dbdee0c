"""An ``__import__`` that answers ``multiprocessing`` with the module under test.

Only the test module sees it. A public name that the module under test lacks is answered by the
standard library where that is a submodule's (recorded in `fallbacks`), and by a stand-in that
raises when used where it is the package's (recorded in `missing`), so that one gap fails the tests
that need it and no others.
"""

from __future__ import annotations

import builtins
import importlib
import types
from collections.abc import Callable
from typing import Any

STANDARD = "multiprocessing"


class Missing:
    """Stands for a name that the module under test lacks: a base class perhaps, never callable."""

    def __init__(self, name: str, module: str) -> None:
        self._name = name
        self._module = module

    def __call__(self, *_args: object, **_kwargs: object) -> Any:
        raise AttributeError(f"{self._module} has no {self._name!r}")

    def __getattr__(self, attribute: str) -> Missing:
        if attribute.startswith("__"):
            raise AttributeError(attribute)
        return Missing(f"{self._name}.{attribute}", self._module)

    def __mro_entries__(self, _bases: tuple[type, ...]) -> tuple[type, ...]:
        return (object,)


class _Submodule(types.ModuleType):
    """``multiprocessing.<name>`` as the test module sees it."""

    def __init__(self, redirection: Redirection, name: str, real: types.ModuleType) -> None:
        super().__init__(f"{STANDARD}.{name}")
        self._redirection = redirection
        self._real = real

    def __reduce__(self) -> tuple[Callable[[str], types.ModuleType], tuple[str]]:
        return self._redirection.by_name, (self.__name__,)

    def __getattr__(self, attribute: str) -> Any:
        try:
            return getattr(self._real, attribute)
        except AttributeError:
            if attribute.startswith("__"):
                raise
            value = getattr(importlib.import_module(self.__name__), attribute)
            self._redirection.fallbacks.add(f"{self.__name__.partition('.')[2]}.{attribute}")
            return value


class _Package(types.ModuleType):
    """``multiprocessing`` as the test module sees it."""

    def __init__(self, redirection: Redirection) -> None:
        super().__init__(STANDARD)
        self.__file__ = getattr(redirection.module, "__file__", None)
        self._redirection = redirection

    def __reduce__(self) -> tuple[Callable[[str], types.ModuleType], tuple[str]]:
        # cloudpickle copies the globals of a function by value, this module among them.
        return self._redirection.by_name, (self.__name__,)

    def __getattr__(self, attribute: str) -> Any:
        return self._redirection.package_attribute(attribute)


class Redirection:
    """Settings that one test module needs about the module under test."""

    def __init__(self, module_name: str, by_name: Callable[[str], types.ModuleType]) -> None:
        """`by_name` is importable in children: it finds the same stand-in there."""
        self.module = importlib.import_module(module_name)
        self.by_name = by_name
        self.fallbacks: set[str] = set()
        self.missing: set[str] = set()
        self.loading = False
        self._submodules: dict[str, _Submodule] = {}
        self.package = _Package(self)

    def import_(
        self,
        name: str,
        globals: Any = None,
        locals: Any = None,
        fromlist: Any = (),
        level: int = 0,
    ) -> types.ModuleType:
        """Import for the test module, in place of ``__import__``."""
        if level or name.partition(".")[0] != STANDARD:
            return builtins.__import__(name, globals, locals, fromlist, level)
        stand_in = self.stand_in(name)
        return stand_in if fromlist else self.package

    def stand_in(self, name: str) -> types.ModuleType:
        """The stand-in for ``multiprocessing`` or ``multiprocessing.<submodule>``."""
        submodule = name.partition(".")[2]
        return self._submodule(submodule) if submodule else self.package

    def package_attribute(self, attribute: str) -> Any:
        """Return ``multiprocessing.<attribute>`` as the test module sees it."""
        name = self.module.__name__
        try:
            value = getattr(self.module, attribute)
        except AttributeError:
            if not attribute.startswith("_"):
                try:
                    return self._submodule(attribute)
                except ImportError:
                    pass
            if self.loading and not attribute.startswith("__"):
                self.missing.add(attribute)
                return Missing(attribute, name)
            raise AttributeError(f"{name} has no attribute {attribute!r}") from None
        return self._submodule(attribute) if isinstance(value, types.ModuleType) else value

    def _submodule(self, name: str) -> _Submodule:
        if name not in self._submodules:
            self._submodules[name] = _Submodule(self, name, self._find(name))
        return self._submodules[name]

    def _find(self, name: str) -> types.ModuleType:
        attribute = getattr(self.module, name, None)
        if isinstance(attribute, types.ModuleType):
            return attribute
        wanted = f"{self.module.__name__}.{name}"
        try:
            return importlib.import_module(wanted)
        except ModuleNotFoundError as error:
            if error.name != wanted:
                raise
            standard = importlib.import_module(f"{STANDARD}.{name}")
            self.fallbacks.add(name)
            return standard
