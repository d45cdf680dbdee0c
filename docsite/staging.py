"""Copies of the pages of ``docs``, with other links, and without benchmarks in the search.

A page of ``docs`` is also read on the code host, so its links are relative paths of the repository.
The site has the folder ``docs`` and the reference. Links to other files lead to the code host, and
links to sources that have a page of the reference lead there.
"""

from __future__ import annotations

import os
import re
import shutil
import tomllib
from pathlib import Path

from docsite import ROOT, SiteError

_LINK = re.compile(r"(!?\[[^]]*\]\()([^)\s#:]+)(#[^)\s]*)?(?=[)\s])")
_REFERENCE = {
    "sdk/fiber": "reference/fiber.md",
    "sdk/fiber/config.py": "reference/configuration.md",
    "sdk/fiber/errors.py": "reference/errors.md",
}
"""Sources that have a page of the reference."""

_UNSEARCHED = ("benchmarks", "decisions")
"""Folders whose pages the search leaves out: tables of numbers, and reasons of developers.

Almost every word of a question is somewhere in them, so they would come before the guides.
"""

EXCLUDED = "---\nsearch:\n  exclude: true\n---\n\n"
"""Head of a page that the search leaves out."""

_FENCE = re.compile(r"(^```.*?^```$)", re.MULTILINE | re.DOTALL)


def stage(target: Path, root: Path = ROOT) -> None:
    """Copy the pages and pictures of ``docs`` into an empty folder ``target``."""
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(root / "docs", target)
    shutil.copytree(root / "docsite" / "assets", target / "assets")
    host = source_address(root)
    for page in target.rglob("*.md"):
        name = page.relative_to(target)
        text = with_absolute_links(root / "docs" / name, host, root)
        head = EXCLUDED if name.parts[0] in _UNSEARCHED else ""
        page.write_text(head + text, encoding="utf-8")


def source_address(root: Path = ROOT) -> str:
    """Return the address at which the code host shows files of the repository."""
    with (root / "pyproject.toml").open("rb") as file:
        source: str = tomllib.load(file)["project"]["urls"]["Source"]
    return f"{source}/blob/main"


def with_absolute_links(page: Path, host: str, root: Path = ROOT, *, site: bool = True) -> str:
    """Return the text of a page in which links are addresses, except those to the site's pages.

    ``site=False`` is for a text that is read without the site: all its links are addresses.
    """

    def replaced(link: re.Match[str]) -> str:
        path = Path(os.path.normpath(page.parent / link[2]))
        if site and path.is_relative_to(root / "docs"):
            return link[0]
        if not path.exists():
            raise SiteError(f"{page.relative_to(root)}: {link[2]} does not exist. Mend the link.")
        name = str(path.relative_to(root))
        if site and name in _REFERENCE:
            target = os.path.relpath(root / "docs" / _REFERENCE[name], page.parent)
            return f"{link[1]}{target}{link[3] or ''}"
        return f"{link[1]}{host}/{name}{link[3] or ''}"

    parts = _FENCE.split(page.read_text(encoding="utf-8"))
    parts[::2] = [_LINK.sub(replaced, part) for part in parts[::2]]
    return "".join(parts)
