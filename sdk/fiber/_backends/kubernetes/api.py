"""The door to the Kubernetes API: JSON documents go in and come out.

The one module here that imports the package ``kubernetes``, and only once it connects.  The package
knows how to log in: kubeconfigs with their plugins, accounts of pods, tokens that expire.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import ssl
import threading
import time
import urllib.parse
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple, TypedDict, Unpack

from fiber._backends.kubernetes.api_errors import (
    Body,
    Throttled,
    Unauthorized,
    Unreachable,
    document_of,
    error_of,
)
from fiber.errors import ConfigError
from fiber_api import names

if TYPE_CHECKING:
    from kubernetes.client import ApiClient
    from urllib3 import BaseHTTPResponse

CONNECT_TIMEOUT = 5.0
READ_TIMEOUT = 30.0
TIMEOUT = 30.0
"""Seconds for one call, all its attempts together, if the caller says nothing else."""

_PAUSE_MIN, _PAUSE_MAX = 0.1, 5.0
"""Seconds between two attempts, growing; each is drawn from the upper half."""

_WATCH_SECONDS = 60.0
"""After so long the API server ends a watch; one that says nothing for twice that was cut off."""

_ACCOUNT = "/var/run/secrets/kubernetes.io/serviceaccount"
_KUBECONFIG = "~/.kube/config"


class _How(TypedDict, total=False):
    timeout: float
    cancel: threading.Event | None


class Api:
    """One API server and one login.  Any thread may call; calls block and raise ``ApiError``.

    ``timeout`` bounds a call with all its attempts, in seconds: what may pass (no connection, 429,
    5xx) is tried again until then, at 0 never.  Setting ``cancel`` ends a pause between attempts.
    A call that was tried again, or ends in Unreachable, may have been carried out before.
    """

    def __init__(self, login: Login) -> None:
        self._login = login
        self._lock = threading.Lock()
        self._client = login.client()

    @classmethod
    def connect(cls, context: str | None = None) -> Api:
        """By the kubeconfig's ``context`` or its current one; in a pod without KUBECONFIG as the
        pod's account.  Calls nobody yet.  ConfigError if there is nothing to go by.
        """
        return cls(Login.find(context))

    @property
    def namespace(self) -> str:
        """The context's, or the account's."""
        return self._login.namespace

    @property
    def in_cluster(self) -> bool:
        """Whether this is a pod that uses its own account."""
        return self._login.in_cluster

    @property
    def server(self) -> str:
        """The API server's host name or address."""
        return urllib.parse.urlsplit(self._client.configuration.host).hostname or ""

    def close(self) -> None:
        """Close the connections; one that is in use is closed after that."""
        self._client.close()

    def get(self, path: str, **how: Unpack[_How]) -> Body:
        """The object at ``path``."""
        return self._call(_Request("GET", path), **how)

    def list(
        self, path: str, selector: Mapping[str, str] | None = None, **how: Unpack[_How]
    ) -> Body:
        """The list at ``path``.  ``selector`` may have labelSelector and fieldSelector."""
        return self._call(_Request("GET", path, selector or {}), **how)

    def create(self, path: str, body: Body, *, strict: bool = False, **how: Unpack[_How]) -> Body:
        """Add ``body`` to the collection ``path``.

        ``strict``: Invalid for fields that the API server does not know, which it else drops.
        """
        query = {**_AS_SDK, "fieldValidation": "Strict"} if strict else _AS_SDK
        return self._call(_Request("POST", path, query, body), **how)

    def apply(self, path: str, body: Body, **how: Unpack[_How]) -> Body:
        """Server-side apply: what the last one had and ``body`` has not is removed."""
        kind = "application/apply-patch+yaml"
        return self._call(_Request("PATCH", path, {**_AS_SDK, "force": "true"}, body, kind), **how)

    def merge_patch(self, path: str, patch: Body, **how: Unpack[_How]) -> Body:
        """None removes a field, a list replaces the list."""
        kind = "application/merge-patch+json"
        return self._call(_Request("PATCH", path, _AS_SDK, patch, kind), **how)

    def delete(self, path: str, *, uid: str | None = None, **how: Unpack[_How]) -> Body:
        """Delete the object and what it owns; Conflict if it is not the one with this ``uid``."""
        options: Body = {"propagationPolicy": "Background"}
        if uid is not None:
            options["preconditions"] = {"uid": uid}
        return self._call(_Request("DELETE", path, {}, options), **how)

    def watch(self, path: str, selector: Mapping[str, str], resource_version: str) -> Watch:
        """What changes at ``path`` after ``resource_version``."""
        query = {
            **selector,
            "watch": "true",
            "resourceVersion": resource_version,
            "allowWatchBookmarks": "true",
            "timeoutSeconds": f"{_WATCH_SECONDS:.0f}",
        }
        return Watch(self, _Request("GET", path, query))

    def _call(
        self,
        request: _Request,
        *,
        timeout: float = TIMEOUT,
        cancel: threading.Event | None = None,
    ) -> Body:
        wait = (cancel or threading.Event()).wait
        deadline = time.monotonic() + timeout
        pause = _PAUSE_MIN
        while True:
            try:
                seconds = min(READ_TIMEOUT, max(deadline - time.monotonic(), CONNECT_TIMEOUT))
                response = self.send(request, seconds)
                with _network_errors():
                    data = response.data
                return document_of(response.status, response.headers, data)
            except Unreachable as error:
                delay = pause * random.uniform(0.5, 1.0)
                if isinstance(error, Throttled):
                    delay = max(delay, error.retry_after)
                if delay > deadline - time.monotonic() or wait(delay):
                    raise
            pause = min(2 * pause, _PAUSE_MAX)

    def send(self, request: _Request, read_timeout: float) -> BaseHTTPResponse:
        """The response, whatever its status, with the body unread."""
        client = self._client
        response = self._send_by(client, request, read_timeout)
        if response.status != 401:
            return response
        # The package renews what it knows to have expired.  A token that was taken back, or whose
        # end its plugin does not tell, is only seen to be no good by this answer.
        response.close()
        with self._lock:
            if self._client is client:
                with _login_errors():
                    self._client = self._login.client()
                client.close()
        return self._send_by(self._client, request, read_timeout)

    def _send_by(
        self, client: ApiClient, request: _Request, read_timeout: float
    ) -> BaseHTTPResponse:
        with self._lock, _login_errors():  # it may run a plugin that logs in: one is enough
            method, url, headers, _, _ = client.param_serialize(
                request.method,
                request.path,
                query_params=list(request.query.items()),
                header_params={"Accept": "application/json", "Content-Type": request.content_type},
                auth_settings=["BearerToken"],
            )
        # The body goes round the package, which would look for models in it.
        with _network_errors():
            answer = client.call_api(
                method, url, headers, request.body, _request_timeout=(CONNECT_TIMEOUT, read_timeout)
            )
        response: BaseHTTPResponse = answer.response
        return response


_AS_SDK: Mapping[str, str] = {"fieldManager": names.SDK_MANAGER}


class _Request(NamedTuple):
    method: str
    path: str
    query: Mapping[str, str] = MappingProxyType({})
    body: Body | None = None
    content_type: str = "application/json"


class Watch:
    """The events of one watch, ``{"type": …, "object": …}``, until it ends or ``stop``.

    Any end is one: whoever wants more asks for another watch from where this one came to.
    """

    def __init__(self, api: Api, request: _Request) -> None:
        self._api = api
        self._request = request
        self._lock = threading.Lock()
        self._response: BaseHTTPResponse | None = None
        self._stopped = False

    def __iter__(self) -> Iterator[Body]:
        """The events; raises ``ApiError``: Expired where it cannot go on from where it was."""
        response = self._api.send(self._request, 2 * _WATCH_SECONDS)
        with self._lock:
            self._response = response
            stopped = self._stopped
        try:
            if response.status != 200:
                with _network_errors():
                    data = response.data
                document_of(response.status, response.headers, data)
            if not stopped:
                yield from self._events(response)
        except Unreachable:
            if not self._stopped:
                raise
        finally:
            with self._lock:
                self._response = None
            response.close()

    def _events(self, response: BaseHTTPResponse) -> Iterator[Body]:
        for line in _lines(response):
            try:
                event = json.loads(line)
                kind, found = event["type"], event["object"]
            except (ValueError, RecursionError, KeyError, TypeError):
                raise Unreachable(f"an event of {len(line)} bytes is no JSON") from None
            if kind == "ERROR":
                raise error_of(int(found.get("code") or 500), {}, found)
            yield {"type": kind, "object": found}

    def stop(self) -> None:
        """End it, also in the middle of waiting for an event.  Any thread."""
        with self._lock:
            self._stopped = True
            if self._response is not None:
                with contextlib.suppress(OSError, ValueError, RuntimeError):  # it has just ended
                    self._response.shutdown()


def _lines(response: BaseHTTPResponse) -> Iterator[bytes]:
    rest = b""
    with _network_errors():
        for piece in response.stream(None, decode_content=True):
            *whole, rest = (rest + piece).split(b"\n")
            yield from filter(None, whole)


@contextlib.contextmanager
def _network_errors() -> Iterator[None]:
    """What goes wrong on the way to the API server is Unreachable."""
    from kubernetes.client.exceptions import ApiException
    from urllib3.exceptions import HTTPError

    try:
        yield
    except ApiException as error:  # TLS alone: statuses are read here
        raise Unreachable(str(error.reason)) from error
    except (HTTPError, OSError) as error:
        raise Unreachable(str(error) or type(error).__name__) from error


@contextlib.contextmanager
def _login_errors() -> Iterator[None]:
    """A login that cannot be renewed may be one a minute later: a token file that is replaced."""
    from kubernetes.config import ConfigException

    try:
        yield
    except (ConfigError, ConfigException, OSError) as error:
        raise Unauthorized(str(error), status=401) from error


class Login(NamedTuple):
    """Where an API server is and who asks it, read anew for each client."""

    kubeconfig: str | None
    """None: the account of the pod that this is."""
    context: str | None
    namespace: str

    @property
    def in_cluster(self) -> bool:
        return self.kubeconfig is None

    @classmethod
    def find(cls, context: str | None) -> Login:
        """What there is to go by."""
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
        except Exception as error:  # whatever a file may hold
            reason = " ".join(str(error).split())
            raise ConfigError(
                f"no cluster to run processes on: {file} cannot be used: {reason}. Let KUBECONFIG "
                "name a kubeconfig and fiber.init(context=) a context in it (`kubectl config "
                "get-contexts`), or choose another backend with FIBER_BACKEND=local"
            ) from error
        return cls(file, context, namespace)

    def client(self) -> ApiClient:
        """A client that is logged in."""
        package = _package()
        configuration = package.client.Configuration()
        try:
            if self.kubeconfig is None:
                package.config.load_incluster_config(configuration)
            else:
                package.config.load_kube_config(self.kubeconfig, self.context, configuration)
        except package.config.ConfigException as error:
            where = self.kubeconfig or _ACCOUNT
            raise ConfigError(f"cannot log in to the cluster by {where}: {error}") from error
        configuration.retries = False  # `timeout` decides
        configuration.keep_alive = True
        client: ApiClient = package.client.ApiClient(configuration)
        client.user_agent = names.SDK_MANAGER
        _read_certificates(client)
        return client


def _read_certificates(client: ApiClient) -> None:
    """Read now what each connection would read.

    The data of a kubeconfig is in temporary files, which the client deletes when the interpreter
    exits: before this program's FiberPools are deleted.
    """
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
            f"this pod has no account to use Kubernetes with: {error}. Give it one that has the "
            "role fiber-user and do not set automountServiceAccountToken to false, or choose "
            "another backend with FIBER_BACKEND=local"
        ) from error


def _package() -> Any:
    try:
        import kubernetes
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"the backend kubernetes needs a package that is not installed ({error}): "
            "pip install 'fiberpool[kubernetes]', or choose another backend with "
            "FIBER_BACKEND=local"
        ) from error
    return kubernetes
