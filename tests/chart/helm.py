"""Renders the chart as Helm does: the objects that a cluster would get for these values."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from cluster import places

CHART = Path(__file__).resolve().parents[2] / "charts" / "fiber-operator"
RELEASE = "fiber"
NAMESPACE = "fiber-system"
# Said to Helm, which without a cluster takes it from how it was built.
KUBERNETES = "1.34.0"
Values = Mapping[str, Any]
Manifest = dict[str, Any]
DEFAULTS: Values = {}
IMAGE: Values = {"repository": "fiber-operator"}
"""Value `image` that the chart of a checkout needs, unless a test gives others."""


class Refused(Exception):
    """Error of Helm, which did not render or accept the chart.  It has Helm's message."""


def find_helm() -> str | None:
    """Helm on the PATH, else the one that the test cluster built."""
    return shutil.which("helm") or shutil.which("helm", path=places.programs())


@dataclass(frozen=True)
class Helm:
    """Helm program whose files go to a temporary folder instead of the user's home."""

    program: str
    home: Path
    _rendered: dict[str, str] = field(default_factory=dict)
    """Cache of rendered charts by their arguments, because Helm is slow."""

    def render(self, values: Values = DEFAULTS, *, release: str = RELEASE) -> list[Manifest]:
        """Every manifest for these values, hooks included, in Helm's order."""
        return self._template(CHART, values, release)

    def notes(self, values: Values = DEFAULTS) -> str:
        """Return the text that a person reads after `helm install`."""
        with tempfile.TemporaryDirectory(dir=self.home) as folder:
            # Helm shows the notes only where it installs, so a copy of the chart shows its own.
            chart = Path(shutil.copytree(CHART, Path(folder) / CHART.name))
            notes = (chart / "templates" / "NOTES.txt").read_text(encoding="utf-8")
            (chart / "templates" / "shown.yaml").write_text(
                f'{{{{ define "shown" }}}}{notes}{{{{ end }}}}'
                'kind: Shown\nmetadata: {name: notes}\ntext: {{ include "shown" . | toJson }}\n',
                encoding="utf-8",
            )
            return str(named(self._template(chart, values, RELEASE), "Shown")["text"])

    def lint(self, values: Values = DEFAULTS) -> str:
        """Helm's own opinion of the chart, warnings being errors."""
        return self._run(["lint", "--strict", str(CHART)], values)

    def _template(self, chart: Path, values: Values, release: str) -> list[Manifest]:
        asked = json.dumps([str(chart), release, values])
        if asked not in self._rendered:
            self._rendered[asked] = self._run(["template", release, str(chart)], values)
        return [document for document in yaml.safe_load_all(self._rendered[asked]) if document]

    def _run(self, arguments: Sequence[str], values: Values) -> str:
        usual = ["--namespace", NAMESPACE, "--kube-version", KUBERNETES]
        folders = {f"HELM_{name}_HOME": str(self.home) for name in ("CACHE", "CONFIG", "DATA")}
        with tempfile.NamedTemporaryFile("w", suffix=".json", dir=self.home) as file:
            json.dump({**values, "image": {**IMAGE, **values.get("image", {})}}, file)
            file.flush()
            done = subprocess.run(
                [self.program, *arguments, *usual, "--values", file.name],
                env={**os.environ, **folders, "KUBECONFIG": os.devnull},
                capture_output=True,
                text=True,
                timeout=60,
            )
        if done.returncode:
            raise Refused(done.stdout + done.stderr)
        return done.stdout


def named(manifests: Sequence[Manifest], kind: str, name: str | None = None) -> Manifest:
    """The one manifest of this kind, and of this name where there are several."""
    found = [
        manifest
        for manifest in manifests
        if manifest["kind"] == kind and name in (None, manifest["metadata"]["name"])
    ]
    assert len(found) == 1, f"{len(found)} manifests of kind {kind}, name {name}"
    return found[0]


def kinds(manifests: Sequence[Manifest]) -> list[str]:
    """The kinds that occur, each once, hooks left out."""
    return sorted({manifest["kind"] for manifest in manifests if not is_hook(manifest)})


def is_hook(manifest: Manifest) -> bool:
    return "helm.sh/hook" in manifest["metadata"].get("annotations", {})


def allowed(role: Manifest) -> Iterator[tuple[str, str, str]]:
    """Each (group, resource, verb) of a role, as often as it is given."""
    for rule in role["rules"]:
        for group in rule["apiGroups"]:
            for resource in rule["resources"]:
                for verb in rule["verbs"]:
                    yield group, resource, verb
