"""Advice about modules that workers lack: which errors get it, and that they stay as they are."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from pathlib import Path

import pytest

from fiber import _worker_images
from fiber._agent.exception_pickles import encode_error
from fiber._engine.start_failures import StartFailure
from fiber._exceptions import fresh
from fiber._worker_images import advice, missing_module
from fiber.errors import AdoptionError


@pytest.fixture
def pods() -> Iterator[None]:
    """Workers of this program are pods."""
    _worker_images.use(True)
    yield
    _worker_images.use(False)


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A package that this program has installed."""
    package = tmp_path / "site-packages" / "only_here"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    monkeypatch.syspath_prepend(str(package.parent))
    return package.name


def not_found(module: str) -> ModuleNotFoundError:
    return ModuleNotFoundError(f"No module named {module!r}", name=module, path="/here")


@pytest.mark.usefixtures("pods")
def test_a_package_that_the_program_has_installed_belongs_into_the_image(installed: str) -> None:
    for module in (installed, f"{installed}.part"):
        found = advice(module)
        assert found.startswith("The image of the workers has no package 'only_here'. ")
        assert "`fiber image build --tag REGISTRY/NAME --push`" in found


@pytest.mark.usefixtures("pods")
def test_a_namespace_package_and_a_single_module_count_too(
    tmp_path: Path, installed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "site-packages" / "namespace_here").mkdir()
    (tmp_path / "site-packages" / "module_here.py").touch()
    monkeypatch.syspath_prepend(str(tmp_path / "site-packages"))
    assert advice("namespace_here.part")
    assert advice("module_here")


@pytest.mark.usefixtures("pods")
def test_a_module_of_the_program_and_one_that_it_lacks_are_no_matter_of_the_image(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "own_module.py").touch()
    monkeypatch.syspath_prepend(str(tmp_path))
    for module in ("own_module", "nowhere", "json", "builtins", "", ".", "a\0b"):
        assert advice(module) == ""


def test_workers_without_images_get_no_advice(installed: str) -> None:
    assert advice(installed) == ""


def test_the_missing_module_is_that_of_the_error_or_its_cause() -> None:
    error = AdoptionError("cannot adopt 'a'")
    assert missing_module(error) == ""
    error.__cause__ = not_found("a")
    assert missing_module(error) == missing_module(not_found("a")) == "a"
    assert missing_module(ModuleNotFoundError("without a name")) == ""
    assert missing_module(ModuleNotFoundError("a", name=3)) == ""  # type: ignore[arg-type]
    assert missing_module(ImportError("cannot import", name="a")) == ""


@pytest.mark.usefixtures("pods")
def test_an_error_keeps_its_type_arguments_and_attributes(installed: str) -> None:
    sent = not_found(installed)
    sent.add_note("a note of the task")
    error = pickle.loads(encode_error(sent))
    assert type(error) is ModuleNotFoundError
    assert error.args == (f"No module named {installed!r}",)
    assert (error.name, error.path) == (installed, "/here")
    assert error.__notes__ == ["a note of the task", advice(installed)]


@pytest.mark.usefixtures("pods")
def test_an_error_of_the_program_itself_has_no_note() -> None:
    assert not hasattr(pickle.loads(encode_error(not_found("nowhere"))), "__notes__")
    assert not hasattr(pickle.loads(encode_error(ValueError("other"))), "__notes__")


def test_the_error_of_a_start_has_the_advice_as_its_note() -> None:
    error = StartFailure("a worker", "it raised an error", "text", advice="build one").error(1)
    assert error.__notes__ == fresh(error).__notes__ == ["build one"]
    assert not hasattr(StartFailure("a worker", "it raised an error").error(1), "__notes__")
