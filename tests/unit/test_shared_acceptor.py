"""Several pools of one program, whose agents dial the same port."""

from __future__ import annotations

import pytest

from fiber._transport.acceptor import Acceptor
from fiber._transport.authentication import Identity
from fiber._transport.credentials import OwnCredentials, make_credentials
from fiber.errors import AuthenticationError, LinkError
from unit.link_site import Notes, Site


@pytest.fixture
def acceptor(site: Site) -> Acceptor:
    return site.acceptor()


@pytest.fixture
def pools(site: Site) -> list[OwnCredentials]:
    """Two pools of one program: their keys differ, and the certificate is the same."""
    other = make_credentials(certificate=site.credentials.certificate)
    return [site.credentials, other]


def test_each_agent_comes_to_the_pool_whose_key_it_has(
    site: Site, acceptor: Acceptor, pools: list[OwnCredentials]
) -> None:
    masters = [site.listener(acceptor, credentials=pool)[1] for pool in pools]
    for number, (pool, master) in enumerate(zip(pools, masters, strict=True)):
        identity = Identity.of_this_process("the same name", f"uid-{number}")
        credentials = pool.agent(identity.name, identity.uid)
        _, agent = site.dialer(acceptor.address, credentials=credentials, identity=identity)
        agent.link.send(b"%d" % number)
        master.wait_for_frames(1)
    assert [master.frames for master in masters] == [[b"0"], [b"1"]]
    assert [len(master.links) for master in masters] == [1, 1]


def test_an_unknown_key_is_refused_and_reported_to_one_pool(
    site: Site, acceptor: Acceptor, pools: list[OwnCredentials]
) -> None:
    masters = [site.listener(acceptor, credentials=pool)[1] for pool in pools]
    stranger = make_credentials(certificate=site.credentials.certificate)
    _, agent = site.dialer(acceptor.address, credentials=stranger.agent("agent-1", "uid"))
    agent.wait(lambda: agent.errors)
    assert isinstance(agent.errors[0], AuthenticationError)
    masters[0].wait(lambda: masters[0].refusals)
    assert "it cannot prove that it is 'agent-1'" in masters[0].refusals[0]
    assert masters[1].refusals == []
    assert all(master.links == master.proofs == [] for master in masters)


def test_the_end_of_one_pool_leaves_the_others_and_tells_its_late_agents(
    site: Site, acceptor: Acceptor, pools: list[OwnCredentials]
) -> None:
    (first, first_master), (_, second_master) = (
        site.listener(acceptor, credentials=pool) for pool in pools
    )
    _, before = site.dialer(acceptor.address, credentials=pools[1].agent("agent-1", "uid"))
    assert before.link is not second_master.link
    site.close(first, linger=0.1)
    late = _dial(site, acceptor, pools[0], "late")
    late.wait(lambda: late.errors)
    assert isinstance(late.errors[0], LinkError)
    assert "this master no longer uses the pool of this agent" in str(late.errors[0])
    assert (first_master.links, first_master.refusals) == ([], [])
    before.link.send(b"still here")
    second_master.wait(lambda: second_master.frames == [b"still here"])
    after = _dial(site, acceptor, pools[1], "after")
    after.link.send(b"new")
    second_master.wait(lambda: second_master.frames == [b"still here", b"new"])


def test_a_pool_comes_after_the_last_one_has_ended(
    site: Site, acceptor: Acceptor, pools: list[OwnCredentials]
) -> None:
    first, _ = site.listener(acceptor, credentials=pools[0])
    site.close(first, linger=0.1)
    _, master = site.listener(acceptor, credentials=pools[1])
    agent = _dial(site, acceptor, pools[1], "agent-1")
    agent.link.send(b"here")
    master.wait(lambda: master.frames == [b"here"])


def _dial(site: Site, acceptor: Acceptor, pool: OwnCredentials, name: str) -> Notes:
    identity = Identity.of_this_process(name, "uid")
    _, notes = site.dialer(acceptor.address, credentials=pool.agent(name, "uid"), identity=identity)
    return notes
