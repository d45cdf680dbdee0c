"""The command ``fiber`` as a whole: its words, its help, and what it imports."""

from __future__ import annotations

import importlib
import os
import pkgutil
import subprocess
import sys
from pathlib import Path

import click
import pytest

from fiber import _cli
from fiber._cli import main
from patience import PATIENCE
from unit.pool_command_rig import examples_of, run

GROUP = main._group()
COMMANDS = list(main._COMMANDS)
MODULES = [found.name for found in pkgutil.iter_modules(_cli.__path__, "fiber._cli.")]
HEAVY = {"kubernetes", "urllib3", "websocket", "yaml", "pydantic"}


def in_fresh_interpreter(statement: str, *words: str, **more: str) -> str:
    command = [sys.executable, "-c", statement, *words]
    environment = {**os.environ, **more}
    return subprocess.run(
        command, env=environment, capture_output=True, text=True, check=True, timeout=PATIENCE
    ).stdout


def test_each_command_of_the_help_exists() -> None:
    shown = run("--help").out
    for name, line in main._COMMANDS.items():
        assert f"  {name} " in shown
        assert line in shown
        command = GROUP.get_command(click.Context(GROUP), name)
        assert command is not None
        assert command.name == name


@pytest.mark.parametrize("name", COMMANDS)
def test_each_help_has_two_examples(name: str) -> None:
    command = importlib.import_module(f"fiber._cli.{name}").command
    named = [found for found, _ in examples_of(command)]
    assert named.count(name) == 2
    assert "Examples:\n    fiber" in run(name, "--help").out
    assert run(name, "-h") == run(name, "--help")


@pytest.mark.parametrize("words", [["--help"], ["run", "--help"], ["ps", "--help"], ["--version"]])
def test_help_imports_no_client(words: list[str]) -> None:
    statement = (
        "import sys\n"
        "from fiber._cli import main\n"
        "try: main.main()\n"
        "except SystemExit: print(*sys.modules)\n"
    )
    loaded = in_fresh_interpreter(statement, *words).split()
    assert HEAVY.isdisjoint(loaded)
    if words == ["--help"]:
        assert [name for name in MODULES if name in loaded] == [
            "fiber._cli.failures",
            "fiber._cli.main",
        ]


def test_no_module_of_the_command_imports_a_client() -> None:
    statement = f"import sys, {', '.join(MODULES)}; print(*sys.modules)"
    assert HEAVY.isdisjoint(in_fresh_interpreter(statement).split())


def test_words_that_do_not_exist() -> None:
    assert run("rnu").status == 2
    assert "No such command 'rnu'" in run("rnu").err
    assert run().status == 2
    assert run("--version").out.startswith("fiber ")


def test_without_click_it_says_what_to_install() -> None:
    statement = (
        "import sys\n"
        "sys.modules['click'] = None\n"
        "from fiber._cli import main\n"
        "try: main.main()\n"
        "except SystemExit as end: print(end.code)\n"
    )
    assert in_fresh_interpreter(statement) == "1\n"


def test_a_working_directory_that_is_gone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "gone"
    folder.mkdir()
    monkeypatch.chdir(folder)
    folder.rmdir()
    outcome = run("run", "-m", "package")
    assert outcome.status == 125
    assert outcome.err.startswith("fiber: cannot run the program\n  why:  ")


# ---- completion


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_prints_a_script(shell: str) -> None:
    outcome = run("completion", shell)
    assert outcome.status == 0, outcome
    assert "_FIBER_COMPLETE" in outcome.out
    assert run("completion", "csh").status == 2


def completed(*words: str) -> list[str]:
    """Return what the shell offers for the last word."""
    return in_fresh_interpreter(
        "import sys; sys.argv = ['fiber']; from fiber._cli.main import main; main()",
        _FIBER_COMPLETE="bash_complete",
        COMP_WORDS=" ".join(("fiber", *words)),
        COMP_CWORD=str(len(words)),
    ).split()


def test_commands_and_options_are_completed() -> None:
    assert completed("p") == ["plain,ps", "plain,pool"]
    assert completed("run", "--ti") == ["plain,--timeout"]
    assert completed("pool", "sc") == ["plain,scale"]
