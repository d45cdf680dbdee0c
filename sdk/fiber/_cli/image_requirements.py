"""Packages that a file lists: requirements.txt, or pyproject.toml with uv.lock."""

from __future__ import annotations

import re
import tomllib
import urllib.parse
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from fiber._cli.failures import CommandError
from fiber._cli.image_packages import (
    FIBER,
    Contents,
    Package,
    canonical,
    fiber_itself,
    installed,
    local_path,
)

_NAME = re.compile(r"[A-Za-z0-9](?:[-\w.]*[A-Za-z0-9])?")
_INCLUDE = re.compile(r"(-r|--requirement|-c|--constraint)[\s=]+(.+)")
_EDITABLE = re.compile(r"(?:-e|--editable)[\s=]+(.+)")
_INDEX = re.compile(r"(?:-i|--index-url|--extra-index-url|-f|--find-links)[\s=]+(\S+)")
_DIRECT = re.compile(r"(?:([A-Za-z0-9][-\w.]*)(?:\[[^]]*\])?\s*@\s*)?([a-z+]+:\S+)")
_PYPI = "https://pypi.org/simple"


class _Line(NamedTuple):
    text: str
    file: Path
    number: int
    constrains: bool

    @property
    def place(self) -> str:
        return f"line {self.number} of {self.file}"


def of_file(file: Path, without: Collection[str] = ()) -> Contents:
    """Return the packages that a file lists, with Fiber in the version of this environment."""
    contents = _of_project(file) if file.suffix in (".toml", ".lock") else _of_requirements(file)
    left_out = {canonical(name) for name in without} | {FIBER}
    fiber = fiber_itself()
    built = [each for each in contents.built if canonical(each.name) not in left_out]
    names = left_out | {canonical(each.name) for each in built}
    lines = [line for line in contents.requirements if canonical(name_in(line)) not in names]
    if fiber.made_of or fiber.problem:
        built.append(fiber)
    elif any("--hash" in line for line in lines):
        # pip wants a hash of each line or of none, and this machine knows no hash of Fiber.
        built.append(fiber._replace(made_of=fiber.pin))
    else:
        lines.append(fiber.pin)
    constraints = [line for line in contents.constraints if canonical(name_in(line)) not in names]
    return Contents(tuple(lines), tuple(built), tuple(constraints), notes=contents.notes)


def name_in(line: str) -> str:
    """Return the name of the package in a line of a requirements file; empty if it has none."""
    found = _NAME.match(line)
    return found[0] if found else ""


# ---- requirements.txt


def _of_requirements(file: Path) -> Contents:
    lines, constraints, built = [], [], []
    for line in _lines(file, constrains=False):
        if line.constrains:
            constraints.append(line.text)
        elif package := _local(line):
            built.append(package)
        else:
            _check_index(line)
            lines.append(line.text)
    return Contents(tuple(lines), tuple(built), tuple(constraints))


def _lines(file: Path, *, constrains: bool, seen: tuple[Path, ...] = ()) -> Iterator[_Line]:
    """Yield the lines of the file and of those that it includes."""
    if file in seen:
        return
    text = re.sub(r"[ \t]*\\\r?\n[ \t]*", " ", _text(file))
    for number, line in enumerate(text.splitlines(), 1):
        words = re.sub(r"(^|\s)#.*", "", line).strip()
        if not words:
            continue
        included = _INCLUDE.fullmatch(words)
        if included is None:
            yield _Line(words, file, number, constrains)
            continue
        other = file.parent / included[2].strip()
        bounds = constrains or included[1] in ("-c", "--constraint")
        yield from _lines(other, constrains=bounds, seen=(*seen, file))


def _local(line: _Line) -> Package | None:
    """Return a package that is a folder, an archive or a repository; None for a requirement."""
    editable = _EDITABLE.fullmatch(line.text)
    text = editable[1].strip() if editable else line.text.partition(" ;")[0].strip()
    direct = _DIRECT.match(text)
    if direct and not direct[2].startswith("file:"):
        named = re.search(r"[#&]egg=([-\w.]+)", direct[2])
        name = direct[1] or (named[1] if named else direct[2].rpartition("/")[2])
        return Package(name, "", text)
    path = local_path(direct[2]) if direct else line.file.parent / re.sub(r"\[[^]]*\]$", "", text)
    if not (editable or direct or text.startswith((".", "/")) or text.endswith(".whl")):
        return None
    problem = "" if path.exists() else f"{line.place} names {path}, which does not exist"
    name = (direct and direct[1]) or _name_of_project(path)
    return Package(name, "", str(path.resolve()), problem)


def _name_of_project(path: Path) -> str:
    """Return the name in a project's pyproject.toml, or else that of the file or folder."""
    if path.suffix == ".whl":
        return path.name.partition("-")[0]
    try:
        project = tomllib.loads((path / "pyproject.toml").read_text(encoding="utf-8"))
        return str(project["project"]["name"])
    except (OSError, ValueError, KeyError, TypeError):
        return path.resolve().name


def _check_index(line: _Line) -> None:
    """Raise an error for an index with credentials, which would be in a layer of the build."""
    found = _INDEX.match(line.text)
    if found and has_credentials(found[1]):
        raise CommandError(
            f"cannot use {line.file}",
            f"line {line.number} has an index with credentials, which the image would keep",
            "move it to pip's configuration, which the build sees as a secret: "
            "`pip config set global.extra-index-url URL`",
        )


def has_credentials(url: str) -> bool:
    """Return whether a URL has a user or a password."""
    return "@" in urllib.parse.urlsplit(url).netloc


# ---- pyproject.toml and uv.lock


def _of_project(file: Path) -> Contents:
    project = _toml(file.with_name("pyproject.toml"))
    lines = tuple(str(each) for each in project.get("project", {}).get("dependencies", ()))
    lock = file.with_name("uv.lock")
    if not lock.is_file():
        if file.suffix == ".lock":
            _text(lock)  # raises the error
        pins = tuple(each.pin for each in installed() if not each.made_of)
        note = f"{lock} does not exist: versions are those of this environment"
        return Contents(lines, (), pins, notes=(note,))
    locked = _toml(lock).get("package", ())
    built = tuple(each for each in (_built(entry, file.parent) for entry in locked) if each)
    pins = tuple(line for entry in locked for line in _pins(entry))
    return Contents((*_other_indexes(locked), *lines), built, pins)


def _pins(entry: dict[str, Any]) -> Iterator[str]:
    """Yield the locked version of a package, for the platforms that it is for."""
    if "registry" not in entry.get("source", {}) or "version" not in entry:
        return
    pin = f"{entry['name']}=={entry['version']}"
    markers = entry.get("resolution-markers")
    yield from [f"{pin} ; {marker}" for marker in markers] if markers else [pin]


def _built(entry: dict[str, Any], folder: Path) -> Package | None:
    """Return a package of the lock that no index has."""
    source, name = entry.get("source", {}), str(entry.get("name"))
    for key in ("editable", "directory", "path"):
        if key in source:
            path = (folder / source[key]).resolve()
            problem = "" if path.exists() else f"uv.lock names {path}, which does not exist"
            return Package(name, str(entry.get("version", "")), str(path), problem)
    if "git" in source:
        url = urllib.parse.urlsplit(source["git"])
        asked = urllib.parse.parse_qs(url.query)
        bare = urllib.parse.urlunsplit((url.scheme, url.netloc, url.path, "", ""))
        below = "".join(f"#subdirectory={each}" for each in asked.get("subdirectory", ()))
        return Package(name, "", f"{name} @ git+{bare}@{url.fragment}{below}")
    if "url" in source:
        return Package(name, "", f"{name} @ {source['url']}")
    return None


def _other_indexes(locked: list[dict[str, Any]]) -> list[str]:
    """Return lines for the indexes of the lock other than pypi.org that need no credentials."""
    urls = {str(entry.get("source", {}).get("registry", _PYPI)) for entry in locked}
    found = [url for url in sorted(urls - {_PYPI}) if url.startswith("https:")]
    return [f"--extra-index-url {url}" for url in found if not has_credentials(url)]


def _toml(file: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(_text(file))
    except ValueError as error:
        raise CommandError(f"cannot read {file}", str(error), "correct it") from error


def _text(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or str(error)
        raise CommandError(
            f"cannot read {file}", why, "name a requirements.txt, a pyproject.toml or a uv.lock"
        ) from error
