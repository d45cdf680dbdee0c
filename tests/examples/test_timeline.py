"""examples/11-timeline"""

from __future__ import annotations

import pytest

from examples.run_example import BACKENDS, run


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("arguments", [(), ("--chunksize", 12)], ids=["adaptive", "chunks"])
def test_the_summary_advises_smaller_chunks(arguments: tuple[object, ...], backend: str) -> None:
    done = run("11-timeline/uneven.py", *arguments, backend=backend)
    assert "tasks      96 done, 0 of them failed" in done.stdout
    assert ("Pass chunksize=1" in done.stdout) == bool(arguments)
    assert not done.stderr
