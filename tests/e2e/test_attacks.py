"""Attackers in pods: a task that wants to be another worker, and a pod without any right."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import pytest

from e2e.accounts import kubeconfig_of
from e2e.clusters import find_program
from e2e.kube import Body, run
from e2e.leftovers import leaves_nothing
from e2e.pools import says
from e2e.program import Programs
from e2e.scene import Scene
from e2e.test_drain import squares
from e2e.test_program import workers

pytestmark = pytest.mark.timeout(240, func_only=True)

AGENT = {"/proc/1/environ", "/proc/1/mem"}
"""Files of the agent, the first process of its container, that tasks must not open."""

STRANGER = """
import json, os, pathlib, socket, ssl, subprocess, sys
address, credentials = sys.argv[1:]
host, _, port = address.rpartition(":")
context = ssl.create_default_context()
context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
with socket.create_connection((host, int(port)), 30) as plain:
    try:
        with context.wrap_socket(plain) as stranger:
            stranger.sendall(b"let me in" * 100)
            stranger.recv(32)  # random bytes, as everybody gets
            print("heard", stranger.recv(100))
    except OSError:
        print("heard", b"")
file = pathlib.Path("/tmp/agent.json")
file.write_text(credentials)
os.environ |= {"FIBER_AGENT_ADDRESS": address, "FIBER_AGENT_CREDENTIALS": str(file)}
sys.exit(subprocess.run([sys.executable, "-m", "fiber.agent"]).returncode)
"""


def test_a_task_finds_no_credentials_and_is_no_other_worker(programs: Programs) -> None:
    program = programs.start("outside", "spying.py")
    spied = program.says("spied")
    assert spied["found"].keys() == {"canary, hexadecimal"}, spied
    assert not AGENT & set(spied["opened"]), spied
    posed = program.says("posed")
    for case in ("as another", "as none"):
        assert says(posed[case], "do not trust each other", "Give the agent the credentials")
    assert says(posed["a second time"], "has a link already", "End the process")
    assert len(program.says("done")["hosts"]) == 2
    output = program.ends()
    assert f"it cannot prove that it is {posed['other']!r}" in output
    leaves_nothing(program)


def test_a_pod_without_rights_gets_no_word_of_a_program(
    programs: Programs, scene: Scene, image: str
) -> None:
    program = programs.start("outside", "mapping.py", "--tasks", 20, "--workers", 1, "--stay")
    program.says("done")
    (worker,) = workers(scene)
    (pool,) = scene.now["fiberpools"].values()
    master = pool["spec"]["master"]
    claimed = {key: worker["metadata"][key] for key in ("name", "uid")}
    forged = {**claimed, "key": "0" * 64, "master": master["certificate"]}
    stranger = pod(image, f"{master['host']}:{master['port']}", json.dumps(forged))
    scene.kube.create(scene.path("pods"), stranger)
    scene.wait("the stranger has ended", lambda: has_failed(scene.now["pods"].get("stranger")), 60)
    said = scene.kube.text(scene.path("pods", "stranger", "log"))
    assert says(said, "heard b''", "do not trust each other", "Give the agent the credentials")
    program.prints(f"it cannot prove that it is {forged['name']!r}")
    scene.kube.delete(scene.path("pods", "stranger"))
    program.interrupt()
    program.ends(-signal.SIGINT)
    leaves_nothing(program)


def test_a_neighbour_changes_and_deletes_the_pool_of_a_program(
    programs: Programs, scene: Scene, tmp_path: Path
) -> None:
    """A known limit: the role fiber-user is for one namespace, not for one pool."""
    config = kubeconfig_of(scene, tmp_path)
    program = programs.start("outside", "mapping.py", "--tasks", 200, "--seconds", 0.2)
    program.says("first")
    (pool,) = scene.now["fiberpools"]
    neighbour = (find_program("kubectl"), "--kubeconfig", config, "--namespace", scene.namespace)
    change = json.dumps({"spec": {"template": {"metadata": {"labels": {"from": "neighbour"}}}}})
    run(*neighbour, "patch", "fiberpool", pool, "--type=merge", "--patch", change)
    run(*neighbour, "delete", "fiberpool", pool, "--wait=false")
    program.prints(f"the FiberPool {pool!r} in namespace {scene.namespace!r} was deleted")
    assert program.says("done", seconds=90)["total"] == squares(200)
    program.ends()
    leaves_nothing(program)


def pod(image: str, *arguments: str) -> Body:
    container = {
        "name": "stranger",
        "image": image,
        "command": ["python", "-c", STRANGER, *arguments],
        "resources": {"requests": {"cpu": "5m", "memory": "16Mi"}},
    }
    spec = {
        "automountServiceAccountToken": False,
        "restartPolicy": "Never",
        "containers": [container],
    }
    return {"metadata": {"name": "stranger"}, "spec": spec}


def has_failed(found: Body | None) -> bool:
    return found is not None and found["status"].get("phase") == "Failed"
