"""Examples without a package that they need: one line says what to install."""

from __future__ import annotations

from pathlib import Path

import pytest

from examples.run_example import run


@pytest.mark.parametrize(
    ("script", "package"),
    [
        ("08-poet/train_poet.py", "numpy"),
        ("08-poet/train_poet.py", "matplotlib"),
        ("09-go-explore/go_explore.py", "numpy"),
        ("10-impala/impala.py", "gymnasium"),
    ],
)
def test_a_missing_package_is_named(
    script: str, package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    missing = f"raise ModuleNotFoundError(name={package!r})"
    (tmp_path / f"{package}.py").write_text(missing, encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    said = run(script, status=1).stderr
    name = script.partition("/")[0]
    assert said == f"{name} needs {package}: pip install --editable '.[rl]'\n"
