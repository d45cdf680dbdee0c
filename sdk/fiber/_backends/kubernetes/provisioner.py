"""Provisioner of a program's FiberPools: its identity, its address for pods, its own pod.

The address is found without connecting to another machine. A PersistentVolumeClaim that only one
node can mount is left out of the workers' pods, because it would keep workers on other nodes from
starting.
"""

from __future__ import annotations

import contextlib
import copy
import ipaddress
import itertools
import os
import secrets
import socket
import sys
import threading
import time
from collections.abc import Collection, Iterator, Mapping
from typing import Any, NamedTuple, Protocol

from fiber._backends.kubernetes.api import Api
from fiber._backends.kubernetes.attached_pool import OwnPool, PoolMaster, WarmPool
from fiber._backends.kubernetes.fiber_pool import OPERATOR_ABSENT, AttachablePool
from fiber._backends.kubernetes.problems import explain
from fiber._backends.kubernetes.template import (
    PodShape,
    fiber_pool_body,
    own_container,
    pod_template,
    pool_name,
    program_name,
    secrets_left_out,
)
from fiber._transport.acceptor import Acceptor
from fiber._transport.authentication import Identity
from fiber._transport.credentials import (
    MasterCredentials,
    WarmCredentials,
    make_certificate,
    make_credentials,
)
from fiber._transport.link import Keepalive, Link
from fiber._transport.listener import MasterListener
from fiber._transport.loop import Loop
from fiber.config import Config
from fiber.errors import ConfigError, FiberPoolError
from fiber_api import names
from fiber_api.names import Reason
from fiber_api.rest import CLAIMS, NODES, PODS, POOLS, ApiError, Body, Forbidden, NotFound

_SUFFIX_BYTES = 4

_LOOK_AGAIN = 0.2
"""Seconds until the next look at a pool that no operator has seen yet."""

_LONGEST_HOST_NAME = 63
"""Characters of a host name that Kubernetes gives a pod, at most."""


class ListenerObserver(Protocol):
    """Observer of agents that dial in.  Called on the loop thread."""

    def on_agent(self, link: Link) -> str | None:
        """Take an agent that has the pool's credentials, or return why it is refused."""

    def objection(self, identity: Identity) -> str | None:
        """Return why an agent is refused; "" if it is admitted, None if that is unknown yet."""

    def on_proven(self) -> None:
        """Note that an agent proved that it has the pool's credentials."""

    def on_refused(self, why: str) -> None:
        """Take the reason why a connection was refused."""


class PreparedPool(NamedTuple):
    """FiberPool to attach to, and the listener for its agents."""

    listener: MasterListener
    address: str
    """``host:port`` that pods dial."""
    attachment: AttachablePool
    slots: int
    """Number of processes in each pod."""
    min_pods: int
    """Smallest number of pods."""
    max_pods: int
    """Largest number of pods."""


class PoolProvisioner:
    """Provisioner of the FiberPools of one program.

    Its methods block until the API server has answered or ``cancel`` is set.
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
        self._relayed = config.relay == "always"
        """True if agents are to connect to a relay, without another attempt."""
        self._acceptors: dict[str, Acceptor] = {}
        """Acceptors by the host that they listen at: one, unless this machine's address changes.
        All pools share them until the program ends."""

    def use_relay(self) -> None:
        """Have the next pools begin with a relay, since pods do not reach this program."""
        self._relayed = True

    def close(self) -> None:
        """Close the acceptors and the connections to the API server."""
        for acceptor in self._acceptors.values():
            acceptor.close()
        self.api.close()

    def prepare_own(
        self, shape: PodShape, loop: Loop, observer: ListenerObserver, cancel: threading.Event
    ) -> PreparedPool:
        """Prepare a new pool for pods of this shape."""
        number = next(self._numbers)
        suffix = self._suffix if not number else f"{self._suffix}-{number}"
        name = pool_name(self._name, shape, suffix)
        credentials = make_credentials(certificate=self._certificate)
        own = self._find_own_pod(cancel)
        container = own_container(own, _mountinfo()) if own is not None else ""
        claims = self._claims(own, container, cancel) if own is not None else VolumeClaims()
        model = without_claims(own, claims.one_node) if own is not None else None
        template = pod_template(shape, model, container, sys.executable)
        if own is not None and number == 0:
            _report_withheld_variables(secrets_left_out(own, container))
            for line in claims.warnings(template):
                _say(line)
        body = fiber_pool_body(name, template, self._config)
        # Last: an error before it leaves no listener open.
        master, listener = self._listen(name, credentials, loop, observer)
        attachment = OwnPool(self._api, self.namespace, body, credentials, master, self._owner(own))
        slots = self._config.processes_per_pod
        return PreparedPool(listener, master.address, attachment, slots, 0, self._config.max_pods)

    def prepare_warm(
        self, name: str, loop: Loop, observer: ListenerObserver, cancel: threading.Event
    ) -> PreparedPool:
        """Prepare to attach to a pool of another owner."""
        try:
            found = self._seen_by_operator(name, cancel)
        except ApiError as error:
            raise self._explained(error, f"attach to the FiberPool {name!r}", name) from error
        spec, public_key = found["spec"], bytes.fromhex(found["status"]["publicKey"])
        credentials = WarmCredentials(public_key, self._certificate)
        master, listener = self._listen(name, credentials, loop, observer)
        attachment = WarmPool(self._api, self.namespace, name, master, credentials)
        return PreparedPool(
            listener,
            master.address,
            attachment,
            int(spec.get("processesPerPod", 1)),
            int(spec.get("minReplicas", 0)),
            int(spec.get("maxReplicas", self._config.max_pods)),
        )

    def _seen_by_operator(self, name: str, cancel: threading.Event) -> Body:
        """Return the pool once the operator has told its public key."""
        deadline = time.monotonic() + OPERATOR_ABSENT
        while True:
            found = self._api.get(POOLS.path(self.namespace, name), cancel=cancel)
            status = found.get("status") or {}
            if status.get("publicKey"):
                return found
            reason, why = _without_key(status)
            if reason or time.monotonic() > deadline or cancel.wait(_LOOK_AGAIN):
                raise FiberPoolError(
                    f"this program cannot attach to the FiberPool {name!r} in namespace "
                    f"{self.namespace!r}: {why}",
                    pool=name,
                    namespace=self.namespace,
                    reason=reason or "NoOperator",
                )

    def _listen(
        self, pool: str, credentials: MasterCredentials, loop: Loop, observer: ListenerObserver
    ) -> tuple[PoolMaster, MasterListener]:
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
            lost_grace=PoolMaster.lost_grace,
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
        if self._relayed:
            return _LOOPBACK, _NOWHERE
        if advertised is not None:
            advertised = resolved("advertised_host", advertised)
            if listen is not None:
                return listen, advertised
        try:
            found = reachable_address(self._api, listen, pool=pool, namespace=self.namespace)
        except FiberPoolError:
            if self._config.relay == "never":
                raise
            self._relayed = True
            return _LOOPBACK, _NOWHERE
        return listen or found, advertised or found

    def _master(self, host: str, listener: MasterListener) -> PoolMaster:
        port = int(listener.address.rpartition(":")[2])
        # The suffix tells this program from an earlier one with the same pid.
        identity = f"{socket.gethostname()}:{os.getpid()}:{self._suffix}"
        certificate = self._certificate.hash.hex()
        return PoolMaster(host, port, identity, certificate, relay=self._relayed)

    def _find_own_pod(self, cancel: threading.Event) -> Body | None:
        """Return the pod that this program runs in; None outside of pods."""
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

    def _claims(self, own: Body, container: str, cancel: threading.Event) -> VolumeClaims:
        try:
            return look_up_claims(self._api, self.namespace, own, container, cancel)
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


def _report_withheld_variables(variables: list[str]) -> None:
    if variables:
        _say(
            f"workers do not get the variables {', '.join(variables)}: they look like "
            "secrets, and a FiberPool shows their values to all its readers. Take them from a "
            "Secret (valueFrom.secretKeyRef) in the manifest of this program"
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


_NODES = 10
"""Number of nodes to look at: the route to one is mostly the route to all."""

_LOOPBACK = "127.0.0.1"
_NOWHERE = "192.0.2.1"
"""Address in ``spec.master`` of a program that only its relay reaches: it belongs to no machine
(RFC 5737)."""

_ELSEWHERE = ("192.0.2.1", "2001:db8::1")
"""Unused addresses (RFC 5737, RFC 3849), to which the default route leads."""


def _without_key(status: Body) -> tuple[str, str]:
    """Return why a pool has no public key: a reason in one word, and in words for people.

    The first is empty if waiting may help.
    """
    for problem in status.get("problems") or ():
        if problem.get("reason") == Reason.INVALID_CREDENTIALS:
            return Reason.INVALID_CREDENTIALS, str(problem.get("message"))
    why = f"its status has no public key after {OPERATOR_ABSENT:g} s. "
    if status.get("credentialsSecret"):
        return "", (
            f"{why}Its Secret names the only program that may ever use it, or its operator is "
            "older than this program. Take a pool that no program has made for itself, or install "
            "the operator anew"
        )
    return "", f"{why}Check that an operator runs and serves this namespace"


def reachable_address(api: Api, listen_host: str | None, *, pool: str, namespace: str) -> str:
    """Return the IP address that pods reach this program at.

    This is ``listen_host``, if it names an address.  Else it is the first that is not a loopback,
    of the local addresses on the routes to the cluster's nodes, to the API server, and out of this
    machine.  In a pod it is the pod's.  FiberPoolError: all are loopbacks.
    """
    if listen_host is not None and not _is_unspecified(listen_host):
        return resolved("listen_host", listen_host)
    for target in _targets(api):
        found = _local_address(target)
        if found is not None and _is_reachable(found):
            return found
    raise FiberPoolError(
        f"pods cannot reach this program: the only address of this machine on the route to the "
        f"cluster at {api.server} is a loopback. Set listen_host (fiber.init(listen_host=) or "
        "FIBER_LISTEN_HOST) to an address of this machine that pods can reach, run the program in "
        "a pod, or set advertised_host too where pods reach this machine at another address",
        pool=pool,
        namespace=namespace,
        reason="NoAddress",
    )


def _targets(api: Api) -> Iterator[str]:
    if not api.in_cluster:
        yield from _node_addresses(api)
    yield api.server
    yield from _ELSEWHERE


def _node_addresses(api: Api) -> Iterator[str]:
    try:
        nodes = api.list(NODES.path(), {"limit": str(_NODES)}, timeout=0.0)["items"]
    except ApiError:
        return  # the right is rare; if the server cannot be reached, the next call says so
    for node in nodes:
        for address in node.get("status", {}).get("addresses", ()):
            if address.get("type") == "InternalIP":
                yield address["address"]


def _local_address(target: str) -> str | None:
    """Return the address that this machine would send from.  Nothing is sent."""
    try:
        family, kind, _, _, where = socket.getaddrinfo(target, 9, type=socket.SOCK_DGRAM)[0]
        with socket.socket(family, kind) as probe:
            probe.connect(where)
            return str(probe.getsockname()[0])
    except OSError:
        return None  # no such name, or no route to it


def resolved(key: str, host: str) -> str:
    """Return the IP address of ``host``, the value of the configuration's ``key``, for pods."""
    try:
        found = str(socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0][4][0])
    except OSError as error:
        raise _useless(key, host, f"has no address ({error})") from error
    if not _is_reachable(found):
        raise _useless(key, host, f"is {found}, an address that means another machine in each pod")
    return found


def _useless(key: str, host: str, why: str) -> ConfigError:
    return ConfigError(
        f"pods cannot reach this program: {key} {host!r} {why}. Set it to an address of this "
        "machine that pods can reach, or leave it out. Behind NAT or port forwarding, set "
        "advertised_host to the address that pods dial"
    )


def _is_unspecified(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_unspecified
    except ValueError:
        return False


def _is_reachable(host: str) -> bool:
    address = ipaddress.ip_address(host.partition("%")[0])
    return not (address.is_loopback or address.is_link_local or address.is_unspecified)


_ONE_NODE = {"ReadWriteOnce", "ReadWriteOncePod"}


class VolumeClaims(NamedTuple):
    """Claims of the program's pod that need a warning."""

    one_node: tuple[str, ...] = ()
    """Names of claims that only one node may mount."""
    unread: Mapping[str, str] = {}
    """Reasons why claims cannot be read, by their names."""

    def warnings(self, template: Mapping[str, Any]) -> list[str]:
        """Return warnings for workers that have this pod template."""
        mounted = set(_claims_by_volume(template["spec"]).values())
        left_out = [claim for claim in self.one_node if claim not in mounted]
        lines = [
            f"workers mount the PersistentVolumeClaim {claim} as this program does, though it "
            f"cannot be read ({why}): if only one node may mount it, workers on other nodes do "
            "not start. Give this program's account the right to get persistentvolumeclaims, "
            "which the role fiber-user has"
            for claim, why in self.unread.items()
        ]
        if left_out:
            lines.append(
                f"workers do not get the PersistentVolumeClaims {', '.join(left_out)}: their "
                "access mode lets only one node mount them, and workers also run on others. Use a "
                "claim with ReadWriteMany or ReadOnlyMany, or bring the volumes and volumeMounts "
                "with fiber.init(template=), where a nodeSelector can keep workers on that node"
            )
        return lines


def look_up_claims(
    api: Api, namespace: str, pod: Mapping[str, Any], container: str, cancel: threading.Event
) -> VolumeClaims:
    """Look up the claims that the container mounts, for workers in ``namespace``."""
    found = next(c for c in pod["spec"]["containers"] if c["name"] == container)
    uses = (*(found.get("volumeMounts") or ()), *(found.get("volumeDevices") or ()))
    used = {use["name"] for use in uses}
    volumes = _claims_by_volume(pod["spec"])
    one_node, unread = [], {}
    for claim in sorted({claim for volume, claim in volumes.items() if volume in used}):
        try:
            spec = api.get(CLAIMS.path(namespace, claim), cancel=cancel)["spec"]
        except (Forbidden, NotFound) as error:
            unread[claim] = error.message
        else:
            modes = set(spec.get("accessModes") or ())
            if modes and modes <= _ONE_NODE:
                one_node.append(claim)
    return VolumeClaims(tuple(one_node), unread)


def without_claims(pod: Mapping[str, Any], claims: Collection[str]) -> Body:
    """Return the pod without the volumes of these claims, and without their mounts."""
    changed = copy.deepcopy(dict(pod))
    spec = changed["spec"]
    gone = {volume for volume, claim in _claims_by_volume(spec).items() if claim in claims}
    documents = [(spec, "volumes")]
    for container in spec["containers"]:
        documents += [(container, "volumeMounts"), (container, "volumeDevices")]
    for document, field in documents:
        if document.get(field):
            document[field] = [item for item in document[field] if item["name"] not in gone]
    return changed


def _claims_by_volume(spec: Mapping[str, Any]) -> dict[str, str]:
    return {
        volume["name"]: volume["persistentVolumeClaim"]["claimName"]
        for volume in spec.get("volumes") or ()
        if volume.get("persistentVolumeClaim")
    }
