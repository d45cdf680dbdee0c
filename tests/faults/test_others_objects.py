"""A process uses and passes on the objects that it was handed, and no others of the same hub."""

from __future__ import annotations

import os
import queue
from collections.abc import Iterator
from typing import Any

import pytest

import fiber
from faults.runtime import running
from fiber._hub.client import HubStream, ObjectUnreachable
from fiber._hub.protocol import GRANTING, NO_SECRET, SECRETS, Op
from patience import PATIENCE


@pytest.fixture(autouse=True, scope="module")
def agents() -> Iterator[None]:
    with running(backend="loopback", agents=2):
        yield


def read(secret: Any, seen: Any) -> None:
    for _ in range(2):
        seen.put(secret.get())


def break_in(mine: Any) -> tuple[int, list[bytes]]:
    """Try to use objects that this process was not given; return the refusals and the finds."""
    home, token = mine._inbox.home, mine._inbox.token
    mine._inbox.confirm()
    numbers = [number.to_bytes(16, order) for number in range(64) for order in ("little", "big")]
    refused = 0
    found: list[bytes] = []
    for guess in [NO_SECRET, *numbers]:
        for say, form in (
            ((Op.ATTACH, 1, guess, NO_SECRET), SECRETS),
            ((Op.ATTACH, 1, token, guess if any(guess) else numbers[-1]), SECRETS),
            ((Op.ATTACH, 1, os.urandom(16), guess), SECRETS),
            ((Op.GRANT, 1, 0, guess), GRANTING),
        ):
            stream = HubStream(home)
            try:
                stream._send(form.pack(*say))
                found += map(bytes, stream.ask(Op.RECV, timeout=0).parts)
            except ObjectUnreachable:
                refused += 1
            finally:
                stream.close()
    return refused, found


def test_the_address_of_a_hub_gives_no_access_to_others_objects() -> None:
    secret: Any = fiber.Queue()
    seen: Any = fiber.Queue()
    mine: Any = fiber.Queue()
    reader = fiber.Process(target=read, args=(secret, seen))
    reader.start()
    secret.put("top secret")
    assert seen.get(timeout=PATIENCE) == "top secret"
    with fiber.Pool(1) as pool:
        refused, found = pool.apply_async(break_in, (mine,)).get(PATIENCE)
    assert (refused, found) == (129 * 4, [])
    secret.put("the end")
    assert seen.get(timeout=PATIENCE) == "the end"
    reader.join(PATIENCE)


def hand_on(depth: int, by: Any, of: Any) -> Any:
    """Put ``of`` through another process, and so on; it comes back as a result, too."""
    if depth:
        pool = fiber.Pool(1)
        answer = pool.apply_async(hand_on, (depth - 1, by, of)).get(PATIENCE)
        pool.close()
        pool.join()  # The worker ends after it has sent its items.
        return answer
    by.put(of)
    return of


@pytest.mark.parametrize("depth", [0, 1, 2])
def test_a_received_object_may_be_passed_on(depth: int) -> None:
    inner: Any = fiber.Queue()
    outer: Any = fiber.Queue()
    with fiber.Manager() as manager, fiber.Pool(1) as pool:
        result = pool.apply_async(hand_on, (depth, outer, inner)).get(PATIENCE)
        kept = manager.dict()
        kept["queue"] = pool.apply_async(hand_on, (0, outer, result)).get(PATIENCE)
        for number, copy in enumerate((result, outer.get(), outer.get(), kept["queue"])):
            copy.put(number)
            assert inner.get(timeout=PATIENCE) == number
    with pytest.raises(queue.Empty):
        inner.get_nowait()
