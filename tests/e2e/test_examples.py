"""The examples give the same results on pods as on one machine."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

import pytest

from cluster import images
from e2e.clusters import Cluster
from e2e.gpus import gpus, wanted
from e2e.leftovers import leaves_nothing
from e2e.program import PLACES, Programs, local

pytestmark = pytest.mark.timeout(240, func_only=True)

ES = ("--env", "CartPole-v1", "--generations", 3, "--population", 16, "--seed", 1, "--workers", 3)
ENVS = ("--envs", 3, "--steps", 40, "--ms", 0.2)
PPO = ("--steps", 10_000, "--envs", 6, "--workers", 3, "--out", "/tmp/curve.png")
SEARCH = ("--samples", 200, "--points", 4, "--trials", 8, "--workers", 2)
MANAGERS = ("--envs", 3, "--updates", 20, "--ms", 0.1, "--out", "/tmp/managers.png")
POET = ("--iterations", 7, "--pairs", 3, "--out", "/tmp/poet.png")
GO_EXPLORE = ("--workers", 2, "--policies", 2, "--episodes", 3000, "--out", "/tmp/go-explore.png")
IMPALA = ("--actors", 2, "--updates", 60, "--out", "/tmp/impala.png")
RING = ("--members", 3, "--samples", 3000, "--steps", 4)


def beginning(pattern: str) -> Callable[[Sequence[str]], list[str]]:
    """Return the rest of each line that begins with this."""
    return lambda lines: [found[0] for line in lines if (found := re.match(pattern, line))]


ES_LINES = beginning(r"(generation|  random|  trained).*")
PI_TO_ONE_PLACE = beginning(r"Pi is roughly 3\.1")  # random numbers have no seed there
RETURNS = beginning(r" *[\d,]+ steps .*")
# A study depends on which trial ends first.
GRID_AND_STUDY = beginning(r"grid .*gamma=\S+|study of 8 trials: [89]")
UPDATES = beginning(r"update .*")
ITERATIONS = beginning(r"iteration .*")
PHASES = beginning(r"round .*|with sticky moves, \d+%")
STEPS = beginning(r"update \d+: [\d,]+ steps")  # which weights an actor has depends on the time
ERRORS = beginning(r"error .*|3 members .*")


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize(
    ("script", "arguments", "results"),
    [
        ("01-pi/pi.py", ("1e5",), PI_TO_ONE_PLACE),
        ("02-es/main.py", (*ES, "--out", "/tmp/learning-curve.png"), ES_LINES),
        ("03-vector-env/piped.py", ENVS, beginning(r".*episodes ended.*")),
        ("03-vector-env/adopted.py", ENVS, beginning(r"observations: the same")),
        pytest.param("04-vector/train_ppo.py", PPO, RETURNS, marks=pytest.mark.long),
        pytest.param("06-managers/train_remote.py", MANAGERS, UPDATES, marks=pytest.mark.long),
        pytest.param("07-ring/regression.py", RING, ERRORS, marks=pytest.mark.long),
        pytest.param("08-poet/train_poet.py", POET, ITERATIONS, marks=pytest.mark.long),
        pytest.param("10-impala/impala.py", IMPALA, STEPS, marks=pytest.mark.long),
    ],
    ids=["pi", "es", "piped", "adopted", "ppo", "managers", "ring", "poet", "impala"],
)
def test_an_example_prints_the_same_as_on_one_machine(
    place: str,
    script: str,
    arguments: tuple[object, ...],
    results: Callable[[Sequence[str]], list[str]],
    programs: Programs,
) -> None:
    program = programs.start(place, script, *arguments)
    output = program.ends(seconds=120)
    expected = results(local(script, *arguments))
    assert expected
    assert results(output.splitlines()) == expected
    leaves_nothing(program)


@pytest.mark.long
@pytest.mark.parametrize("place", PLACES)
def test_go_explore_has_gpus_in_its_second_phase_only(
    place: str, programs: Programs, cluster: Cluster
) -> None:
    script, scene = "09-go-explore/go_explore.py", programs.scene
    with gpus(scene.kube, dict.fromkeys(cluster.workers(), 2)):
        program = programs.start(place, script, *GO_EXPLORE)
        output = program.ends(seconds=120)
    expected = PHASES(local(script, *GO_EXPLORE))
    assert expected
    assert PHASES(output.splitlines()) == expected
    pods = [moment.object for moment in list(scene.moments) if moment.resource == "pods"]
    with_gpu = {pod["metadata"]["name"] for pod in pods if wanted(pod)}
    assert len(with_gpu) == 2
    assert len({pod["metadata"]["name"] for pod in pods}) > len(with_gpu)
    leaves_nothing(program)


@pytest.mark.long
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.timeout(600, func_only=True)  # the image is built by the first
def test_a_search_runs_in_a_custom_image(place: str, programs: Programs, cluster: Cluster) -> None:
    programs.image = cluster.bring(images.SEARCH)
    script = "05-search/search.py"
    output = programs.start(place, script, *SEARCH).ends(seconds=120)
    found = GRID_AND_STUDY(output.splitlines())
    assert len(found) == 2
    assert found == GRID_AND_STUDY(local(script, *SEARCH))
