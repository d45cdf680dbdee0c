"""Settings from the environment, and log lines."""

from __future__ import annotations

import io
import json
import logging
from collections.abc import Iterator
from pathlib import Path

import pytest

from fiber_operator import logs
from fiber_operator.settings import OperatorSettings, SettingsError

NOWHERE = Path("/nowhere/namespace")


def read(**environment: str) -> OperatorSettings:
    return OperatorSettings.from_environment(
        {f"FIBER_OPERATOR_{name}": value for name, value in environment.items()}, NOWHERE
    )


def test_no_setting_is_required() -> None:
    settings = read()
    assert settings.namespaces == ()
    assert (settings.host, settings.port) == ("", 8080)
    assert settings.identity != read().identity


def test_everything_can_be_set() -> None:
    settings = read(
        NAMESPACES="one, two,one,",
        NAMESPACE="fiber-system",
        IDENTITY="pod-1",
        LEASE="my-lease",
        LEASE_SECONDS="30",
        LISTEN="[::1]:9000",
        RESYNC_SECONDS="120",
        CONCURRENCY="4",
        CONNECTIONS="16",
        CPU_REQUEST="0.1",
        MEMORY_REQUEST="",
        LOG_LEVEL="debug",
        LOG_FORMAT="TEXT",
    )
    assert settings == OperatorSettings(
        namespaces=("one", "two"),
        namespace="fiber-system",
        identity="pod-1",
        lease="my-lease",
        lease_seconds=30,
        host="::1",
        port=9000,
        resync_seconds=120,
        concurrency=4,
        connections=16,
        cpu_request="0.1",
        memory_request="",
        log_level="DEBUG",
        log_format="text",
    )


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("NAMESPACES", "Not_A_Name"),
        ("NAMESPACE", ""),
        ("IDENTITY", ""),
        ("LEASE_SECONDS", "1"),
        ("LEASE_SECONDS", "a while"),
        ("LISTEN", "8080"),
        ("LISTEN", ":99999"),
        ("RESYNC_SECONDS", "0"),
        ("CONCURRENCY", "-1"),
        ("CONNECTIONS", "٣٢"),
        ("CPU_REQUEST", "much"),
        ("MEMORY_REQUEST", "64MiB"),
        ("LOG_LEVEL", "LOUD"),
        ("LOG_FORMAT", "xml"),
    ],
)
def test_an_invalid_setting_is_named(name: str, value: str) -> None:
    with pytest.raises(SettingsError, match=f"FIBER_OPERATOR_{name}="):
        read(**{name: value})


def test_all_invalid_settings_are_reported_at_once() -> None:
    with pytest.raises(SettingsError) as caught:
        read(LOG_LEVEL="LOUD", NAMESPACE="-", NAMESPCES="one")
    message = str(caught.value)
    assert "LOG_LEVEL" in message
    assert "NAMESPACE=" in message
    assert (
        "FIBER_OPERATOR_NAMESPCES is not a setting. The settings are FIBER_OPERATOR_CONCURRENCY"
        in message
    )


@pytest.mark.parametrize(
    "name",
    [
        "SERVICE_HOST",
        "SERVICE_PORT",
        "SERVICE_PORT_METRICS",
        "PORT",
        "PORT_8080_TCP",
        "PORT_8080_TCP_ADDR",
        "METRICS_SERVICE_HOST",
        "METRICS_SERVICE_PORT_HTTP",
        "METRICS_PORT",
        "METRICS_PORT_8080_TCP_PROTO",
    ],
)
def test_variables_of_a_service_called_fiber_operator_are_ignored(name: str) -> None:
    """A Service called fiber-operator gives every container beside it such variables."""
    read(**{name: "tcp://10.96.0.7:8080"})


def test_the_pods_own_namespace_is_where_the_lease_is(tmp_path: Path) -> None:
    file = tmp_path / "namespace"
    file.write_text("fiber-system\n")
    assert OperatorSettings.from_environment({}, file).namespace == "fiber-system"
    given = {"FIBER_OPERATOR_NAMESPACE": "other"}
    assert OperatorSettings.from_environment(given, file).namespace == "other"


# -- Log lines


@pytest.fixture
def lines() -> Iterator[io.StringIO]:
    root = logging.getLogger()
    before = root.handlers[:], root.level
    yield io.StringIO()
    root.handlers[:] = before[0]
    root.setLevel(before[1])


def test_a_line_is_one_json_object(lines: io.StringIO) -> None:
    logs.set_up("INFO", "json", lines)
    extra = logs.about("team", "es", uid="123", reason="Because", node=None, pods=3)
    logging.getLogger("a.b").warning("two\nlines: %s", "ü", extra=extra)
    (line,) = lines.getvalue().splitlines()
    found = json.loads(line)
    assert found.pop("time").endswith("Z")
    assert found == {
        "level": "warning",
        "logger": "a.b",
        "message": "two\nlines: ü",
        "namespace": "team",
        "pool": "es",
        "uid": "123",
        "reason": "Because",
        "pods": 3,
    }


def test_an_exception_is_in_its_line(lines: io.StringIO) -> None:
    logs.set_up("INFO", "json", lines)
    try:
        raise ValueError("no such thing")
    except ValueError:
        logging.getLogger("a").exception("it failed")
    (line,) = lines.getvalue().splitlines()
    assert "ValueError: no such thing" in json.loads(line)["exception"]


def test_kopfs_own_lines_say_which_object_they_are_about(lines: io.StringIO) -> None:
    logs.set_up("INFO", "json", lines)
    reference = {"kind": "Pod", "name": "p", "namespace": "team", "uid": "1", "apiVersion": "v1"}
    logging.getLogger("a").warning("hm", extra={"k8s_ref": reference})
    found = json.loads(lines.getvalue())
    assert (found["kind"], found["name"], found["namespace"]) == ("Pod", "p", "team")


def test_kopf_does_not_log_every_event(lines: io.StringIO) -> None:
    logs.set_up("INFO", "json", lines)
    logging.getLogger("kopf.objects").info("Handler succeeded.")
    assert lines.getvalue() == ""


def test_text_is_for_people(lines: io.StringIO) -> None:
    logs.set_up("DEBUG", "text", lines)
    logging.getLogger("a").info("created %d", 3, extra=logs.about("team", "es"))
    assert lines.getvalue().endswith("INFO    created 3  [namespace=team pool=es]\n")
    logging.getLogger("a").info("nothing more")
    assert lines.getvalue().endswith("INFO    nothing more\n")
