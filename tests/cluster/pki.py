"""A throw-away certificate authority for the cluster's own parts."""

from __future__ import annotations

import base64
import json
import secrets
from pathlib import Path
from typing import NamedTuple

from cluster import places
from cluster.shell import output

_NEW_KEY = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes")
_VALID = ("-days", "3650")


class Pair(NamedTuple):
    """A certificate and its key, as files."""

    certificate: Path
    key: Path


class Pki:
    """Certificates and kubeconfigs in one folder, each made when it is first asked for."""

    def __init__(self, folder: Path) -> None:
        self.authority = Pair(folder / "ca.crt", folder / "ca.key")
        self.service_accounts = Pair(folder / "sa.pub", folder / "sa.key")
        self._folder = folder
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        if not self.authority.certificate.exists():
            self._make_authority()

    def _make_authority(self) -> None:
        certificate, key = self.authority
        name = ("-subj", "/CN=fiber-test-cluster")
        output(
            "openssl",
            "req",
            "-x509",
            *_NEW_KEY,
            *_VALID,
            *name,
            "-keyout",
            key,
            "-out",
            certificate,
        )
        public, private = self.service_accounts
        output("openssl", "genrsa", "-out", private, "2048")
        output("openssl", "rsa", "-in", private, "-pubout", "-out", public)

    def issue(self, name: str, user: str, group: str = "", addresses: str = "") -> Pair:
        """A certificate for a user of Kubernetes, and for the server that answers there."""
        pair = Pair(self._folder / f"{name}.crt", self._folder / f"{name}.key")
        if pair.certificate.exists():
            return pair
        request, extensions = self._folder / f"{name}.csr", self._folder / f"{name}.ext"
        subject = (f"/O={group}" if group else "") + f"/CN={user}"
        output("openssl", "req", *_NEW_KEY, "-subj", subject, "-keyout", pair.key, "-out", request)
        alternatives = f"subjectAltName={addresses}\n" if addresses else ""
        extensions.write_text(f"extendedKeyUsage=clientAuth,serverAuth\n{alternatives}")
        authority = ("-CA", self.authority.certificate, "-CAkey", self.authority.key)
        # Several threads make certificates; they could not share a file of serial numbers.
        number = ("-set_serial", f"0x{secrets.token_hex(8)}")
        files = ("-in", request, "-extfile", extensions, "-out", pair.certificate)
        output("openssl", "x509", "-req", *_VALID, *authority, *number, *files)
        return pair

    def kubeconfig(self, name: str, user: str, group: str = "") -> Path:
        """A kubeconfig whose bearer is this user."""
        pair = self.issue(name, user, group)
        file = self._folder / f"{name}.kubeconfig"
        file.touch(mode=0o600)
        file.write_text(json.dumps(_kubeconfig(self.authority.certificate, pair)))
        return file


def _kubeconfig(authority: Path, pair: Pair) -> dict[str, object]:
    cluster = {"server": places.API, "certificate-authority-data": _encoded(authority)}
    user = {
        "client-certificate-data": _encoded(pair.certificate),
        "client-key-data": _encoded(pair.key),
    }
    return {
        "apiVersion": "v1",
        "kind": "Config",
        "current-context": "fiber",
        "clusters": [{"name": "fiber", "cluster": cluster}],
        "users": [{"name": "fiber", "user": user}],
        "contexts": [{"name": "fiber", "context": {"cluster": "fiber", "user": "fiber"}}],
    }


def _encoded(file: Path) -> str:
    return base64.b64encode(file.read_bytes()).decode()
