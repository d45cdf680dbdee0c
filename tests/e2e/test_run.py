"""``fiber run`` as a person uses it: output, exit status, Ctrl-C, a killed terminal, lost pods."""

from __future__ import annotations

import re
import signal
from pathlib import Path

import pytest

from e2e.accounts import ACCOUNT, may_run_programs
from e2e.clusters import Cluster
from e2e.person import Person
from e2e.program import Programs
from e2e.scene import Scene
from patience import PATIENCE

pytestmark = pytest.mark.timeout(300, func_only=True)


@pytest.fixture
def person(scene: Scene, programs: Programs, cluster: Cluster, tmp_path: Path) -> Person:
    may_run_programs(scene)
    return Person(scene, programs, tmp_path, cluster.images["fiber-worker"])


def test_a_program_in_a_pod_has_the_output_and_status_that_it_has_here(person: Person) -> None:
    done = person.runs("run", "--service-account", ACCOUNT, "count.py", "--steps", "3")
    assert done.returncode == 7, done.stderr
    assert done.stdout == "to stdout --steps 3\n[0, 1, 4, 9, 16]\n"
    assert "to stderr\n" in done.stderr
    assert "Traceback" not in done.stderr
    (name,) = person.lists("failed")
    shown = person.runs("logs", name)
    assert "to stdout --steps 3" in shown.stdout
    assert person.runs("stop", name, "--now").returncode == 0
    person.lists()


def test_ctrl_c_interrupts_the_program(person: Person) -> None:
    with person.start("run", "--service-account", ACCOUNT, "--name", "waits", "wait.py") as run:
        assert run.stdout is not None
        assert run.stdout.readline() == "0\n"
        run.send_signal(signal.SIGINT)
        output, errors = run.communicate(timeout=PATIENCE)
    assert run.returncode == 9, errors
    assert output.endswith("interrupted\n")


def test_a_killed_command_leaves_the_program_running(person: Person) -> None:
    with person.start("run", "--service-account", ACCOUNT, "--name", "waits", "wait.py") as run:
        assert run.stdout is not None
        assert run.stdout.readline() == "0\n"
        run.kill()
        run.communicate()
    assert person.lists("running") == ["waits"]
    with person.start("run", "--attach", "waits") as again:
        assert again.stdout is not None
        assert again.stdout.readline() == "0\n"
        person.runs("stop", "waits", "--now")
        again.communicate(timeout=PATIENCE)
    assert again.returncode != 0


def test_the_stack_of_a_worker_that_hangs_in_native_code_is_shown(person: Person) -> None:
    with person.start("run", "--service-account", ACCOUNT, "--name", "hangs", "hang.py") as run:

        def stack() -> str | None:
            found = person.runs("stack", "hangs")
            return found.stdout if " in hang\n" in found.stdout else None

        text = person.scene.wait("the worker hangs", stack, PATIENCE, poll=0.5) or ""
        assert text.startswith("program (pid ")
        assert " in map\n" in text
        (worker,) = (line for line in text.splitlines() if "PoolWorker" in line)
        (pod,) = re.findall("host ([^,]+), busy", worker)
        assert " in hang\n" in person.runs("stack", "hangs", "--worker", pod).stdout
        person.runs("stop", "hangs", "--now")
        run.communicate(timeout=PATIENCE)


def test_output_goes_on_where_it_was_after_the_api_server_was_away(
    person: Person, cluster: Cluster
) -> None:
    with person.start("run", "--service-account", ACCOUNT, "--name", "waits", "wait.py") as run:
        assert run.stdout is not None
        lines = [run.stdout.readline() for _ in range(10)]
        with cluster.without_apiserver():
            pass
        lines += [run.stdout.readline() for _ in range(1500)]
        assert lines == [f"{number}\n" for number in range(1510)]
        run.send_signal(signal.SIGINT)
        run.communicate(timeout=PATIENCE)
    assert run.returncode == 9


def test_a_program_whose_pod_is_deleted_is_lost(person: Person) -> None:
    with person.start("run", "--service-account", ACCOUNT, "--name", "waits", "wait.py") as run:
        assert run.stdout is not None
        assert run.stdout.readline() == "0\n"
        path = person.scene.path("pods", person.pod("waits"))
        person.scene.kube.delete(path, {"gracePeriodSeconds": 0})
        _, errors = run.communicate(timeout=PATIENCE)
    # The program may end by SIGTERM before its pod is gone.
    assert run.returncode in (125, 143), errors
    assert "the program 'waits'" in errors
    assert "deleted" in errors
    assert "Traceback" not in errors


def test_a_program_that_needs_too_much_memory_is_told_so(person: Person) -> None:
    (person.folder / "swell.py").write_text("b'1' * (1 << 30)\n", encoding="utf-8")
    done = person.runs("run", "--service-account", ACCOUNT, "--memory", "160Mi", "swell.py")
    assert done.returncode != 0
    assert "OOMKilled" in done.stderr, done.stderr


def test_an_account_without_rights_is_told_which(person: Person) -> None:
    done = person.runs("run", "count.py")
    assert done.returncode == 125, done.stderr
    assert "fiber-program" in done.stderr
    assert "--service-account" in done.stderr
