"""Makes one pool after the other, and says how soon each has a first result."""

from __future__ import annotations

import json
import os
import sys
import time

import fiber


def main() -> None:
    """Eight workers, as many times as the argument says."""
    for _ in range(int(sys.argv[1])):
        asked = time.monotonic()
        with fiber.Pool(8) as pool:
            pool.apply(os.getpid)
            took = time.monotonic() - asked
            print(
                json.dumps({"event": "first", "asked": asked, "took": took}) + "\n",
                end="",
                flush=True,
            )
            pool.map(os.path.basename, ["a/b"] * 100, chunksize=1)


if __name__ == "__main__":
    main()
