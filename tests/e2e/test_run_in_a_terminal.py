"""``fiber run`` in a terminal: Ctrl-C at every stage, a closed window, attaching, stopping."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from e2e.accounts import ACCOUNT, may_run_programs
from e2e.clusters import Cluster
from e2e.kube import Body
from e2e.person import Person
from e2e.pools import is_ready
from e2e.program import Programs
from e2e.scene import Scene
from fiber_api import names

pytestmark = pytest.mark.timeout(300, func_only=True)

RUN = ("run", "--service-account", ACCOUNT, "--name", "mine")
ENDS = """
import atexit, signal, time

def end():
    print("ending", flush=True)
    time.sleep(600)

atexit.register(end)
print("running", flush=True)
"""
STOPS = """
import signal, sys, time

def terminated(*_):
    print("saving", flush=True)
    sys.exit(5)

signal.signal(signal.SIGTERM, terminated)
print("running", flush=True)
while True:
    time.sleep(0.1)
"""
WORKERS = """
import signal
import fiber

def work(number):
    print("the worker says its last words", flush=True)
    signal.pause()

if __name__ == "__main__":
    with fiber.Pool(1) as pool:
        pool.map(work, [0])
"""


@pytest.fixture
def person(scene: Scene, programs: Programs, cluster: Cluster, tmp_path: Path) -> Person:
    may_run_programs(scene)
    return Person(scene, programs, tmp_path, cluster.images["fiber-worker"])


def runs(person: Person) -> bool:
    """Return whether the program's pod runs."""
    pods = person.scene.now["pods"].values()
    return any(pod["status"]["phase"] == "Running" for pod in pods)


def has_no_program(person: Person) -> None:
    """Wait until there is neither a program nor its pod."""
    person.lists()
    person.scene.wait("no pod is left", lambda: not person.scene.now["pods"])


def test_ctrl_c_while_the_pod_waits_ends_the_program(person: Person) -> None:
    with person.terminal(*RUN, "--cpu", "900", "wait.py") as terminal:
        terminal.shows("waiting for the program 'mine': its pod has no node")
        terminal.press(terminal.CTRL_C)
        assert terminal.ends() == 130
        assert "fiber: the program 'mine' was ended" in terminal.shown
    has_no_program(person)


def test_ctrl_c_while_the_files_are_sent_ends_the_program(person: Person) -> None:
    # So much that does not compress takes seconds to send, from when the pod runs.
    (person.folder / "large.bin").write_bytes(os.urandom(90 << 20))
    with person.terminal(*RUN, "wait.py") as terminal:
        person.scene.wait("the pod runs", lambda: runs(person))
        terminal.press(terminal.CTRL_C)
        assert terminal.ends() == 130
        assert "fiber: the program 'mine' was ended" in terminal.shown
    has_no_program(person)


def test_ctrl_c_while_it_runs_and_again_while_it_ends(person: Person) -> None:
    (person.folder / "ends.py").write_text(ENDS + "import signal\nsignal.pause()\n")
    with person.terminal(*RUN, "ends.py") as terminal:
        terminal.shows("running")
        terminal.press(terminal.CTRL_C)
        terminal.shows("interrupting the program; Ctrl-C again ends it")
        terminal.shows("ending")
        terminal.press(terminal.CTRL_C)
        assert terminal.ends() == 130
        assert "fiber: the program 'mine' was ended" in terminal.shown
    has_no_program(person)


def test_after_the_window_is_closed_ps_says_how_to_get_back(person: Person) -> None:
    with person.terminal(*RUN, "wait.py") as terminal:
        terminal.shows("1\n")
    with person.terminal("ps") as ps:
        ps.shows("mine   running")
        ps.shows("`fiber run --attach NAME` follows one again")
        assert ps.ends() == 0
    with person.terminal("run", "--attach", "mine") as first:
        first.shows("0\n1\n2\n")
        with person.terminal("run", "--attach", "mine") as second:
            second.shows("0\n1\n2\n")
            first.press(first.CTRL_C)
            assert (first.ends(), second.ends()) == (9, 9)
            assert "interrupted" in first.shown
            assert "interrupted" in second.shown


def test_stop_lets_a_program_end_and_stop_now_does_not(person: Person) -> None:
    (person.folder / "stops.py").write_text(STOPS)
    with person.terminal(*RUN, "stops.py") as terminal:
        terminal.shows("running")
        assert person.runs("stop", "mine").stdout == "asked the program 'mine' to end\n"
        terminal.shows("saving")
        assert terminal.ends() == 5
    assert "saving" in person.runs("logs", "mine").stdout  # it is kept
    assert person.runs("stop", "mine", "--now").returncode == 0
    has_no_program(person)
    with person.terminal(*RUN, "wait.py") as terminal:
        terminal.shows("1\n")
        assert person.runs("stop", "mine", "--now").stdout == "deleted the program 'mine'\n"
        assert terminal.ends() in (125, 143)
        assert "fiber: the program 'mine' was deleted" in terminal.shown
    has_no_program(person)


def worker(person: Person) -> Body | None:
    """Return the pod of a worker that is Ready."""
    pods = person.scene.now["pods"].values()
    ours = (pod for pod in pods if names.LABEL_POOL in pod["metadata"]["labels"])
    return next((pod for pod in ours if is_ready(pod)), None)


def test_what_a_worker_said_before_it_died_is_in_the_log_of_its_program(
    person: Person, cluster: Cluster
) -> None:
    (person.folder / "workers.py").write_text(WORKERS)
    with person.terminal(*RUN, "workers.py") as terminal:
        terminal.shows("the worker says its last words")
        pod = person.scene.wait("its pod is ready", lambda: worker(person))
        assert pod is not None
        cluster.kill(pod, names.WORKER_CONTAINER)
        terminal.shows("the worker says its last words")  # another one, whose turn it is
        (line, _) = [
            line
            for line in person.runs("logs", "mine").stdout.splitlines()
            if "the worker says its last words" in line
        ]
        assert pod["metadata"]["name"] in line
        person.runs("stop", "mine", "--now")
    has_no_program(person)
