"""Node of the cluster: a containerd, a kubelet and a kube-proxy in one network namespace."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from cluster import cgroups, diagnosis, places
from cluster.containerd import Containerd
from cluster.daemons import Daemon
from cluster.pause import PAUSE, pause_archive
from cluster.pki import Pair, Pki
from cluster.shell import wait_for

_LEASE = 20
"""Seconds; a kubelet renews its Lease every quarter of it."""


class Node:
    """The three daemons of a node, and the files that they read."""

    def __init__(self, index: int, pki: Pki) -> None:
        self.index = index
        self.name = places.node_name(index)
        self._pki = pki
        self._files = places.STATE / "conf" / self.name
        self._data = places.STATE / self.name
        self._containerd = Containerd(index)

    def start(self) -> None:
        """Start it all. The kubelet joins by itself, as soon as there is an API server."""
        self._start_containerd()
        self._start_kubelet()
        self._start_proxy()

    def _start_containerd(self) -> None:
        (self._files / "cni").mkdir(parents=True, exist_ok=True)
        self.write("cni/10-bridge.conflist", _pod_network(self.index, self._data))
        settings = self._files / "containerd.toml"
        settings.write_text(self.containerd_settings())
        self._containerd.socket.parent.mkdir(parents=True, exist_ok=True)
        self._start("containerd", "containerd", "--config", settings)
        daemons = [Daemon(f"{self.name}-containerd")]
        wait_for(
            f"containerd of {self.name}",
            self._containerd.answers,
            complaint=lambda: diagnosis.end_of(daemons),
            account=lambda: diagnosis.silence_of(daemons, self._containerd.answer()),
        )
        if not self._containerd.has(PAUSE):
            self._containerd.load(pause_archive())

    def _start_kubelet(self) -> None:
        address = places.node_ip(self.index)
        serving = self._pki.issue(
            f"{self.name}-serving", self.name, addresses=f"IP:{address},DNS:{self.name}"
        )
        cgroups.make(places.namespace(self.index))
        settings = self.write("kubelet.yaml", self.kubelet_settings(serving))
        user = f"system:node:{self.name}"
        self._start(
            "kubelet",
            "kubelet",
            f"--config={settings}",
            f"--root-dir={self._data}/kubelet",
            f"--kubeconfig={self._pki.kubeconfig(self.name, user, 'system:nodes')}",
            f"--hostname-override={self.name}",
            f"--node-ip={address}",
        )

    def _start_proxy(self) -> None:
        kubeconfig = self._pki.kubeconfig(f"{self.name}-proxy", "system:kube-proxy")
        settings = {
            "apiVersion": "kubeproxy.config.k8s.io/v1alpha1",
            "kind": "KubeProxyConfiguration",
            "mode": "iptables",
            "clientConnection": {"kubeconfig": str(kubeconfig)},
            "clusterCIDR": places.POD_RANGE,
            "hostnameOverride": self.name,
            "conntrack": {"maxPerCore": 0},  # the limit is the machine's, not a namespace's
            "healthzBindAddress": "127.0.0.1:10256",
            "metricsBindAddress": "127.0.0.1:10249",
        }
        self._start("proxy", "kube-proxy", f"--config={self.write('proxy.yaml', settings)}")

    def _start(self, part: str, *command: str | Path) -> None:
        daemon = Daemon(f"{self.name}-{part}")
        daemon.start(*command, namespace=places.namespace(self.index))

    def write(self, name: str, settings: dict[str, Any]) -> Path:
        """Write settings that have changed; kube-proxy ends whenever its file is written."""
        file, text = self._files / name, json.dumps(settings, indent=2)
        if not file.exists() or file.read_text() != text:
            file.write_text(text)
        return file

    def containerd_settings(self) -> str:
        return _CONTAINERD.format(
            root=self._data / "containerd",
            state=self._containerd.socket.parent / "containerd",
            socket=self._containerd.socket,
            pause=PAUSE,
            cni=self._files / "cni",
        )

    def kubelet_settings(self, serving: Pair) -> dict[str, Any]:
        authority = {"clientCAFile": str(self._pki.authority.certificate)}
        return {
            "apiVersion": "kubelet.config.k8s.io/v1beta1",
            "kind": "KubeletConfiguration",
            "address": places.node_ip(self.index),
            "authentication": {
                "anonymous": {"enabled": False},
                "webhook": {"enabled": True},
                "x509": authority,
            },
            "authorization": {"mode": "Webhook"},
            "tlsCertFile": str(serving.certificate),
            "tlsPrivateKeyFile": str(serving.key),
            "healthzBindAddress": "127.0.0.1",
            "containerRuntimeEndpoint": f"unix://{self._containerd.socket}",
            "cgroupDriver": "cgroupfs",
            "cgroupRoot": f"/{places.namespace(self.index)}",
            "podCIDR": places.pod_range(self.index),
            # A kubelet deletes the logs of pods that it does not know: no folder for two of them.
            "podLogsDir": f"{self._data}/pod-logs",
            "maxPods": 250,
            "resolvConf": "/etc/resolv.conf",
            "failSwapOn": False,
            "serializeImagePulls": False,
            "kubeAPIQPS": 200,
            "kubeAPIBurst": 400,
            "nodeStatusUpdateFrequency": "4s",
            "nodeLeaseDurationSeconds": _LEASE,
            # The disk is the whole machine's: nearly full must not mean that no pod starts.
            "evictionHard": {
                "memory.available": "100Mi",
                "nodefs.available": "1%",
                "imagefs.available": "1%",
            },
            "imageGCHighThresholdPercent": 100,
        }


def _pod_network(index: int, data: Path) -> dict[str, Any]:
    addresses = {
        "type": "host-local",
        "dataDir": f"{data}/cni",
        "ranges": [[{"subnet": places.pod_range(index)}]],
        "routes": [{"dst": "0.0.0.0/0"}],
    }
    bridge = {
        "type": "bridge",
        "bridge": "cni0",
        "isGateway": True,
        "hairpinMode": True,
        "ipam": addresses,
    }
    ports = {"type": "portmap", "capabilities": {"portMappings": True}}
    return {"cniVersion": "1.0.0", "name": "pods", "plugins": [bridge, ports]}


_CONTAINERD = """\
version = 2
root = "{root}"
state = "{state}"
[grpc]
  address = "{socket}"
[plugins."io.containerd.grpc.v1.cri"]
  sandbox_image = "{pause}"
  stream_server_address = "127.0.0.1"
  restrict_oom_score_adj = true  # so that it also runs where root lacks CAP_SYS_RESOURCE
[plugins."io.containerd.grpc.v1.cri".cni]
  bin_dir = "/usr/lib/cni"
  conf_dir = "{cni}"
[plugins."io.containerd.grpc.v1.cri".containerd.runtimes.runc]
  runtime_type = "io.containerd.runc.v2"
"""
