"""Links, on a simulated clock and over a connection as bad as it gets."""

from __future__ import annotations

import random

import pytest

import fiber._transport.link
import memory_link
from fiber._transport.link import Keepalive, Link
from fiber._transport.link_protocol import Frame
from memory_link import Cable, SimulatedLoop
from unit.interrupting import is_interrupted


class Notes:
    """An observer that writes down what it hears."""

    def __init__(self, link: Link) -> None:
        self.frames: list[bytes] = []
        self.events: list[str] = []
        link.attach(self)

    def on_frame(self, frame: Frame) -> None:
        self.frames.append(bytes(frame))

    def on_suspect(self) -> None:
        self.events.append("suspect")

    def on_trusted(self) -> None:
        self.events.append("trusted")

    def on_lost(self, reason: str) -> None:
        self.events.append(f"lost: {reason}")


@pytest.fixture
def loop() -> SimulatedLoop:
    return SimulatedLoop()


@pytest.mark.parametrize("block", range(4))
def test_every_frame_arrives_once_and_in_order_over_a_bad_connection(block: int) -> None:
    for seed in range(10 * block, 10 * (block + 1)):
        try:
            run_schedule(seed)
        except BaseException as error:
            error.add_note(f"with seed {seed}")
            raise


def run_schedule(seed: int) -> None:
    loop, rng = SimulatedLoop(), random.Random(seed)
    cable = Cable(loop, seed=seed, drop=rng.choice((0, 0.2)), delay=(0, rng.choice((0.001, 0.3))))
    notes = {link: Notes(link) for link in (cable.agent, cable.master)}
    sent: dict[Link, list[bytes]] = {cable.agent: [], cable.master: []}
    faults = [cable.break_off, cable.cut, cable.mend]
    for number in range(60):
        link = rng.choice((cable.agent, cable.master))
        frame = b"%d " % number * rng.choice((1, 10, 100, 100_000))
        sent[link].append(frame)
        link.send(frame)
        loop.run_for(rng.choice((0.0, 0.001, 0.5)))
        if rng.random() < 0.1:
            rng.choice(faults)()
    cable.mend()
    cable.drop = 0
    loop.run_until(
        lambda: (
            len(notes[cable.agent].frames) == len(sent[cable.master])
            and len(notes[cable.master].frames) == len(sent[cable.agent])
        ),
        within=120,
    )
    assert notes[cable.agent].frames == sent[cable.master]
    assert notes[cable.master].frames == sent[cable.agent]


def test_the_same_seed_gives_the_same_run() -> None:
    def run(seed: int) -> tuple[object, ...]:
        loop = SimulatedLoop()
        cable = Cable(loop, seed=seed, drop=0.3)
        Notes(cable.master)
        for number in range(100):
            cable.agent.send(b"%d" % number)
            loop.run_for(0.01)
        loop.run_for(10)
        return cable.agent.statistics()

    assert run(1) == run(1)
    assert run(1) != run(2)


def test_an_idle_link_lives(loop: SimulatedLoop) -> None:
    cable = Cable(loop)
    notes = Notes(cable.master)
    loop.run_for(1000)
    assert notes.events == []
    assert cable.agent.statistics().datagrams_sent < 340, "a heartbeat each three seconds"


def test_a_silent_peer_is_first_suspect_and_then_lost(loop: SimulatedLoop) -> None:
    cable = Cable(loop)
    notes = Notes(cable.master)
    loop.run_for(10)
    cable.cut()
    loop.run_until(lambda: bool(notes.events), within=8.1)
    assert notes.events == ["suspect"]
    loop.run_until(lambda: len(notes.events) == 2, within=8)
    assert notes.events[1].startswith("lost: ")
    assert "the other side was silent for 1" in notes.events[1]


def test_messages_after_the_loss_are_dropped(loop: SimulatedLoop) -> None:
    cable = Cable(loop)
    notes, of_agent = Notes(cable.master), Notes(cable.agent)
    cable.cut()
    cable.agent.send(b"late")
    loop.run_for(14)
    cable.agent.send(b"later")
    loop.run_until(lambda: notes.events[-1].startswith("lost"), within=3)
    cable.mend()
    loop.run_for(60)
    assert notes.frames == []
    assert [event[:4] for event in notes.events] == ["susp", "lost"]
    assert [event[:4] for event in of_agent.events] == ["susp", "lost"]


def test_a_cut_that_ends_in_time_loses_no_frame(loop: SimulatedLoop) -> None:
    cable = Cable(loop)
    notes = Notes(cable.master)
    cable.agent.send(b"before")
    loop.run_for(1)
    cable.cut()
    cable.agent.send(b"meanwhile")
    loop.run_for(10)
    assert notes.events == ["suspect"]
    cable.mend()
    loop.run_for(5)
    assert notes.events == ["suspect", "trusted"]
    assert notes.frames == [b"before", b"meanwhile"]


def test_a_process_that_did_not_run_does_not_count_silence(loop: SimulatedLoop) -> None:
    cable = Cable(loop)
    notes = Notes(cable.master)
    loop.run_for(1)
    loop._now += 1000  # stopped, as by SIGSTOP: no timer ran, no packet was read
    loop.run_for(60)
    assert notes.events == []


def test_close_delivers_earlier_messages_and_gives_the_reason(loop: SimulatedLoop) -> None:
    cable = Cable(loop, delay=(0.01, 0.02))
    notes, own = Notes(cable.agent), Notes(cable.master)
    closed: list[float] = []
    for number in range(5):
        cable.master.send(bytes(300_000 + number))
    cable.master.close("work is done", then=lambda: closed.append(loop.now()))
    loop.run_for(5)
    assert [len(frame) for frame in notes.frames] == [300_000 + number for number in range(5)]
    assert notes.events == ["lost: work is done"]
    assert own.events == []
    assert len(closed) == 1
    assert closed[0] < 1


def test_close_waits_no_longer_than_its_linger(loop: SimulatedLoop) -> None:
    cable = Cable(loop)
    closed: list[float] = []
    cable.cut()
    cable.master.send(b"never arrives")
    cable.master.close(linger=2, then=lambda: closed.append(loop.now()))
    loop.run_until(lambda: bool(closed), within=2.5)
    assert closed[0] >= 2


def test_both_sides_of_a_link_may_close_at_once(loop: SimulatedLoop) -> None:
    cable = Cable(loop)
    closed: list[str] = []
    cable.master.close(then=lambda: closed.append("master"))
    cable.agent.close(then=lambda: closed.append("agent"))
    loop.run_until(lambda: len(closed) == 2, within=1)
    cable.master.close(then=lambda: closed.append("again"))
    loop.run_until(lambda: closed[-1] == "again", within=0)


def test_an_observer_that_closes_gets_no_more_calls(loop: SimulatedLoop) -> None:
    cable = Cable(loop)

    class Quitter(Notes):
        def on_frame(self, frame: Frame) -> None:
            super().on_frame(frame)
            cable.master.close()

    quitter = Quitter(cable.master)
    cable.agent.send(b"one")
    cable.agent.send(b"two")
    loop.run_for(30)
    assert quitter.frames == [b"one"]
    assert quitter.events == []


def test_frames_wait_for_an_observer(loop: SimulatedLoop) -> None:
    cable = Cable(loop)
    cable.agent.send(b"early")
    cable.agent.close("bye")
    loop.run_for(1)
    notes = Notes(cable.master)
    loop.run_for(1)
    assert (notes.frames, notes.events) == ([b"early"], ["lost: bye"])


def test_an_observer_that_fails_on_a_frame_loses_the_peer(loop: SimulatedLoop) -> None:
    """The peer counts on each frame: going on as if it had been handled would leave it waiting."""
    cable = Cable(loop)

    class Picky(Notes):
        def on_frame(self, frame: Frame) -> None:
            if frame == b"bad":
                raise ValueError("bad")
            super().on_frame(frame)

    picky = Picky(cable.master)
    for frame in (b"good", b"bad", b"fine"):
        cable.agent.send(frame)
    with pytest.raises(ValueError, match="bad"):
        loop.run_for(1)
    loop.run_for(1)
    assert picky.frames == [b"good"]
    assert picky.events == ["lost: ValueError while its message was handled: bad"]


def test_a_peer_that_talks_nonsense_is_lost(loop: SimulatedLoop) -> None:
    cable = Cable(loop)
    notes = Notes(cable.master)
    wire = cable.agent._connection
    assert wire is not None
    wire.put(b"nonsense that is long enough to have a header")
    loop.run_for(1)
    assert notes.events == ["lost: it broke the protocol: a datagram is of unknown kind 110"]


def test_messages_after_the_end_are_not_kept(loop: SimulatedLoop) -> None:
    cable = Cable(loop)
    cable.master.close()
    loop.run_for(1)
    cable.master.send(b"to nobody")
    loop.run_for(1)
    assert cable.master.statistics().queued_frames == 0


def test_a_send_that_a_signal_interrupts_does_not_keep_later_ones_back(loop: SimulatedLoop) -> None:
    cable = Cable(loop)
    notes = Notes(cable.agent)
    files = {fiber._transport.link.__file__, memory_link.__file__}
    step = 0
    while is_interrupted(lambda: cable.master.send(b"lost or sent"), step, files):
        step += 1
        cable.master.send(b"%d" % step)
        loop.run_for(1)
        assert notes.frames[-1] == b"%d" % step
    assert step > 2


def test_keepalive_is_configurable(loop: SimulatedLoop) -> None:
    cable = Cable(loop, keepalive=Keepalive(0.5, 2, 4))
    notes = Notes(cable.master)
    loop.run_for(20)
    assert notes.events == []
    cable.cut()
    loop.run_for(6)
    assert [event[:4] for event in notes.events] == ["susp", "lost"]


@pytest.mark.parametrize("breaks", [False, True])
def test_small_frames_pass_a_large_one_also_over_connections_that_break(
    loop: SimulatedLoop, breaks: bool
) -> None:
    cable = Cable(loop, delay=(0.01, 0.01))
    notes = Notes(cable.master)
    large = random.Random(1).randbytes(20_000_000)
    cable.agent.send(large, lane="one")
    for number in range(1, 10):
        loop.run_for(0.005)
        cable.agent.send(b"%d" % number, lane=number)
        if breaks and number % 3 == 0:
            cable.break_off()
    loop.run_until(lambda: len(notes.frames) == 10, within=60)
    assert notes.frames == [*(b"%d" % number for number in range(1, 10)), large]
    assert not notes.events


def test_a_lost_peer_leaves_no_part_of_a_large_frame(loop: SimulatedLoop) -> None:
    cable = Cable(loop, delay=(0.01, 0.01))
    notes = Notes(cable.master)
    cable.agent.send(bytes(20_000_000), lane="one")
    loop.run_until(lambda: cable.master.statistics().partial_bytes > 10_000_000, within=60)
    cable.cut()
    loop.run_for(30)
    assert notes.frames == []
    assert [event.partition(":")[0] for event in notes.events] == ["suspect", "lost"]
    assert cable.master.statistics().partial_bytes == 0
    assert cable.agent.statistics().queued_bytes == 0
