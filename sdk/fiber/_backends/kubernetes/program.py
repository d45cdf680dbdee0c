"""Program on a cluster: its identity, its address for pods, and the start of its FiberPools."""

from __future__ import annotations

import contextlib
import itertools
import os
import secrets
import socket
import sys
import threading
from typing import NamedTuple, Protocol

from fiber._backends.kubernetes.address import reachable_address, resolved
from fiber._backends.kubernetes.api import Api
from fiber._backends.kubernetes.api_errors import ApiError, Body, NotFound, explain
from fiber._backends.kubernetes.attached_pool import Master
from fiber._backends.kubernetes.claims import Claims, look_up, without_claims
from fiber._backends.kubernetes.fiber_pool import Attachment
from fiber._backends.kubernetes.own_pool import OwnPool
from fiber._backends.kubernetes.resources import PODS, POOLS
from fiber._backends.kubernetes.shape import Shape, pool_name, program_name
from fiber._backends.kubernetes.template import (
    fiber_pool_body,
    own_container,
    pod_template,
    secrets_left_out,
)
from fiber._backends.kubernetes.warm_pool import WarmPool, read_pool_key
from fiber._transport.acceptor import Acceptor
from fiber._transport.credentials import MasterCredentials, make_certificate, make_credentials
from fiber._transport.handshake import Identity
from fiber._transport.link import Keepalive, Link
from fiber._transport.listener import MasterListener
from fiber._transport.loop import Loop
from fiber.config import Config
from fiber.errors import ConfigError, FiberPoolError
from fiber_api import names

_SUFFIX_BYTES = 4

_LONGEST_HOST_NAME = 63
"""Characters of a host name that Kubernetes gives a pod, at most."""


class ListenerObserver(Protocol):
    """Hears of agents that dial in, on the loop's thread."""

    def on_agent(self, link: Link) -> str | None:
        """Take an agent with the pool's credentials, or return why it is not wanted."""

    def objection(self, identity: Identity) -> str | None:
        """Return why an agent is not taken; "" if it is, None if that is not known yet."""

    def on_proven(self) -> None:
        """Note that an agent proved to be of the pool, whether or not it is wanted."""

    def on_refused(self, why: str) -> None:
        """Take the line to log for a connection that was turned away."""


class PreparedPool(NamedTuple):
    """A FiberPool that this program is about to be the master of, and listens for."""

    listener: MasterListener
    address: str
    """``host:port`` at which pods are to reach this program."""
    attachment: Attachment
    slots: int
    """Processes that each of its pods runs."""
    min_pods: int
    """Pods that it keeps whatever is wanted."""
    max_pods: int


class Program:
    """Prepares FiberPools for one program.

    Its methods ask the API server, and block until that has answered or ``cancel`` is set.
    """

    def __init__(self, config: Config) -> None:
        self._config = config
        self._api = Api.connect(config.context)
        self.api = self._api
        self.namespace = config.namespace or self._api.namespace
        self._lock = threading.Lock()
        self._own_pod: Body | None = None
        self._name = program_name(getattr(sys.modules["__main__"], "__file__", None))
        self._suffix = secrets.token_hex(_SUFFIX_BYTES)
        self._numbers = itertools.count()
        self._certificate = make_certificate()
        self._acceptors: dict[str, Acceptor] = {}
        """Acceptors by the host that they listen at: one, unless this machine's address changes.
        All pools share them, and they stay until the program ends."""

    def close(self) -> None:
        """Listen no more, and say good-bye to the API server."""
        for acceptor in self._acceptors.values():
            acceptor.close()
        self.api.close()

    def prepare_own(
        self, shape: Shape, loop: Loop, observer: ListenerObserver, cancel: threading.Event
    ) -> PreparedPool:
        """A pool of this program's own, for pods of this shape."""
        number = next(self._numbers)
        suffix = self._suffix if not number else f"{self._suffix}-{number}"
        name = pool_name(self._name, shape, suffix)
        credentials = make_credentials(certificate=self._certificate)
        own = self._find_own_pod(cancel)
        container = own_container(own, _mountinfo()) if own is not None else ""
        claims = self._claims(own, container, cancel) if own is not None else Claims()
        model = without_claims(own, claims.one_node) if own is not None else None
        template = pod_template(shape, model, container, sys.executable)
        if own is not None and number == 0:
            _say_what_stays_behind(secrets_left_out(own, container))
            for line in claims.warnings(template):
                _say(line)
        body = fiber_pool_body(name, template, self._config)
        # Last: whatever fails before leaves nothing open.
        master, listener = self._listen(name, credentials, loop, observer)
        attachment = OwnPool(self._api, self.namespace, body, credentials, master, self._owner(own))
        slots = self._config.processes_per_pod
        return PreparedPool(listener, master.address, attachment, slots, 0, self._config.max_pods)

    def prepare_warm(
        self, name: str, loop: Loop, observer: ListenerObserver, cancel: threading.Event
    ) -> PreparedPool:
        """A pool that somebody else keeps."""
        try:
            path = POOLS.path(self.namespace, name)
            spec = self._api.get(path, cancel=cancel)["spec"]
            key = read_pool_key(self._api, self.namespace, name, spec, cancel)
        except ApiError as error:
            raise self._explained(error, f"attach to the FiberPool {name!r}", name) from error
        credentials = make_credentials(key, self._certificate)
        master, listener = self._listen(name, credentials, loop, observer)
        attachment = WarmPool(self._api, self.namespace, name, master)
        return PreparedPool(
            listener,
            master.address,
            attachment,
            int(spec.get("processesPerPod", 1)),
            int(spec.get("minReplicas", 0)),
            int(spec.get("maxReplicas", self._config.max_pods)),
        )

    def _listen(
        self, pool: str, credentials: MasterCredentials, loop: Loop, observer: ListenerObserver
    ) -> tuple[Master, MasterListener]:
        config = self._config
        bound, host = self._addresses(pool)
        listener = MasterListener(
            loop,
            self._acceptor_at(bound),
            credentials,
            on_agent=observer.on_agent,
            on_refused=observer.on_refused,
            on_proven=observer.on_proven,
            objection=observer.objection,
            keepalive=Keepalive(config.heartbeat_interval, config.suspect_after, config.lost_after),
            lost_grace=Master.lost_grace,
        )
        return self._master(host, listener), listener

    def _acceptor_at(self, host: str) -> Acceptor:
        with self._lock:
            if host not in self._acceptors:
                address = names.address_of(host, self._config.listen_port)
                self._acceptors[host] = Acceptor(address, self._certificate)
            return self._acceptors[host]

    def _addresses(self, pool: str) -> tuple[str, str]:
        """Return the address to listen at and the one that pods dial."""
        listen, advertised = self._config.listen_host, self._config.advertised_host
        if advertised is not None:
            advertised = resolved("advertised_host", advertised)
            if listen is not None:
                return listen, advertised
        found = reachable_address(self._api, listen, pool=pool, namespace=self.namespace)
        return listen or found, advertised or found

    def _master(self, host: str, listener: MasterListener) -> Master:
        port = int(listener.address.rpartition(":")[2])
        # The suffix makes it this program's, and not an earlier one's of the same pid.
        return Master(host, port, f"{socket.gethostname()}:{os.getpid()}:{self._suffix}")

    def _find_own_pod(self, cancel: threading.Event) -> Body | None:
        """The pod that this program runs in, if it is in one."""
        if not self._api.in_cluster:
            return None
        with self._lock:
            if self._own_pod is None:
                name = os.environ.get("HOSTNAME") or socket.gethostname()
                self._own_pod = self._read_own_pod(name, cancel)
            return self._own_pod

    def _read_own_pod(self, name: str, cancel: threading.Event) -> Body:
        namespace = self._api.namespace
        try:
            return self._api.get(PODS.path(namespace, name), cancel=cancel)
        except NotFound as error:
            why = "with hostNetwork, or with spec.hostname, a pod's host name is not its name"
            if len(name) >= _LONGEST_HOST_NAME:
                why = f"a pod's host name is cut after {_LONGEST_HOST_NAME} characters"
            raise ConfigError(
                f"there is no pod {name!r} in namespace {namespace!r}, where this program seems to "
                f"run: {why}. Set the variable HOSTNAME in the pod's manifest by "
                "valueFrom.fieldRef, fieldPath metadata.name"
            ) from error
        except ApiError as error:
            raise self._explained(error, f"read this program's pod {name!r}", "") from error

    def _claims(self, own: Body, container: str, cancel: threading.Event) -> Claims:
        try:
            return look_up(self._api, self.namespace, own, container, cancel)
        except ApiError as error:
            raise self._explained(error, "read the claims of this program's pod", "") from error

    def _explained(self, error: ApiError, doing: str, pool: str) -> FiberPoolError:
        return explain(error, doing, pool=pool, namespace=self.namespace, server=self._api.server)

    def _owner(self, pod: Body | None) -> Body | None:
        """Return the owner of the pool, in the same namespace, with which it is deleted."""
        if pod is None or pod["metadata"]["namespace"] != self.namespace:
            return None
        metadata = pod["metadata"]
        return {
            "apiVersion": PODS.api_version,
            "kind": PODS.kind,
            "name": metadata["name"],
            "uid": metadata["uid"],
        }


def _say_what_stays_behind(variables: list[str]) -> None:
    if variables:
        _say(
            f"workers do not get the variables {', '.join(variables)}: they look like "
            "secrets, and everybody who may read FiberPools could read their values there. Take "
            "them from a Secret (valueFrom.secretKeyRef) in the manifest of this program"
        )


def _say(line: str) -> None:
    with contextlib.suppress(Exception):  # stderr may be closed
        sys.stderr.write(f"fiber: {line}\n")


def _mountinfo() -> str:
    try:
        with open("/proc/self/mountinfo") as file:
            return file.read()
    except OSError:
        return ""
