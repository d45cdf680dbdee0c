"""A login at an API server, and the requests that are sent with it.

The one module here that imports the package ``kubernetes``, and only once it connects.  The package
knows how to log in: kubeconfigs with their plugins, accounts of pods, tokens that expire.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import ssl
import tempfile
import threading
import urllib.parse
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

from fiber._backends.kubernetes.api_errors import Body, Unauthorized, Unreachable
from fiber.errors import ConfigError
from fiber_api import names

if TYPE_CHECKING:
    from kubernetes.client import ApiClient
    from urllib3 import BaseHTTPResponse

CONNECT_TIMEOUT = 5.0

_ACCOUNT = "/var/run/secrets/kubernetes.io/serviceaccount"
_KUBECONFIG = "~/.kube/config"


class Request(NamedTuple):
    """Request to the API server."""

    method: str
    path: str
    query: Mapping[str, str] = MappingProxyType({})
    body: Body | None = None
    content_type: str = "application/json"


class Session:
    """Session with an API server.  Its login is renewed when it expires.  Any thread may use it."""

    def __init__(self, login: Login) -> None:
        self.login = login
        self._lock = threading.Lock()
        self._client = login.client()

    @property
    def server(self) -> str:
        """The API server's host name or address."""
        return urllib.parse.urlsplit(self._client.configuration.host).hostname or ""

    def close(self) -> None:
        """Close the connections; one that is in use is closed after that."""
        self._client.close()

    def send(self, request: Request, read_timeout: float) -> BaseHTTPResponse:
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
                    self._client = self.login.client()
                client.close()
        return self._send_by(self._client, request, read_timeout)

    def _send_by(
        self, client: ApiClient, request: Request, read_timeout: float
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
    """Address of an API server and account, read anew for each client."""

    kubeconfig: str | None
    """None: the account of the pod that this is."""
    context: str | None
    namespace: str

    @property
    def in_cluster(self) -> bool:
        return self.kubeconfig is None

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
    """Give the package a folder for certificates and keys of a kubeconfig, which OpenSSL reads.

    It is gone once they are read: the package itself would delete those files when the interpreter
    exits, and never if it is killed.  None where nothing can be written, as in a pod whose files
    are read-only: a kubeconfig that names files needs none.
    """
    try:
        made = tempfile.TemporaryDirectory(prefix="fiber-", ignore_cleanup_errors=True)
    except OSError:
        yield None
    else:
        with made as folder:
            yield folder


def _read_certificates(client: ApiClient) -> None:
    """Read now what each connection would read."""
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

        if importlib.util.find_spec("pathspec") is None:  # needed once the program is sent
            raise ModuleNotFoundError("No module named 'pathspec'")
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"the backend kubernetes needs a package that is not installed ({error}): "
            "pip install 'fiberpool[kubernetes]', or choose another backend with "
            "FIBER_BACKEND=local"
        ) from error
    return kubernetes
