"""The meaning of each response of the API server, for both clients."""

from __future__ import annotations

import copy
import json
from typing import Any

import pytest

from fiber_api import rest
from fiber_api.rest import LEASES, NODES, PODS, POOLS, ApiError, document_of, event_of


def answer(status: int, *, proxy: bool = False, **more: Any) -> ApiError:
    """Return the error of a response from the API server, or of a proxy before it."""
    body = {"kind": "Status", "message": "words", "reason": "Because", **more}
    data = b"<html>words" if proxy else json.dumps(body).encode()
    with pytest.raises(ApiError) as caught:
        document_of(status, {}, data, "create pods in here")
    return caught.value


@pytest.mark.parametrize(
    ("status", "of_api_server", "of_proxy"),
    [
        (302, rest.ServerUnreachable, rest.ServerUnreachable),
        (400, rest.Invalid, rest.ServerUnreachable),
        (401, rest.Unauthorized, rest.Unauthorized),
        (403, rest.Forbidden, rest.ServerUnreachable),
        (404, rest.NotFound, rest.NotServed),
        (405, rest.Invalid, rest.ServerUnreachable),
        (408, rest.ServerUnreachable, rest.ServerUnreachable),
        (409, rest.Conflict, rest.ServerUnreachable),
        (410, rest.Expired, rest.Expired),
        (422, rest.Invalid, rest.ServerUnreachable),
        (429, rest.TooManyRequests, rest.TooManyRequests),
        (500, rest.ServerError, rest.ServerError),
        (503, rest.ServerError, rest.ServerError),
    ],
)
def test_each_status_is_one_error(
    status: int, of_api_server: type[ApiError], of_proxy: type[ApiError]
) -> None:
    error = answer(status)
    assert type(error) is of_api_server
    assert str(error) == "create pods in here: words"
    assert (error.call, error.message) == ("create pods", "words")
    assert (error.status, error.reason) == (status, "Because")
    error = answer(status, proxy=True)
    assert type(error) is of_proxy
    assert (error.message, error.status, error.reason) == ("<html>words", status, "")


@pytest.mark.parametrize("status", [429, 503])
@pytest.mark.parametrize(
    ("header", "seconds"),
    [("7", 7.0), (None, 0.0), ("1000000000", 30.0), ("0", 0.0), ("soon", 0.0), ("-1", 0.0)],
)
def test_a_server_may_say_when_to_come_back(
    status: int, header: str | None, seconds: float
) -> None:
    headers = {} if header is None else {"Retry-After": header}
    with pytest.raises(rest.Transient) as caught:
        document_of(status, headers, b"")
    assert caught.value.retry_after == seconds


def test_a_watch_may_say_when_to_come_back() -> None:
    error = answer(503, details={"retryAfterSeconds": 7})
    assert isinstance(error, rest.ServerError)
    assert error.retry_after == 7
    assert answer(503, details="soon").retry_after == 0  # type: ignore[attr-defined]


@pytest.mark.parametrize("data", [b"", b"<html>", b"[]", b"null", b"3", b'{"kind":', b"\xed\xa0"])
def test_nonsense_is_no_answer_and_is_not_shown(data: bytes) -> None:
    with pytest.raises(rest.ServerUnreachable) as caught:
        document_of(200, {}, data, "get secrets")
    assert str(caught.value) == f"get secrets: the answer is no JSON object ({len(data)} bytes)"


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "HTTP status 502"),
        (b"bad gateway", "bad gateway"),
        (b"{}", "{}"),
        (b"x" * 999, "x" * 200),
    ],
)
def test_an_error_without_a_message_says_what_is_known(data: bytes, words: str) -> None:
    with pytest.raises(rest.ServerError) as caught:
        document_of(502, {}, data)
    assert str(caught.value) == words
    assert caught.value.call == ""


def test_a_long_message_is_cut() -> None:
    assert len(answer(422, message="x" * 5000).message) == 2000


def test_an_event_has_a_type_and_an_object() -> None:
    pod = {"metadata": {"name": "a"}}
    assert event_of(json.dumps({"type": "ADDED", "object": pod}).encode()) == ("ADDED", pod)


@pytest.mark.parametrize(
    ("event", "kind"),
    [
        ("", rest.ServerUnreachable),
        ("{nonsense", rest.ServerUnreachable),
        ("[]", rest.ServerUnreachable),
        ('{"type": "ADDED"}', rest.ServerUnreachable),
        ('{"type": 1, "object": {}}', rest.ServerUnreachable),
        ('{"type": "ERROR", "object": {}}', rest.ServerError),
        ('{"type": "ERROR", "object": {"code": "x"}}', rest.ServerError),
        ('{"type": "ERROR", "object": {"code": 410}}', rest.Expired),
        ('{"type": "ERROR", "object": {"kind": "Status", "code": 403}}', rest.Forbidden),
    ],
)
def test_an_event_may_be_an_error(event: str, kind: type[ApiError]) -> None:
    with pytest.raises(ApiError) as caught:
        event_of(event.encode(), "watch pods")
    assert type(caught.value) is kind
    assert caught.value.call == "watch pods"


def test_a_copy_of_an_error_is_equal() -> None:
    for error in (answer(403), answer(429, details={"retryAfterSeconds": 2})):
        again = copy.copy(error)
        assert (type(again), str(again), vars(again)) == (type(error), str(error), vars(error))
        assert again.__traceback__ is None


def test_paths_are_the_apis() -> None:
    assert PODS.path("lab", "a") == "/api/v1/namespaces/lab/pods/a"
    assert PODS.path("lab", "a", "status") == "/api/v1/namespaces/lab/pods/a/status"
    assert NODES.path() == "/api/v1/nodes"
    assert POOLS.path("lab") == "/apis/fiber.dev/v1alpha1/namespaces/lab/fiberpools"
    assert LEASES.path("l", "n") == "/apis/coordination.k8s.io/v1/namespaces/l/leases/n"
