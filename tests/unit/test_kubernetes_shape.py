"""Identity and names of FiberPools, and templates that people write."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from fiber._backends.kubernetes.template import PodShape, pool_name, program_name, read_template
from fiber.config import Config
from fiber.errors import ConfigError
from fiber.resources import Resources
from fiber_api import names

GPU = {"spec": {"nodeSelector": {"gpu": "yes"}}}


def test_equal_shapes_are_one_key() -> None:
    first = PodShape.of(Config(image="es:1", template={"spec": {"a": 1, "b": 2}}))
    second = PodShape.of(Config(image="es:1", template={"spec": {"b": 2, "a": 1}}))
    assert {first: "pool"}[second] == "pool"


@pytest.mark.parametrize(
    "other",
    [
        PodShape.of(Config(image="es:2")),
        PodShape.of(Config(template=GPU)),
        PodShape.of(Config(processes_per_pod=8)),
        PodShape().with_resources(Resources(gpu=1)),
    ],
)
def test_every_property_of_a_pod_makes_another_shape(other: PodShape) -> None:
    assert other != PodShape.of(Config())


def test_invisible_settings_are_no_part_of_a_shape() -> None:
    assert PodShape.of(Config(idle_timeout=5, max_pods=3, retries=0)) == PodShape.of(Config())


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ("/home/me/train.py", "train"),
        ("/repo/examples/02-es/main.py", "es"),
        ("/venv/lib/Package_One/__main__.py", "package-one"),
        ("/home/me/2048 (v2).py", "v2"),
        ("/home/me/训练.py", "python"),
        ("/main.py", "python"),
        ("", "python"),
        (None, "python"),
    ],
)
def test_a_program_has_the_name_that_people_know(path: str | None, name: str) -> None:
    assert program_name(path) == name


@pytest.mark.parametrize(
    ("resources", "name"),
    [
        (Resources(), "es-1a2b3c"),
        (Resources(gpu=1), "es-gpu1-1a2b3c"),
        (Resources(cpu=0.5, memory=2048), "es-cpu500m-mem2048mi-1a2b3c"),
        (Resources(cpu=2.0), "es-cpu2-1a2b3c"),
    ],
)
def test_a_pool_is_called_after_the_program_and_its_wishes(resources: Resources, name: str) -> None:
    assert pool_name("es", PodShape().with_resources(resources), "1a2b3c") == name


@pytest.mark.parametrize("program", ["x" * 80, "a-" * 40, "Übung", "_", "9", "es"])
@pytest.mark.parametrize("resources", [Resources(), Resources(cpu=0.0001, memory=10**9, gpu=1000)])
def test_each_name_of_a_shape_is_valid_for_a_pool(program: str, resources: Resources) -> None:
    name = pool_name(program, PodShape().with_resources(resources), "1a2b3c")
    assert names.check_pool_name(name) == name
    assert name.endswith("-1a2b3c")


class TestTemplates:
    @pytest.mark.parametrize(
        ("file", "text"),
        [
            ("pod.yaml", "spec:\n  nodeSelector: {gpu: 'yes'}\n"),
            ("pod.json", '{"spec": {"nodeSelector": {"gpu": "yes"}}}'),
            ("pod.yml", "apiVersion: v1\nkind: Pod\nspec:\n  nodeSelector: {gpu: 'yes'}\n"),
        ],
    )
    def test_a_template_is_read_from_a_file(self, tmp_path: Path, file: str, text: str) -> None:
        (tmp_path / file).write_text(text)
        assert read_template(str(tmp_path / file)) == GPU

    def test_there_is_no_template_by_default(self) -> None:
        assert read_template(None) == {}

    @pytest.mark.parametrize(
        ("file", "text"),
        [("pod.yaml", "spec: ["), ("pod.json", "{"), ("pod.yaml", "\udcff"), ("none.yaml", None)],
    )
    def test_a_file_that_cannot_be_read_is_named(
        self, tmp_path: Path, file: str, text: str | None
    ) -> None:
        path = tmp_path / file
        if text is not None:
            path.write_bytes(text.encode("utf-8", "surrogateescape"))
        with pytest.raises(ConfigError, match="cannot read the pod template") as caught:
            PodShape.of(Config(template=str(path)))
        assert str(path) in str(caught.value)

    @pytest.mark.parametrize(
        ("template", "complaint"),
        [
            ({"containers": []}, "has 'containers' beside metadata and spec. Put fields of the "),
            ({"spec": {}, "Spec": {}}, "has 'Spec' beside metadata and spec$"),
            ({"spec": []}, "has a spec that is not an object"),
            ({"spec": {"containers": [{"image": "x"}]}}, "a container without a name.*'worker'"),
            ({"spec": {"containers": ["x"]}}, "a container without a name"),
            (
                {"spec": {"containers": [{"name": "main"}]}},
                "'main' without an image. The one that runs the processes is called 'worker'",
            ),
            ({"spec": {"nodeSelector": {"since": Path()}}}, "not JSON serializable.*in quotes"),
        ],
    )
    def test_an_invalid_template_is_refused_with_the_reason(
        self, template: dict[str, Any], complaint: str
    ) -> None:
        with pytest.raises(ConfigError, match=complaint):
            PodShape.of(Config(template=template))

    def test_a_list_is_not_a_template(self, tmp_path: Path) -> None:
        (tmp_path / "pod.yaml").write_text("- spec: {}\n")
        with pytest.raises(ConfigError, match=r"pod\.yaml is not an object with metadata and spec"):
            read_template(str(tmp_path / "pod.yaml"))
