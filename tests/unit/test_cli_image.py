"""The command ``fiber image build``: with builders that only note what they are asked."""

from __future__ import annotations

import subprocess
import tomllib
from pathlib import Path

import pytest

from fiber._cli import image, image_builders, image_pip
from fiber._cli.failures import FAILED, USAGE
from fiber._cli.image_context import BASE, PYTHON
from unit.image_site import Builders, Environment, environment, project
from unit.pool_command_rig import Outcome, examples_of, run

TAG = "registry.example/worker:1"
EXAMPLES = list(examples_of(image.command))


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Environment:
    """An environment, and the working directory ``here`` without a pyproject.toml."""
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    monkeypatch.delenv("FIBER_IMAGE", raising=False)
    return environment(tmp_path, monkeypatch)


@pytest.fixture
def builders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Builders:
    return Builders(tmp_path, monkeypatch)


def refused(outcome: Outcome) -> list[str]:
    """Return what happened, why, and what to do."""
    assert outcome.status == FAILED, outcome
    lines = outcome.err.splitlines()[-3:]
    assert [line[:6] for line in lines] == ["fiber:", "  why:", "  do: "], outcome.err
    return [lines[0][7:], *(line[8:] for line in lines[1:])]


@pytest.mark.parametrize("words", [words for _, words in EXAMPLES], ids=" ".join)
def test_an_example_of_a_help_succeeds(
    site: Environment, builders: Builders, words: list[str]
) -> None:
    builders.add("docker")
    Path("requirements.txt").write_text("numpy==2.1\n")
    outcome = run(*words)
    assert outcome.status == 0, outcome


def test_each_help_has_two_examples() -> None:
    assert [name for name, _ in EXAMPLES] == ["image", "image", "build", "build"]


# ---- the context


def test_the_context_has_the_exact_versions_and_wheels_of_local_packages(
    site: Environment, tmp_path: Path
) -> None:
    site.install("numpy", "2.1")
    site.install("pip", "23")
    folder = project(tmp_path / "mine")
    site.install("mine", origin={"url": folder.as_uri(), "dir_info": {"editable": True}})
    assert run("image", "build", "--file-only").status == 0
    context = Path("fiber-image")
    assert (context / "requirements.txt").read_text() == "fiberpool==0.1\nnumpy==2.1\n"
    assert [each.name for each in (context / "wheels").iterdir()] == ["mine-1.0-py3-none-any.whl"]
    text = (context / "Dockerfile").read_text()
    assert f"ARG BASE_IMAGE={BASE}" in text
    assert "pip install --quiet --no-deps -r /src/requirements.txt" in text
    assert "pip install --quiet --no-deps /src/wheels/*.whl" in text
    assert "\nUSER 65532:65532\n" in text


def test_a_context_is_written_again_and_other_files_are_kept(site: Environment) -> None:
    assert run("image", "build", "--file-only", "out").status == 0
    assert run("image", "build", "--file-only", "out").status == 0
    Path("other").mkdir()
    Path("other", "file").write_text("mine")
    assert "other files" in refused(run("image", "build", "--file-only", "other"))[1]
    assert Path("other", "file").read_text() == "mine"


def test_the_image_without_wheels_or_constraints_has_no_steps_for_them(site: Environment) -> None:
    run("image", "build", "--file-only", "--base", "localhost/mine:2")
    text = Path("fiber-image", "Dockerfile").read_text()
    assert "ARG BASE_IMAGE=localhost/mine:2\n" in text
    assert "wheels" not in text
    assert "constraints" not in text


# ---- builders


@pytest.mark.parametrize(
    ("present", "begins"),
    [
        ({"docker": "exit 0", "podman": "exit 0"}, f"docker build --tag {TAG} "),
        ({"docker": '[ "$1" != info ]', "podman": "exit 0"}, f"podman build --layers --tag {TAG} "),
        ({"buildah": "exit 0"}, f"buildah bud --layers --tag {TAG} "),
    ],
    ids=["docker", "podman", "buildah"],
)
def test_the_builder_that_is_there_builds_and_pushes(
    site: Environment, builders: Builders, present: dict[str, str], begins: str
) -> None:
    for name, script in present.items():
        builders.add(name, script)
    outcome = run("image", "build", "--tag", TAG, "--push", "--platform", "linux/arm64")
    assert outcome.status == 0, outcome
    built, pushed = [call for call in builders.calls() if " info" not in call]
    assert built.startswith(f"{begins}--platform linux/arm64 --secret id=pip,src=")
    assert pushed == f"{begins.split(maxsplit=1)[0]} push {TAG}"
    assert (builders.seen / "requirements.txt").read_text() == "fiberpool==0.1\n"
    assert f"FIBER_IMAGE={TAG}" in outcome.out


@pytest.mark.parametrize(
    ("docker", "why"), [(None, "docker, podman and buildah are"), ("exit 1", "does not answer")]
)
def test_without_a_builder_the_error_says_what_to_install(
    site: Environment, builders: Builders, docker: str | None, why: str
) -> None:
    if docker:
        builders.add("docker", docker)
    _, reason, remedy = refused(run("image", "build", "--tag", TAG))
    assert why in reason
    assert "apt install podman" in remedy
    assert "--file-only" in remedy


@pytest.mark.parametrize(
    ("said", "what", "remedy"),
    [
        ("ERROR: No matching distribution found for gone==1", "no index has gone==1", "--without"),
        ("ERROR: Failed building wheel for slow-c", "slow-c cannot be compiled", "--base python"),
        ("fiber-image: the base image has Python 3.9", "wrong Python", f"with Python {PYTHON}"),
        ("Error: pull access denied for x", "the base image", "--base IMAGE"),
        ("Retrying: Connection refused", "no package index answers", "pip config list"),
        ("something else", "cannot build", "output above"),
    ],
)
def test_a_build_that_fails_says_why(
    site: Environment, builders: Builders, said: str, what: str, remedy: str
) -> None:
    builders.add("buildah", f"echo '{said}'; exit 1")
    found = refused(run("image", "build", "--tag", TAG))
    assert what in found[0]
    assert remedy in found[2]
    assert not Path("pyproject.toml").exists()


@pytest.mark.parametrize(
    ("said", "remedy"),
    [("denied: no login", "buildah login registry.example"), ("no such host", "buildah push")],
)
def test_a_push_that_fails_says_what_to_do(
    site: Environment, builders: Builders, said: str, remedy: str
) -> None:
    builders.add("buildah", f"[ $1 != push ] || {{ echo '{said}'; exit 1; }}")
    what, why, do = refused(run("image", "build", "--tag", TAG, "--push"))
    assert (what, why) == (f"cannot push {TAG}", said)
    assert remedy in do


def test_the_registry_of_a_name() -> None:
    names = {"a/b": "docker.io", "a.example/b": "a.example", "localhost/b": "localhost", "b": None}
    for name, registry in names.items():
        assert image_builders.registry_of(name) == (registry or "docker.io")


@pytest.mark.parametrize(
    "words",
    [
        ["--tag", TAG, "--without", "FiberPool"],
        ["--tag", "Bad Name"],
        ["--tag", "user:secret@registry/name"],
        ["--push"],
        ["--tag", "-x"],
    ],
    ids=" ".join,
)
def test_a_mistake_of_the_command_line(site: Environment, words: list[str]) -> None:
    assert run("image", "build", *words).status == USAGE


# ---- secrets


def test_an_index_with_a_password_is_a_secret_of_the_build(
    site: Environment, builders: Builders, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    certificates = tmp_path / "ca.crt"
    certificates.write_text("trusted")
    listed = [
        "global.index-url='https://me:hidden@one.example/simple'",
        r"global.extra-index-url='\nhttps://two.example\nhttps://three.example'",
        f"global.cert='{certificates}'",
        "global.disable-pip-version-check='1'",
    ]
    monkeypatch.setattr(image_pip, "_listed", lambda: listed)
    builders.add("docker")
    assert run("image", "build", "--tag", TAG).status == 0
    (built,) = [call for call in builders.calls() if " build " in call]
    assert f"--secret id=certificates,src={certificates}" in built
    assert "hidden" not in built
    kept = {file.name: file.read_text() for file in builders.seen.iterdir()}
    secret = kept.pop("pip.conf")
    assert "hidden" not in "".join(kept.values())
    assert "index-url = https://me:hidden@one.example/simple\n" in secret
    assert "cert = /run/secrets/certificates\n" in secret
    assert "disable" not in secret


def test_the_environment_wins_over_the_files_of_pip() -> None:
    listed = [":env:.index-url='https://a'", "global.index-url='https://b'"]
    environ = {"UV_INDEX_URL": "https://c", "UV_EXTRA_INDEX_URL": "https://d"}
    settings, certificates = image_pip.settings_of(listed, environ)
    assert settings == {"index-url": "https://a", "extra-index-url": "https://d"}
    assert certificates is None


def test_the_list_of_settings_comes_from_pip() -> None:
    assert isinstance(image_pip._listed(), list)


# ---- what cannot be in the image


def test_all_packages_that_cannot_be_had_are_in_one_error(
    site: Environment, tmp_path: Path
) -> None:
    gone = tmp_path / "gone"
    site.install("lost", origin={"url": gone.as_uri(), "dir_info": {}})
    bad = project(tmp_path / "bad")
    (bad / "backend.py").write_text("raise RuntimeError('no compiler here')")
    site.install("broken", origin={"url": bad.as_uri(), "dir_info": {"editable": True}})
    what, why, remedy = refused(run("image", "build", "--file-only"))
    assert what == "cannot put broken, lost into the image"
    assert f"lost: it was installed from {gone}, which is gone" in why
    assert "broken: " in why
    assert "--without broken --without lost" in remedy
    outcome = run("image", "build", "--file-only", "--without", "Broken", "--without", "lost")
    assert outcome.status == 0


def test_a_wheel_for_another_system_is_refused(site: Environment, tmp_path: Path) -> None:
    wheel = tmp_path / "apple-1.0-cp311-cp311-macosx_14_0_arm64.whl"
    wheel.write_bytes(b"")
    site.install("apple", origin={"url": wheel.as_uri(), "archive_info": {}})
    assert "macosx_14_0_arm64" in refused(run("image", "build", "--file-only"))[1]


def test_a_package_of_another_index_gets_a_hint(site: Environment) -> None:
    site.install("torch", "2.5+cu124")
    outcome = run("image", "build", "--file-only")
    assert "torch==2.5+cu124: the part after +" in outcome.err


def test_an_environment_without_pip_makes_wheels_by_uv(
    site: Environment, builders: Builders, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = project(tmp_path / "mine")
    site.install("mine", origin={"url": folder.as_uri(), "dir_info": {}})
    monkeypatch.setattr("fiber._cli.image_wheels.importlib.util.find_spec", lambda name: None)
    assert "ensurepip" in refused(run("image", "build", "--file-only"))[2]
    builders.add("uv", 'echo x > "$5/mine-1.0-py3-none-any.whl"')
    Path("fiber-image").rename("first")
    outcome = run("image", "build", "--file-only")
    assert outcome.status == 0, outcome
    assert builders.calls()[-1].endswith(f"mine {folder}".removeprefix("mine "))


# ---- the image is remembered


def test_the_nearest_pyproject_remembers_the_image(
    site: Environment, builders: Builders, monkeypatch: pytest.MonkeyPatch
) -> None:
    builders.add("podman")
    file = Path.cwd().parent / "pyproject.toml"
    file.write_text("[tool.fiber]\nretries = 1\n")
    monkeypatch.setenv("FIBER_IMAGE", "other")
    outcome = run("image", "build", "--tag", TAG)
    assert tomllib.loads(file.read_text())["tool"]["fiber"] == {"retries": 1, "image": TAG}
    assert "FIBER_IMAGE=other is stronger" in outcome.err


def test_a_file_that_cannot_be_edited_stays(site: Environment, builders: Builders) -> None:
    builders.add("podman")
    file = Path("pyproject.toml")
    file.write_text("tool = 1\n")
    outcome = run("image", "build", "--tag", TAG)
    assert outcome.status == 0
    assert "cannot set the image" in outcome.err
    assert file.read_text() == "tool = 1\n"


def test_pip_is_asked_by_a_file_and_not_by_arguments(
    site: Environment, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A URL in arguments would show its password to all accounts of this machine."""
    url = "https://me:hidden@example/mine.git"
    origin = {"url": url, "vcs_info": {"vcs": "git", "commit_id": "abc"}}
    site.install("mine", origin=origin)
    asked = []

    def ask(command: list[str], **options: object) -> subprocess.CompletedProcess[str]:
        asked.append((" ".join(command), Path(command[-1]).read_text()))
        return subprocess.CompletedProcess(command, 1, "", f"ERROR: no {url}")

    monkeypatch.setattr("fiber._cli.image_wheels.subprocess.run", ask)
    assert refused(run("image", "build", "--file-only"))[1] == "mine: no https://example/mine.git"
    ((words, text),) = asked
    assert "hidden" not in words
    assert text == f"mine @ git+{url}@abc\n"
