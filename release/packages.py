"""Files of a release: sdist, wheel and chart, made of one source tree and checked.

The sdist is made first, from the checkout.  The registry is written into its copy of
``published.py``, and everything else is made from that: the final sdist, the wheel, and the images.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import sys
import tarfile
import zipfile
from email.parser import Parser
from pathlib import Path

from fiber._backends.kubernetes.published import OPERATOR
from release import ROOT, ReleaseError, output, versions

PUBLISHED = Path("sdk/fiber/_backends/kubernetes/published.py")
SUMS = "SHA256SUMS"
DEFINITION = Path("crds/fiberpools.yaml")

_REGISTRY_LINE = re.compile(r'^REGISTRY = ""$', re.MULTILINE)
_REPOSITORY_LINE = re.compile(r'^(image:\n(?:  #.*\n)*  repository: )""$', re.MULTILINE)
_REPOSITORY_ROW = '| `image.repository` | `""` |'


def stamped_sources(registry: str, folder: Path) -> Path:
    """Unpack the checkout's sdist below ``folder``, write the registry into it, return it."""
    archive = _built("sdist", ROOT, folder / "plain")
    with tarfile.open(archive) as packed:
        packed.extractall(folder, filter="data")
    sources = folder / archive.name.removesuffix(".tar.gz")
    _replace(sources / PUBLISHED, _REGISTRY_LINE, f'REGISTRY = "{registry}"')
    (sources / "PKG-INFO").unlink()  # of the archive, which is made anew
    return sources


def sdist_and_wheel(sources: Path, folder: Path) -> tuple[Path, Path]:
    """Make both, with the metadata that a package index accepts."""
    sdist = _built("sdist", sources, folder)
    wheel = _built("wheel", sources, folder)
    output(sys.executable, "-m", "twine", "check", "--strict", sdist, wheel)
    return sdist, wheel


def wheel_version(wheel: Path) -> str:
    """Return the version that the metadata of a wheel has."""
    with zipfile.ZipFile(wheel) as packed:
        (name,) = (name for name in packed.namelist() if name.endswith(".dist-info/METADATA"))
        return str(Parser().parsestr(packed.read(name).decode())["Version"])


def chart_archive(helm: str, registry: str, sources: Path, folder: Path, home: Path) -> Path:
    """Package the chart, whose default image is in the registry."""
    chart = Path(shutil.copytree(sources / versions.CHART, home / OPERATOR))
    repository = f"{registry}/{OPERATOR}"
    _replace(chart / "values.yaml", _REPOSITORY_LINE, rf'\g<1>"{repository}"')
    row = re.compile(re.escape(_REPOSITORY_ROW))
    _replace(chart / "README.md", row, f'| `image.repository` | `"{repository}"` |')
    output(helm, "package", chart, "--destination", folder, env=helm_environment(home))
    (archive,) = folder.glob(f"{OPERATOR}-*.tgz")
    return archive


def chart_images(helm: str, chart: Path, registry: str, home: Path) -> set[str]:
    """Return the images in the registry that a chart names, with its default values."""
    # The oldest Kubernetes that the chart supports is older than any Helm.
    command = (helm, "template", "fiber", chart, "--kube-version", "1.34.0")
    rendered = output(*command, env=helm_environment(home))
    return set(re.findall(rf"{re.escape(registry)}/[\w./-]+[:@][\w.:-]+", rendered))


def chart_metadata(helm: str, chart: Path, home: Path) -> tuple[str, str]:
    """Return the version and the appVersion of a packaged chart."""
    shown = output(helm, "show", "chart", chart, env=helm_environment(home))
    fields = dict(re.findall(r"^(version|appVersion): \"?([^\"\s]+)\"?$", shown, re.MULTILINE))
    return fields["version"], fields["appVersion"]


def push_chart(helm: str, chart: Path, registry: str) -> str:
    """Push a packaged chart with the login that Helm has; return its digest."""
    said = output(helm, "push", chart, f"oci://{registry}/charts")
    found = re.search(r"^Digest: (sha256:[0-9a-f]{64})$", said, re.MULTILINE)
    if found is None:
        raise ReleaseError(
            f"Helm did not say the digest of {chart.name}, but: {said.strip()}. Look for the chart "
            "in the registry, and run this again"
        )
    return found[1]


def find_helm() -> str:
    """Return Helm's path; ReleaseError if it is not installed."""
    helm = shutil.which("helm")
    if helm is None:
        raise ReleaseError(
            "helm is not on the PATH, and packages the chart. Install Helm 3, or run `make "
            "release-dry-run`, which also finds the one that `make test-prepare` builds"
        )
    return helm


def helm_environment(home: Path) -> dict[str, str]:
    """Return an environment in which Helm uses no cluster, and no file of the user."""
    folders = {f"HELM_{kind}_HOME": str(home / "helm") for kind in ("CACHE", "CONFIG", "DATA")}
    return {**os.environ, **folders, "KUBECONFIG": os.devnull}


def write_sums(folder: Path) -> None:
    """Write the checksums of all files of the folder, as ``sha256sum --check`` reads them."""
    files = sorted(path for path in folder.iterdir() if path.name != SUMS)
    lines = [f"{hashlib.sha256(file.read_bytes()).hexdigest()}  {file.name}\n" for file in files]
    (folder / SUMS).write_text("".join(lines), encoding="utf-8")


def _built(target: str, sources: Path, folder: Path) -> Path:
    before = set(folder.glob("*"))
    command = ("-m", "hatchling", "build", "--target", target, "--directory", str(folder))
    output(sys.executable, *command, cwd=sources)
    (made,) = set(folder.glob("*")) - before
    return made


def _replace(path: Path, pattern: re.Pattern[str], replacement: str) -> None:
    text, count = pattern.subn(replacement, path.read_text(encoding="utf-8"))
    if count != 1:
        raise ReleaseError(
            f"{path.name} has {count} places for the registry instead of one ("
            f"{pattern.pattern!r}). Restore the line, or change the pattern in release/packages.py"
        )
    path.write_text(text, encoding="utf-8")
