"""Folders that make up a program, and their places elsewhere."""

from __future__ import annotations

import os
import sysconfig
import tempfile
from multiprocessing import process
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from fiber._backends import main_module, program_layout
from fiber._backends.program_layout import find_layout
from unit.shipping_site import write

STDLIB = sysconfig.get_path("stdlib")


class Machine:
    """A machine with a program, which ``main`` and ``path`` describe."""

    def __init__(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.home = write(tmp_path / "home", train_py="", helper_py="", secret="key")
        self.es = write(self.home / "es", main_py="", pkg__sub__tool_py="", data__x_npy="x")
        self.lib = write(tmp_path / "lib", shared__init_py="")
        self.main = ModuleType("__main__")
        self.imported_by: dict[str, str] = {}
        """Fields by which children import the main module."""
        monkeypatch.setenv("HOME", str(self.home))
        monkeypatch.setattr(process, "ORIGINAL_DIR", str(self.es))
        # Without the modules that the tests themselves have imported from outside of site-packages.
        self.modules = {"__main__": self.main}
        for module in (main_module, program_layout):
            monkeypatch.setattr(module, "sys", SimpleNamespace(modules=self.modules))
        monkeypatch.setattr(tempfile, "tempdir", "/nowhere")  # ours is in that

    def runs(self, file: Path, name: str | None = None) -> None:
        """Run that main module; ``-m name`` if that is given."""
        self.main.__file__ = str(file)
        self.imported_by = {"name": name} if name else {"path": str(file)}
        spec: Any = ModuleType("spec")
        spec.name = name
        self.main.__spec__ = spec if name else None

    def has_imported(self, name: str, file: Path, package: Path | None = None) -> None:
        """A module from there."""
        module = ModuleType(name)
        module.__file__ = str(file)
        if package is not None:
            module.__path__ = [str(package)]
        self.modules[name] = module

    def layout(
        self, *path: Path | str, directory: Path | None = None, left_out: tuple[Path, ...] = ()
    ) -> program_layout.Layout:
        """The layout, with that ``sys.path`` and working directory."""
        preparation = {
            "sys_path": list(map(str, path)),
            "dir": str(directory or self.es),
            **{f"init_main_from_{how}": main for how, main in self.imported_by.items()},
        }
        return find_layout(preparation, frozenset(map(str, left_out)))


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Machine:
    return Machine(tmp_path, monkeypatch)


def test_a_script_has_its_folder(machine: Machine) -> None:
    machine.runs(machine.es / "main.py")
    layout = machine.layout(machine.es, STDLIB, directory=machine.es / "data")
    assert layout.places == {str(machine.es): "es"}
    assert layout.paths == (("es",), (), "es/data", "es/main.py")
    assert not layout.session


def test_a_working_directory_elsewhere_is_the_programs_folder_there(machine: Machine) -> None:
    machine.runs(machine.es / "main.py")
    layout = machine.layout(machine.es, STDLIB, directory=machine.home)
    assert layout.places == {str(machine.es): "es"}
    assert layout.paths.directory == "es"


def test_a_module_that_is_run_by_name_has_the_folder_of_its_package(machine: Machine) -> None:
    machine.runs(machine.es / "pkg/sub/tool.py", name="pkg.sub.tool")
    layout = machine.layout(machine.es, STDLIB)
    assert (layout.program, layout.places) == (str(machine.es), {str(machine.es): "es"})


def test_folders_on_the_path_that_are_offered_come_along_in_their_order(machine: Machine) -> None:
    machine.runs(machine.es / "main.py")
    editable = write(machine.lib.parent / "src" / "lib", other_py="")
    for folder in (machine.lib, editable):
        (folder / ".fiberignore").touch()
    layout = machine.layout(machine.es, machine.lib, STDLIB, "/gone", editable)
    assert layout.places == {
        str(machine.es): "es",
        str(machine.lib): "lib",
        str(editable): "lib-2",
    }
    assert layout.paths.before_library == ("es", "lib")
    assert layout.paths.before_installed == ("lib-2",)


def test_imported_modules_of_other_folders_on_the_path_are_sent(machine: Machine) -> None:
    machine.runs(machine.es / "main.py")
    write(machine.lib, big__data_npy="x", space__deep__tool_py="", single_py="", other_py="")
    machine.has_imported("shared", machine.lib / "shared/init.py", machine.lib / "shared")
    machine.has_imported("single", machine.lib / "single.py")
    space: Any = ModuleType("space")
    space.__path__ = [str(machine.lib / "space")]
    machine.modules["space"] = space
    machine.has_imported("space.deep.tool", machine.lib / "space/deep/tool.py")
    layout = machine.layout(machine.es, machine.lib, STDLIB)
    assert layout.places == {
        str(machine.es): "es",
        str(machine.lib / "shared"): "program/shared",
        str(machine.lib / "single.py"): "program/single.py",
        str(machine.lib / "space"): "program/space",
    }
    assert layout.paths.before_library == ("es", "program")
    assert layout.trees == (str(machine.lib),)


def test_a_script_in_its_own_package_imports_the_package(machine: Machine) -> None:
    # The program may have imported the package, or not, as with `fiber run`.
    package = write(machine.lib / "pkg", main_py="", tool_py="")
    (package / "__init__.py").touch()
    machine.runs(package / "main.py")
    layout = machine.layout(package, machine.lib, STDLIB)
    assert layout.places == {str(package): "pkg"}
    assert layout.paths.before_library == ("pkg", "")


def test_the_folder_around_a_folder_of_scripts_is_not_on_the_path(machine: Machine) -> None:
    scripts = write(machine.lib / "scripts", main_py="")
    machine.runs(scripts / "main.py")
    layout = machine.layout(scripts, machine.lib, STDLIB)
    assert layout.paths.before_library == ("scripts",)


def test_folders_within_one_another_are_sent_once(machine: Machine) -> None:
    (machine.es / ".fiberignore").touch()
    machine.runs(machine.es / "pkg/sub/tool.py")
    layout = machine.layout(machine.es / "pkg/sub", machine.es, STDLIB)
    assert layout.places == {str(machine.es): "es"}
    assert layout.paths == (("es/pkg/sub", "es"), (), "es/pkg/sub", "es/pkg/sub/tool.py")


def test_installed_packages_are_not_sent(machine: Machine) -> None:
    machine.runs(machine.es / "main.py")
    fiber = Path(program_layout.__file__).parents[2]
    other = machine.lib / "python3/site-packages"
    other.mkdir(parents=True)
    layout = machine.layout(machine.es, STDLIB, f"{STDLIB}/lib-dynload", other, fiber)
    assert layout.places == {str(machine.es): "es"}


def test_packages_installed_in_the_programs_folder_are_not_on_the_path(machine: Machine) -> None:
    machine.runs(machine.es / "main.py")
    inside = write(machine.es / ".venv/lib/site-packages", pkg_py="")
    layout = machine.layout(machine.es, STDLIB, inside)
    assert layout.paths == (("es",), (), "es", "es/main.py")


def test_a_session_has_its_working_directory(machine: Machine) -> None:
    layout = machine.layout(machine.es, STDLIB)
    assert layout.places == {str(machine.es): "es"}
    assert layout.session == {str(machine.es)}
    assert layout.paths == (("es",), (), "es", None)


def test_an_installed_command_is_like_a_session(machine: Machine) -> None:
    machine.runs(Path(sysconfig.get_path("scripts")) / "tool")
    layout = machine.layout(sysconfig.get_path("scripts"), STDLIB)
    assert layout.session == {str(machine.es)}
    assert layout.paths.main is None


def test_only_imported_modules_of_a_home_directory_are_sent(machine: Machine) -> None:
    machine.runs(machine.home / "train.py")
    machine.has_imported("helper", machine.home / "helper.py")
    machine.has_imported("pkg", machine.es / "pkg/__init__.py", machine.es / "pkg")
    (machine.es / "pkg/__init__.py").touch()
    layout = machine.layout(machine.home, STDLIB, directory=machine.home)
    assert set(layout.places.values()) == {"program/train.py", "program/helper.py", "program/pkg"}
    assert layout.paths == (("program",), (), "program", "program/train.py")


def test_a_module_with_an_empty_path_is_no_package(machine: Machine) -> None:
    machine.runs(machine.es / "main.py")
    (machine.lib / "six.py").touch()
    machine.has_imported("six", machine.lib / "six.py")
    machine.modules["six"].__path__ = []
    layout = machine.layout(machine.es, machine.lib, STDLIB)
    assert layout.places[str(machine.lib / "six.py")] == "program/six.py"


def test_a_module_of_a_namespace_package_keeps_its_path(machine: Machine) -> None:
    machine.runs(machine.home / "train.py")
    module = write(machine.home / "space", part__tool_py="") / "part/tool.py"
    space: Any = ModuleType("space")
    space.__path__ = [str(machine.home / "space")]
    machine.modules["space"] = space
    machine.has_imported("space.part.tool", module)
    layout = machine.layout(machine.home, STDLIB, directory=machine.home)
    assert layout.places[str(module)] == "program/space/part/tool.py"


@pytest.mark.parametrize("folder", ["/", "home", "above"])
def test_a_session_in_a_home_or_system_folder_sends_no_files_of_it(
    machine: Machine, folder: str
) -> None:
    here = {"home": machine.home, "above": machine.home.parent}.get(folder, Path("/"))
    layout = machine.layout(here, STDLIB, directory=here)
    assert layout.places == {}
    assert layout.paths == ((), (), "program", None)


def test_imported_modules_of_a_left_out_folder_are_sent(machine: Machine) -> None:
    machine.has_imported("tool", machine.es / "pkg/sub/tool.py")
    layout = machine.layout(machine.es, STDLIB, left_out=(machine.es,))
    assert layout.places == {str(machine.es / "pkg/sub/tool.py"): "program/tool.py"}


def test_imported_modules_are_named(machine: Machine) -> None:
    machine.runs(machine.es / "main.py")
    machine.has_imported("tool", machine.es / "pkg/sub/tool.py")
    machine.has_imported("gone", machine.es / "gone.py")
    layout = machine.layout(machine.es, STDLIB)
    assert {os.path.basename(file) for file in layout.files} == {"main.py", "tool.py"}
