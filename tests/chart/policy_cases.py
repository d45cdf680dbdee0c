"""Templates of FiberPools that the chart's admission policy refuses, and some that it lets pass."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any, NamedTuple

Body = dict[str, Any]

OPERATOR_EXISTS: Body = {"operator": "Exists"}
CONTROL_PLANE: Body = {**OPERATOR_EXISTS, "key": "node-role.kubernetes.io/control-plane"}
APPARMOR = "container.apparmor.security.beta.kubernetes.io/worker"


class Case(NamedTuple):
    """Changes of a good template, and words of the policy's refusal."""

    more: Body
    words: str


def of_pod(**spec: object) -> Body:
    return {"spec": spec}


def of_container(kind: str = "containers", **fields: object) -> Body:
    return {"spec": {kind: [{"name": "worker", "image": "fiber-worker", **fields}]}}


def of_context(**context: object) -> Body:
    return of_container(securityContext=context)


def with_more(template: Body, more: Body) -> Body:
    """Merge it into the template; a list replaces one of the same name."""
    changed = copy.deepcopy(template)
    for part, fields in copy.deepcopy(more).items():
        changed.setdefault(part, {}).update(fields)
    return changed


def volume(kind: str, **fields: object) -> Body:
    return of_pod(volumes=[{"name": "any", kind: fields}])


def volumes(**kinds: Mapping[str, object]) -> dict[str, Case]:
    return {kind: Case(volume(kind, **of), "a volume other than") for kind, of in kinds.items()}


FORBIDDEN = {
    "the node's network": Case(of_pod(hostNetwork=True), "network, processes or IPC"),
    "the node's processes": Case(of_pod(hostPID=True), "network, processes or IPC"),
    "the node's IPC": Case(of_pod(hostIPC=True), "network, processes or IPC"),
    **volumes(
        hostPath={"path": "/"},
        flexVolume={"driver": "example.com/any"},
        nfs={"server": "10.0.0.1", "path": "/"},
        iscsi={"targetPortal": "10.0.0.1", "iqn": "iqn.2001-04.com.example:disk", "lun": 0},
        rbd={"monitors": ["10.0.0.1"], "image": "disk"},
        cephfs={"monitors": ["10.0.0.1"]},
        glusterfs={"endpoints": "any", "path": "/"},
        portworxVolume={"volumeID": "any"},
        gitRepo={"repository": "https://example.com"},
    ),
    "privilege": Case(of_context(privileged=True), "a privileged container"),
    "privilege at first": Case(
        of_container("initContainers", securityContext={"privileged": True}),
        "a privileged container",
    ),
    "a capability": Case(of_context(capabilities={"add": ["NET_ADMIN"]}), "more capabilities"),
    "a process of the node": Case(
        of_pod(securityContext={"windowsOptions": {"hostProcess": True}}), "hostProcess"
    ),
    "the whole of /proc": Case(of_context(procMount="Unmasked"), "procMount"),
    "no seccomp": Case(
        of_pod(securityContext={"seccompProfile": {"type": "Unconfined"}}), "Unconfined"
    ),
    "no seccomp in the container": Case(
        of_context(seccompProfile={"type": "Unconfined"}), "Unconfined"
    ),
    "no AppArmor": Case(
        of_pod(securityContext={"appArmorProfile": {"type": "Unconfined"}}), "Unconfined"
    ),
    "no AppArmor in the container": Case(
        of_context(appArmorProfile={"type": "Unconfined"}), "Unconfined"
    ),
    "no AppArmor, by its old name": Case(
        {"metadata": {"annotations": {APPARMOR: "unconfined"}}}, "no profile of AppArmor"
    ),
    "a type of SELinux": Case(of_context(seLinuxOptions={"type": "spc_t"}), "seLinuxOptions"),
    "a user of SELinux": Case(
        of_pod(securityContext={"seLinuxOptions": {"user": "system_u"}}), "seLinuxOptions"
    ),
    "kernel parameters": Case(
        of_pod(securityContext={"sysctls": [{"name": "kernel.msgmax", "value": "1"}]}), "sysctls"
    ),
    "a node by its name": Case(of_pod(nodeName="node-1"), "nodeName"),
    "nodes with any taint": Case(of_pod(tolerations=[OPERATOR_EXISTS]), "tolerations"),
    "nodes with any taint of one effect": Case(
        of_pod(tolerations=[{**OPERATOR_EXISTS, "key": "", "effect": "NoSchedule"}]), "tolerations"
    ),
    "the control plane": Case(of_pod(tolerations=[CONTROL_PLANE]), "tolerations"),
    "a priority class of the system": Case(
        of_pod(priorityClassName="system-node-critical"), "priority class of the system"
    ),
    "a port of the node": Case(
        of_container(ports=[{"containerPort": 80, "hostPort": 80}]), "hostPort"
    ),
    "a call of the node": Case(
        of_container(livenessProbe={"httpGet": {"host": "169.254.169.254", "port": 80}}),
        "calls of the node",
    ),
    "a call of the node at the end": Case(
        of_container(lifecycle={"preStop": {"tcpSocket": {"host": "10.0.0.1", "port": 80}}}),
        "calls of the node",
    ),
    "another account": Case(of_pod(serviceAccountName="master"), "ServiceAccount"),
    "another account, by its old name": Case(of_pod(serviceAccount="master"), "ServiceAccount"),
}

_NULLS = (
    "initContainers nodeName priorityClassName securityContext serviceAccount tolerations volumes"
)
_CONTEXT: Body = {
    "appArmorProfile": {"type": "RuntimeDefault"},
    "capabilities": {"drop": ["ALL"]},
    "privileged": False,
    "procMount": "Default",
    "runAsNonRoot": True,
    "seccompProfile": {"type": "RuntimeDefault"},
    "seLinuxOptions": {"level": "s0:c123,c456", "type": "container_t"},
}

ALLOWED = {
    "nothing": of_pod(),
    "fields without a value": of_pod(**dict.fromkeys(_NULLS.split())),
    "what the restricted standard allows": {
        "metadata": {"annotations": {APPARMOR: "runtime/default", "team": "unconfined"}},
        "spec": {
            "hostNetwork": False,
            "serviceAccountName": "default",
            "tolerations": [
                {**OPERATOR_EXISTS, "key": "spot"},
                {"key": "team", "value": "a", "effect": "NoSchedule"},
            ],
            "priorityClassName": "research",
            "initContainers": [{"name": "first", "image": "x", "securityContext": _CONTEXT}],
        },
    },
    "volumes of the cluster": of_pod(
        volumes=[
            {"name": "tmp", "emptyDir": {}, "hostPath": None},
            {"name": "anothers", "secret": {"secretName": "warm-fiber-key"}},
            {"name": "claim", "persistentVolumeClaim": {"claimName": "data"}},
            {"name": "driver", "csi": {"driver": "example.com"}},
            {"name": "bare"},
        ]
    ),
    "a probe of its own pod": of_container(
        livenessProbe={"httpGet": {"port": 80}},
        lifecycle={"preStop": {"exec": {"command": ["true"]}}, "postStart": None},
    ),
    "a container without a context": of_container(securityContext=None, ports=None),
    "a context without capabilities": of_context(capabilities=None),
    "capabilities without a value": of_container(
        securityContext={"capabilities": {"add": None, "drop": ["ALL"]}},
        ports=[{"containerPort": 80, "hostPort": None}],
    ),
}
