"""Agents that do not fit: wrong credentials, wrong versions, nonsense in their environment."""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import pytest

from faults.program import Program
from fiber._transport import authentication
from fiber._transport.credentials import make_credentials
from fiber._wire.packet_layout import PROTOCOL
from patience import PATIENCE

AGENT = """
    import runpy, sys
    {before}
    sys.argv = ["agent"]
    runpy.run_module("fiber.agent", run_name="__main__")
"""

MASTER = """
    import fiber, sys
    from fiber._transport.listener import MasterListener
    from fiber._transport.loop import Loop
    from fiber._transport.credentials import MasterCredentials
    import pickle
    credentials = pickle.load(open(sys.argv[1], "rb"))
    loop = Loop()
    listener = MasterListener(
        loop, "127.0.0.1:0", credentials,
        on_agent=lambda link: print("joined", link.peer.name, flush=True),
        on_refused=lambda reason: print("refused", reason, flush=True),
    )
    print(listener.address, flush=True)
    loop.run()
"""


@pytest.fixture
def master(
    launch: Callable[..., Program], tmp_path: Path
) -> Callable[..., tuple[Program, Program]]:
    """Starts an agent beside a master that expects it; ``before`` runs in it first."""
    credentials = make_credentials()
    path = tmp_path / "credentials"
    path.write_bytes(pickle.dumps(credentials))
    file = tmp_path / "agent.json"
    file.write_text(json.dumps(asdict(credentials.agent("newcomer", "uid"))))

    def agent(before: str = "", **env: str) -> tuple[Program, Program]:
        listening = launch(MASTER, str(path))
        told = {
            "FIBER_AGENT_ADDRESS": listening.line(),
            "FIBER_AGENT_CREDENTIALS": str(file),
            "FIBER_AGENT_PARENT": str(os.getpid()),
            "FIBER_START_TIMEOUT": "10",
        }
        return listening, launch(AGENT.format(before=before), env={**told, **env})

    return agent


def test_an_agent_that_fits_is_taken(master: Callable[..., tuple[Program, Program]]) -> None:
    listening, agent = master()
    assert listening.line() == "joined newcomer"
    listening.kill()
    agent.kill()


def test_an_agent_with_wrong_credentials_gives_up_early(
    master: Callable[..., tuple[Program, Program]], tmp_path: Path
) -> None:
    other = str(tmp_path / "other")
    Path(other).write_text(json.dumps(asdict(make_credentials().agent("newcomer", "uid"))))
    # It gives up long before its timeout.
    _, agent = master(FIBER_AGENT_CREDENTIALS=other, FIBER_START_TIMEOUT=str(9 * PATIENCE))
    assert agent.wait() == 1
    assert "do not trust each other" in agent.stderr
    assert "Traceback" not in agent.stderr


@pytest.mark.parametrize(
    ("before", "ours", "theirs"),
    [
        (
            "import platform; platform.python_version = lambda: '2.7.18'",
            authentication.Identity.of_this_process("x").python,
            "2.7.18",
        ),
        (
            "import fiber._transport.authentication as h; h.PROTOCOL = 999",
            str(PROTOCOL),
            "999",
        ),
    ],
    ids=["Python", "protocol"],
)
def test_wrong_version_of(
    master: Callable[..., tuple[Program, Program]], before: str, ours: str, theirs: str
) -> None:
    listening, agent = master(before)
    refusal = listening.line()
    assert refusal.startswith("refused")
    assert ours in refusal
    assert theirs in refusal
    assert agent.wait() == 1
    assert ours in agent.stderr
    assert theirs in agent.stderr
    assert "Traceback" not in agent.stderr


@pytest.mark.parametrize(
    ("told", "words"),
    [
        ({"FIBER_AGENT_ADDRESS": ""}, "FIBER_AGENT_ADDRESS is not set"),
        ({"FIBER_AGENT_CREDENTIALS": ""}, "FIBER_AGENT_CREDENTIALS is not set"),
        (
            {"FIBER_AGENT_CREDENTIALS": "garbage"},
            "(7 characters) is neither an absolute path nor fd:N",
        ),
        ({"FIBER_AGENT_CREDENTIALS": "fd:"}, "is neither an absolute path nor fd:N"),
        ({"FIBER_AGENT_CREDENTIALS": "fd:77"}, "the credentials on descriptor 77 cannot be read"),
        ({"FIBER_AGENT_CREDENTIALS": "/no/such/folder"}, "/no/such/folder"),
        ({"FIBER_AGENT_ADDRESS": "nonsense"}, "nonsense"),
        ({"FIBER_AGENT_PARENT": "abc"}, "FIBER_AGENT_PARENT='abc' is not the id of a process"),
        ({"FIBER_AGENT_PARENT": "0"}, "FIBER_AGENT_PARENT='0' is not the id of a process"),
        ({"FIBER_AGENT_LOST_GRACE": "nan"}, "'nan' is not a number of seconds"),
        ({"FIBER_AGENT_ADRESS": "x"}, "Did you mean 'FIBER_AGENT_ADDRESS'?"),
        ({"FIBER_BACKEND": "typo"}, "'typo' for 'backend'"),
        ({"FIBER_AGENT_ADDRESS": "127.0.0.1:1", "FIBER_START_TIMEOUT": "0.5"}, "127.0.0.1:1"),
    ],
    ids=lambda given: " ".join(given) if isinstance(given, dict) else "",
)
def test_an_agent_survives_nonsense(
    master: Callable[..., tuple[Program, Program]], told: dict[str, str], words: str
) -> None:
    _, agent = master(**told)
    assert agent.wait() == 1
    assert words in agent.stderr
    assert "Traceback" not in agent.stderr


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        (["--help"], 0, "FIBER_AGENT_ADDRESS"),
        (["--port", "7"], 2, "unexpected arguments '--port 7'"),
    ],
)
def test_an_agent_with_a_command_line(arguments: list[str], status: int, words: str) -> None:
    command = [sys.executable, "-m", "fiber.agent", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == status
    assert words in (done.stderr if status else done.stdout)
    assert "Traceback" not in done.stderr
