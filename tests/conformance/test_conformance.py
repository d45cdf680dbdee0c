"""Run CPython's own multiprocessing tests on Fiber, except those that `exclusions` explains."""

from __future__ import annotations

import pytest

from conformance.run import METHODS, run_once

RUNS = [(backend, method) for backend, methods in METHODS.items() for method in methods]


@pytest.mark.parametrize(("backend", "method"), RUNS)
def test_cpython_tests(
    backend: str,
    method: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("KUBECONFIG", raising=False)  # it is for `make conformance`
    verdict = run_once(backend, method)
    with capsys.disabled():
        print("", verdict.closing_line(), sep="\n")
    assert verdict.ok, verdict.text()
