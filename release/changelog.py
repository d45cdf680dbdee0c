"""Changelog: news fragments become a section, and the section the notes of the release."""

from __future__ import annotations

import re
import textwrap
import tomllib
from pathlib import Path

from release import ReleaseError

FRAGMENTS, CHANGELOG = Path("changelog.d"), Path("CHANGELOG.md")

_KINDS = {"feature": "New", "change": "Changed", "removal": "Removed", "fix": "Fixed"}
_NAME = re.compile(r"(\d+)\.(feature|change|removal|fix)(-[a-z0-9-]+)?\.md")
_SECTION = re.compile(r"^## ", re.MULTILINE)
_RELATIVE = re.compile(r"\]\((?![a-z]+:|#)([^)]+)\)")


def fragments(root: Path) -> dict[str, list[Path]]:
    """Return the news fragments by their kind, in the order of their issues."""
    found: dict[str, list[tuple[int, Path]]] = {kind: [] for kind in _KINDS}
    for path in sorted((root / FRAGMENTS).glob("*.md")):
        if path.name == "README.md":
            continue
        name = _NAME.fullmatch(path.name)
        if name is None:
            raise ReleaseError(
                f"{FRAGMENTS}/{path.name} is no name of a news fragment. Call it "
                "ISSUE.KIND-WORD.md, where KIND is one of " + ", ".join(_KINDS)
            )
        found[name[2]].append((int(name[1]), path))
    return {kind: [path for _, path in sorted(paths)] for kind, paths in found.items()}


def unreleased(root: Path) -> str:
    """Return the text of a section, without its heading, from the news fragments."""
    parts = [
        f"### {_KINDS[kind]}\n\n" + "".join(map(_item, paths))
        for kind, paths in fragments(root).items()
        if paths
    ]
    return "\n".join(parts)


def collect(root: Path, version: str, date: str) -> None:
    """Move the news fragments to a new section of the changelog, above the others."""
    text = (root / CHANGELOG).read_text(encoding="utf-8")
    news = unreleased(root)
    if not news:
        raise ReleaseError(
            f"{FRAGMENTS} has no news for version {version}. A release has news: add a fragment"
        )
    head, *sections = _SECTION.split(text)
    section = f"{version} ({date})\n\n{news}"
    (root / CHANGELOG).write_text("## ".join([head, section + "\n" * bool(sections), *sections]))
    for path in (path for paths in fragments(root).values() for path in paths):
        path.unlink()


def section(root: Path, version: str) -> str:
    """Return the changelog's section of a released version, without its heading."""
    left = [path.name for paths in fragments(root).values() for path in paths]
    if left:
        raise ReleaseError(
            f"{FRAGMENTS} has {len(left)} news fragments, such as {left[0]}, which the section of "
            f"{version} lacks. Collect them with `make release-prepare VERSION={version}`"
        )
    for text in _SECTION.split((root / CHANGELOG).read_text(encoding="utf-8"))[1:]:
        heading, _, body = text.partition("\n")
        if heading.split()[0] == version:
            return body.strip() + "\n"
    raise ReleaseError(
        f"{CHANGELOG} has no section {version}. Make it with `make release-prepare "
        f"VERSION={version}`"
    )


def absolute_links(root: Path, text: str, tag: str) -> str:
    """Return the text with links to files of the repository at the tag."""
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return _RELATIVE.sub(rf"]({project['urls']['Source']}/blob/{tag}/\1)", text)


def _item(path: Path) -> str:
    text = path.read_text(encoding="utf-8").strip()
    return "* " + textwrap.indent(text, "  ").lstrip() + "\n"
