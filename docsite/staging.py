"""Copies of the pages of ``docs``, whose links outside that folder lead to the code host.

A page of ``docs`` is also read on the code host, so its links are relative paths of the repository.
The site has the folder ``docs`` only.
"""

from __future__ import annotations

import os
import re
import shutil
import tomllib
from pathlib import Path

from docsite import ROOT, SiteError

_LINK = re.compile(r"(!?\[[^]]*\]\()([^)\s#:]+)(#[^)\s]*)?(?=[)\s])")
_FENCE = re.compile(r"(^```.*?^```$)", re.MULTILINE | re.DOTALL)


def stage(target: Path, root: Path = ROOT) -> None:
    """Copy the pages and pictures of ``docs`` into an empty folder ``target``."""
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(root / "docs", target)
    shutil.copytree(root / "docsite" / "assets", target / "assets")
    host = source_address(root)
    for page in target.rglob("*.md"):
        original = root / "docs" / page.relative_to(target)
        page.write_text(with_absolute_links(original, host, root), encoding="utf-8")


def source_address(root: Path = ROOT) -> str:
    """Return the address at which the code host shows files of the repository."""
    with (root / "pyproject.toml").open("rb") as file:
        source: str = tomllib.load(file)["project"]["urls"]["Source"]
    return f"{source}/blob/main"


def with_absolute_links(page: Path, host: str, root: Path = ROOT) -> str:
    """Return the text of a page in which links to files outside of ``docs`` are addresses."""

    def replaced(link: re.Match[str]) -> str:
        path = Path(os.path.normpath(page.parent / link[2]))
        if path.is_relative_to(root / "docs"):
            return link[0]
        if not path.exists():
            raise SiteError(f"{page.relative_to(root)}: {link[2]} does not exist. Mend the link.")
        return f"{link[1]}{host}/{path.relative_to(root)}{link[3] or ''}"

    parts = _FENCE.split(page.read_text(encoding="utf-8"))
    parts[::2] = [_LINK.sub(replaced, part) for part in parts[::2]]
    return "".join(parts)
