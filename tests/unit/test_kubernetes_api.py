"""The door to the Kubernetes API: logging in, calls, what goes wrong, watches."""

from __future__ import annotations

import base64
import contextlib
import math
import ssl
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from kubernetes.config import incluster_config

from fakes.certificates import RUN_VALIDITY, Certificates, make_certificates
from fakes.kubernetes_api import Fault
from fakes.served import Served, served
from fiber._backends.kubernetes.api import Api
from fiber._backends.kubernetes.problems import explain
from fiber.errors import ConfigError
from fiber_api.rest import (
    PODS,
    ApiError,
    Conflict,
    Expired,
    Forbidden,
    Invalid,
    NotFound,
    ServerError,
    ServerUnreachable,
    TooManyRequests,
    Transient,
    Unauthorized,
)
from patience import PATIENCE
from unit.kubernetes_rig import NAMESPACE, kubeconfig

POD = {"metadata": {"name": "a", "labels": {"app": "x"}}, "spec": {}}
ONE = PODS.path(NAMESPACE, "a")
ALL = PODS.path(NAMESPACE)


@pytest.fixture
def server() -> Iterator[Served]:
    with served() as server:
        yield server


@pytest.fixture
def connect() -> Iterator[Callable[..., Api]]:
    """``Api.connect``; what it makes is closed with the test."""
    with contextlib.ExitStack() as ends:

        def connect(context: str | None = None) -> Api:
            return ends.enter_context(contextlib.closing(Api.connect(context)))

        yield connect


@pytest.fixture
def api(
    server: Served, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, connect: Callable[..., Api]
) -> Api:
    monkeypatch.setenv("KUBECONFIG", str(kubeconfig(tmp_path, server.api.url)))
    return connect()


# -- Logging in


def test_the_current_context_gives_namespace_server_and_token(server: Served, api: Api) -> None:
    assert (api.namespace, api.in_cluster, api.server) == (NAMESPACE, False, "127.0.0.1")
    api.list(ALL)
    assert server.api.tokens == ["Bearer one"]


def test_a_context_without_a_namespace_has_the_default_one(api: Api) -> None:
    assert Api.connect("bare").namespace == "default"


def test_a_context_that_is_not_there(api: Api) -> None:
    with pytest.raises(ConfigError, match=r"elsewhere.*get-contexts"):
        Api.connect("elsewhere")


@pytest.mark.parametrize("content", [None, "", "[]", "clusters: 3", "{", "current-context: here"])
def test_an_invalid_kubeconfig_is_named(
    content: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "kubeconfig"
    if content is not None:
        path.write_text(content)
    monkeypatch.setenv("KUBECONFIG", str(path))
    with pytest.raises(ConfigError, match=f"{path} cannot be used.*FIBER_BACKEND=local"):
        Api.connect()


@pytest.mark.parametrize("package", ["kubernetes", "pathspec"])
def test_the_error_of_a_missing_package_says_how_to_install_it(
    package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ConfigError, match=rf"{package}.*pip install 'fiberpool\[kubernetes\]'"):
        Api.connect()


def test_only_a_connection_imports_the_package() -> None:
    program = (
        "import sys, fiber._backends.kubernetes.fiber_pool, fiber._backends.kubernetes.provisioner;"
        "print([name for name in ('kubernetes', 'urllib3') if name in sys.modules])"
    )
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert ran.stdout == "[]\n", ran.stderr


def test_a_login_plugin_is_asked_again_when_its_token_is_not_accepted(
    server: Served, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, connect: Callable[..., Api]
) -> None:
    token = tmp_path / "token"
    token.write_text("one")
    credential = '{"apiVersion":"client.authentication.k8s.io/v1","kind":"ExecCredential",'
    plugin = {
        "apiVersion": "client.authentication.k8s.io/v1",
        "command": "sh",
        "args": ["-c", f'echo \'{credential}"status":{{"token":"\'$(cat {token})\'"}}}}\''],
        "interactiveMode": "Never",
    }
    monkeypatch.setenv("KUBECONFIG", str(kubeconfig(tmp_path, server.api.url, {"exec": plugin})))
    api = connect()
    server.api.accepts = {"Bearer one"}
    api.list(ALL)
    server.api.accepts = {"Bearer two"}
    token.write_text("two")
    api.list(ALL)
    server.api.accepts = set()
    with pytest.raises(Unauthorized):
        api.list(ALL)


def test_the_certificates_of_a_kubeconfig_leave_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The package would delete them when the interpreter exits: before our pools are deleted, and
    never if it is killed.
    """
    made = make_certificates("localhost", "nobody", valid_for=RUN_VALIDITY)
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    with served(_server_side(made, tmp_path)) as server:
        url = f"https://localhost:{server.api.port}"
        file = kubeconfig(
            tmp_path,
            url,
            {
                "client-certificate-data": _base64(made.agent.certificate),
                "client-key-data": _base64(made.agent.key),
            },
            **{"certificate-authority-data": _base64(made.authority)},
        )
        monkeypatch.setenv("KUBECONFIG", str(file))
        for _ in range(2):  # the package remembers the names of its files
            with contextlib.closing(Api.connect()) as api:
                assert list(temporary.iterdir()) == []
                api.list(ALL, timeout=0)
        assert "Bearer one" not in server.api.tokens


def _base64(text: str) -> str:
    return base64.b64encode(text.encode()).decode()


def test_a_kubeconfig_that_names_its_files_needs_no_folder_to_write_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = make_certificates("localhost", "nobody", valid_for=RUN_VALIDITY)
    (tmp_path / "ca.crt").write_text(made.authority)
    with served(_server_side(made, tmp_path)) as server:
        url = f"https://localhost:{server.api.port}"
        file = kubeconfig(tmp_path, url, **{"certificate-authority": str(tmp_path / "ca.crt")})
        monkeypatch.setenv("KUBECONFIG", str(file))
        monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "missing"))
        with contextlib.closing(Api.connect()) as api:
            api.list(ALL, timeout=0)


def test_invalid_certificates_of_a_kubeconfig_are_an_error_that_names_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = kubeconfig(tmp_path, "https://localhost:1", **{"certificate-authority-data": "bm9uZQ=="})
    monkeypatch.setenv("KUBECONFIG", str(file))
    with pytest.raises(ConfigError, match=f"cannot log in to the cluster by {file}"):
        Api.connect()


# -- The account of a pod


@pytest.fixture
def account(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Served, Path]]:
    """An API server that knows the account's token, and the folder that the account is in."""
    made = make_certificates("localhost", "nobody", valid_for=RUN_VALIDITY)
    with served(_server_side(made, tmp_path)) as server:
        (tmp_path / "ca.crt").write_text(made.authority)
        (tmp_path / "namespace").write_text("lab\n")
        (tmp_path / "token").write_text("one")
        monkeypatch.delenv("KUBECONFIG", raising=False)
        monkeypatch.setenv("KUBERNETES_SERVICE_HOST", "localhost")
        monkeypatch.setenv("KUBERNETES_SERVICE_PORT", str(server.api.port))
        monkeypatch.setattr("fiber._backends.kubernetes.api._ACCOUNT", str(tmp_path))
        files = {"SERVICE_TOKEN_FILENAME": "token", "SERVICE_CERT_FILENAME": "ca.crt"}
        for constant, file in files.items():
            monkeypatch.setattr(incluster_config, constant, str(tmp_path / file))
        yield server, tmp_path


def _server_side(made: Certificates, folder: Path) -> ssl.SSLContext:
    pem = folder / "server.pem"
    pem.write_text(f"{made.master.certificate}\n{made.master.key}\n")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(pem)
    return context


def test_a_program_in_a_pod_uses_the_pods_account(
    account: tuple[Served, Path], connect: Callable[..., Api]
) -> None:
    server, _ = account
    api = connect()
    assert (api.namespace, api.in_cluster, api.server) == ("lab", True, "localhost")
    api.list(ALL)
    assert [token.lower() for token in server.api.tokens] == ["bearer one"]


def test_the_accounts_token_is_read_again_once_it_has_expired(
    account: tuple[Served, Path], connect: Callable[..., Api]
) -> None:
    server, folder = account
    api = connect()
    server.api.accepts = {"bearer two"}
    (folder / "token").write_text("two")  # as the kubelet replaces it
    api.list(ALL)
    assert server.api.tokens[-1] == "bearer two"


def test_an_account_whose_token_is_gone_is_unauthorized(
    account: tuple[Served, Path], connect: Callable[..., Api]
) -> None:
    server, folder = account
    api = connect()
    server.api.accepts = set()
    (folder / "token").unlink()
    with pytest.raises(Unauthorized, match="token file"):
        api.list(ALL)


def test_a_pod_without_an_account_gets_the_remedy(account: tuple[Served, Path]) -> None:
    _, folder = account
    (folder / "namespace").unlink()
    with pytest.raises(ConfigError, match="automountServiceAccountToken"):
        Api.connect()


# asyncio of Python 3.12, which serves here, never closes connections that a client cut off within
# TLS.
@pytest.mark.filterwarnings("ignore:Exception ignored in:pytest.PytestUnraisableExceptionWarning")
def test_a_watch_over_tls_is_stopped_from_another_thread(
    account: tuple[Served, Path], connect: Callable[..., Api]
) -> None:
    _watch_and_stop(connect())


def test_an_authority_that_signed_another_server_is_unreachable(
    account: tuple[Served, Path], connect: Callable[..., Api]
) -> None:
    _, folder = account
    strangers = make_certificates("localhost", "nobody", valid_for=RUN_VALIDITY)
    (folder / "ca.crt").write_text(strangers.authority)
    api = connect()
    with pytest.raises(ServerUnreachable, match=r"(?i)certificate"):
        api.list(ALL, timeout=0)


# -- Calls


def test_objects_are_made_read_changed_and_deleted(server: Served, api: Api) -> None:
    made = api.create(ALL, POD)
    assert api.get(ONE) == made
    assert api.merge_patch(ONE, {"spec": {"nodeName": "n"}})["spec"] == {"nodeName": "n"}
    assert [pod["metadata"]["name"] for pod in api.list(ALL)["items"]] == ["a"]
    assert api.list(ALL, {"labelSelector": "app=y"})["items"] == []
    with pytest.raises(Conflict):
        api.delete(ONE, uid="another")
    api.delete(ONE, uid=made["metadata"]["uid"])
    with pytest.raises(NotFound) as caught:
        api.get(ONE)
    assert (caught.value.status, caught.value.reason) == (404, "NotFound")


@pytest.mark.parametrize(
    ("status", "kind"),
    [(401, Unauthorized), (403, Forbidden), (404, NotFound), (409, Conflict), (422, Invalid)],
)
def test_permanent_errors_are_raised_at_once(
    server: Served, api: Api, status: int, kind: type[ApiError]
) -> None:
    server.api.faults.append(Fault("list", "pods", status=status, message="why", times=99))
    with pytest.raises(kind, match="why") as caught:
        api.list(ALL)
    assert type(caught.value) is kind
    assert server.api.count("list", "pods") == (2 if status == 401 else 1)


@pytest.mark.parametrize(
    "fault",
    [
        Fault(status=500),
        Fault(status=503),
        Fault(status=429, retry_after=0),
        Fault(),
        Fault(text="<html>"),
    ],
)
def test_transient_errors_are_tried_again(server: Served, api: Api, fault: Fault) -> None:
    fault.verb, fault.times = "list", 2
    server.api.faults.append(fault)
    assert api.list(ALL)["items"] == []
    assert server.api.count("list", "pods") == 3


def test_a_call_with_timeout_0_makes_one_attempt(server: Served, api: Api) -> None:
    server.api.faults.append(Fault(status=503, times=9))
    with pytest.raises(ServerError):
        api.list(ALL, timeout=0.0)
    assert server.api.count("list", "pods") == 1


def test_a_retry_after_beyond_the_deadline_is_not_waited_for(server: Served, api: Api) -> None:
    server.api.faults.append(Fault(status=429, retry_after=20, times=9))
    pauses = Pauses()
    with pytest.raises(TooManyRequests) as caught:
        api.list(ALL, timeout=5.0, cancel=pauses)
    assert caught.value.retry_after == 20
    assert pauses.seconds == []


class Pauses(threading.Event):
    """An event whose ``wait`` takes no time and notes how long it should have taken."""

    def __init__(self) -> None:
        super().__init__()
        self.seconds = list[float | None]()

    def wait(self, timeout: float | None = None) -> bool:
        self.seconds.append(timeout)
        return False


@pytest.mark.parametrize("status", [429, 503])
def test_a_retry_after_is_respected(server: Served, api: Api, status: int) -> None:
    server.api.faults.append(Fault(status=status, retry_after=3))
    pauses = Pauses()
    api.list(ALL, cancel=pauses)
    assert pauses.seconds == [3]


@pytest.mark.parametrize(
    ("fault", "kind", "reason", "said"),
    [
        (Fault(status=500), ServerError, "InternalError", "this is a test. The API server kube"),
        (Fault(status=500), ServerError, "InternalError", "HTTP status 500.*/readyz"),
        (Fault(status=503, reason=""), ServerError, "InternalError", "HTTP status 503"),
        (Fault(status=502, text="<html>bad gateway"), ServerError, "InternalError", "bad gateway"),
        (Fault(status=429, reason=""), TooManyRequests, "TooManyRequests", "try again later"),
        (Fault(), ServerUnreachable, "Unreachable", "cannot be reached.*kubectl cluster-info"),
        (Fault(status=302, text=""), ServerUnreachable, "Unreachable", "HTTP status 302"),
    ],
)
def test_a_server_that_answers_is_reachable(
    server: Served, api: Api, fault: Fault, kind: type[Transient], reason: str, said: str
) -> None:
    fault.times = 99
    server.api.faults.append(fault)
    with pytest.raises(kind) as caught:
        api.list(ALL, timeout=0.0)
    assert api.trouble == str(caught.value)
    told = explain(caught.value, "list", pool="es", namespace="lab", server="kube")
    assert told.reason == reason
    assert ("cannot be reached" in str(told)) == (kind is ServerUnreachable)
    with pytest.raises(type(told), match=said):
        raise told
    server.api.faults.clear()
    api.list(ALL)
    assert api.trouble is None


def test_attempts_end_when_they_are_cancelled(server: Served, api: Api) -> None:
    server.api.faults.append(Fault(status=503, times=math.inf))
    cancel = threading.Event()
    cancel.set()
    with pytest.raises(ServerError):
        api.list(ALL, timeout=60.0, cancel=cancel)
    assert server.api.count("list", "pods") == 1


def test_no_answering_server_is_unreachable(api: Api, server: Served) -> None:
    server.api.down = True
    with pytest.raises(ServerUnreachable):
        api.list(ALL, timeout=0.0)


def test_garbage_is_not_shown(server: Served, api: Api) -> None:
    server.api.faults.append(Fault(text='["s3cret"', times=9))
    with pytest.raises(ServerUnreachable) as caught:
        api.list(ALL, timeout=0.0)
    assert "s3cret" not in str(caught.value)


# -- Watches


def test_a_watch_goes_on_from_a_version(server: Served, api: Api) -> None:
    version = api.list(ALL)["metadata"]["resourceVersion"]
    api.create(ALL, POD)
    api.create(ALL, {"metadata": {"name": "b"}, "spec": {}})
    api.delete(ONE)
    watch = api.watch(ALL, {"labelSelector": "app=x"}, version)
    events = iter(watch)
    got = [next(events) for _ in range(2)]
    assert [kind for kind, _ in got] == ["ADDED", "DELETED"]
    watch.stop()
    assert list(events) == []


def test_a_watch_is_stopped_in_the_middle_of_waiting(api: Api) -> None:
    _watch_and_stop(api)


def _watch_and_stop(api: Api) -> None:
    version = api.list(ALL)["metadata"]["resourceVersion"]
    watch = api.watch(ALL, {}, version)
    first = threading.Event()
    seen = []

    def follow() -> None:
        for kind, _ in watch:
            seen.append(kind)
            first.set()

    thread = threading.Thread(target=follow)
    thread.start()
    api.create(ALL, POD)
    assert first.wait(PATIENCE)
    watch.stop()
    thread.join(PATIENCE)
    assert not thread.is_alive()
    assert seen == ["ADDED"]


def test_a_watch_that_was_stopped_before_brings_no_event(server: Served, api: Api) -> None:
    version = api.list(ALL)["metadata"]["resourceVersion"]
    api.create(ALL, POD)
    watch = api.watch(ALL, {}, version)
    watch.stop()
    assert list(watch) == []


def test_a_watch_from_a_version_that_is_forgotten(server: Served, api: Api) -> None:
    version = api.list(ALL)["metadata"]["resourceVersion"]
    api.create(ALL, POD)
    server.do(server.store.forget_history)
    with pytest.raises(Expired):
        list(api.watch(ALL, {}, version))


def test_a_watch_that_is_refused(server: Served, api: Api) -> None:
    server.api.faults.append(Fault("watch", status=403))
    with pytest.raises(Forbidden):
        list(api.watch(ALL, {}, "1"))


def test_a_watch_that_is_cut_off(server: Served, api: Api) -> None:
    version = api.list(ALL)["metadata"]["resourceVersion"]
    api.create(ALL, POD)
    events = iter(api.watch(ALL, {}, version))
    next(events)
    server.do(server.api.drop_watches)
    with pytest.raises(ServerUnreachable):
        next(events)
