"""A cluster with the operator installed by Helm, and a namespace for each test."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pytest

from e2e.accounts import may_use_pools
from e2e.clusters import Cluster, NoCluster, choose
from e2e.cordons import uncordon
from e2e.delays import measured, report
from e2e.kube import Body, Kube, path_of
from e2e.pools import Pool, template
from e2e.program import Programs
from e2e.release import Release, crd_owner
from e2e.scene import Scene
from fiber_api import names

RELEASE = "fiber-e2e"
LABEL = "fiber.dev/e2e"
# Seconds for one test, without the fixtures that all tests share: programs may have to be built.
LIMIT = 120
_NO_CLUSTER = pytest.StashKey[str]()
_RELEASE = pytest.StashKey[Release]()
_TROUBLE = pytest.StashKey[str]()

MakeScene = Callable[[str], AbstractContextManager[Scene]]


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        ours = item.path.is_relative_to(Path(__file__).parent)
        if ours and item.get_closest_marker("timeout") is None:
            item.add_marker(pytest.mark.timeout(LIMIT, func_only=True))


@pytest.fixture(scope="session")
def cluster(pytestconfig: pytest.Config) -> Iterator[Cluster]:
    """A Kubernetes cluster whose nodes have Fiber's images; clusters.py says which one."""
    capture = pytestconfig.pluginmanager.getplugin("capturemanager")
    try:
        with capture.global_and_fixture_disabled():  # progress, where something is built
            chosen = choose()
    except NoCluster as error:
        pytestconfig.stash[_NO_CLUSTER] = str(error)
        if os.environ.get("CI") == "true":
            pytest.fail(f"CI=true, and {error}", pytrace=False)
        pytest.skip(str(error))
    yield chosen
    pytestconfig.stash[_TROUBLE] = chosen.trouble()
    chosen.close()


@pytest.fixture(scope="session")
def kube(cluster: Cluster) -> Iterator[Kube]:
    kube = Kube(cluster.kubeconfig)
    try:
        yield kube
    finally:
        kube.close()


@pytest.fixture(scope="session")
def release(
    cluster: Cluster,
    kube: Kube,
    pytestconfig: pytest.Config,
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[Release]:
    """The operator for all namespaces, ready.  Objects of an earlier session are removed."""
    owner = crd_owner(kube)
    if owner not in (None, f"{RELEASE}/{RELEASE}"):
        pytest.fail(
            f"the cluster has FiberPools of the release {owner} already, whose operator and these "
            "tests' would get in each other's way: helm uninstall it, kubectl delete crd "
            f"{names.CRD_NAME}, or take another cluster",
            pytrace=False,
        )
    release = Release(kube, RELEASE, RELEASE, cluster.images, tmp_path_factory.mktemp("helm"))
    uncordon(kube)
    _remove_namespaces(kube)
    release.uninstall()  # left by a session that was killed, perhaps while Helm ran
    # The namespace may still be terminating after the last session, and then accepts no objects.
    kube.delete_namespaces(RELEASE)
    release.install()
    pytestconfig.stash[_RELEASE] = release
    yield release
    _remove_namespaces(kube)
    release.uninstall()
    kube.delete(path_of("customresourcedefinitions", name=names.CRD_NAME))
    kube.delete(path_of("namespaces", name=RELEASE))
    if release.refused:
        pytest.fail(f"the operator lacks rights: {sorted(release.refused)}", pytrace=False)


@pytest.fixture(scope="session")
def make_scene(kube: Kube, release: Release) -> MakeScene:
    """Makes a namespace, watches it, and deletes it at the end without waiting for that."""

    @contextmanager
    def make(name: str) -> Iterator[Scene]:
        path = path_of("namespaces")
        metadata = {"generateName": f"e2e-{_short(name)}-", "labels": {LABEL: "true"}}
        namespace = kube.create(path, {"metadata": metadata})["metadata"]["name"]
        scene = Scene(kube, namespace)
        try:
            yield scene
        finally:
            scene.close()
            kube.delete(f"{path}/{namespace}")

    return make


@pytest.fixture(scope="module")
def module_scene(make_scene: MakeScene, request: pytest.FixtureRequest) -> Iterator[Scene]:
    """A namespace for all tests of a module."""
    with make_scene(Path(request.path).stem) as scene:
        yield scene


@pytest.fixture
def scene(make_scene: MakeScene, request: pytest.FixtureRequest) -> Iterator[Scene]:
    """A namespace of the test's own."""
    with make_scene(request.node.name) as scene:
        yield scene


@pytest.fixture
def pool(scene: Scene) -> Pool:
    """The name of a pool that is not made yet."""
    return Pool(scene, "es")


@pytest.fixture
def bare_cluster(cluster: Cluster, release: Release, kube: Kube) -> Iterator[None]:
    """A cluster that has only Fiber's images; afterwards the operator of all tests."""
    if not cluster.by_version:
        pytest.skip(f"{cluster.description}: its nodes have no images under the chart's version")
    remove_type = ("delete", "--ignore-not-found", "customresourcedefinition", names.CRD_NAME)
    release.uninstall()
    kube.kubectl(*remove_type)
    yield
    kube.kubectl(*remove_type)
    release.install()


@pytest.fixture
def programs(scene: Scene, cluster: Cluster, tmp_path: Path) -> Iterator[Programs]:
    """Starts programs that use Fiber, in a namespace where they may use pools."""
    may_use_pools(scene)
    default = scene.path("serviceaccounts", "default")  # all workers use it; it comes later
    scene.wait("the namespace has its account", lambda: scene.kube.get(default), 60.0, poll=0.2)
    programs = Programs(scene, cluster, tmp_path)
    yield programs
    programs.close()


@pytest.fixture(scope="session")
def agent(cluster: Cluster) -> Body:
    """The template of a worker that runs Fiber's agent."""
    return template(cluster.images["fiber-worker"])


@pytest.fixture(scope="session")
def lone_agent(cluster: Cluster) -> Body:
    """Return the template of a worker that is Ready though the pool's master is nowhere."""
    probe = {"exec": {"command": ["true"]}}
    return template(cluster.images["fiber-worker"], startupProbe=probe)


@pytest.fixture(scope="session")
def image(cluster: Cluster) -> str:
    """The worker's image."""
    return cluster.images["fiber-worker"]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """A failed test shows its namespace and the end of the operator's log."""
    report = yield
    if report.failed and call.when != "teardown":
        found = getattr(item, "funcargs", {}).values()
        for scene in (value for value in found if isinstance(value, Scene)):
            report.sections += scene.account()
        release = item.config.stash.get(_RELEASE, None)
        if release is not None:
            report.sections.append(("the operator's log", release.log()))
    return report


def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter, config: pytest.Config
) -> None:
    if measured:
        terminalreporter.section("seconds from an event to what follows")
        for line in report():
            terminalreporter.line(line)
    if trouble := config.stash.get(_TROUBLE, ""):
        terminalreporter.section("daemons of the cluster that ended by themselves")
        terminalreporter.line(trouble)
    reason = config.stash.get(_NO_CLUSTER, None)
    if reason is not None:
        terminalreporter.section("NO END-TO-END TEST HAS RUN", red=True, bold=True)
        terminalreporter.line(reason)


def _short(name: str) -> str:
    return re.sub("[^a-z0-9]+", "-", name.lower()).removeprefix("test-")[:40].strip("-")


def _remove_namespaces(kube: Kube) -> None:
    kube.delete_namespaces("--selector", f"{LABEL}=true")
