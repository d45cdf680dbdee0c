"""Installed files: the wheel, the packages of its extras, and files of another distribution."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
import zipfile
from email import message_from_string
from pathlib import Path

import pytest

import fiber
from fiber import _installation

ROOT = Path(__file__).resolve().parents[2]
SDK = ROOT / "sdk" / "fiber"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.Path:
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True, timeout=120)
    (built,) = folder.iterdir()
    return zipfile.Path(built)


def test_the_wheel_holds_the_files_of_a_program(wheel: zipfile.Path) -> None:
    (info,) = (each.name for each in wheel.iterdir() if each.name.endswith(".dist-info"))
    assert {each.name for each in wheel.iterdir()} == {"fiber", "fiber_api", info}
    assert wheel.joinpath("fiber", "py.typed").exists()
    assert not wheel.joinpath("fiber", "__pycache__").exists()


def test_the_wheel_holds_the_files_of_the_dashboard(wheel: zipfile.Path) -> None:
    page = SDK / "_cli" / "dashboard_page"
    for path in page.rglob("*"):
        if path.is_file():
            assert wheel.joinpath("fiber", str(path.relative_to(SDK))).read_bytes()


def test_links_of_the_readme_lead_somewhere_from_a_package_index(wheel: zipfile.Path) -> None:
    (info,) = (each for each in wheel.iterdir() if each.name.endswith(".dist-info"))
    metadata = message_from_string(info.joinpath("METADATA").read_text(encoding="utf-8"))
    assert metadata["Description-Content-Type"] == "text/markdown"
    readme = metadata.get_payload()
    assert isinstance(readme, str)
    links = re.findall(r"\]\(([^)\s]+)", readme)
    assert [link for link in links if not link.startswith("https://")] == []
    source = PROJECT["urls"]["Source"].removeprefix("https://github.com/")
    places = (
        rf"https://github\.com/{source}/blob/main/(.*)",
        rf"https://raw\.githubusercontent\.com/{source}/main/(.*)",
    )
    paths = [match[1] for link in links for place in places if (match := re.match(place, link))]
    assert len(paths) > 10
    files = [path.partition("#")[0] for path in paths]
    assert [file for file in files if not (ROOT / file).exists()] == []


# Packages that are missing


@pytest.mark.parametrize(
    ("package", "statement", "advice"),
    [
        ("gymnasium", "fiber.vector.VectorEnv", r"fiber\.vector\.VectorEnv .*fiberpool\[vector\]"),
        ("numpy", "fiber.vector.make_vec", r"fiber\.vector\.make_vec .*'fiberpool\[vector\]'"),
        ("stable_baselines3", "fiber.vector.VecEnv", "pip install stable-baselines3"),
        ("joblib", "import fiber.joblib", r"fiber\.joblib .*'fiberpool\[joblib\]'"),
    ],
)
def test_a_missing_package_is_named_with_its_extra(
    package: str, statement: str, advice: str
) -> None:
    program = (
        f"import sys; sys.modules[{package!r}] = None; import fiber, fiber.vector; {statement}"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    last = done.stderr.splitlines()[-1]
    assert re.search(f"^ModuleNotFoundError: .*needs the package {package}.*", last)
    assert re.search(advice, last)


def test_another_missing_module_is_reported_unchanged() -> None:
    with (
        pytest.raises(ModuleNotFoundError, match=r"^No module named 'no_such_module'$"),
        _installation.explained_if_missing("fiber.vector"),
    ):
        import no_such_module  # type: ignore[import-not-found]  # noqa: F401


def test_extras_match_their_documentation() -> None:
    for package, argument in _installation._INSTALLED_BY.items():
        if extra := re.fullmatch(r"'fiberpool\[(\w+)\]'", argument):
            requirements = PROJECT["optional-dependencies"][extra[1]]
            assert any(requirement.startswith(package) for requirement in requirements)


# Another distribution with a package ``fiber``


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A folder of packages with Fiber, and the files that say that a distribution is installed."""
    (tmp_path / "fiber").mkdir()
    for path in SDK.iterdir():
        if path.name != "__pycache__":
            (tmp_path / "fiber" / path.name).symlink_to(path)
    info = tmp_path / "fiber-0.2.1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: fiber\nVersion: 0.2.1\n")
    (info / "RECORD").write_text("fiber/__init__.py,,\nfiber/core.py,,\n")
    return tmp_path


def run(site: Path, statement: str) -> str:
    program = f"import sys; sys.path.insert(0, {str(site)!r}); {statement}"
    command = [sys.executable, "-B", "-c", program]
    return subprocess.run(command, capture_output=True, text=True, timeout=60).stderr


def test_files_of_another_distribution_are_found(site: Path) -> None:
    assert run(site, "import fiber") == ""
    (site / "fiber" / "core.py").touch()
    printed = run(site, "import fiber")
    assert printed.startswith("<string>:1: RuntimeWarning: the folder of Fiber, ")
    assert f", {site}/fiber, has modules" in printed
    assert "core.py. They belong to the distribution fiber." in printed
    assert "pip uninstall fiber, and then pip install --force-reinstall fiberpool" in printed


def test_files_of_no_distribution_are_found(site: Path) -> None:
    (site / "fiber" / "core.py").touch()
    (site / "fiber-0.2.1.dist-info" / "RECORD").write_text("")
    assert "core.py. They belong to no installed distribution." in run(site, "import fiber")


def test_a_package_that_was_overwritten_says_so(site: Path) -> None:
    package = site / "fiber" / "__init__.py"
    package.unlink()
    package.write_text('__version__ = "0.2.1"\n')
    printed = run(site, "import fiber.futures").splitlines()[-1]
    assert printed.startswith("ImportError: the distribution fiber has overwritten files of Fiber")
    assert "pip uninstall fiber, and then pip install --force-reinstall fiberpool" in printed


def test_pool_is_shown_as_a_method_of_its_context() -> None:
    assert repr(fiber.Pool) == "<bound method BaseContext.Pool of fiber>"
    spawn = fiber.get_context("spawn")
    assert repr(spawn.Pool) == "<bound method BaseContext.Pool of fiber.get_context('spawn')>"
