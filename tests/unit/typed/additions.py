# pyright: strict
"""Additions of Fiber: each line says which type is revealed in it, or that it is an error."""

from __future__ import annotations

import ctypes
from typing import reveal_type

import fiber
from fiber.connection import Connection, wait
from fiber.queues import SimpleQueuePush
from fiber.synchronize import Abandoned


def show(number: int) -> str:
    return str(number)


def configure(backend: str, directory: str) -> None:
    config = fiber.init(backend="local", retries=3, template={"spec": {}}, namespace=None)
    reveal_type(config)  # Config
    reveal_type(config.pod_timeout)  # float
    fiber.init(bakend="local")  # error
    fiber.init(backend="typo")  # error
    fiber.init(backend=backend)  # error
    fiber.init(retries="3")  # error
    fiber.init(runtime_directory=directory)


def pools() -> None:
    with fiber.Pool(min_workers=1, max_workers=4, retries=2, task_timeout=3.0) as pool:
        reveal_type(pool.map(show, [1], timeout=3.0))  # list[str]
        reveal_type(pool.broadcast(show, 1))  # list[str]
        reveal_type(pool.starmap_async(show, [(1,)]))  # MapResult[str]
        reveal_type(pool.workers()[0].name)  # str
    fiber.Pool(max_wokers=3)  # error
    with fiber.get_context("spawn").Pool(2, min_workers=3) as pool:
        pool.wait_until_workers_up(timeout=3)
    with fiber.Manager() as manager:
        manager.Pool(2, retries=3)


def locks() -> None:
    lock = fiber.Lock()
    acquired = lock.acquire()
    reveal_type(acquired)  # bool
    if isinstance(acquired, Abandoned):
        reveal_type(acquired.holder)  # str
    fiber.Condition(fiber.Value("i").get_lock())
    reveal_type(fiber.Value(ctypes.c_int, lock=False))  # c_int
    reveal_type(fiber.Array(ctypes.c_int, 3, lock=False))  # Array[c_int]


def connections() -> None:
    one: Connection[int, str] = fiber.Pipe()[0]
    reveal_type(wait([one]))  # list[Connection[int, str]]
    wait([one, fiber.Process().sentinel])
    dealt: SimpleQueuePush[int] = SimpleQueuePush()
    reveal_type(dealt.get())  # int


def train(rank: int, size: int) -> float:
    return rank / size


def rings() -> None:
    reveal_type(fiber.Ring(4, train).run())  # list[float]
    reveal_type(fiber.ring.current().rank)  # int
    fiber.Ring(4, show)  # error


@fiber.meta(cpu=2, memory="1Gi")
def wish(number: int) -> str:
    return str(number)


def executors() -> None:
    with fiber.Executor(max_workers=3, retries=2) as executor:
        reveal_type(executor.submit(wish, 3).result())  # str
        reveal_type(list(executor.options(memory="2Gi").map(show, [1])))  # list[str]
        executor.submit(show, "not a number")  # error
    fiber.meta(cpus=2)  # error


def unknown_names() -> None:
    print(fiber.Poool)  # error
    print(fiber.util.debugg)  # error
    print(fiber.connection.Pipee)  # error
    print(fiber.vector.VectorEnvv)  # error
    print(fiber.errors.MaybeEncoding)  # error
