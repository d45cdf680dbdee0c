"""Raise exceptions of users in each way, on each backend: they arrive unchanged."""

from __future__ import annotations

from collections.abc import Callable
from multiprocessing.pool import MaybeEncodingError  # type: ignore[attr-defined]
from typing import Any

import joblib
import pytest

import fiber
import fiber.joblib
from faults.program import Program, wait_for
from faults.raising import (
    Diverged,
    DivergingEnv,
    ModelManager,
    diverge,
    diverge_as_member,
    raise_unreadable,
    raise_with,
)
from fiber.vector import VectorEnv
from patience import PATIENCE

STEP = 7


def heard(raised: Callable[[], object]) -> BaseException:
    with pytest.raises(Diverged) as caught:
        raised()
    return caught.value


def of_a_pool(call: Callable[[Any], object]) -> BaseException:
    with fiber.Pool(1) as pool:
        return heard(lambda: call(pool))


def of_a_callback() -> BaseException:
    told: list[BaseException] = []
    with fiber.Pool(1) as pool:
        result = pool.map_async(diverge, [STEP], error_callback=told.append)
        heard(lambda: result.get(PATIENCE))
        wait_for(lambda: bool(told))
    return told[0]


def of_an_executor() -> BaseException:
    with fiber.Executor(1) as executor:
        return heard(executor.submit(diverge, STEP).result)


def of_joblib() -> BaseException:
    with fiber.Executor(2) as executor:
        call = joblib.delayed(diverge)(STEP)
        with joblib.parallel_config(backend="fiber", executor=executor, n_jobs=2):
            return heard(lambda: joblib.Parallel()([call]))


def of_a_manager() -> BaseException:
    with ModelManager() as manager:
        return heard(lambda: manager.Model().diverge(STEP))  # type: ignore[attr-defined]


def of_an_environment() -> BaseException:
    env = VectorEnv([DivergingEnv], num_workers=1)
    env.reset()
    try:
        return heard(lambda: env.step([STEP]))
    finally:
        env.close()


def of_a_ring() -> BaseException:
    return heard(lambda: fiber.Ring(1, diverge_as_member).run())


FACES: dict[str, Callable[[], BaseException]] = {
    "apply": lambda: of_a_pool(lambda pool: pool.apply(diverge, (STEP,))),
    "apply_async": lambda: of_a_pool(lambda pool: pool.apply_async(diverge, (STEP,)).get(PATIENCE)),
    "map": lambda: of_a_pool(lambda pool: pool.map(diverge, [STEP] * 3, chunksize=3)),
    "imap": lambda: of_a_pool(lambda pool: next(pool.imap(diverge, [STEP]))),
    "imap_unordered": lambda: of_a_pool(lambda pool: next(pool.imap_unordered(diverge, [STEP]))),
    "broadcast": lambda: of_a_pool(lambda pool: pool.broadcast(diverge, STEP)),
    "error_callback": of_a_callback,
    "executor": of_an_executor,
    "joblib": of_joblib,
    "manager": of_a_manager,
    "vector environment": of_an_environment,
    "ring": of_a_ring,
}


@pytest.mark.parametrize("face", FACES)
def test_an_exception_keeps_its_class_and_attributes_for_each_init(backend: str, face: str) -> None:
    error: Any = FACES[face]()
    assert (error.step, error.loss) == (STEP, 0.5)
    assert str(error) == "loss 0.5 at step 7"
    assert "in diverge" in str(error.__cause__)


def test_retry_exceptions_know_it(backend: str) -> None:
    with fiber.Pool(1, retries=1, retry_exceptions=Diverged) as pool:
        heard(lambda: pool.apply(diverge, (STEP,)))


def test_an_exception_whose_attributes_raise_does_not_end_the_worker(backend: str) -> None:
    with fiber.Pool(1) as pool:
        with pytest.raises(MaybeEncodingError, match="Unreadable"):
            pool.apply(raise_unreadable)
        assert pool.apply(abs, (-1,)) == 1


def test_an_exception_may_hold_a_handle(backend: str) -> None:
    queue: Any = fiber.Queue()
    with fiber.Pool(1) as pool, pytest.raises(ValueError, match="holds a handle") as caught:
        pool.apply(raise_with, (queue,))
    error: Any = caught.value
    error.thing.put(STEP)
    assert queue.get(timeout=PATIENCE) == STEP


def test_exceptions_of_the_main_module_keep_their_class_and_attributes(
    launch_on: Callable[..., Program],
) -> None:
    """Also of a ``__main__`` that its agents cannot import."""
    program = launch_on(
        """
        import dataclasses
        import threading
        import fiber

        class Diverged(Exception):
            def __init__(self, step, *, loss):
                super().__init__(f"loss {loss} at step {step}")
                self.step, self.loss = step, loss

        class Slotted(Exception):
            __slots__ = ("step", "loss")

            def __init__(self, step, *, loss):
                super().__init__()
                self.step, self.loss = step, loss

        @dataclasses.dataclass(frozen=True, slots=True)
        class Frozen(Exception):
            step: int
            loss: float

        class Result:
            def __init__(self):
                self.lock = threading.Lock()

        def diverge(step):
            raise Diverged(step, loss=0.5)

        def local(step):
            class Local(Diverged):
                pass
            raise Local(step, loss=0.5)

        def slotted(step):
            raise Slotted(step, loss=0.5)

        def frozen(step):
            raise Frozen(step, loss=0.5)

        def unsendable():
            return Result()

        if __name__ == "__main__":
            with fiber.Pool(1) as pool:
                for task in diverge, local, slotted, frozen:
                    try:
                        pool.apply(task, (7,))
                    except (Diverged, Slotted, Frozen) as error:
                        print(type(error).__name__, error.step, error.loss, flush=True)
                try:
                    pool.apply(unsendable)
                except fiber.pool.MaybeEncodingError as error:
                    print(error.exc, flush=True)
        """
    )
    assert program.line() == "Diverged 7 0.5"
    assert program.line() == "Local 7 0.5"
    assert program.line() == "Slotted 7 0.5"
    assert program.line() == "Frozen 7 0.5"
    assert "cannot pickle '_thread.lock' object" in program.line()
    assert program.wait() == 0
