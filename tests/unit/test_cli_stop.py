"""The command ``fiber stop``: programs that run, that do not answer, and that have ended."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

from fakes.kubernetes_api import Call, Fault
from fiber._cli import stop
from unit.kubernetes_rig import NAMESPACE, Body
from unit.pool_command_rig import Outcome, examples_of
from unit.run_rig import Site, run_site
from unit.test_cli_run import refused

EXAMPLES = [words for _, words in examples_of(stop.command)]


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    with run_site(tmp_path) as made:
        yield made


@pytest.mark.parametrize("words", EXAMPLES, ids=shlex.join)
def test_an_example_of_the_help_succeeds(site: Site, words: list[str]) -> None:
    site.waits()
    command = site.begin("run", "--name", words[1], "train.py")
    assert site.fiber(*words).status == 0
    assert site.end(command).status == 143
    assert len(site.nodes.jobs()) == (0 if "--now" in words else 1)


def test_a_program_may_take_its_time_to_end(site: Site) -> None:
    site.write(
        "train.py",
        "import signal, sys, time\n"
        "signal.signal(signal.SIGTERM, lambda *_: sys.exit('saved'))\n"
        "print('begun', flush=True)\n"
        "while True: time.sleep(0.1)\n",
    )
    command = site.begin("run", "--name", "mine", "train.py")
    assert site.fiber("stop", "mine") == Outcome(0, "asked the program 'mine' to end\n", "")
    assert site.end(command) == Outcome(1, "", "saved\n")
    assert site.fiber("stop", "mine") == Outcome(0, "deleted the program 'mine'\n", "")
    assert site.nodes.jobs() == []


def test_a_pod_that_does_not_answer_is_deleted(site: Site) -> None:
    site.waits()
    site.begin("run", "--name", "mine", "train.py")

    def allows(call: Call) -> bool:
        return call.subresource != "portforward"

    site.server.api.allows = allows
    outcome = site.fiber("stop", "mine")
    assert (outcome.status, outcome.out) == (0, "deleted the program 'mine'\n")
    assert "does not answer" in outcome.err


def test_a_job_of_another_kind_is_no_program(site: Site) -> None:
    site.nodes.auto = False
    template: Body = {"metadata": {}, "spec": {}}
    body = {"metadata": {"name": "backup"}, "spec": {"template": template}}
    site.server.do(site.server.store.create, "jobs", NAMESPACE, body)
    assert refused(site.fiber("stop", "backup", "--now"), 3)[0] == "there is no program 'backup'"
    assert len(site.nodes.jobs()) == 1


def test_a_new_program_of_the_same_name_stays(site: Site) -> None:
    site.nodes.auto = False
    site.write("train.py", "")
    site.spawn("run", "--name", "mine", "train.py")
    site.nodes.wait(site.nodes.jobs)
    fault = Fault("delete", "jobs", 409, "Conflict", "uid in precondition")
    site.server.api.faults.append(fault)
    assert site.fiber("stop", "mine", "--now").status == 0
    assert len(site.nodes.jobs()) == 1
