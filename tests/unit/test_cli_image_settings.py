"""The image in pyproject.toml: this key changes, and no other character."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from fiber._cli.image_settings import CannotEdit, nearest, remember, with_image


@pytest.mark.parametrize(
    ("text", "changed"),
    [
        ("", '[tool.fiber]\nimage = "new"\n'),
        ("[project]", '[project]\n\n[tool.fiber]\nimage = "new"\n'),
        ("[tool.fiber]", '[tool.fiber]\nimage = "new"\n'),
        (
            "[tool.fiber] # mine\nretries = 1\n[other]\nimage = 'x'\n",
            "[tool.fiber] # mine\nimage = \"new\"\nretries = 1\n[other]\nimage = 'x'\n",
        ),
        (
            "[ tool . \"fiber\" ]\n  image='old'  # why\nretries = 1\n",
            '[ tool . "fiber" ]\n  image="new"  # why\nretries = 1\n',
        ),
        (
            '[a]\nimage = "old"\n[tool.fiber]\nretries = 1\nimage = "old" # x\n',
            '[a]\nimage = "old"\n[tool.fiber]\nretries = 1\nimage = "new" # x\n',
        ),
        (
            '[a]\ntext = """\n[tool.fiber]\nimage = "old"\n"""\n',
            '[a]\ntext = """\n[tool.fiber]\nimage = "old"\n"""\n\n[tool.fiber]\nimage = "new"\n',
        ),
        (
            "[tool.fiber.sub]\nx = 1\n",
            '[tool.fiber.sub]\nx = 1\n\n[tool.fiber]\nimage = "new"\n',
        ),
        ("[a]\r\nb = 1\r\n", '[a]\r\nb = 1\r\n\r\n[tool.fiber]\r\nimage = "new"\r\n'),
    ],
)
def test_only_the_image_changes(text: str, changed: str) -> None:
    assert with_image(text, "new") == changed
    assert with_image(changed, "new") == changed
    assert tomllib.loads(changed)["tool"]["fiber"]["image"] == "new"


@pytest.mark.parametrize(
    "text",
    [
        "[tool]\nfiber = { retries = 1 }\n",
        "tool.fiber.retries = 1\n",
        '[tool.fiber]\nimage = """old"""\n',
        "[tool]\nfiber = 1\n",
        "no toml",
    ],
)
def test_a_form_that_cannot_be_edited_is_left(text: str, tmp_path: Path) -> None:
    file = tmp_path / "pyproject.toml"
    file.write_text(text)
    with pytest.raises(CannotEdit):
        remember(file, "new")
    assert file.read_text() == text


def test_the_nearest_file_counts(tmp_path: Path) -> None:
    inner = tmp_path / "a" / "b"
    inner.mkdir(parents=True)
    (tmp_path / "pyproject.toml").touch()
    assert nearest(inner) == tmp_path / "pyproject.toml"
    (inner.parent / "pyproject.toml").touch()
    assert nearest(inner) == inner.parent / "pyproject.toml"
