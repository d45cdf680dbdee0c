"""Checks of the written pages: links lead somewhere, and nothing comes from another host."""

from __future__ import annotations

from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

_LOADS = {
    "audio": "src",
    "embed": "src",
    "iframe": "src",
    "img": "src",
    "link": "href",
    "object": "data",
    "script": "src",
    "source": "src",
    "video": "src",
}
"""Elements that make a browser load an address, and the attribute that has it."""

_REFERENCES = frozenset({"alternate", "canonical", "next", "prev"})
"""Relations of a ``link`` that a browser does not load."""


class Page(HTMLParser):
    """Anchors and addresses of one page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        self.anchors |= {values[name] for name in ("id", "name") if name in values}
        if tag == "a" and "href" in values:
            self.links.append(values["href"])
        loads = tag in _LOADS and not _REFERENCES & set(values.get("rel", "").split())
        if loads and values.get(_LOADS[tag]):
            self.loaded.append(values[_LOADS[tag]])


def mistakes(site: Path) -> Iterator[str]:
    """Yield a line for each link that leads nowhere, and for each load from another host."""
    site = site.resolve()
    pages = {path: Page(path.read_text(encoding="utf-8")) for path in site.rglob("*.html")}
    if not pages:
        yield f"{site} has no page"
    for path, page in pages.items():
        # The page of an unknown address has links from the root of a server.
        if path.name != "404.html":
            yield from (f"{path.relative_to(site)}: {what}" for what in _of(path, page, pages))
    yield from _styles(site)


def _of(path: Path, page: Page, pages: dict[Path, Page]) -> Iterator[str]:
    for address in page.loaded:
        if urlsplit(address).scheme not in ("", "data") or address.startswith("//"):
            yield f"loads {address} from another host"
        elif not urlsplit(address).scheme and not (path.parent / _file(address)).exists():
            yield f"loads {address}, which does not exist"
    for address in page.links:
        parts = urlsplit(address)
        if parts.scheme or parts.netloc:
            continue
        target = (path.parent / _file(address)).resolve() if parts.path else path.resolve()
        if not target.is_file():
            yield f"links to {address}, which does not exist"
        elif target in pages and parts.fragment and not _has(pages[target], parts.fragment):
            yield f"links to {address}, which has no such place"


def _file(address: str) -> str:
    return unquote(urlsplit(address).path)


def _has(page: Page, fragment: str) -> bool:
    return fragment in page.anchors or unquote(fragment) in page.anchors


def _styles(site: Path) -> Iterator[str]:
    for path in site.rglob("*.css"):
        text = path.read_text(encoding="utf-8")
        if "url(http" in text or "url(//" in text or '@import"http' in text:
            yield f"{path.relative_to(site)}: loads a file from another host"
