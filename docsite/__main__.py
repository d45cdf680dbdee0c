"""Command of the site: ``python -m docsite`` writes it to ``build/site``."""

from __future__ import annotations

import sys

from docsite import ROOT, SiteError
from docsite.building import build


def main() -> int:
    """Build the site, and say where it is or what is wrong."""
    try:
        site = build(ROOT / "build")
    except SiteError as error:
        print(f"make docs: {error}", file=sys.stderr)
        return 1
    print(f"open {(site / 'index.html').relative_to(ROOT)} in a browser")
    return 0


if __name__ == "__main__":
    sys.exit(main())
