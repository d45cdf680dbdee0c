"""fiber.meta: wishes belong to one function object, which behaves and pickles as before."""

from __future__ import annotations

import functools
import inspect
import math
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import cloudpickle
import pytest

from fiber.resources import Resources, largest, meta, resources_of

LIBRARY = '''
"""A module as a user writes it."""
import functools
from fiber.resources import meta

@meta(cpu=2, memory="1Gi")
def decorated(x: int, /, y: int = 1, *, z: int = 2) -> int:
    """Adds."""
    return x + y + z

def plain(x):
    return x + 1

small = meta(cpu=1)(plain)
large = meta(cpu=8)(plain)

def rebound(x):
    return x + 2

rebound = meta(gpu=1)(rebound)

@meta(cpu=3)
def factorial(n):
    return n * factorial(n - 1) if n else 1

class Model:
    bias = 100

    @meta(gpu=2)
    def train(self, x):
        return self.bias + x

    @staticmethod
    @meta(gpu=3)
    def evaluate(x):
        return x

    score = small

def noted(function):
    @functools.wraps(function)
    def wrapper(*args):
        return ("noted", function(*args))
    return wrapper

@noted
@meta(cpu=4)
def outside(x):
    return x

@meta(cpu=5)
@noted
def inside(x):
    return x
'''


@pytest.fixture
def library(monkeypatch: pytest.MonkeyPatch) -> Any:
    module = ModuleType("fiber_test_library")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    exec(compile(LIBRARY, "library.py", "exec", dont_inherit=True), vars(module))
    return module


def round_trip(value: Any) -> Any:
    return pickle.loads(pickle.dumps(value))


class TestOwnership:
    def test_functions_without_wishes(self, library: Any) -> None:
        assert resources_of(library.plain) == Resources()
        assert resources_of(len) == Resources()

    def test_a_decorated_function_has_its_resources(self, library: Any) -> None:
        assert resources_of(library.decorated) == Resources(cpu=2, memory=1024)

    def test_a_shared_function_stays_clean(self, library: Any) -> None:
        assert resources_of(library.small) == Resources(cpu=1)
        assert resources_of(library.large) == Resources(cpu=8)
        assert resources_of(library.plain) == Resources()
        assert vars(library.plain) == {}

    def test_meta_leaves_a_local_function_unchanged(self) -> None:
        def local() -> int:
            return 1

        wishing = meta(cpu=1)(local)
        assert resources_of(wishing) == Resources(cpu=1)
        assert resources_of(local) == Resources()

    def test_wishes_add_up_and_the_outer_ones_win(self, library: Any) -> None:
        both = meta(memory=10, cpu=9)(library.small)
        assert resources_of(both) == Resources(cpu=9, memory=10)
        assert resources_of(library.small) == Resources(cpu=1)

    def test_decorated_methods_have_their_resources(self, library: Any) -> None:
        assert resources_of(library.Model.train) == Resources(gpu=2)
        assert resources_of(library.Model().train) == Resources(gpu=2)
        assert resources_of(library.Model.evaluate) == Resources(gpu=3)

    def test_partials_have_the_wishes_of_their_function(self, library: Any) -> None:
        inner = functools.partial(library.decorated, 1)
        assert resources_of(functools.partial(inner, 2)) == Resources(cpu=2, memory=1024)

    def test_other_decorators_inside_and_outside(self, library: Any) -> None:
        assert resources_of(library.outside) == Resources(cpu=4)
        assert resources_of(library.inside) == Resources(cpu=5)
        assert library.outside(1) == library.inside(1) == ("noted", 1)

    def test_a_foreign_attribute_of_that_name_is_no_wish(self) -> None:
        def odd() -> None:
            pass

        odd.__fiber_meta__ = {"cpu": 3}  # type: ignore[attr-defined]
        assert resources_of(odd) == Resources()


class TestBehaviour:
    def test_a_decorated_function_is_a_function_like_before(self, library: Any) -> None:
        function = library.decorated
        assert function(1) == 4
        assert function(1, 2, z=3) == 6
        assert inspect.isfunction(function)
        assert (function.__name__, function.__doc__) == ("decorated", "Adds.")
        assert str(inspect.signature(function)) == "(x: int, /, y: int = 1, *, z: int = 2) -> int"
        assert not hasattr(function, "__wrapped__")

    def test_recursion_and_closures(self, library: Any) -> None:
        step = 3

        @meta(cpu=1)
        def add(x: int) -> int:
            return x + step

        assert library.factorial(5) == 120
        assert add(1) == 4

    def test_a_coroutine_function_stays_one(self) -> None:
        @meta(cpu=1)
        async def work() -> None:
            pass

        assert inspect.iscoroutinefunction(work)

    def test_a_shared_function_with_wishes(self, library: Any) -> None:
        assert library.small(1) == 2
        assert library.small.__name__ == "plain"
        assert inspect.signature(library.small) == inspect.signature(library.plain)
        assert "plain" in repr(library.small)
        assert "cpu=1.0" in repr(library.small)

    def test_decorated_methods_bind_to_their_object(self, library: Any) -> None:
        assert library.Model().train(1) == 101
        assert library.Model.evaluate(1) == 1

        class WithPlain:
            method = library.small

            def __add__(self, other: int) -> str:
                return f"self + {other}"

        assert WithPlain().method() == "self + 1"
        assert WithPlain.method is library.small

    def test_a_callable_that_is_no_method_does_not_become_one(self) -> None:
        class WithBuiltin:
            size: Any = meta(cpu=1)(len)

        assert WithBuiltin().size([1, 2]) == 2


class TestPickle:
    @pytest.mark.parametrize("name", ["decorated", "rebound", "small", "large"])
    def test_a_decorated_function_survives_plain_pickle(self, library: Any, name: str) -> None:
        original = getattr(library, name)
        back = round_trip(original)
        assert back(1) == original(1)
        assert resources_of(back) == resources_of(original)

    @pytest.mark.parametrize("name", ["decorated", "rebound"])
    def test_the_owner_of_a_name_is_pickled_as_that_name(self, library: Any, name: str) -> None:
        assert round_trip(getattr(library, name)) is getattr(library, name)

    def test_a_shared_function_travels_by_its_own_name(self, library: Any) -> None:
        assert round_trip(library.small).__wrapped__ is library.plain

    def test_decorated_methods_survive_pickle(self, library: Any) -> None:
        assert round_trip(library.Model.train) is library.Model.train
        assert round_trip(library.Model().train)(1) == 101

    @pytest.mark.parametrize("function", [math.sqrt, functools.partial(pow, 2)])
    def test_callables_that_are_no_functions(self, function: Callable[..., Any]) -> None:
        back = round_trip(meta(cpu=1)(function))
        assert back(4) == function(4)
        assert resources_of(back) == Resources(cpu=1)

    def test_local_functions_by_cloudpickle(self, library: Any) -> None:
        offset = 10
        wishing = meta(cpu=1)(lambda x: x + offset)
        back = pickle.loads(cloudpickle.dumps(wishing))
        assert back(1) == 11
        assert resources_of(back) == Resources(cpu=1)

    def test_functions_of_main_by_value_in_a_process_with_another_main(
        self, tmp_path: Path
    ) -> None:
        script = tmp_path / "script.py"
        script.write_text(
            LIBRARY + "import sys, cloudpickle\n"
            "sys.stdout.buffer.write(cloudpickle.dumps([decorated, rebound, small]))\n"
        )
        made = subprocess.run(
            [sys.executable, str(script)], check=True, capture_output=True, timeout=60
        )
        decorated, rebound, small = pickle.loads(made.stdout)
        assert (decorated(1), rebound(1), small(1)) == (4, 3, 2)
        assert [resources_of(f) for f in (decorated, rebound, small)] == [
            Resources(cpu=2, memory=1024),
            Resources(gpu=1),
            Resources(cpu=1),
        ]


class TestValues:
    @pytest.mark.parametrize(
        ("given", "cpu"), [(1, 1.0), (0.5, 0.5), ("500m", 0.5), ("2", 2.0), ("1.5", 1.5)]
    )
    def test_meta_takes_numbers_and_quantities_of_cpu(self, given: float | str, cpu: float) -> None:
        assert resources_of(meta(cpu=given)(print)) == Resources(cpu=cpu)

    @pytest.mark.parametrize(
        ("given", "memory"),
        [(512, 512), ("512Mi", 512), ("2Gi", 2048), ("1.5Gi", 1536), ("1Ti", 1024 * 1024)],
    )
    def test_memory_in_mib(self, given: int | str, memory: int) -> None:
        assert resources_of(meta(memory=given)(print)) == Resources(memory=memory)

    @pytest.mark.parametrize("gpu", [0, 4])
    def test_meta_takes_whole_numbers_of_gpu(self, gpu: int) -> None:
        assert resources_of(meta(gpu=gpu)(print)) == Resources(gpu=gpu)

    @pytest.mark.parametrize(
        ("key", "value"),
        [
            *(("cpu", bad) for bad in (0, -1, "0m", "two", "", True, math.nan, math.inf)),
            *(("memory", bad) for bad in (0, -1, 1.5, "2G", "2", "Gi", "0Mi", True)),
            *(("gpu", bad) for bad in (-1, 1.5, "1", True)),
        ],
    )
    def test_bad_values_are_named(self, key: str, value: Any) -> None:
        with pytest.raises(ValueError, match="expected") as caught:
            meta(**{key: value})
        assert f"fiber.meta({key}={value!r})" in str(caught.value)

    def test_an_unknown_wish_is_named(self) -> None:
        with pytest.raises(TypeError, match="disk"):
            meta(disk=3)  # type: ignore[call-arg]

    def test_no_wish_at_all(self) -> None:
        with pytest.raises(TypeError, match="at least one of cpu=, memory=, gpu="):
            meta()

    @pytest.mark.parametrize("thing", [3, int])
    def test_meta_refuses_an_object_that_is_not_a_function(self, thing: Any) -> None:
        with pytest.raises(TypeError, match="is for functions"):
            meta(cpu=1)(thing)

    def test_resources_are_frozen(self) -> None:
        with pytest.raises(AttributeError):
            Resources().cpu = 1  # type: ignore[misc]


class TestNodes:
    def test_other_resources_and_nodes_are_wishes(self) -> None:
        wishing = meta(
            resources={"amd.com/gpu": 1},
            node_selector={"disk": "ssd"},
            tolerations=["spot=true:NoSchedule", {"key": "team", "operator": "Exists"}],
        )(print)
        spot = {"key": "spot", "operator": "Equal", "value": "true", "effect": "NoSchedule"}
        found = resources_of(wishing)
        assert found.extended == (("amd.com/gpu", 1),)
        assert found.node_selector == (("disk", "ssd"),)
        assert [dict(one) for one in found.tolerations] == [
            spot,
            {"key": "team", "operator": "Exists"},
        ]
        hash(found)

    def test_outer_wishes_are_added(self) -> None:
        inner = meta(resources={"a.b/c": 1}, node_selector={"x": "1", "y": "1"})(print)
        found = resources_of(meta(resources={"a.b/c": 2}, node_selector={"y": "2"})(inner))
        assert found.extended == (("a.b/c", 2),)
        assert found.node_selector == (("x", "1"), ("y", "2"))

    @pytest.mark.parametrize(
        ("wishes", "why"),
        [
            ({"resources": {"cpu": 1}}, "CPUs and memory are cpu= and memory="),
            ({"resources": {"nvidia.com/gpu": 1}}, "use gpu= instead"),
            ({"resources": {"amd.com/gpu": 0.5}}, "a whole number"),
            ({"node_selector": {"disk": 1}}, "a dict of labels"),
            ({"tolerations": ["spot:Never"]}, "is no toleration"),
            ({"tolerations": [{"keys": "spot"}]}, "is no toleration"),
        ],
    )
    def test_unreadable_metadata_is_an_error(self, wishes: dict[str, Any], why: str) -> None:
        with pytest.raises(ValueError, match=why):
            meta(**wishes)

    def test_a_worker_of_several_suits_them_all(self) -> None:
        one = Resources(cpu=1, extended=(("a.b/c", 2),), node_selector=(("x", "1"),))
        other = Resources(cpu=2, extended=(("a.b/c", 1), ("a.b/d", 1)))
        found = largest([one, other])
        assert found == Resources(
            cpu=2, extended=(("a.b/c", 2), ("a.b/d", 1)), node_selector=(("x", "1"),)
        )
        with pytest.raises(ValueError, match="x=1 and with x=2"):
            largest([one, Resources(node_selector=(("x", "2"),))])
