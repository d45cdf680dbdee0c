"""Agents and masters of a warm pool, whose masters do not trust each other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from fiber._transport import credentials_file
from fiber._transport.authentication import Identity
from fiber._transport.credentials import Credentials, WarmCredentials
from fiber.errors import AuthenticationError
from fiber_api import identity, names, signatures
from unit.link_site import Notes, Site
from warm_key import WarmKey

SAID = b"what the handshake covers"
POOL_KEY = "ab" * 32


@pytest.fixture
def key() -> WarmKey:
    return WarmKey(POOL_KEY)


def dial(site: Site, address: str, credentials: Credentials) -> Notes:
    identity = Identity.of_this_process(credentials.name, credentials.uid)
    return site.dialer(address, credentials=credentials, identity=identity)[1]


def test_the_init_container_makes_a_key_that_the_pool_signs(tmp_path: Path, key: WarmKey) -> None:
    (tmp_path / names.KEY_POOL).write_text(POOL_KEY)
    environment = {
        names.ENV_KEY: str(tmp_path),
        names.ENV_NAME: "warm-1",
        names.ENV_UID: "77",
        names.ENV_EPOCH: "3",
        names.ENV_POOL_UID: "pool",
        names.ENV_CREDENTIALS: str(tmp_path / "agent.json"),
    }
    assert credentials_file.write(environment) == 0
    made = Credentials.from_file(tmp_path / "agent.json")
    assert (made.name, made.uid, made.epoch, made.master) == ("warm-1", "77", 3, "")
    assert key.unsigned().believes("warm-1", "77", SAID, made.prove(SAID))


@pytest.mark.parametrize(
    ("name", "uid", "said"),
    [("warm-2", "77", SAID), ("warm-1", "78", SAID), ("warm-1", "77", b"something else")],
)
def test_a_proof_is_good_for_one_agent_and_one_handshake(
    key: WarmKey, name: str, uid: str, said: bytes
) -> None:
    proof = key.agent("warm-1", "77").prove(SAID)
    assert not key.unsigned().believes(name, uid, said, proof)


def test_what_a_master_knows_makes_no_agent(key: WarmKey) -> None:
    """A master knows the public key of the pool, its own signature, and the proofs of agents."""
    agent = key.agent("warm-1", "77")
    own = identity.new_key()
    signature = agent.prove(SAID)[signatures.PUBLIC_KEY_SIZE :][: signatures.SIGNATURE_SIZE]
    for forged in (
        replace(agent, key=own),
        replace(agent, key=own, signature=bytes(signatures.SIGNATURE_SIZE).hex()),
        replace(WarmKey(own).agent("warm-1", "77"), signature=signature.hex()),
    ):
        assert not key.unsigned().believes("warm-1", "77", SAID, forged.prove(SAID))


def test_a_signature_serves_one_epoch_and_one_certificate(key: WarmKey) -> None:
    agent, master = key.agent("warm-1", "77"), key.master(3)
    shown, proof = master.certificate.hash, master.prove("warm-1", "77", SAID)
    assert agent.check_master(SAID, shown, proof) == (3, shown.hex())
    assert agent.check_master(SAID, key.master(3).certificate.hash, proof) is None
    later = (4).to_bytes(8, "big") + proof[8:]
    for forged in (later, b"", proof[:8], proof[:-1]):
        assert agent.check_master(SAID, shown, forged) is None


def test_the_next_pool_with_the_same_secret_has_another_key_pair() -> None:
    first, second = WarmKey(POOL_KEY, "uid-1"), WarmKey(POOL_KEY, "uid-2")
    master = first.master(50)
    proof = master.prove("warm-1", "77", SAID)
    assert second.agent("warm-1", "77").check_master(SAID, master.certificate.hash, proof) is None


@pytest.mark.parametrize("signature", [b"", bytes(64)])
def test_a_signature_that_is_not_the_operators_is_not_taken(key: WarmKey, signature: bytes) -> None:
    credentials = key.unsigned()
    assert not credentials.take_signature(1, signature)
    assert not WarmKey().sign(credentials, 1)
    assert not credentials.complete


def test_agents_wait_until_the_operator_has_signed(site: Site, key: WarmKey) -> None:
    credentials: WarmCredentials = key.unsigned()
    listener, master = site.listener(credentials=credentials)
    agent = dial(site, listener.address, key.agent("warm-1", "77"))
    master.wait(lambda: master.proofs)
    site.on_loop(listener.look_again)
    assert (agent.links, agent.errors) == ([], [])
    assert key.sign(credentials, 1)
    site.on_loop(listener.look_again)
    assert agent.link is not master.link


def test_a_master_that_ends_unsigned_lets_its_agents_dial_on(site: Site, key: WarmKey) -> None:
    """Give no answer, since the agent would not believe it."""
    acceptor, certificate = site.acceptor(), site.credentials.certificate
    listener, _ = site.listener(acceptor, credentials=key.unsigned(certificate))
    site.close(listener, linger=0.1)
    agent = dial(site, acceptor.address, key.agent("warm-1", "77"))
    _, master = site.listener(acceptor, credentials=key.master(1, certificate))
    assert agent.link is not master.link


def test_a_master_of_an_earlier_epoch_is_refused(site: Site, key: WarmKey) -> None:
    listener, _ = site.listener(credentials=key.master(3))
    agent = dial(site, listener.address, key.agent("warm-1", "77", epoch=4))
    agent.wait(lambda: agent.errors)
    assert "has epoch 3, and this agent belongs to one of epoch 4" in str(agent.errors[0])


def test_another_master_of_the_same_epoch_is_refused(site: Site, key: WarmKey) -> None:
    """Two programs may get one epoch if the operator signs for the first one late."""
    listener, _ = site.listener(credentials=key.master(3))
    met = replace(key.agent("warm-1", "77", epoch=3), met=key.master(3).certificate.hash.hex())
    agent = dial(site, listener.address, met)
    agent.wait(lambda: agent.errors)
    assert "this agent belongs to another one of that epoch" in str(agent.errors[0])


def test_a_later_master_that_refuses_an_agent_counts(site: Site, key: WarmKey) -> None:
    listener, _ = site.listener(credentials=key.master(7))
    listener._knows = lambda identity: "it is no pod"
    identity = Identity.of_this_process("warm-1", "77")
    agent = key.agent("warm-1", "77", epoch=3)
    dialling, notes = site.dialer(listener.address, credentials=agent, identity=identity)
    notes.wait(lambda: notes.errors)
    assert dialling.credentials.epoch == 7


def test_an_agent_of_another_pool_is_a_stranger(site: Site, key: WarmKey) -> None:
    listener, master = site.listener(credentials=key.master(1))
    agent = dial(site, listener.address, WarmKey().agent("warm-1", "77"))
    agent.wait(lambda: agent.errors)
    assert isinstance(agent.errors[0], AuthenticationError)
    assert master.links == master.proofs == []


def test_a_master_without_the_operators_signature_gets_no_agent(site: Site, key: WarmKey) -> None:
    forged = key.unsigned()
    forged._proof = (1).to_bytes(8, "big") + bytes(signatures.SIGNATURE_SIZE)
    listener, master = site.listener(credentials=forged)
    agent = dial(site, listener.address, key.agent("warm-1", "77"))
    agent.wait(lambda: agent.errors)
    assert "it cannot prove that it is this pool's master" in str(agent.errors[0])
    assert master.links == []
