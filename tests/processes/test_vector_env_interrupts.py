"""Ctrl-C at each line of a vector environment's calls: nothing hangs, and it goes on as ever."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import fiber.vector
from faults.program import alive
from fiber.vector import VectorEnv
from unit.interrupting import is_interrupted
from vector_envs import Faulty

FILES = {str(path) for path in Path(fiber.vector.__file__).parent.glob("*.py")}
GOOD = Faulty.GOOD


def send_and_recv(env: VectorEnv) -> None:
    env.send([GOOD] * 4)
    env.recv(2)
    env.recv(2)


CALLS: dict[str, Callable[[VectorEnv], object]] = {
    "reset": lambda env: env.reset(seed=1),
    "step": lambda env: env.step([GOOD] * 4),
    "call": lambda env: env.call("pid"),
    "set": lambda env: env.set_attr("name", [1, 2, 3, 4]),
    "send and recv": send_and_recv,
}

pytestmark = [
    # Python itself drops an interrupt that strikes while a generator is being closed.
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


@pytest.fixture(scope="module")
def env() -> Iterator[VectorEnv]:
    env = VectorEnv([Faulty] * 4, num_workers=2)
    yield env
    env.close(terminate=True)


@pytest.mark.slow
@pytest.mark.parametrize("call", CALLS)
def test_a_call_that_is_interrupted_anywhere(call: str, env: VectorEnv) -> None:
    stop = 0
    env.reset()
    while is_interrupted(lambda: CALLS[call](env), stop, FILES):
        stop += 1
        if env._dispatcher.under_way():
            env.recv()  # the interrupt came before or after all that it could lose
        assert env.reset()[0].tolist() == [[0]] * 4
        assert env.step([GOOD] * 4)[0].tolist() == [[1]] * 4
    assert stop > 20


@pytest.mark.slow
def test_an_end_that_is_interrupted_anywhere() -> None:
    stop, interrupted = 0, True
    while interrupted:
        env = VectorEnv([Faulty], num_workers=1)
        pids = env.call("pid")
        interrupted = is_interrupted(env.close, stop, FILES)
        env.close()
        assert not any(alive(pid) for pid in pids)
        stop += 7
    assert stop > 20
