"""Rings: who is whom, what goes round, who hears of a loss."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

import pytest

import fiber
from fiber import connection
from fiber.errors import MemberLost
from patience import PATIENCE


def ranks(rank: int, size: int) -> tuple[int, int, int, int]:
    member = fiber.ring.current()
    return rank, size, member.rank, member.size


def go_round(rank: int, size: int) -> list[int]:
    """Every rank, as they come by."""
    member, seen = fiber.ring.current(), [rank]
    for _ in range(size - 1):
        seen.append(member.exchange(seen[-1]))
    return seen


def exchange_much(rank: int, size: int) -> int:
    received = fiber.ring.current().exchange(bytes([rank]) * (1 << 20))
    return int(received[-1])


def pass_on(rank: int, size: int) -> int:
    member = fiber.ring.current()
    if rank == 0:
        member.send(1)
        return int(member.recv())
    member.send(member.recv() + 1)
    return 0


@pytest.mark.slow
@pytest.mark.parametrize("size", [1, 2, 3, 4])
def test_members_know_their_rank_and_their_neighbours(size: int) -> None:
    assert fiber.Ring(size, ranks).run() == [(rank, size, rank, size) for rank in range(size)]
    around = fiber.Ring(size, go_round).run()
    assert around == [[(rank - n) % size for n in range(size)] for rank in range(size)]
    assert fiber.Ring(size, pass_on).run() == [size, *[0] * (size - 1)]


@pytest.mark.parametrize("size", [1, 2, 3])
def test_all_can_send_much_at_the_same_time(size: int) -> None:
    assert fiber.Ring(size, exchange_much).run() == [(rank - 1) % size for rank in range(size)]


def test_a_ring_runs_again_and_takes_lambdas() -> None:
    ring = fiber.Ring(2, lambda rank, size: 10 * rank + size)
    assert [ring.run(), ring.run()] == [[2, 12], [2, 12]]


def keep(member: fiber.ring.Member, key: str, value: str) -> None:
    assert fiber.ring.current() is member
    os.environ[key] = f"{value}-{member.rank}"


def test_the_initializer_comes_first() -> None:
    ring = fiber.Ring(2, lambda rank, size: os.environ["KEPT"], keep, ("KEPT", "here"))
    assert ring.run() == ["here-0", "here-1"]


# Losses


def lose_one(how: str, folder: Path, rank: int, size: int) -> None:
    """Rank 1 is lost; the others write down what they hear."""
    member = fiber.ring.current()
    if rank == 1:
        if how == "raise":
            raise ValueError("no such device")
        if how == "exit":
            os._exit(3)
        os.kill(os.getpid(), signal.SIGKILL)
    try:
        while True:
            member.exchange(rank)
    except MemberLost as error:
        (folder / str(rank)).write_text(f"{error.rank} {error.how}")


class Losing:
    def __init__(self, how: str, folder: Path) -> None:
        self.how, self.folder = how, folder

    def __call__(self, rank: int, size: int) -> None:
        lose_one(self.how, self.folder, rank, size)

    def heard(self) -> dict[int, str]:
        return {int(path.name): path.read_text() for path in self.folder.iterdir()}


def test_all_members_learn_of_a_killed_member(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "_NEWS", PATIENCE)
    losing = Losing("kill", tmp_path)
    with pytest.raises(MemberLost, match=r"member 1 of the ring is lost: .*SIGKILL") as caught:
        fiber.Ring(4, losing).run()
    assert caught.value.rank == 1
    heard = losing.heard()
    assert set(heard) == {0, 2, 3}
    assert set(heard.values()) == {f"1 {caught.value.how}"}


def test_an_exit_is_a_loss(tmp_path: Path) -> None:
    losing = Losing("exit", tmp_path)
    with pytest.raises(MemberLost, match=r"exit(ed)? .*3"):
        fiber.Ring(3, losing).run()
    assert set(losing.heard()) == {0, 2}


def test_an_exception_of_a_member_is_raised(tmp_path: Path) -> None:
    losing = Losing("raise", tmp_path)
    with pytest.raises(ValueError, match="no such device") as caught:
        fiber.Ring(3, losing).run()
    assert "in lose_one" in str(caught.value.__cause__)
    assert caught.value.__notes__ == ["raised by member 1 of the ring"]
    assert set(losing.heard().values()) == {"1 it raised ValueError: no such device"}


def keep_folder(member: fiber.ring.Member, folder: str) -> None:
    os.environ["HEARD"] = folder


def work_on(rank: int, size: int) -> dict[int, str]:
    """Looks for losses while it computes."""
    member = fiber.ring.current()
    if rank == 2:
        raise ValueError
    deadline = time.monotonic() + PATIENCE
    while not member.lost and time.monotonic() < deadline:
        time.sleep(0.001)
    Path(os.environ["HEARD"], str(rank)).write_text(str(member.lost))
    return member.lost


def test_losses_can_be_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ring = fiber.Ring(
        3, work_on, lambda _, folder: os.environ.update(HEARD=folder), [str(tmp_path)]
    )
    with pytest.raises(ValueError):
        ring.run()
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {
        "0": "{2: 'it raised ValueError: '}",
        "1": "{2: 'it raised ValueError: '}",
    }


def wait_for_who_has_returned(rank: int, size: int) -> str:
    if rank == 0:
        return "early"
    try:
        fiber.ring.current().recv()
    except MemberLost as error:
        return error.how
    return "nothing"


def test_a_returned_member_sends_no_message() -> None:
    assert fiber.Ring(2, wait_for_who_has_returned).run() == ["early", "it has returned"]


def test_a_result_that_does_not_pickle() -> None:
    with pytest.raises(fiber.UnpicklableError):
        fiber.Ring(2, lambda rank, size: (n for n in range(3))).run()


class Unreadable:
    """Can be pickled, and not unpickled."""

    def __reduce__(self) -> Any:
        return int, ("no number",)


def return_unreadable(rank: int, size: int) -> Any:
    if rank == 1:
        return Unreadable()
    try:
        fiber.ring.current().recv()
    except MemberLost:
        return "heard"


def test_a_result_that_cannot_be_unpickled() -> None:
    with pytest.raises(ValueError, match="no number") as caught:
        fiber.Ring(2, return_unreadable).run()
    assert caught.value.__notes__ == ["the result of member 1 of the ring cannot be unpickled here"]


def raise_a_lock(rank: int, size: int) -> None:
    raise ValueError("no device", threading.Lock())


def test_an_exception_that_does_not_pickle() -> None:
    with pytest.raises(ValueError, match=r"no device.*lock object"):
        fiber.Ring(1, raise_a_lock).run()


def test_an_interrupt_ends_all(tmp_path: Path) -> None:
    def interrupt(rank: int, size: int) -> None:
        if rank == 0:
            os.kill(parent, signal.SIGINT)
        time.sleep(4 * PATIENCE)

    parent = os.getpid()
    with pytest.raises(KeyboardInterrupt):
        fiber.Ring(2, interrupt).run()
    assert not fiber.active_children()


def test_an_interrupt_just_after_the_start_of_a_member_ends_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    start = fiber.Process.start

    def interrupted(process: fiber.Process) -> None:
        start(process)
        raise KeyboardInterrupt

    monkeypatch.setattr(fiber.Process, "start", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fiber.Ring(2, lambda rank, size: time.sleep(4 * PATIENCE)).run()
    assert not fiber.active_children()


# Refusals


@pytest.mark.parametrize(
    ("arguments", "error", "says"),
    [
        ((0, ranks), ValueError, "processes must be greater than 0, not 0"),
        ((None, ranks), TypeError, "processes must be a whole number, not None"),
        ((1.5, ranks), TypeError, "processes must be a whole number"),
        ((2, "ranks"), TypeError, "func must be a callable, not 'ranks'"),
        ((2, ranks, 3), TypeError, "initializer must be a callable"),
    ],
)
def test_bad_arguments(arguments: Any, error: type[Exception], says: str) -> None:
    with pytest.raises(error, match=says):
        fiber.Ring(*arguments)


def test_arguments_that_do_not_pickle_start_no_member() -> None:
    with pytest.raises(fiber.UnpicklableError):
        fiber.Ring(2, ranks, keep, [(n for n in range(3))]).run()
    assert not fiber.active_children()


def test_no_member_outside_of_a_ring() -> None:
    with pytest.raises(RuntimeError, match="no member of a ring"):
        fiber.ring.current()
