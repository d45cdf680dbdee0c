"""Client of the Kubernetes API for a program. JSON documents go in and come out.

``ApiSession`` is the only importer of the package ``kubernetes``, and imports it at the first
connection. The package does the logins: kubeconfigs with their plugins, accounts of pods, tokens
that expire. ``Api`` adds the calls and repeats those that may succeed later. Paths, errors and the
meaning of each response are those of ``fiber_api.rest``.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import random
import ssl
import tempfile
import threading
import time
import urllib.parse
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple, TypedDict, Unpack

from fiber._backends.kubernetes.port_forward import (
    PortForward,
    PortForwardRequest,
    proxy_options,
)
from fiber.errors import ConfigError
from fiber_api import names
from fiber_api.rest import (
    Body,
    Conflict,
    ServerUnreachable,
    Transient,
    Unauthorized,
    document_of,
    event_of,
)

if TYPE_CHECKING:
    from kubernetes.client import ApiClient
    from urllib3 import BaseHTTPResponse

READ_TIMEOUT = 30.0
TIMEOUT = 30.0
"""Seconds for one call with all its attempts, by default."""

_PAUSE_MIN, _PAUSE_MAX = 0.1, 5.0
"""Seconds between two attempts, growing; each is random in the upper half."""

_WATCH_SECONDS = 60.0
"""Seconds after which the API server ends a watch; a silence of twice that ends it too."""

_SILENCE = 24 * 3600.0
"""Seconds that a log may be silent."""

_AS_SDK: Mapping[str, str] = {"fieldManager": names.SDK_MANAGER}


class _How(TypedDict, total=False):
    timeout: float
    cancel: threading.Event | None


class Api:
    """Client of one API server with one login.

    Any thread may call it.  Calls block and raise ``ApiError``.  ``timeout`` bounds a call with all
    its attempts, in seconds.  Errors that may pass (no connection, 429, 5xx) are tried again until
    then; at 0 never.  Setting ``cancel`` ends a pause between attempts.  A call that was repeated,
    or raises Transient, may have been carried out.
    """

    def __init__(self, session: ApiSession) -> None:
        self._session = session
        self.trouble: str | None = None
        """Error of the newest attempt; None once a call succeeds."""

    @classmethod
    def connect(cls, context: str | None = None) -> Api:
        """Connect by the kubeconfig's ``context`` or its current one.

        A pod without KUBECONFIG uses its account.  ConfigError if there is neither.  No call is
        made.
        """
        return cls(ApiSession(Login.find(context)))

    @property
    def namespace(self) -> str:
        """Namespace of the context or of the account."""
        return self._session.login.namespace

    @property
    def in_cluster(self) -> bool:
        """True in a pod that uses its own account."""
        return self._session.login.in_cluster

    @property
    def server(self) -> str:
        """Host name or address of the API server."""
        return self._session.server

    def close(self) -> None:
        """Close the connections; a connection in use is closed after its use."""
        self._session.close()

    def get(self, path: str, **how: Unpack[_How]) -> Body:
        """Return the object at ``path``."""
        return self._call(ApiRequest("GET", path), **how)

    def list(
        self, path: str, selector: Mapping[str, str] | None = None, **how: Unpack[_How]
    ) -> Body:
        """Return the list at ``path``.  ``selector``: labelSelector and fieldSelector."""
        return self._call(ApiRequest("GET", path, selector or {}), **how)

    def create(self, path: str, body: Body, *, strict: bool = False, **how: Unpack[_How]) -> Body:
        """Add ``body`` to the collection ``path``.

        ``strict``: raise Invalid for fields that the API server does not know and would drop.
        """
        query = {**_AS_SDK, "fieldValidation": "Strict"} if strict else _AS_SDK
        return self._call(ApiRequest("POST", path, query, body), **how)

    def apply(self, path: str, body: Body, **how: Unpack[_How]) -> Body:
        """Apply ``body`` on the server; fields of the last apply that it lacks are removed."""
        return self._apply(path, body, {**_AS_SDK, "force": "true"}, **how)

    def apply_manifest(
        self, path: str, body: Body, *, force: bool = False, **how: Unpack[_How]
    ) -> Body:
        """Apply a person's ``body``; the fields that programs write stay theirs.

        Conflict if another writer set one of the fields, unless ``force`` takes it over; Invalid
        for fields that the API server does not know.
        """
        query = {"fieldManager": names.COMMAND_MANAGER, "fieldValidation": "Strict"}
        return self._apply(path, body, {**query, **({"force": "true"} if force else {})}, **how)

    def merge_patch(
        self, path: str, patch: Body, *, manager: str = names.SDK_MANAGER, **how: Unpack[_How]
    ) -> Body:
        """Patch an object: None removes a field, a list replaces a list."""
        kind = "application/merge-patch+json"
        return self._call(ApiRequest("PATCH", path, {"fieldManager": manager}, patch, kind), **how)

    def delete(self, path: str, *, uid: str | None = None, **how: Unpack[_How]) -> Body:
        """Delete an object and those that it owns; Conflict if its uid is not ``uid``."""
        options: Body = {"propagationPolicy": "Background"}
        if uid is not None:
            options["preconditions"] = {"uid": uid}
        return self._call(ApiRequest("DELETE", path, {}, options), **how)

    def watch(self, path: str, selector: Mapping[str, str], resource_version: str) -> Watch:
        """Watch the changes at ``path`` after ``resource_version``."""
        query = {
            **selector,
            "watch": "true",
            "resourceVersion": resource_version,
            "allowWatchBookmarks": "true",
            "timeoutSeconds": f"{_WATCH_SECONDS:.0f}",
        }
        return Watch(self._session, ApiRequest("GET", path, query))

    def log(self, pod: str, query: Mapping[str, str]) -> PodLog:
        """Read the log of the pod at the path ``pod``.  ``query``: options of the API server."""
        return PodLog(self._session, ApiRequest("GET", f"{pod}/log", query))

    def port_forward(self, pod: str, port: int) -> PortForward:
        """Connect to a port on the loopback of the pod at the path ``pod``."""
        query = {"ports": str(port)}
        return self._session.port_forward(ApiRequest("GET", f"{pod}/portforward", query))

    def _apply(self, path: str, body: Body, query: Mapping[str, str], **how: Unpack[_How]) -> Body:
        kind = "application/apply-patch+yaml"
        return self._call(ApiRequest("PATCH", path, query, body, kind), **how)

    def _call(
        self,
        request: ApiRequest,
        *,
        timeout: float = TIMEOUT,
        cancel: threading.Event | None = None,
    ) -> Body:
        wait = (cancel or threading.Event()).wait
        deadline = time.monotonic() + timeout
        pause = _PAUSE_MIN
        repeated = False
        while True:
            try:
                seconds = min(READ_TIMEOUT, max(deadline - time.monotonic(), CONNECT_TIMEOUT))
                found = _document(self._session.send(request, seconds))
                self.trouble = None
                return found
            except Conflict as error:
                error.repeated = repeated
                raise
            except Transient as error:
                self.trouble = str(error)
                repeated = True
                delay = max(pause * random.uniform(0.5, 1.0), error.retry_after)
                if delay > deadline - time.monotonic() or wait(delay):
                    raise
            pause = min(2 * pause, _PAUSE_MAX)


class PodLog:
    """Log of one container, in pieces of bytes, until its end or ``stop``."""

    def __init__(self, session: ApiSession, request: ApiRequest) -> None:
        self._session = session
        self._request = request
        self._response: BaseHTTPResponse | None = None

    def __iter__(self) -> Iterator[bytes]:
        """Yield the pieces; ``ApiError``."""
        # A program may print nothing for a long time.
        response = self._session.send(self._request, _SILENCE)
        self._response = response
        try:
            if response.status != 200:
                _document(response)
            with network_errors():
                yield from response.stream(None, decode_content=True)
        finally:
            response.close()

    def stop(self) -> None:
        """End the reading, also while it waits.  Any thread."""
        if (response := self._response) is not None:
            with contextlib.suppress(OSError, ValueError, RuntimeError):  # it has just ended
                response.shutdown()


class Watch:
    """Events of one watch, each a type and an object, until it ends or ``stop``.

    After the end, another watch can continue from the last version.
    """

    def __init__(self, session: ApiSession, request: ApiRequest) -> None:
        self._session = session
        self._request = request
        self._lock = threading.Lock()
        self._response: BaseHTTPResponse | None = None
        self._stopped = False

    def __iter__(self) -> Iterator[tuple[str, Body]]:
        """Yield the events; ``ApiError``, Expired if the version is forgotten."""
        response = self._session.send(self._request, 2 * _WATCH_SECONDS)
        with self._lock:
            self._response = response
            stopped = self._stopped
        try:
            if response.status != 200:
                _document(response)
            if not stopped:
                yield from map(event_of, _lines(response))
        except ServerUnreachable:
            if not self._stopped:
                raise
        finally:
            with self._lock:
                self._response = None
            response.close()

    def stop(self) -> None:
        """End the watch, also while it waits for an event.  Any thread."""
        with self._lock:
            self._stopped = True
            if self._response is not None:
                with contextlib.suppress(OSError, ValueError, RuntimeError):  # it has just ended
                    self._response.shutdown()


def _document(response: BaseHTTPResponse) -> Body:
    with network_errors():
        data = response.data
    return document_of(response.status, response.headers, data)


def _lines(response: BaseHTTPResponse) -> Iterator[bytes]:
    rest = b""
    with network_errors():
        for piece in response.stream(None, decode_content=True):
            *whole, rest = (rest + piece).split(b"\n")
            yield from filter(None, whole)


CONNECT_TIMEOUT = 5.0

_ACCOUNT = "/var/run/secrets/kubernetes.io/serviceaccount"
_KUBECONFIG = "~/.kube/config"


class ApiRequest(NamedTuple):
    """Request to the API server."""

    method: str
    path: str
    query: Mapping[str, str] = MappingProxyType({})
    body: Body | None = None
    content_type: str = "application/json"


class ApiSession:
    """Session with an API server.  Its login is renewed when it expires.  Any thread may use it."""

    def __init__(self, login: Login) -> None:
        self.login = login
        self._lock = threading.Lock()
        self._client = login.client()

    @property
    def server(self) -> str:
        """Host name or address of the API server."""
        return urllib.parse.urlsplit(self._client.configuration.host).hostname or ""

    def close(self) -> None:
        """Close the connections; a connection in use is closed after its use."""
        self._client.close()

    def send(self, request: ApiRequest, read_timeout: float) -> BaseHTTPResponse:
        """Return the response of any status, with the body unread."""
        client = self._client
        response = self._send_by(client, request, read_timeout)
        if response.status != 401:
            return response
        response.close()
        self._log_in_again(client)
        return self._send_by(self._client, request, read_timeout)

    def port_forward(self, request: ApiRequest) -> PortForward:
        """Open the port-forward that the request asks for."""
        client = self._client
        try:
            return self._port_forward_by(client, request)
        except Unauthorized:
            self._log_in_again(client)
            return self._port_forward_by(self._client, request)

    def _log_in_again(self, client: ApiClient) -> None:
        """Replace a client that the API server does not know.

        The package renews tokens that have expired.  Only the answer 401 shows that a token was
        revoked, or has expired without the plugin saying when.
        """
        with self._lock:
            if self._client is client:
                with _login_errors():
                    self._client = self.login.client()
                client.close()

    def _serialize(self, client: ApiClient, request: ApiRequest) -> tuple[str, str, dict[str, str]]:
        """Return method, URL and headers."""
        with self._lock, _login_errors():  # it may run a plugin that logs in: one at a time
            method, url, headers, _, _ = client.param_serialize(
                request.method,
                request.path,
                query_params=list(request.query.items()),
                header_params={"Accept": "application/json", "Content-Type": request.content_type},
                auth_settings=["BearerToken"],
            )
        return method, url, headers

    def _port_forward_by(self, client: ApiClient, request: ApiRequest) -> PortForward:
        _, url, headers = self._serialize(client, request)
        configuration = client.configuration
        return PortForwardRequest(
            url.replace("http", "ws", 1),
            {name.lower(): value for name, value in headers.items()}.get("authorization"),
            client.rest_client.pool_manager.connection_pool_kw["ssl_context"],
            configuration.tls_server_name,
            proxy_options(configuration.proxy, configuration.no_proxy),
        ).connect(CONNECT_TIMEOUT)

    def _send_by(
        self, client: ApiClient, request: ApiRequest, read_timeout: float
    ) -> BaseHTTPResponse:
        method, url, headers = self._serialize(client, request)
        # The package must not see the body, in which it would look for its models.
        with network_errors():
            answer = client.call_api(
                method, url, headers, request.body, _request_timeout=(CONNECT_TIMEOUT, read_timeout)
            )
        response: BaseHTTPResponse = answer.response
        return response


@contextlib.contextmanager
def network_errors() -> Iterator[None]:
    """Turn errors on the way to the API server into Unreachable."""
    from kubernetes.client.exceptions import ApiException
    from urllib3.exceptions import HTTPError

    try:
        yield
    except ApiException as error:  # an error of TLS; statuses are checked elsewhere
        raise ServerUnreachable(str(error.reason)) from error
    except (HTTPError, OSError) as error:
        raise ServerUnreachable(str(error) or type(error).__name__) from error


@contextlib.contextmanager
def _login_errors() -> Iterator[None]:
    """Turn errors of the login into Unauthorized, after which the caller may try again."""
    from kubernetes.config import ConfigException

    try:
        yield
    except (ConfigError, ConfigException, OSError) as error:
        raise Unauthorized(str(error), status=401) from error


class Login(NamedTuple):
    """Address of an API server and account, read again for each client."""

    kubeconfig: str | None
    """Path of the kubeconfig; None for the account of this pod."""
    context: str | None
    namespace: str

    @property
    def in_cluster(self) -> bool:
        return self.kubeconfig is None

    @staticmethod
    def is_configured() -> bool:
        """Return whether this environment can use a cluster.

        It needs a kubeconfig or an account of this pod, and the package that logs in.
        """
        if importlib.util.find_spec("kubernetes") is None:
            return False
        names = (os.environ.get("KUBECONFIG") or os.path.expanduser(_KUBECONFIG)).split(os.pathsep)
        return "KUBERNETES_SERVICE_HOST" in os.environ or any(map(os.path.exists, names))

    @classmethod
    def find(cls, context: str | None) -> Login:
        """Find a kubeconfig, or the account of this pod."""
        package = _package()
        file = os.environ.get("KUBECONFIG")
        if not file and context is None and "KUBERNETES_SERVICE_HOST" in os.environ:
            return cls(None, None, _account_namespace())
        file = file or _KUBECONFIG
        try:
            merged = package.config.kube_config.KubeConfigMerger(file).config
            if merged is None:
                raise ConfigError("there is no such file")
            chosen = package.config.kube_config.KubeConfigLoader(merged, active_context=context)
            namespace = chosen.current_context["context"].get("namespace") or "default"
        except Exception as error:  # a file may have any contents
            reason = " ".join(str(error).split())
            raise ConfigError(
                f"no cluster to run processes on: {file} cannot be used: {reason}. Set KUBECONFIG "
                "to a kubeconfig and fiber.init(context=) to a context in it (`kubectl config "
                "get-contexts`), or choose another backend with FIBER_BACKEND=local"
            ) from error
        return cls(file, context, namespace)

    def client(self) -> ApiClient:
        """Return a client that is logged in."""
        package = _package()
        configuration = package.client.Configuration()
        try:
            with _temporary_folder() as folder:
                if self.kubeconfig is None:
                    package.config.load_incluster_config(configuration)
                else:
                    package.config.load_kube_config(
                        self.kubeconfig, self.context, configuration, temp_file_path=folder
                    )
                configuration.retries = False  # the caller's timeout decides
                configuration.keep_alive = True
                client: ApiClient = package.client.ApiClient(configuration)
                _read_certificates(client)
        except (package.config.ConfigException, OSError) as error:
            where = self.kubeconfig or _ACCOUNT
            raise ConfigError(f"cannot log in to the cluster by {where}: {error}") from error
        client.user_agent = names.SDK_MANAGER
        return client


@contextlib.contextmanager
def _temporary_folder() -> Iterator[str | None]:
    """Yield a folder for certificates and keys of a kubeconfig, and remove it at the end.

    The package itself would delete those files when the interpreter exits, and never if it is
    killed.  None if the file system is read-only: a kubeconfig that names files needs no folder.
    """
    try:
        made = tempfile.TemporaryDirectory(prefix="fiber-", ignore_cleanup_errors=True)
    except OSError:
        yield None
    else:
        with made as folder:
            yield folder


def _read_certificates(client: ApiClient) -> None:
    """Read the certificates once, instead of for each connection."""
    configuration = client.configuration
    context = ssl.create_default_context(cafile=configuration.ssl_ca_cert)
    if configuration.cert_file:
        context.load_cert_chain(configuration.cert_file, configuration.key_file)
    if not configuration.verify_ssl:
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    settings = client.rest_client.pool_manager.connection_pool_kw
    for key in ("ca_certs", "cert_file", "key_file"):
        settings.pop(key, None)
    settings["ssl_context"] = context


def _account_namespace() -> str:
    try:
        with open(f"{_ACCOUNT}/namespace") as file:
            return file.read().strip()
    except OSError as error:
        raise ConfigError(
            f"this pod has no account for Kubernetes: {error}. Give it an account with the "
            "role fiber-user, and do not set automountServiceAccountToken to false, or choose "
            "another backend with FIBER_BACKEND=local"
        ) from error


def _package() -> Any:
    try:
        import kubernetes

        if importlib.util.find_spec("pathspec") is None:  # needed to send the program
            raise ModuleNotFoundError("No module named 'pathspec'")
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"the backend kubernetes needs a package that is not installed ({error}): "
            "pip install 'fiberpool[kubernetes]', or choose another backend with "
            "FIBER_BACKEND=local"
        ) from error
    return kubernetes
