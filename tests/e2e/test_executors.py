"""fiber.Executor on pods, and libraries that have their work done by one."""

from __future__ import annotations

import pytest

from cluster import images
from e2e.clusters import Cluster
from e2e.leftovers import leaves_nothing
from e2e.program import PLACES, Programs, local
from e2e.scene import Scene
from e2e.test_program import ever, is_worker

pytestmark = pytest.mark.timeout(240, func_only=True)


@pytest.mark.parametrize("place", ["outside", pytest.param("inside", marks=pytest.mark.long)])
def test_an_executor_works_as_on_one_machine(place: str, programs: Programs, scene: Scene) -> None:
    program = programs.start(place, "executor.py")
    small, large = program.says("options")["hosts"]
    output = program.ends()
    assert words(output.splitlines()) == words(local("executor.py"))
    memory = {name: memory_of(pod) for name, pod in ever(scene, "pods").items() if is_worker(pod)}
    assert [{memory[host] for host in hosts} for hosts in (small, large)] == [{"160Mi"}, {"192Mi"}]
    leaves_nothing(program)


@pytest.mark.long
@pytest.mark.timeout(600, func_only=True)  # the image is built by the first
@pytest.mark.parametrize("place", PLACES)
def test_libraries_find_the_same_as_without_fiber(
    place: str, programs: Programs, cluster: Cluster
) -> None:
    programs.image = cluster.bring(images.SEARCH)
    program = programs.start(place, "searching.py")
    found = words(program.ends(seconds=120).splitlines())
    assert [line.partition(":")[0] for line in found] == ["scikit-learn", "SciPy", "Optuna"]
    assert found == words(local("searching.py"))
    leaves_nothing(program)


def words(lines: list[str]) -> list[str]:
    """Return the program's own lines. Fiber's lines report pods that a busy cluster starts late."""
    return [line for line in lines if not line.startswith(('{"', "[fiber]"))]


def memory_of(pod: dict[str, object]) -> str:
    limits = pod["spec"]["containers"][0]["resources"].get("limits", {})  # type: ignore[index]
    return str(limits.get("memory"))
