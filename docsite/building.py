"""Build of the site: a copy of ``docs``, the reference, the settings, then the site generator."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from docsite import ROOT, SiteError, checking, reference, staging

SETTINGS = Path(__file__).parent / "mkdocs.yml"
_MODULES = "      # modules\n"
_SOURCES = "@sources@"


def build(folder: Path) -> Path:
    """Write the site to ``folder / "site"``, check its pages, and return that path.

    The generator accepts only folders below the one with its settings. So the settings are
    written to ``folder``, too.
    """
    folder.mkdir(parents=True, exist_ok=True)
    site = folder / "site"
    shutil.rmtree(site, ignore_errors=True)
    staging.stage(folder / "site-source")
    reference.write(folder / "site-source" / "reference")
    (folder / "mkdocs.yml").write_text(settings(), encoding="utf-8")
    _generate(folder / "mkdocs.yml")
    if found := list(checking.mistakes(site)):
        raise SiteError("\n".join(["the site has mistakes:", *found]))
    return site


def settings() -> str:
    """Return the generator's settings with the pages of modules and the folder of the sources."""
    text = SETTINGS.read_text(encoding="utf-8")
    assert _MODULES in text
    assert _SOURCES in text
    return text.replace(_MODULES, "".join(_module_lines())).replace(_SOURCES, str(ROOT / "sdk"))


def _module_lines() -> Iterator[str]:
    for name in reference.MODULES:
        yield f"      - reference/fiber.{name}.md\n"


def _generate(settings: Path) -> None:
    """Run the generator.  Its warnings are errors."""
    command = [sys.executable, "-m", "zensical", "build", "--clean", "--strict", "-f"]
    done = subprocess.run(
        [*command, str(settings)],
        check=False,
        cwd=settings.parent,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    if done.returncode:
        raise SiteError(f"the generator refuses a page:\n{done.stdout}")
