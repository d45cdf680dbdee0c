"""Facts about a cluster for ``fiber doctor``, and the class that gathers them.

A fact is a document, or the error in its place, or None if it was not asked for.  Nothing is
changed in the cluster.
"""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from email.utils import parsedate_to_datetime
from typing import Any, NamedTuple

from fiber import config
from fiber._backends.kubernetes.api import Api, ApiRequest, ApiSession, Login, network_errors
from fiber._backends.kubernetes.template import (
    ImageMissing,
    PodShape,
    own_container,
    pod_template,
)
from fiber._cli.doctor_rights import (
    ACCOUNT_RIGHTS,
    PROGRAM_RIGHTS,
    REVIEWS,
    RUN_RIGHTS,
    SCHEMA,
    Right,
)
from fiber._cli.session import SECONDS
from fiber.config import Config
from fiber.errors import ConfigError
from fiber_api import names
from fiber_api.rest import (
    ACCOUNTS,
    DEPLOYMENTS,
    LEASES,
    NODES,
    PODS,
    POOLS,
    ApiError,
    Body,
    Forbidden,
    ResourceType,
    document_of,
)

Answer = Body | ApiError
"""Document of the API server, or its error."""

_AT_ONCE = 8
"""Calls at one time."""

QUOTAS = ResourceType("v1", "ResourceQuota", "resourcequotas")
LIMITS = ResourceType("v1", "LimitRange", "limitranges")
NAMESPACES = ResourceType("v1", "Namespace", "namespaces")

_OPERATORS = "app.kubernetes.io/component=operator,app.kubernetes.io/part-of=fiber"


class Wishes(NamedTuple):
    """Options of the command line."""

    namespace: str | None = None
    context: str | None = None
    image: str | None = None


class Place(NamedTuple):
    """Cluster and namespace that the configuration chooses."""

    kubeconfig: str
    """Path of the kubeconfig; empty for the account of this pod."""
    context: str | None
    namespace: str
    server: str


class NoPlace(NamedTuple):
    """Reason why no cluster is chosen."""

    kubeconfig: str
    """Path of the kubeconfig; empty for the account of this pod."""
    exists: bool
    context: str | None
    error: str


class FirstAnswer(NamedTuple):
    """First answer of the API server."""

    version: str
    seconds: float
    """Time to the answer."""
    ahead: float | None
    """Seconds by which this machine's clock is ahead of the server's; None if it did not say."""


@dataclass
class Facts:
    """Facts for the checks."""

    configuration: Config | ConfigError
    now: float = 0.0
    """Unix time, by the API server's clock."""
    place: Place | NoPlace | None = None
    image: tuple[str, str] | ConfigError | None = None
    """Image of workers, and where the setting comes from."""
    template: Body = field(default_factory=dict)
    """Pod template of a worker whose function asks for nothing."""
    server: FirstAnswer | ApiError | None = None
    namespace: Answer | None = None
    resources: Answer | None = None
    """Resources of the API group of FiberPools."""
    schema: Answer | None = None
    leases: Mapping[str, Answer] = field(default_factory=dict)
    """Leases by which operators show that they serve, by namespace."""
    operators: Answer | None = None
    rights: Mapping[Right, bool] | ApiError | None = None
    account: Answer | None = None
    """Account of the programs of ``fiber run``."""
    quotas: Answer | None = None
    limits: Answer | None = None
    nodes: Answer | None = None
    pods: Answer | None = None
    """Pods of all namespaces."""
    pools: Answer | None = None


class Gatherer:
    """Gatherer of all facts.  ``close`` ends its connections."""

    def __init__(self, wishes: Wishes, clock: Callable[[], float] = time.time) -> None:
        self._wishes = wishes
        self._clock = clock
        self.api: Api | None = None

    def close(self) -> None:
        """Close the connections."""
        if self.api is not None:
            self.api.close()

    def gather(self) -> Facts:
        """Return the facts, up to the first that hides all others."""
        facts = Facts(self._configuration())
        if isinstance(facts.configuration, ConfigError):
            return facts
        settings = facts.configuration
        facts.image, facts.template = self._template(settings)
        session, facts.place = self._connect(settings)
        if session is None or isinstance(facts.place, NoPlace):
            return facts
        self.api = Api(session)
        facts.now = self._clock()
        facts.server = self._first_answer(session)
        if isinstance(facts.server, FirstAnswer):
            facts.now -= facts.server.ahead or 0.0
            self._ask(self.api, facts.place.namespace, facts)
            if self.api.in_cluster:
                self._copy_own_pod(self.api, settings, facts)
        return facts

    def _copy_own_pod(self, api: Api, settings: Config, facts: Facts) -> None:
        """Take the template of a program in this pod, whose workers are like it."""
        name = os.environ.get("HOSTNAME") or socket.gethostname()
        with contextlib.suppress(ApiError, ConfigError):
            own = api.get(PODS.path(api.namespace, name), timeout=SECONDS)
            shape = PodShape.of(settings)
            template = pod_template(shape, own, own_container(own, ""))
            if image_in(template) != image_in(facts.template):
                facts.image = image_in(template), "this pod"
            facts.template = template

    def _configuration(self) -> Config | ConfigError:
        wishes = {key: value for key, value in self._wishes._asdict().items() if value is not None}
        try:
            return config.load(wishes)
        except ConfigError as error:
            return error

    def _template(self, settings: Config) -> tuple[tuple[str, str] | ConfigError, Body]:
        try:
            template = pod_template(PodShape.of(settings), None, "")
            return (image_in(template), self._source(settings, template)), template
        except ImageMissing as error:
            if settings.pool is None:
                return error, {}
            return ("that of its pods", f"the FiberPool {settings.pool!r}"), {}
        except ConfigError as error:
            return error, {}

    def _source(self, settings: Config, template: Body) -> str:
        """Return where the image comes from, in words."""
        if settings.image is not None and image_in(template) != settings.image:
            return "the configured template"
        if self._wishes.image is not None:
            return "--image"
        if settings.image is None:
            with_template = settings.template is not None
            return "the template, or the default" if with_template else "the default"
        if os.environ.get("FIBER_IMAGE"):
            return "FIBER_IMAGE"
        return "image in [tool.fiber] of pyproject.toml"

    def _connect(self, settings: Config) -> tuple[ApiSession | None, Place | NoPlace]:
        file = os.environ.get("KUBECONFIG") or "~/.kube/config"
        if "KUBERNETES_SERVICE_HOST" in os.environ and settings.context is None:
            file = os.environ.get("KUBECONFIG") or ""  # the account of this pod
        try:
            login = Login.find(settings.context)
            session = ApiSession(login)
        except ConfigError as error:
            paths = [os.path.expanduser(path) for path in file.split(os.pathsep) if path]
            exists = any(map(os.path.isfile, paths))
            return None, NoPlace(file, exists, settings.context, str(error))
        namespace = settings.namespace or login.namespace
        return session, Place(login.kubeconfig or "", login.context, namespace, session.server)

    def _first_answer(self, session: ApiSession) -> FirstAnswer | ApiError:
        before, started = self._clock(), time.perf_counter()
        try:
            response = session.send(ApiRequest("GET", "/version"), SECONDS)
            with network_errors():
                data = response.data
            seconds = time.perf_counter() - started
            ahead = _ahead((before + self._clock()) / 2, response.headers.get("Date"))
            return FirstAnswer(_version(response.status, response.headers, data), seconds, ahead)
        except ApiError as error:
            return error

    def _ask(self, api: Api, namespace: str, facts: Facts) -> None:
        """Ask everything that needs no other answer, at one time."""
        asked: dict[str, tuple[str, dict[str, str]]] = {
            "namespace": (NAMESPACES.path(None, namespace), {}),
            "resources": (f"/apis/{names.API_VERSION}", {}),
            "schema": (SCHEMA, {}),
            "operators": (DEPLOYMENTS.path(), {"labelSelector": _OPERATORS}),
            "account": (ACCOUNTS.path(namespace, names.PROGRAM_ACCOUNT), {}),
            "quotas": (QUOTAS.path(namespace), {}),
            "limits": (LIMITS.path(namespace), {}),
            "nodes": (NODES.path(), {}),
            "pods": (PODS.path(), {}),
            "pools": (POOLS.path(namespace), {}),
        }
        places = dict.fromkeys((names.SERVING_NAMESPACE, namespace))
        leases: dict[str, tuple[str, dict[str, str]]]
        leases = {place: (LEASES.path(place, names.SERVING_LEASE), {}) for place in places}
        with ThreadPoolExecutor(_AT_ONCE) as pool:

            def answer(question: tuple[str, dict[str, str]]) -> Answer:
                return _answered(lambda: api.list(*question, timeout=SECONDS))

            found = dict(zip(asked, pool.map(answer, asked.values()), strict=True))
            facts.leases = dict(zip(leases, pool.map(answer, leases.values()), strict=True))
            facts.rights = _rights(api, namespace, pool)
        for name, each in found.items():
            setattr(facts, name, each)


def image_in(template: Body) -> str:
    """Return the image of the worker's container; empty if it has none."""
    for container in worker_containers(template):
        return str(container.get("image") or "")
    return ""


def worker_containers(template: Body) -> Iterator[Body]:
    """Yield the worker's container of a pod template."""
    for container in (template.get("spec") or {}).get("containers") or ():
        if container.get("name") == names.WORKER_CONTAINER:
            yield container


def _version(status: int, headers: Mapping[str, str], data: bytes) -> str:
    try:
        found = document_of(status, headers, data)
    except Forbidden:
        return "of an unknown version"  # it answers, all the same
    return str(found.get("gitVersion") or f"{found.get('major')}.{found.get('minor')}")


def _ahead(now: float, date: str | None) -> float | None:
    """Return how far this clock is ahead of the header ``Date``, which has whole seconds."""
    with contextlib.suppress(TypeError, ValueError):
        return now - (parsedate_to_datetime(str(date)).timestamp() + 0.5)
    return None


def _answered(call: Callable[[], Body]) -> Answer:
    try:
        return call()
    except ApiError as error:
        return error


def _rights(api: Api, namespace: str, pool: ThreadPoolExecutor) -> dict[Right, bool] | ApiError:
    wanted = list(dict.fromkeys((*PROGRAM_RIGHTS, *RUN_RIGHTS, *ACCOUNT_RIGHTS)))

    def has(right: Right) -> Any:
        review = right.review(namespace)
        return _answered(lambda: api.create(REVIEWS, review, timeout=SECONDS))

    found: dict[Right, bool] = {}
    for right, answer in zip(wanted, pool.map(has, wanted), strict=True):
        if isinstance(answer, ApiError):
            return answer
        found[right] = bool((answer.get("status") or {}).get("allowed"))
    return found
