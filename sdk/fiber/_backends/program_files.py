"""Selection of the program's files that are sent, with the reasons for those that are not.

Files that hold secrets are not sent.  The name of a file decides, or that of a folder around it, or
the head of a small file.  Modules are judged by their name alone: a program cannot run without its
code.
"""

from __future__ import annotations

import enum
import fnmatch
import os
import re
import stat
from collections import Counter
from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple

from fiber._backends.program_layout import IgnoreRules, Layout
from fiber.errors import ProgramTooLarge

LIMIT = 100 << 20
"""Bytes of all files together."""

MOST_FILES = 50_000

_LARGEST = 5
"""Number of entries that an error lists."""


class FileEntry(NamedTuple):
    """File, folder or link, as it was found."""

    path: str
    """Path on this host, from which the contents are read, also through a link."""
    mode: int
    size: int = 0
    modified: int = 0
    target: str | None = None
    """Target of a link within the folder; other links are replaced by their targets."""


class Why(enum.Enum):
    """Reason to leave something out."""

    IGNORED = "ignored"
    SECRET = "secret"
    LINK = "link"
    PATH = "path"
    UNREADABLE = "unreadable"


class UnsentFile(NamedTuple):
    """File, folder or link that is not sent."""

    path: str
    why: Why
    detail: str


class Selection(NamedTuple):
    """Files that are sent, by their names in the archive, and files that are left out."""

    files: dict[str, FileEntry]
    left_out: tuple[UnsentFile, ...]


def select(layout: Layout, *, bounded: bool = True) -> Selection:
    """Return the files to send; ProgramTooLarge if they are too many and ``bounded``."""
    found: dict[str, FileEntry] = {}
    name_of = layout.places.name_of
    walk = _Walk(layout)
    for top in dict.fromkeys((*layout.places, layout.program, *layout.files)):
        if name_of(top) is None:
            continue
        for path, entry in walk.everything_in(top):
            found[name_of(path) or path] = entry
            if bounded and len(found) > MOST_FILES:
                raise too_large(layout, found, f"more than {MOST_FILES:,} files")
    if bounded:
        _check_size(layout, found)
    if layout.paths.directory:  # the working directory must exist, also if it is empty
        found.setdefault(layout.paths.directory, FileEntry("", stat.S_IFDIR))
    sent = {entry.path for entry in found.values()}
    return Selection(found, tuple(left for left in walk.left_out if left.path not in sent))


def _check_size(layout: Layout, found: dict[str, FileEntry]) -> None:
    total = sum(entry.size for entry in found.values())
    if total > LIMIT:
        raise too_large(layout, found, mebibytes(total))


def too_large(layout: Layout, found: dict[str, FileEntry], what: str) -> ProgramTooLarge:
    """Return the error for a program that has ``what``."""
    sizes: Counter[str] = Counter()
    for entry in found.values():
        place = layout.places.place_of(entry.path) or ""
        below = entry.path[len(place) :].split(os.sep)
        sizes[place + os.sep.join(below[:2]) + os.sep * (len(below) > 2)] += entry.size
    largest = {path: mebibytes(size) for path, size in sizes.most_common(_LARGEST) if size}
    return ProgramTooLarge(layout.program, what, mebibytes(LIMIT), largest)


def mebibytes(size: int) -> str:
    """Return a size in MiB, as text."""
    return f"{size / (1 << 20):.1f} MiB"


class _Around(NamedTuple):
    """Path of real folders to a folder."""

    folders: tuple[str, ...]
    """Real folders on the path, the last one included."""
    top: str
    """Real folder that links may lead to: the first one, or the target of a link."""
    trusted: bool = False
    """True if an ignore file asks for a folder of secrets around this one."""

    def within(self, real: str, trusted: bool) -> _Around:
        top = self.top if _is_inside(real, self.top) else real
        return _Around((*self.folders, real), top, trusted)


class _Walk:
    """Walk over all files of a program."""

    def __init__(self, layout: Layout) -> None:
        self.left_out: list[UnsentFile] = []
        self._packages = {os.path.dirname(file) for file in layout.files}
        """Folders with modules that the program has imported."""

    def everything_in(self, top: str) -> Iterator[tuple[str, FileEntry]]:
        """Yield ``top`` and, if it is a folder, the entries in it that the rules select."""
        entry = _entry(top)
        if entry is None:
            return
        if not _is_readable(entry):
            self.left_out.append(UnsentFile(top, Why.UNREADABLE, ""))
            return
        yield top, entry
        if stat.S_ISDIR(entry.mode):
            real = os.path.realpath(top)
            yield from self._walk(top, IgnoreRules.around(top), _Around((real,), real))

    def _walk(
        self, folder: str, rules: IgnoreRules, around: _Around
    ) -> Iterator[tuple[str, FileEntry]]:
        rules = rules.within(folder)
        for found in _found_in(folder):
            path = found.path
            if found.is_symlink():
                real = os.path.realpath(path)
                entry = _link(path, real, around)
            else:
                real = os.path.join(around.folders[-1], found.name)
                entry = _entry(path)
            if entry is None:
                continue
            is_folder = stat.S_ISDIR(entry.mode)
            left_out = self._objection(entry, real, rules, around)
            if left_out is not None:
                self.left_out.append(left_out)
            elif not is_folder:
                yield path, entry
            elif real not in around.folders:  # else a link leads back to an outer folder
                yield path, entry
                trusted = around.trusted or secret_in_folder(found.name) is not None
                yield from self._walk(path, rules, around.within(real, trusted))

    def _objection(
        self, entry: FileEntry, real: str, rules: IgnoreRules, around: _Around
    ) -> UnsentFile | None:
        """Return why an entry is left out; None if it is sent."""
        path, is_folder = entry.path, stat.S_ISDIR(entry.mode)
        ignored = rules.ignores(path, is_folder=is_folder)
        if ignored is not None:
            return UnsentFile(path, Why.IGNORED, ignored)
        holds = None if around.trusted else _secret(entry, real)
        leads_out = not _is_inside(real, around.top) and path not in self._packages
        if (holds or leads_out) and not rules.asks_for(path, is_folder=is_folder):
            return (
                UnsentFile(path, Why.SECRET, holds) if holds else UnsentFile(path, Why.LINK, real)
            )
        return None if _is_readable(entry) else UnsentFile(path, Why.UNREADABLE, "")


def _found_in(folder: str) -> list[os.DirEntry[str]]:
    try:
        with os.scandir(folder) as found:
            return list(found)
    except OSError:
        return []


def _is_readable(entry: FileEntry) -> bool:
    """Return whether this program can read the file, or list and enter the folder."""
    if entry.target is not None:
        return True
    needed = os.R_OK | os.X_OK if stat.S_ISDIR(entry.mode) else os.R_OK
    return os.access(entry.path, needed)


def _secret(entry: FileEntry, real: str) -> str | None:
    """Return the kind of secret that the entry or its target is; None if it is none."""
    if stat.S_ISDIR(entry.mode):
        names = map(os.path.basename, (entry.path, real))
        return next(filter(None, map(secret_in_folder, names)), None)
    for path in dict.fromkeys((entry.path, real)):
        holds = secret_in_file(path, entry.size, entry.modified)
        if holds is not None:
            return holds
    return None


def _link(path: str, real: str, around: _Around) -> FileEntry | None:
    """Return the link itself if it stays within the folder, otherwise its target."""
    first, parent = around.folders[0], around.folders[-1]
    inside = all(_is_inside(place, first) for place in (*around.folders, real))
    if inside and os.path.exists(path):
        return FileEntry(path, stat.S_IFLNK, target=os.path.relpath(real, parent))
    return _entry(path)


def _is_inside(path: str, folder: str) -> bool:
    return f"{path}/".startswith(f"{folder.rstrip('/')}/")


def _entry(path: str) -> FileEntry | None:
    """Return the file or folder at ``path``; None for others and for missing ones."""
    try:
        found = os.stat(path)
    except OSError:
        return None
    if stat.S_ISDIR(found.st_mode):
        return FileEntry(path, stat.S_IFDIR)
    if not stat.S_ISREG(found.st_mode):
        return None
    mode = stat.S_IFREG | (found.st_mode & stat.S_IXUSR)
    return FileEntry(path, mode, found.st_size, found.st_mtime_ns)


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
"""Ends of paths, in lower case, of files whose names alone are too common."""

_EXAMPLES = (".env.example", ".env.sample", ".env.template", ".env.dist")

_COPY = re.compile(
    r"#(?P<emacs>.+)#|\.(?P<vim>.+)\.sw[op]|(?P<copy>.+?)(?:~|\.(?:bak|old|orig|save))"
)
"""Names of copies that editors or people keep beside a file."""

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
"""Expressions that all match in the contents of each kind.  An expression that begins with fixed
letters is found fastest, so the condition about letters before them stands after them.
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


def secret_in_folder(name: str) -> str | None:
    """Return the kind of secrets in a folder of this name; None if there are none."""
    return _FOLDERS.get(name.lower())


def secret_in_file(path: str, size: int, modified: int) -> str | None:
    """Return the kind of secret in the file; None if there is none.

    Each state of a file, by its ``size`` and ``modified``, is read once.
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
        # Do not wait if a pipe has replaced the file.
        with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
            limit = _SMALL if path.lower().endswith(".pem") else _HEAD
            head = file.read(limit) or b""  # None: a pipe with nothing in it
    except OSError:
        return ""  # an unreadable file is not sent
    for holds, needed in _BY_CONTENTS.items():
        if all(pattern.search(head) for pattern in needed):
            return holds
    public = size <= limit and _BLOCK.search(head) and b"PRIVATE" not in head
    return _PUBLIC if public else ""
