"""Loads CPython's test module under a redirection and rebuilds its classes.

The rebuilt classes live in one namespace (the module `cases`) and carry its name, so that a child
that unpickles one of them imports `cases`, and with it the redirection, first. Classes get the ids
that CPython's ``install_tests_in_module_dict`` gives them, such as ``WithProcessesTestQueue``.
"""

from __future__ import annotations

import builtins
import gc
import importlib
import importlib.util
import sys
import types
import unittest
from collections.abc import Callable
from importlib.abc import Loader
from importlib.machinery import ModuleSpec
from typing import Any, NamedTuple

from .redirect import Missing, Redirection
from .tiers import Tier, tier_of

SOURCE = "test._test_multiprocessing"

# The test module's other imports are loaded before the redirection.
_SUPPORT = (
    "test.support",
    "test.support.hashlib_helper",
    "test.support.import_helper",
    "test.support.os_helper",
    "test.support.script_helper",
    "test.support.socket_helper",
    "test.support.threading_helper",
    "test.support.warnings_helper",
)


class Case(NamedTuple):
    """Test case of CPython."""

    class_name: str  # as CPython reports it: WithProcessesTestQueue
    base_name: str  # as it is written in the source: TestQueue
    type: str | None  # processes, manager, or None
    method: str
    tier: Tier

    @property
    def id(self) -> str:
        return f"{self.class_name}.{self.method}"


def load_source(redirection: Redirection) -> types.ModuleType:
    """CPython's test module, executed with the redirection as its ``__import__``."""
    spec, loader = _find_source()
    module = importlib.util.module_from_spec(spec)
    vars(module)["__builtins__"] = dict(vars(builtins), __import__=redirection.import_)
    sys.modules[SOURCE] = module
    redirection.loading = True
    try:
        loader.exec_module(module)
    finally:
        redirection.loading = False
    return module


def _find_source() -> tuple[ModuleSpec, Loader]:
    try:
        for name in _SUPPORT:
            importlib.import_module(name)
        spec = importlib.util.find_spec(SOURCE)
    except ModuleNotFoundError:
        spec = None
    if spec is None or spec.loader is None:
        version = f"{sys.version_info.major}.{sys.version_info.minor}"
        raise ImportError(
            f"{sys.executable} has no {SOURCE}: install CPython's own tests for it "
            f"(Debian, Ubuntu: libpython{version}-testsuite), or use a Python that has them"
        )
    return spec, spec.loader


class Builder:
    """Puts the test classes and everything that children unpickle into `namespace`."""

    def __init__(
        self,
        source: types.ModuleType,
        redirection: Redirection,
        namespace: dict[str, Any],
        tiers: frozenset[str],
    ) -> None:
        self.source = source
        self.redirection = redirection
        self.namespace = namespace
        self.home: str = namespace["__name__"]
        self.tiers = tiers
        self.cases: list[Case] = []
        self._mixins = {"processes": self._processes_mixin(), "manager": self._manager_mixin()}

    def build(self) -> list[Case]:
        """Every test of the running Python; those outside the wanted tiers are disabled."""
        for name, value in list(vars(self.source).items()):
            if getattr(value, "__module__", None) != SOURCE:
                continue
            if not isinstance(value, type):
                self._rehome(value)
                self.namespace.setdefault(name, value)
            elif issubclass(value, self.source.BaseTestCase):
                self._rehome_methods(value)
                self.namespace.setdefault(name, value)
                self._install_typed(name, value)
            elif issubclass(value, unittest.TestCase):
                self._rehome_methods(value)
                self._install(self._untyped(name, value), name.lstrip("_"), name.lstrip("_"), None)
            elif not name.endswith("Mixin"):
                self._rehome_methods(value)
                value.__module__ = self.home
                self.namespace.setdefault(name, value)
        return self.cases

    def _install_typed(self, name: str, base: type) -> None:
        for type_ in getattr(base, "ALLOWED_TYPES", ()):
            if base is not self.source.BaseTestCase and type_ in self._mixins:
                built = type(name, (base, self._mixins[type_], unittest.TestCase), {})
                base_name = name.lstrip("_")
                self._install(built, base_name, f"With{type_.capitalize()}{base_name}", type_)

    def _untyped(self, name: str, base: type) -> type:
        # CPython's set-up of this class reaps children that other classes wait for.
        quiet: dict[str, Any] = {
            "setUpClass": classmethod(_nothing),
            "tearDownClass": classmethod(_nothing),
        }
        return type(name, (base,), quiet if name == "TestSyncManagerTypes" else {})

    def _install(self, built: type, base_name: str, new_name: str, type_: str | None) -> None:
        self._save_classmethods_by_name(built)
        loader = unittest.TestLoader()
        for method in loader.getTestCaseNames(built):
            case = Case(new_name, base_name, type_, method, tier_of(base_name, method, type_))
            self.cases.append(case)
            if case.tier not in self.tiers:
                setattr(built, method, None)
        built.__name__ = built.__qualname__ = new_name
        built.__module__ = self.home
        self.namespace[new_name] = built

    def _save_classmethods_by_name(self, built: type) -> None:
        for parent in built.__mro__:
            if parent.__module__ not in (SOURCE, self.home) or parent.__name__.endswith("Mixin"):
                continue
            for name, value in list(vars(parent).items()):
                if isinstance(value, classmethod) and name not in ("setUpClass", "tearDownClass"):
                    setattr(built, name, _ByName(name, value, self.home))

    def _rehome(self, value: Any) -> None:
        try:
            value.__module__ = self.home
        except (AttributeError, TypeError):
            pass  # an instance or a builtin with a __module__; children never ask for it

    def _rehome_methods(self, owner: type) -> None:
        # A pickler by value looks a method up by its module and qualified name.
        for value in list(vars(owner).values()):
            function = getattr(value, "__func__", value)
            if getattr(function, "__module__", None) == SOURCE:
                self._rehome(function)

    def _processes_mixin(self) -> type:
        # CPython's own mixin stays a base: one test asks isinstance(self, ProcessesMixin).
        bases = (_QuietMixin, self.source.ProcessesMixin)
        return type("ProcessesMixin", bases, self._bound_names(self.source.ProcessesMixin))

    def _manager_mixin(self) -> type:
        manager_of = self.redirection.package_attribute

        def set_up(cls: Any) -> None:
            cls.manager = manager_of("Manager")()

        def tear_down(cls: Any) -> None:
            gc.collect()
            cls.manager.shutdown()
            cls.manager = None

        body = {"setUpClass": classmethod(set_up), "tearDownClass": classmethod(tear_down)}
        body["Process"] = manager_of("Process")
        return type("ManagerMixin", (_QuietMixin, self.source.ManagerMixin), body)

    def _bound_names(self, mixin: type) -> dict[str, Any]:
        """The attributes of CPython's mixin, taken from the module under test."""
        bound: dict[str, Any] = {}
        for name, value in vars(mixin).items():
            if name.startswith("__") or isinstance(value, property | classmethod):
                continue
            if isinstance(value, str):
                bound[name] = value
                continue
            found = getattr(self.redirection.package, name, None)
            if found is None:
                self.redirection.missing.add(name)
                found = Missing(name, self.redirection.module.__name__)
            bound[name] = staticmethod(found) if isinstance(value, staticmethod) else found
        return bound


class _QuietMixin:
    """CPython's mixins check for dangling processes of the standard library; these do not."""

    @classmethod
    def setUpClass(cls) -> None:
        pass

    @classmethod
    def tearDownClass(cls) -> None:
        gc.collect()


class _BoundByName:
    """A bound classmethod that every pickler saves by name.

    cloudpickle would copy the function and its globals by value, the redirection among them.
    """

    def __init__(self, owner: type, name: str, function: Callable[..., Any], home: str) -> None:
        self._owner = owner
        self._function = function
        self.__name__ = name
        self.__module__ = home
        self.__qualname__ = f"{owner.__name__}.{name}"

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self._function(*args, **kwargs)

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[type, str]]:
        return getattr, (self._owner, self.__name__)


class _ByName:
    def __init__(self, name: str, method: classmethod[Any, Any, Any], home: str) -> None:
        self._name = name
        self._method = method
        self._home = home

    def __get__(self, _instance: object, owner: type) -> _BoundByName:
        return _BoundByName(owner, self._name, self._method.__get__(None, owner), self._home)


def _nothing(_cls: type) -> None:
    pass
