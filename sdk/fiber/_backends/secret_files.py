"""Recognition of files that hold secrets: keys, passwords and tokens.

The name of a file decides, or that of a folder around it, or the contents of a small file.
Modules are judged by their name alone: a program cannot run without its code.
"""

from __future__ import annotations

import fnmatch
import os
import re
from functools import lru_cache

_FOLDERS = {
    ".aws": "credentials of AWS",
    ".azure": "credentials of Azure",
    ".envs": "environment variables",
    ".gcloud": "credentials of Google Cloud",
    ".gnupg": "private keys",
    ".kube": "credentials of Kubernetes",
    ".oci": "credentials of Oracle Cloud",
    ".password-store": "passwords",
    ".ssh": "private keys",
}

_FILES = {
    "environment variables": (".env", ".env.*", "*.env", ".envrc", ".flaskenv"),
    "passwords of hosts": (
        ".netrc",
        "_netrc",
        ".git-credentials",
        ".htpasswd",
        ".ftpconfig",
        "sftp-config.json",
        "rclone.conf",
        ".passwd-s3fs",
    ),
    "passwords of databases": (".pgpass", ".my.cnf", ".mylogin.cnf"),
    "tokens of package registries": (".npmrc", ".pypirc"),
    "credentials of image registries": (".dockercfg", ".dockerconfigjson"),
    "credentials of Kubernetes": ("kubeconfig", "*.kubeconfig", "kubeconfig.*"),
    "credentials of a cloud": (
        "credentials.db",
        "access_tokens.db",
        "application_default_credentials.json",
        "client_secret*.json",
        "service-account*.json",
        "service_account*.json",
        ".boto",
        ".s3cfg",
    ),
    "tokens of a service": (
        ".vault-token",
        ".terraformrc",
        "terraform.rc",
        "credentials.tfrc.json",
        ".databrickscfg",
        "kaggle.json",
        ".comet.config",
        ".modal.toml",
        ".sentryclirc",
        "ngrok.yml",
    ),
    "values of Terraform": ("*.tfstate", "*.tfstate.*", "*.tfvars", "*.tfvars.json"),
    "secrets": tuple(
        f"{name}.{kind}"
        for name in ("credentials", "secrets")
        for kind in ("ini", "json", "toml", "yaml", "yml")
    ),
    "commands that were typed": (
        ".bash_history",
        ".mysql_history",
        ".psql_history",
        ".python_history",
        ".zsh_history",
    ),
    "private keys": (
        "*.key",
        "*.pem",
        "*.p12",
        "*.pfx",
        "*.p8",
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

_PATHS = {
    "/.docker/config.json": "credentials of image registries",
    "/containers/auth.json": "credentials of image registries",
    "/.composer/auth.json": "tokens of package registries",
    "/.cargo/credentials": "tokens of package registries",
    "/.gem/credentials": "tokens of package registries",
    "/.m2/settings.xml": "tokens of package registries",
    "/gh/hosts.yml": "tokens of GitHub",
    "/glab-cli/config.yml": "tokens of GitLab",
    "/huggingface/token": "tokens of Hugging Face",
    "/.huggingface/token": "tokens of Hugging Face",
    "/.mlflow/credentials": "passwords of MLflow",
    "/.snowsql/config": "passwords of databases",
}
"""Ends of paths, in lower case, of files whose names alone say little."""

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
    "credentials of a user of Google Cloud": (
        rb""""type"\s*:\s*"authorized_user\"""",
        rb""""refresh_token"\s*:""",
    ),
    "an identity of age": (rb"AGE-SECRET-KEY-1[0-9A-Z]{58}",),
    "a token of GitHub": (
        rb"g(?:h[opsur]_(?<![\w-]gh[opsur]_)|ithub_pat_[A-Za-z0-9]{22}_)[A-Za-z0-9]{36}",
    ),
    "a token of GitLab": (rb"glpat-(?<![\w-]glpat-)[\w-]{20}",),
    "a token of Hugging Face": (rb"hf_(?<![\w-]hf_)[A-Za-z]{34}(?!\w)",),
    "a token of PyPI": (rb"pypi-AgEIcHlwaS5vcmc[\w-]{50}",),
    "a token of npm": (rb"npm_(?<![\w-]npm_)[A-Za-z0-9]{36}(?!\w)",),
    "a token of Slack": (rb"xox[abeprs]-[0-9]{10,}-[0-9A-Za-z-]{20,}",),
    "a key of Stripe": (rb"k_live_(?<=[rs]k_live_)[0-9A-Za-z]{24}",),
    "a key of Anthropic": (rb"sk-ant-[a-z]+[0-9]{2}-[\w-]{80}",),
    "a key of OpenAI": (rb"sk-[\w-]{20,}T3BlbkFJ[\w-]{20}",),
}
"""Expressions that are found in contents of each kind.  One that begins with fixed letters is found
fastest, so what must not precede them comes after.
"""

_CODE = (".py", ".pyi", ".pyx", ".so")

_SMALL = 1 << 20
"""Bytes of the largest file that is opened."""

_HEAD = 64 << 10
"""Bytes that are read of it, unless its name says that it holds keys or certificates."""


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
    if holds is None:
        whole = path.lower()
        holds = next((held for end, held in _PATHS.items() if whole.endswith(end)), None)
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
_BLOCK = re.compile(rb"^-----BEGIN [A-Z0-9 ]+-----", re.MULTILINE)


@lru_cache(maxsize=1 << 16)
def _by_contents(path: str, size: int, modified: int) -> str:
    """Return what the file shows; nothing if that is neither secret nor public.

    The head of a file shows secrets.  Only all of a ``*.pem`` file shows that it has none.
    """
    try:
        # A pipe in its place meanwhile must not be waited for.
        with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
            limit = _SMALL if path.lower().endswith(".pem") else _HEAD
            head = file.read(limit) or b""  # None: a pipe with nothing in it
    except OSError:
        return ""  # what cannot be read is not sent
    for holds, needed in _BY_CONTENTS.items():
        if all(pattern.search(head) for pattern in needed):
            return holds
    public = size <= limit and _BLOCK.search(head) and b"PRIVATE" not in head
    return _PUBLIC if public else ""
