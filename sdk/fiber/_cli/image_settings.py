"""Key ``image`` in ``[tool.fiber]`` of pyproject.toml, set without a change of other text."""

from __future__ import annotations

import copy
import json
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

_WORD = r"(?:{0}|\"{0}\"|'{0}')"
_TABLE = re.compile(
    rf"^[ \t]*\[[ \t]*{_WORD.format('tool')}[ \t]*\.[ \t]*{_WORD.format('fiber')}[ \t]*\]"
    r"[ \t]*(?:#[^\n]*)?(?:\n|\Z)",
    re.MULTILINE,
)
_IMAGE = re.compile(
    rf"^([ \t]*{_WORD.format('image')}[ \t]*=[ \t]*)(?:\"[^\"\n]*\"|'[^'\n]*')", re.MULTILINE
)


class CannotEdit(ValueError):
    """Error: the file has a form that this module does not edit."""


def nearest(folder: Path) -> Path | None:
    """Return the nearest pyproject.toml upward from ``folder``, as a program finds it."""
    found = (each / "pyproject.toml" for each in (folder, *folder.parents))
    return next((each for each in found if each.is_file()), None)


def remember(file: Path, image: str) -> None:
    """Set the key ``image`` in the file; CannotEdit if more would change."""
    with open(file, encoding="utf-8", newline="") as stream:
        text = stream.read()
    new = with_image(text, image)
    with open(file, "w", encoding="utf-8", newline="") as stream:
        stream.write(new)


def with_image(text: str, image: str) -> str:
    """Return the text of a pyproject.toml with this image."""
    newline = "\r\n" if "\r\n" in text else "\n"
    plain = text.replace("\r\n", "\n")
    try:
        wanted = _changed(tomllib.loads(plain), image)
    except (tomllib.TOMLDecodeError, TypeError, AttributeError) as error:
        raise CannotEdit(str(error)) from error
    for candidate in _candidates(plain, json.dumps(image)):
        if _reads_as(candidate, wanted):
            return candidate.replace("\n", newline)
    raise CannotEdit("[tool.fiber] is written in a form that this command does not change")


def _changed(document: dict[str, Any], image: str) -> dict[str, Any]:
    """Return the document with this image and no other change."""
    new = copy.deepcopy(document)
    new.setdefault("tool", {}).setdefault("fiber", {})["image"] = image
    return new


def _candidates(text: str, value: str) -> Iterator[str]:
    """Yield texts that may be right: a value replaced, a line added, a table added."""
    for table in _TABLE.finditer(text):
        start = table.end()
        for line in _IMAGE.finditer(text, start):
            yield f"{text[: line.start()]}{line[1]}{value}{text[line.end() :]}"
        head = text[:start] if text[:start].endswith("\n") else f"{text[:start]}\n"
        yield f"{head}image = {value}\n{text[start:]}"
    end = "" if not text or text.endswith("\n") else "\n"
    gap = "\n" if text.strip() else ""
    yield f"{text}{end}{gap}[tool.fiber]\nimage = {value}\n"


def _reads_as(text: str, wanted: dict[str, Any]) -> bool:
    try:
        return tomllib.loads(text) == wanted
    except tomllib.TOMLDecodeError:
        return False
