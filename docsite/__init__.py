"""Documentation as a site: pages of ``docs``, and a reference that the sources give.

python -m docsite            writes build/site
"""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


class SiteError(Exception):
    """A page that would be wrong; says which one, and why."""
