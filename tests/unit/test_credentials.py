"""Credentials: what each side gets, where it is kept, and who can read it."""

from __future__ import annotations

import json
import os
import stat
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from fiber._transport import credentials_file
from fiber._transport.credentials import Credentials, OwnCredentials, make_credentials
from fiber.errors import ConfigError
from fiber_api import identity, names


@pytest.fixture(scope="module")
def credentials() -> OwnCredentials:
    return make_credentials()


def test_each_agent_has_a_separate_key(credentials: OwnCredentials) -> None:
    pods = [("a", "1"), ("a", "2"), ("b", "1"), ("a1", ""), ("a 1", "2"), ("a", "1 2")]
    keys = {credentials.agent(*pod).key for pod in pods}
    assert len(keys) == len(pods)
    assert credentials.pool_key not in keys
    assert credentials.agent("a", "1") == credentials.agent("a", "1")


def test_each_run_has_its_own_key_and_certificate(credentials: OwnCredentials) -> None:
    other = make_credentials()
    assert other.pool_key != credentials.pool_key
    assert other.certificate != credentials.certificate


def mounted(folder: Path, credentials: OwnCredentials) -> dict[str, str]:
    """The environment of an init container that mounts the Secret of a program's own pool."""
    (folder / names.KEY_POOL).write_text(credentials.pool_key + "\n")
    (folder / names.KEY_MASTER).write_text(credentials.fingerprint)
    return {
        names.ENV_KEY: str(folder),
        names.ENV_NAME: "es-1",
        names.ENV_UID: "77",
        names.ENV_EPOCH: "3",
        names.ENV_CREDENTIALS: str(folder / "agent.json"),
    }


def test_the_agent_reads_the_init_containers_output_once(
    credentials: OwnCredentials, tmp_path: Path
) -> None:
    environment = mounted(tmp_path, credentials)
    before = os.umask(0)
    try:
        assert credentials_file.write(environment) == 0
        assert credentials_file.write(environment) == 0, "a node may fail between the two"
    finally:
        os.umask(before)
    probe = tmp_path / names.PROBE_PROGRAM
    assert os.readlink(probe) == os.path.realpath(sys.executable)
    file = tmp_path / "agent.json"
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert credentials.pool_key not in file.read_text()
    assert Credentials.from_file(file) == replace(credentials.agent("es-1", "77"), epoch=3)
    assert not file.exists()


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        (lambda told, _: told.pop(names.ENV_UID), "'FIBER_AGENT_UID' is not set"),
        (lambda _, folder: (folder / names.KEY_POOL).unlink(), "No such file"),
        (lambda _, folder: (folder / names.KEY_POOL).write_text("secret"), "64 hexadecimal digits"),
    ],
)
def test_an_init_container_that_cannot_write_says_why(
    credentials: OwnCredentials, tmp_path: Path, fault: object, said: str
) -> None:
    environment = mounted(tmp_path, credentials)
    assert callable(fault)
    fault(environment, tmp_path)
    command = [sys.executable, "-m", "fiber.agent"]
    done = subprocess.run(
        command, env={**os.environ, **environment}, capture_output=True, text=True
    )
    assert done.returncode == 1
    assert said in done.stderr
    assert "secret" not in done.stderr.replace("Secret", "")
    assert not (tmp_path / "agent.json").exists()


def test_the_init_container_of_an_own_pool_imports_the_standard_library_alone(
    credentials: OwnCredentials, tmp_path: Path
) -> None:
    statement = (
        "import sys, runpy; sys.argv = ['agent']\n"
        "try: runpy.run_module('fiber.agent', run_name='__main__')\n"
        "except SystemExit as end: assert end.code == 0\n"
        "print(sorted(m for m in sys.modules if m.partition('.')[0] in "
        "('cryptography', 'pynng', 'cloudpickle', 'ssl', 'socket')))"
    )
    environment = {**os.environ, **mounted(tmp_path, credentials)}
    command = [sys.executable, "-c", statement]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.stdout == "[]\n", done.stderr


@pytest.mark.parametrize(
    ("content", "why"),
    [(None, "no such file or directory"), ("{}", "its content is incomplete or not Fiber's")],
)
def test_a_file_that_cannot_be_read_is_named_with_the_reason(
    tmp_path: Path, content: str | None, why: str
) -> None:
    if content is not None:
        (tmp_path / "agent.json").write_text(content)
    said = rf"no credentials can be read from .*agent\.json and removed: {why}\."
    with pytest.raises(ConfigError, match=said):
        Credentials.from_file(tmp_path / "agent.json")


def test_a_descriptor_brings_them_once(credentials: OwnCredentials) -> None:
    agent = credentials.agent("a", "1")
    descriptor = agent.to_descriptor()
    assert not os.get_inheritable(descriptor)
    again = os.dup(descriptor)
    assert Credentials.from_descriptor(descriptor) == agent
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(descriptor)
    with pytest.raises(ConfigError, match="its content is incomplete"):
        Credentials.from_descriptor(again)


def test_credentials_that_do_not_fit_into_a_pipe_are_refused_without_a_leak() -> None:
    before = os.listdir("/proc/self/fd")
    with pytest.raises(ConfigError, match="too long for a pipe"):
        Credentials("a" * (1 << 20), "1", "ab" * 32, "cd" * 32).to_descriptor()
    assert os.listdir("/proc/self/fd") == before


def not_credentials() -> list[bytes]:
    whole = {"name": "a", "uid": "1", "key": "ab" * 32}
    documents = (
        {"key": "secret"},
        whole,
        {**whole, "pool": "secret", "signature": "ab" * 64},
        {**whole, "pool": "ab" * 32, "signature": "ab"},
        {**whole, "pool": "ab" * 32, "signature": "ab" * 64, "master": "cd" * 32},
    )
    return [b"", b"secret", b"s\xff", b"[]", b"1", *(json.dumps(d).encode() for d in documents)]


@pytest.mark.parametrize("value", not_credentials())
def test_other_content_of_a_descriptor_is_refused_and_not_repeated(value: bytes) -> None:
    reader, writer = os.pipe()
    os.write(writer, value)
    os.close(writer)
    with pytest.raises(ConfigError, match=rf"on descriptor {reader} cannot be read") as caught:
        Credentials.from_descriptor(reader)
    assert "secret" not in str(caught.value)


@pytest.mark.parametrize("descriptor", [-1, 10**6, 10**12])
def test_an_invalid_descriptor_is_named(descriptor: int) -> None:
    with pytest.raises(ConfigError, match=f"descriptor {descriptor} cannot be read"):
        Credentials.from_descriptor(descriptor)


def test_no_secret_in_a_repr(credentials: OwnCredentials) -> None:
    assert repr(credentials) == "OwnCredentials()"
    assert credentials.agent("a", "1").key not in repr(credentials.agent("a", "1"))


@pytest.mark.parametrize("data", [{}, {"key": ""}, {"key": "%"}, {"key": "bm9uZQ=="}, {"key": 7}])
def test_a_secret_that_cannot_serve_is_named(data: dict[str, object]) -> None:
    with pytest.raises(identity.InvalidKey, match=r"^key "):
        identity.key_in(data)


def test_importing_the_module_does_not_import_cryptography() -> None:
    statement = (
        "import sys, fiber._transport.credentials; "
        "sys.exit(any(name.startswith('cryptography') for name in sys.modules))"
    )
    path = os.pathsep.join(entry for entry in sys.path if entry)
    environment = {**os.environ, "PYTHONPATH": path}
    assert subprocess.run([sys.executable, "-c", statement], env=environment).returncode == 0
