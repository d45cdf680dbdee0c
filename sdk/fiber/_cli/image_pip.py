"""Settings by which pip reaches its indexes, as secrets of a build.

A secret is seen by the steps that ask for it.  It is in no image, no layer and no argument.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

_CERTIFICATES = "/run/secrets/certificates"
# Other settings are the business of this machine.
_SETTINGS = ("extra-index-url", "index-url", "proxy", "retries", "timeout", "trusted-host")
_OF_UV = {
    "UV_DEFAULT_INDEX": "index-url",
    "UV_INDEX_URL": "index-url",
    "UV_EXTRA_INDEX_URL": "extra-index-url",
}


@contextmanager
def secrets() -> Iterator[list[str]]:
    """Yield the options that give pip's settings to a build."""
    with tempfile.TemporaryDirectory(prefix="fiber-image-") as folder:
        settings, certificates = settings_of(_listed(), os.environ)
        options = []
        if certificates:
            settings["cert"] = _CERTIFICATES
            options = ["--secret", f"id=certificates,src={certificates}"]
        file = Path(folder, "pip.conf")
        file.touch(mode=0o600)
        lines = [f"{key} = {value}" for key, value in sorted(settings.items())]
        file.write_text("\n".join(["[global]", *lines, ""]), encoding="utf-8")
        yield [*options, "--secret", f"id=pip,src={file}"]


def settings_of(
    listed: Iterable[str], environ: Mapping[str, str]
) -> tuple[dict[str, str], str | None]:
    """Return the settings that matter to a build, and the file of this machine's certificates.

    ``listed``: lines of ``pip config list``.  Of two places that set the same key the environment
    wins, as in pip.
    """
    found = {key: environ[name] for name, key in _OF_UV.items() if environ.get(name)}
    for line in sorted(listed, key=lambda line: line.startswith(":env:")):
        name, _, value = line.partition("=")
        section, _, key = name.partition(".")
        if section in ("global", "install", "download", ":env:"):
            found[key.removeprefix("default-")] = value.strip().strip("'\"")
    settings = {key: found[key].replace("\\n", "\n    ") for key in _SETTINGS if key in found}
    certificates = found.get("cert") or environ.get("SSL_CERT_FILE") or ""
    return settings, certificates if Path(certificates).is_file() else None


def _listed() -> list[str]:
    """Return the lines of ``pip config list``; none where there is no pip."""
    command = [sys.executable, "-m", "pip", "config", "list"]
    return subprocess.run(command, check=False, capture_output=True, text=True).stdout.splitlines()
