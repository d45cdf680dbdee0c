"""Liveness: silence is judged by received datagrams, and no judgement loses a frame."""

from __future__ import annotations

import random
from collections.abc import Callable

import pytest

from fiber._transport.link import Keepalive, Link
from fiber._transport.link_protocol import Frame
from memory_link import Cable, SimulatedLoop

KEEPALIVE = Keepalive()
SEEDS = 200
PARTS = 4
INSTANT = 1e-6
TICK = KEEPALIVE.heartbeat / 3 + 0.05
"""Seconds after which silence that is too long has been noticed."""


class Judge:
    """Observer of one end of a link, which knows when that end received a datagram."""

    def __init__(self, loop: SimulatedLoop, link: Link) -> None:
        self.frames: list[bytes] = []
        self.suspect = False
        self.lost: str | None = None
        self.longest = 0.0
        """Seconds of silence, at most."""
        self._loop = loop
        self._heard_at = loop.now()
        setattr(link, "datagram", self._noting(link.datagram))  # noqa: B010  # in place of a method
        link.attach(self)

    def _noting(self, happens: Callable[..., None]) -> Callable[..., None]:
        def noted(*args: object) -> None:
            self.longest = max(self.longest, self.silence)
            self._heard_at = self._loop.now()
            happens(*args)

        return noted

    @property
    def silence(self) -> float:
        """Seconds since this end received a datagram."""
        return self._loop.now() - self._heard_at

    def on_frame(self, frame: Frame) -> None:
        assert self.lost is None
        self.frames.append(bytes(frame))

    def on_suspect(self) -> None:
        assert self.lost is None
        assert not self.suspect
        assert 0 <= self.silence - KEEPALIVE.suspect_after + INSTANT <= TICK
        self.suspect = True

    def on_trusted(self) -> None:
        assert self.lost is None
        assert self.suspect
        assert self.silence == 0
        self.suspect = False

    def on_lost(self, reason: str) -> None:
        assert self.lost is None
        self.lost = reason
        self.longest = max(self.longest, self.silence)
        if "the other side was silent" in reason:
            assert self.suspect
            assert 0 <= self.silence - KEEPALIVE.lost_after + INSTANT <= TICK


def run(seed: int) -> tuple[list[Judge], list[list[bytes]]]:
    """Traffic both ways over a connection that is cut, breaks off and drops; then a good one."""
    loop, rng = SimulatedLoop(), random.Random(seed)
    delay = rng.choice((1e-4, 1e-2, 0.3))
    cable = Cable(loop, seed=seed, delay=(0, delay), drop=rng.choice((0, 0, 0.2)))
    links = cable.agent, cable.master
    judges = [Judge(loop, link) for link in links]
    sent: list[list[bytes]] = [[], []]
    for number in range(40):
        side = rng.randrange(2)
        sent[1 - side].append(b"%d" % number)
        links[side].send(b"%d" % number)
        loop.run_for(rng.choice((0.0, 0.01, 1.0, 5.0)))
        fault = rng.random()
        if fault < 0.1:
            cable.cut()
            loop.run_for(rng.choice((0.5, 5.0, 10.0, 14.0, 17.0)))
            cable.mend()
        elif fault < 0.2:
            cable.break_off()
    cable.drop = 0
    loop.run_for(120)
    return judges, sent


def test_repeated_connections_without_data_are_lost() -> None:
    loop = SimulatedLoop()
    cable = Cable(loop, drop=1.0)
    judges = [Judge(loop, link) for link in (cable.agent, cable.master)]
    while loop.now() < KEEPALIVE.lost_after + TICK:
        loop.run_for(0.4)
        cable.break_off()
    for judge in judges:
        assert judge.lost is not None
        assert "the other side was silent" in judge.lost


@pytest.mark.parametrize("part", range(PARTS))
def test_silence_is_judged_right(part: int) -> None:
    for seed in range(part, SEEDS, PARTS):
        check(seed)


def check(seed: int) -> None:
    judges, sent = run(seed)
    for judge, frames in zip(judges, sent, strict=True):
        assert judge.frames == frames[: len(judge.frames)]
    lost = [judge.lost is not None for judge in judges]
    if any(lost):
        assert all(lost), "one end waits for an other that has given up"
        assert max(judge.longest for judge in judges) + TICK >= KEEPALIVE.lost_after
    else:
        assert [judge.frames for judge in judges] == sent
        assert not any(judge.suspect for judge in judges)


def test_some_simulated_links_are_lost_and_some_survive() -> None:
    ends = [judges[0].lost is not None for judges, _ in map(run, range(SEEDS // 4))]
    assert 5 < sum(ends) < len(ends) - 5
