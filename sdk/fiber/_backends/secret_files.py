"""Recognition of files that hold secrets: keys, passwords and tokens.

The name of a file decides, or that of a folder around it, or the head of a small file.  Modules are
judged by their name alone: a program cannot run without its code.
"""

from __future__ import annotations

import fnmatch
import os
import re
from functools import lru_cache

_FOLDERS = {
    ".aws": "credentials of AWS",
    ".azure": "credentials of Azure",
    ".gcloud": "credentials of Google Cloud",
    ".gnupg": "private keys",
    ".kube": "credentials of Kubernetes",
    ".oci": "credentials of Oracle Cloud",
    ".password-store": "passwords",
    ".ssh": "private keys",
}

_FILES = {
    "environment variables": (".env", ".env.*", "*.env", ".envrc"),
    "passwords of hosts": (".netrc", "_netrc", ".git-credentials", ".htpasswd"),
    "passwords of databases": (".pgpass", ".my.cnf"),
    "tokens of package registries": (".npmrc", ".pypirc"),
    "credentials of image registries": (".dockercfg", ".dockerconfigjson"),
    "credentials of Kubernetes": ("kubeconfig", "*.kubeconfig", "kubeconfig.*"),
    "credentials of a cloud": (
        "credentials.json",
        "application_default_credentials.json",
        "client_secret*.json",
        "service-account*.json",
        "service_account*.json",
        ".boto",
        ".s3cfg",
    ),
    "tokens of a service": (".vault-token", ".terraformrc", ".databrickscfg", "kaggle.json"),
    "secrets": ("secrets.json", "secrets.toml", "secrets.yaml", "secrets.yml"),
    "private keys": (
        "*.key",
        "*.pem",
        "*.p12",
        "*.pfx",
        "*.ppk",
        "*.jks",
        "*.keystore",
        "*.kdbx",
        "id_rsa",
        "id_dsa",
        "id_ecdsa",
        "id_ed25519",
        "id_*_sk",
    ),
}
"""Patterns of names, in lower case, by what such files hold."""

_REGISTRIES = "/.docker/config.json"

_EXAMPLES = (".env.example", ".env.sample", ".env.template", ".env.dist")

_COPY = re.compile(
    r"#(?P<emacs>.+)#|\.(?P<vim>.+)\.sw[op]|(?P<copy>.+?)(?:~|\.(?:bak|old|orig|save))"
)
"""A name of a copy that an editor or a person keeps beside the file."""

_CONTENTS = {
    "a private key": (
        rb"(?s)-----BEGIN (?:[A-Z0-9]+ )*PRIVATE KEY(?: BLOCK)?-----.{0,400}?[A-Za-z0-9+/]{40}",
    ),
    "a private key of PuTTY": (rb"PuTTY-User-Key-File-",),
    "credentials of Kubernetes": (
        rb"""\bkind["']?:\s*["']?Config\b""",
        rb"""\b(?:client-key-data|token|password)["']?:\s*["']?[^\s"']""",
    ),
    "credentials of AWS": (
        rb"""(?i)secret_?access_?key["']?\s*[:=]\s*["']?[a-z0-9/+]{40}(?![a-z0-9/+])""",
    ),
    "credentials of Google Cloud": (
        rb""""type"\s*:\s*"service_account\"""",
        rb""""private_key"\s*:""",
    ),
}
"""What such contents show: each of the expressions is found in them."""

_CODE = (".py", ".pyi", ".pyx", ".so")

_SMALL = 1 << 20
"""Bytes of the largest file that is opened."""

_HEAD = 64 << 10
"""Bytes that are read of it."""


def _compiled(patterns: tuple[str, ...]) -> re.Pattern[str]:
    return re.compile("|".join(map(fnmatch.translate, patterns)))


_BY_CONTENTS = {holds: tuple(map(re.compile, needed)) for holds, needed in _CONTENTS.items()}
_BY_NAME = {holds: _compiled(patterns) for holds, patterns in _FILES.items()}
_ANY_NAME = _compiled(tuple(pattern for patterns in _FILES.values() for pattern in patterns))


def in_folder(name: str) -> str | None:
    """Return what a folder of this name holds, if that is secret."""
    return _FOLDERS.get(name.lower())


def in_file(path: str, size: int, modified: int) -> str | None:
    """Return what the file holds, if that is secret.

    ``size`` and ``modified`` say which state of the file is meant: each is read once.
    """
    name = os.path.basename(path).lower()
    if name.endswith(_CODE):
        return None
    holds = _by_name(name)
    if path.lower().endswith(_REGISTRIES):
        return "credentials of image registries"
    if holds is not None and not name.endswith(".pem"):
        return holds
    found = _by_contents(path, size, modified) if 0 < size <= _SMALL else ""
    if found == _PUBLIC:
        return None
    return found or holds


def _by_name(name: str) -> str | None:
    if copy := _COPY.fullmatch(name):
        name = copy[copy.lastgroup or 0]
    if name in _EXAMPLES or not _ANY_NAME.match(name):
        return None
    return next(holds for holds, pattern in _BY_NAME.items() if pattern.match(name))


_PUBLIC = "certificates"


@lru_cache(maxsize=1 << 16)
def _by_contents(path: str, size: int, modified: int) -> str:
    """Return what the head of the file shows; nothing if that is neither secret nor public."""
    try:
        # A pipe in its place meanwhile must not be waited for.
        with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
            head = file.read(_HEAD) or b""  # None: a pipe with nothing in it
    except OSError:
        return ""  # what cannot be read is not sent
    for holds, needed in _BY_CONTENTS.items():
        if all(pattern.search(head) for pattern in needed):
            return holds
    public = size <= _HEAD and b"-----BEGIN CERTIFICATE-----" in head and b"PRIVATE" not in head
    return _PUBLIC if public else ""
