"""Rights of a process to a hub's objects: it can use those that it was handed, while it has them.

Host ``a`` has the objects; this process, with the key of that hub, is on host ``b``.
"""

from __future__ import annotations

import os
import pickle
from collections.abc import Iterator

import pytest

import fiber
from census import wait_until
from fiber._hub import protocol
from fiber._hub.client import HubStream, ObjectUnreachable
from fiber._hub.handles import HubHandle, handle_for
from fiber._hub.protocol import (
    GRANTING,
    NO_SECRET,
    ONE,
    SECRET,
    SECRETS,
    HubAddress,
    Op,
)
from fiber._hub.remote import RemoteChannel
from hosts import Far, Hosts
from patience import PATIENCE


@pytest.fixture
def home(hosts: Hosts, far: Far) -> HubAddress:
    return hosts["a"].address


@pytest.fixture
def stream(home: HubAddress) -> Iterator[HubStream]:
    stream = HubStream(home)
    yield stream
    stream.close()


@pytest.fixture
def others(home: HubAddress, far: Far) -> Iterator[RemoteChannel]:
    """The end of a pipe that somebody else on this host was handed."""
    here, there = fiber.Pipe()
    remote = far(there)
    there.close()
    remote._channel.confirm()
    yield remote._channel
    remote.close()
    here.close()


def refused(stream: HubStream) -> None:
    with pytest.raises(ObjectUnreachable, match="is gone"):
        stream.ask(Op.SYNC, 0, form=ONE)


NUMBERS = [NO_SECRET, *(number.to_bytes(16, "little") for number in range(1, 6))]


@pytest.mark.parametrize("guess", [*NUMBERS, "the identity"])
@pytest.mark.parametrize("as_grant", [False, True])
def test_objects_of_others_cannot_be_used_by_guessing(
    others: RemoteChannel, stream: HubStream, guess: bytes | str, as_grant: bool
) -> None:
    tried = others.identity if isinstance(guess, str) else guess
    stream._send(
        SECRETS.pack(Op.ATTACH, 1, *((os.urandom(16), tried) if as_grant else (tried, NO_SECRET)))
    )
    refused(stream)


@pytest.mark.parametrize("guess", [*NUMBERS, "the identity"])
def test_objects_of_others_cannot_be_passed_on(
    others: RemoteChannel, stream: HubStream, guess: bytes | str
) -> None:
    tried = others.identity if isinstance(guess, str) else guess
    with pytest.raises(ObjectUnreachable, match="is gone"):
        stream.ask(Op.GRANT, 0, tried, form=GRANTING)


def test_a_descriptor_takes_a_grant(hosts: Hosts, others: RemoteChannel, home: HubAddress) -> None:
    for tried in (NO_SECRET, others.identity, others.token):
        with hosts.child_at("a"):
            stream = HubStream(home)
            with pytest.raises(ObjectUnreachable, match="is gone"):
                stream.ask(Op.FETCH, tried, form=SECRET)
            stream.close()


def test_a_token_ends_with_its_user(hosts: Hosts, far: Far, home: HubAddress) -> None:
    _, there = fiber.Pipe()
    first, other = far(there), far(there)
    for end in (first, other):
        end._channel.confirm()
    token = first._channel.token
    assert knows(home, token)
    first.close()
    assert wait_until(lambda: not knows(home, token), PATIENCE)
    other.send("still used")


def knows(home: HubAddress, token: bytes) -> bool:
    """Return whether a hub lets a user with this token attach."""
    stream = HubStream(home)
    try:
        stream._send(SECRETS.pack(Op.ATTACH, 1, token, NO_SECRET))
        stream.ask(Op.SYNC, 0, form=ONE)
    except ObjectUnreachable:
        return False
    finally:
        stream.close()
    return True


def test_a_token_stands_for_one_object(far: Far, home: HubAddress, hosts: Hosts) -> None:
    _, one = fiber.Pipe()
    _, two = fiber.Pipe()
    used = far(one)
    used._channel.confirm()
    with hosts.at("a"):
        handle = handle_for(two._channel)
    assert isinstance(handle, HubHandle)
    stream = HubStream(home)
    stream._send(SECRETS.pack(Op.ATTACH, 1, used._channel.token, handle.grant))
    with pytest.raises(ObjectUnreachable, match="already in use"):
        stream.ask(Op.SYNC, 0, form=ONE)
    stream.close()


def test_a_received_object_is_used_by_all_and_passed_on_again(far: Far, hosts: Hosts) -> None:
    here, there = fiber.Pipe()
    ends = [far(there)]
    for _ in range(3):
        ends.append(pickle.loads(pickle.dumps(ends[-1])))
    ends[0].close()
    for number, end in enumerate(ends[1:]):
        end.send(number)
        assert here.poll(PATIENCE)
        assert here.recv() == number


def test_secrets_are_not_shown(hosts: Hosts) -> None:
    with hosts.at("a"):
        _, there = fiber.Pipe()
        handle = handle_for(there._channel)
        array = fiber.RawArray("i", 3)
        block = pickle.dumps(array)
    assert isinstance(handle, HubHandle)
    assert block
    origin = protocol.Origin("a", handle.identity, 3, handle.grant, handle.grant)
    for hidden in (handle.grant, handle.identity, handle.home.key):
        assert repr(hidden) not in repr(handle) + repr(origin)
