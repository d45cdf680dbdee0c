"""Packages that the program has installed and its pods lack: the error names the way out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

import fiber
from faults import drained
from faults.program import Program
from faults.runtime import running
from fiber.errors import StartError
from patience import PATIENCE

pytestmark = [
    pytest.mark.may_leak("the operator's connections, for as long as the cluster is there"),
]

WAY_OUT = "`fiber image build --tag REGISTRY/NAME --push`"
LACKS = "The image of the workers has no package 'only_here'."


cluster = drained.played_cluster


@pytest.fixture
def packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of installed packages that no pod has."""
    folder = tmp_path / "site-packages"
    folder.mkdir()
    (folder / "only_here.py").write_text(
        "import multiprocessing as mp\n\ndef double(number):\n    return 2 * number\n"
    )
    monkeypatch.syspath_prepend(str(folder))
    return folder


def uses(name: str) -> object:
    return __import__(name)


def does_without(name: str) -> tuple[str, object, str | None]:
    try:
        __import__(name)
    except ModuleNotFoundError as error:
        return type(error).__name__, error.args, error.name
    return "", (), ""


@pytest.mark.usefixtures("cluster", "packages")
def test_a_task_that_lacks_a_package_names_the_way_out() -> None:
    with running(backend="kubernetes"), fiber.Pool(1) as pool:
        with pytest.raises(ModuleNotFoundError) as caught:
            pool.apply(uses, ("only_here",))
        assert caught.value.name == "only_here"
        assert caught.value.args == ("No module named 'only_here'",)
        (note,) = caught.value.__notes__
        assert note.startswith(LACKS)
        assert WAY_OUT in note
        with pytest.raises(ModuleNotFoundError) as caught:
            pool.apply(uses, ("nowhere",))
        assert not hasattr(caught.value, "__notes__")
        words = "ModuleNotFoundError", ("No module named 'only_here'",), "only_here"
        assert pool.apply(does_without, ("only_here",)) == words


@pytest.mark.usefixtures("cluster", "packages")
def test_a_function_of_a_package_that_pods_lack_names_the_way_out() -> None:
    import only_here  # type: ignore[import-not-found]

    with running(backend="kubernetes"), fiber.Pool(1) as pool:
        for ask in (
            lambda: pool.map(only_here.double, range(3)),
            lambda: pool.apply(only_here.double, (1,)),
        ):
            with pytest.raises(ModuleNotFoundError) as caught:
                ask()
            assert caught.value.name == "only_here"
            assert WAY_OUT in caught.value.__notes__[0]


@pytest.mark.usefixtures("cluster", "packages")
def test_an_initializer_that_lacks_a_package_names_the_way_out() -> None:
    with (
        running(backend="kubernetes"),
        fiber.Pool(1, initializer=uses, initargs=("only_here",)) as pool,
    ):
        with pytest.raises(StartError, match="No module named 'only_here'") as caught:
            pool.apply(abs, (1,))
        assert caught.value.__notes__[0].startswith(LACKS)


@pytest.mark.usefixtures("cluster")
@pytest.mark.parametrize(
    "statement", ["import only_here", "fiber.adopt('only_here')"], ids=["imported", "adopted"]
)
def test_a_program_whose_module_pods_lack_names_the_way_out(
    statement: str, packages: Path, launch: Callable[..., Program]
) -> None:
    script = f"""
        import fiber
        {statement}

        if __name__ == "__main__":
            with fiber.Pool(1) as pool:
                pool.map(abs, range(3))
    """
    env = {"FIBER_BACKEND": "kubernetes", "PYTHONPATH": str(packages)}
    program = launch(script, env=env)
    assert program.wait(PATIENCE) == 1
    told = program.stderr
    assert "No module named 'only_here'" in told
    assert LACKS in told
    assert WAY_OUT in told
