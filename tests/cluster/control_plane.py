"""etcd, kube-apiserver, controller-manager and scheduler, in the root network namespace."""

from __future__ import annotations

from cluster import diagnosis, places
from cluster.daemons import Daemon
from cluster.kubectl import answer_of, kubectl
from cluster.pki import Pki
from cluster.shell import wait_for

_ETCD = "http://127.0.0.1:2479"
_ETCD_PEERS = "http://127.0.0.1:2480"
_ISSUER = "https://kubernetes.default.svc.cluster.local"
# No limit that a test at thousands of pods would measure instead of the operator.
_UNHURRIED = ("--kube-api-qps=1000", "--kube-api-burst=2000")
NODE_LOST_AFTER = 20
"""Seconds of silence after which a node is NotReady; Kubernetes' own default is 50."""


def start(pki: Pki) -> None:
    """Start all four and return when they answer."""
    etcd = Daemon("etcd")
    etcd.start(
        "etcd",
        f"--data-dir={places.STATE}/etcd",
        "--unsafe-no-fsync",  # The folder's contents need not survive the machine.
        f"--listen-client-urls={_ETCD}",
        f"--advertise-client-urls={_ETCD}",
        f"--listen-peer-urls={_ETCD_PEERS}",
    )
    pki.kubeconfig("admin", "admin", "system:masters")
    start_apiserver(pki)
    _start_controllers(pki)
    role = ("--clusterrole=system:node-proxier", "--user=system:kube-proxy")
    kubectl("create", "clusterrolebinding", "kube-proxy", *role, check=False)


def start_apiserver(pki: Pki) -> None:
    serving = pki.issue("apiserver", "kube-apiserver", addresses=_addresses())
    client = pki.issue("apiserver-kubelet", "kube-apiserver-kubelet", "system:masters")
    Daemon("apiserver").start(
        "kube-apiserver",
        f"--etcd-servers={_ETCD}",
        f"--advertise-address={places.HOST_IP}",
        f"--bind-address={places.HOST_IP}",
        "--secure-port=6443",
        f"--service-cluster-ip-range={places.SERVICE_RANGE}",
        "--authorization-mode=Node,RBAC",
        # The second one is stricter than most clusters: a client may set an owner only if it may
        # delete that owner. So a missing right of the operator is found.
        "--enable-admission-plugins=NodeRestriction,OwnerReferencesPermissionEnforcement",
        "--allow-privileged=true",
        "--kubelet-preferred-address-types=InternalIP",
        f"--client-ca-file={pki.authority.certificate}",
        f"--tls-cert-file={serving.certificate}",
        f"--tls-private-key-file={serving.key}",
        f"--kubelet-client-certificate={client.certificate}",
        f"--kubelet-client-key={client.key}",
        f"--service-account-key-file={pki.service_accounts.certificate}",
        f"--service-account-signing-key-file={pki.service_accounts.key}",
        f"--service-account-issuer={_ISSUER}",
    )
    wait_for_apiserver()


def wait_for_apiserver() -> None:
    """Return once the API server says that it is ready."""
    daemons = [Daemon("etcd"), Daemon("apiserver")]
    wait_for(
        "the API server",
        lambda: kubectl("get", "--raw", "/readyz", check=False) == "ok",
        complaint=lambda: diagnosis.end_of(daemons),
        account=lambda: diagnosis.silence_of(daemons, answer_of("get", "--raw", "/readyz?verbose")),
    )


def _start_controllers(pki: Pki) -> None:
    manager = pki.kubeconfig("controller-manager", "system:kube-controller-manager")
    Daemon("controller-manager").start(
        "kube-controller-manager",
        f"--kubeconfig={manager}",
        f"--service-account-private-key-file={pki.service_accounts.key}",
        f"--root-ca-file={pki.authority.certificate}",
        "--use-service-account-credentials=true",
        "--allocate-node-cidrs=false",
        "--leader-elect=false",
        f"--node-monitor-grace-period={NODE_LOST_AFTER}s",
        f"--cluster-signing-cert-file={pki.authority.certificate}",
        f"--cluster-signing-key-file={pki.authority.key}",
        "--bind-address=127.0.0.1",
        *_UNHURRIED,
    )
    scheduler = pki.kubeconfig("scheduler", "system:kube-scheduler")
    Daemon("scheduler").start(
        "kube-scheduler",
        f"--kubeconfig={scheduler}",
        "--leader-elect=false",
        "--bind-address=127.0.0.1",
        *_UNHURRIED,
    )


def limit_controllers(rate: int | None = None) -> None:
    """Start Kubernetes' controllers again, each with so many calls a second; without: as before."""
    manager = Daemon("controller-manager")
    command = [word for word in manager.command if not word.startswith("--kube-api-")]
    manager.kill()
    limits = (f"--kube-api-qps={rate}", f"--kube-api-burst={rate + rate // 2}") if rate else ()
    manager.start(*command, *(limits or _UNHURRIED))


def _addresses() -> str:
    names = ["kubernetes", "kubernetes.default", "kubernetes.default.svc", "localhost"]
    addresses = [places.HOST_IP, places.SERVICE_IP, "127.0.0.1"]
    return ",".join([f"DNS:{name}" for name in names] + [f"IP:{ip}" for ip in addresses])
