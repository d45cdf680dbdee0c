"""Run CPython's own tests of executors on fiber.Executor, except the listed ones."""

from __future__ import annotations

import pytest

from conformance.executors import available, run_once


@pytest.mark.skipif(not available(), reason="this Python has no test.test_concurrent_futures")
@pytest.mark.parametrize("backend", ["local", "loopback"])
def test_cpython_tests(backend: str, capsys: pytest.CaptureFixture[str]) -> None:
    verdict = run_once(backend)
    with capsys.disabled():
        print("", verdict.closing_line(), sep="\n")
    assert verdict.ok, verdict.text()
