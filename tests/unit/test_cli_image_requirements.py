"""Packages of an image: of this environment, of requirements.txt, of pyproject.toml and uv.lock."""

from __future__ import annotations

import importlib.metadata
from pathlib import Path

import pytest

from fiber._cli.failures import CommandError
from fiber._cli.image_packages import Contents, fiber_itself, of_environment, package_of
from fiber._cli.image_requirements import of_file
from unit.image_site import Environment, environment


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Environment:
    return environment(tmp_path, monkeypatch)


def read(folder: Path, text: str, name: str = "requirements.txt") -> Contents:
    (folder / name).write_text(text)
    return of_file(folder / name)


def built(contents: Contents) -> dict[str, str]:
    return {each.name: each.made_of for each in contents.built}


# ---- the environment


def test_origins_of_installed_packages(site: Environment, tmp_path: Path) -> None:
    here = tmp_path.as_uri()
    repository = {"url": "https://g/x", "vcs_info": {"vcs": "git", "commit_id": "1"}}
    site.install("below", origin={**repository, "subdirectory": "python"})
    site.install("archive", origin={"url": "https://a/archive-1.0.tar.gz", "archive_info": {}})
    site.install("folder", origin={"url": here, "dir_info": {}})
    site.install("of-conda", origin={"url": "file:///feedstock/work"}, installer="conda")
    contents = of_environment()
    assert contents.complete
    assert contents.requirements == ("fiberpool==0.1", "of-conda==1.0")
    assert built(contents) == {
        "archive": "archive @ https://a/archive-1.0.tar.gz",
        "below": "below @ git+https://g/x@1#subdirectory=python",
        "folder": str(tmp_path),
    }


def test_remains_of_a_removed_package_are_no_package(site: Environment) -> None:
    (site.folder / "left-1.0.dist-info").mkdir()
    assert of_environment().requirements == ("fiberpool==0.1",)


def test_an_origin_that_cannot_be_read_is_none(site: Environment) -> None:
    site.install("odd", origin=[1])
    assert "odd==1.0" in of_environment().requirements


def test_an_editable_package_of_the_old_kind_is_its_project(tmp_path: Path) -> None:
    info = tmp_path / "old.egg-info"
    info.mkdir()
    (info / "PKG-INFO").write_text("Metadata-Version: 2.1\nName: old\nVersion: 1\n")
    (tmp_path / "setup.py").touch()
    found = package_of(importlib.metadata.PathDistribution(info))
    assert found.made_of == str(tmp_path)


def test_fiber_that_no_installer_knows_is_a_problem(site: Environment) -> None:
    for file in (site.folder / "fiberpool-0.1.dist-info").iterdir():
        file.unlink()
    (site.folder / "fiberpool-0.1.dist-info").rmdir()
    assert "not installed by pip" in fiber_itself().problem
    assert of_environment().built == (fiber_itself(),)


# ---- requirements.txt


def test_fiber_is_added_in_the_version_of_this_environment(
    site: Environment, tmp_path: Path
) -> None:
    contents = read(tmp_path, "numpy>=2 # comment\n# nothing\nFiberPool[kubernetes]==9\n")
    assert contents.requirements == ("numpy>=2", "fiberpool==0.1")
    assert not contents.complete


def test_files_and_constraints_that_a_file_includes(site: Environment, tmp_path: Path) -> None:
    (tmp_path / "more.txt").write_text(
        "scipy==1.15 \\\n    --hash=sha256:00\n-r requirements.txt\n"
    )
    (tmp_path / "bounds.txt").write_text("six==1.17\n")
    contents = read(tmp_path, "-r more.txt\n-c bounds.txt\nnumpy\n")
    assert contents.requirements == ("scipy==1.15 --hash=sha256:00", "numpy")
    assert built(contents) == {"fiberpool": "fiberpool==0.1"}
    assert contents.constraints == ("six==1.17",)


def test_local_packages_of_a_file_become_wheels(site: Environment, tmp_path: Path) -> None:
    for name in ("one", "two", "three"):
        (tmp_path / name).mkdir()
    (tmp_path / "one" / "pyproject.toml").write_text('[project]\nname = "first"\n')
    (tmp_path / "four-1.0-py3-none-any.whl").touch()
    text = "\n".join(
        [
            "-e ./one[extra]",
            "./two",
            f"third @ {(tmp_path / 'three').as_uri()}",
            "four-1.0-py3-none-any.whl",
            "five @ git+https://example/five@abc",
            "git+https://example/six#egg=six",
            "first==1.0",
            "numpy",
        ]
    )
    contents = read(tmp_path, text)
    assert contents.requirements == ("numpy", "fiberpool==0.1")
    assert built(contents) == {
        "first": str(tmp_path / "one"),
        "two": str(tmp_path / "two"),
        "third": str(tmp_path / "three"),
        "four": str(tmp_path / "four-1.0-py3-none-any.whl"),
        "five": "five @ git+https://example/five@abc",
        "six": "git+https://example/six#egg=six",
    }
    assert "line 1 of" in read(tmp_path, "-e ./missing").built[0].problem


@pytest.mark.parametrize("option", ["--index-url", "--extra-index-url=", "-i", "-f"])
@pytest.mark.parametrize("user", ["me:hidden", "${TOKEN}"])
def test_an_index_with_credentials_is_refused(
    site: Environment, tmp_path: Path, option: str, user: str
) -> None:
    with pytest.raises(CommandError) as caught:
        read(tmp_path, f"numpy\n{option} https://{user}@one.example/simple\n")
    assert "line 2 has an index with credentials" in str(caught.value)
    assert "hidden" not in str(caught.value)
    contents = read(tmp_path, f"{option} https://one.example/simple\n")
    assert "one.example" in contents.requirements[0]


@pytest.mark.parametrize(
    ("name", "data"),
    [("missing.txt", None), ("a.txt", b"\xff"), ("pyproject.toml", b"["), ("uv.lock", None)],
)
def test_a_file_that_cannot_be_read(
    site: Environment, tmp_path: Path, name: str, data: bytes | None
) -> None:
    (tmp_path / "pyproject.toml").write_text("")
    if data is not None:
        (tmp_path / name).write_bytes(data)
    with pytest.raises(CommandError, match=f"cannot read .*{name}"):
        of_file(tmp_path / name)


# ---- pyproject.toml and uv.lock

PROJECT = """\
[project]
name = "app"
dependencies = ["numpy>=2", "lib", "tool; sys_platform == 'linux'"]
"""

LOCK = """\
version = 1

[[package]]
name = "app"
source = { virtual = "." }

[[package]]
name = "lib"
version = "3.0"
source = { editable = "lib" }

[[package]]
name = "numpy"
version = "2.1"
source = { registry = "https://pypi.org/simple" }

[[package]]
name = "tool"
version = "1.0"
source = { registry = "https://other.example/simple" }
resolution-markers = ["python_version < '3.12'", "python_version >= '3.12'"]

[[package]]
name = "private"
version = "1.0"
source = { registry = "https://me:hidden@private.example/simple" }

[[package]]
name = "repo"
version = "1.0"
source = { git = "https://g.example/repo?subdirectory=py&rev=main#abc" }

[[package]]
name = "direct"
source = { url = "https://d.example/direct-1.0.zip" }
"""


@pytest.mark.parametrize("name", ["pyproject.toml", "uv.lock"])
def test_a_lock_gives_the_versions(site: Environment, tmp_path: Path, name: str) -> None:
    (tmp_path / "lib").mkdir()
    (tmp_path / "pyproject.toml").write_text(PROJECT)
    (tmp_path / "uv.lock").write_text(LOCK)
    contents = of_file(tmp_path / name)
    assert contents.requirements == (
        "--extra-index-url https://other.example/simple",
        "numpy>=2",
        "tool; sys_platform == 'linux'",
        "fiberpool==0.1",
    )
    assert contents.constraints == (
        "numpy==2.1",
        "tool==1.0 ; python_version < '3.12'",
        "tool==1.0 ; python_version >= '3.12'",
        "private==1.0",
    )
    assert built(contents) == {
        "lib": str(tmp_path / "lib"),
        "repo": "repo @ git+https://g.example/repo@abc#subdirectory=py",
        "direct": "direct @ https://d.example/direct-1.0.zip",
    }
    assert "hidden" not in repr(contents)


def test_without_a_lock_the_versions_are_those_of_this_environment(
    site: Environment, tmp_path: Path
) -> None:
    site.install("numpy", "2.3")
    contents = read(tmp_path, PROJECT, "pyproject.toml")
    assert contents.requirements[0] == "numpy>=2"
    assert contents.constraints == ("numpy==2.3",)
    assert "uv.lock does not exist" in contents.notes[0]
