# pyright: strict
"""Code as users write it.  Type checkers are to find in it what they find with multiprocessing."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from typing import reveal_type

import fiber as mp
from fiber import connection, managers, pool, queues, sharedctypes, synchronize
from fiber.shared_memory import ShareableList, SharedMemory


def show(number: int) -> str:
    return str(number)


def add(one: int, other: int) -> float:
    return one + other


def log(message: str) -> None: ...


def failed(error: BaseException) -> None: ...


def prepare(seed: int) -> None: ...


def produce(queue: queues.Queue[int], lock: synchronize.Lock) -> None:
    with lock:
        queue.put(1)


def numbers() -> Iterator[int]:
    yield 1


class Job(mp.Process):
    def run(self) -> None: ...


def pools() -> None:
    with mp.Pool(4, initializer=prepare, initargs=(3,), maxtasksperchild=2) as workers:
        reveal_type(workers)
        reveal_type(workers.map(show, range(10), chunksize=2))
        reveal_type(workers.apply(show, (1,), {}))
        result = workers.apply_async(show, (1,), callback=log, error_callback=failed)
        reveal_type(result)
        reveal_type(result.get(timeout=3))
        reveal_type(result.ready())
        reveal_type(result.successful())
        reveal_type(result.wait(1.0))
        several = workers.map_async(show, numbers())
        reveal_type(several)
        reveal_type(several.get())
        reveal_type(workers.imap(show, [1, 2]))
        reveal_type(workers.imap_unordered(show, [1, 2], 3))
        reveal_type(next(workers.imap(show, [1, 2])))
        reveal_type(workers.imap(show, [1, 2]).next(timeout=1))
        reveal_type(workers.starmap(add, [(1, 2)]))
        reveal_type(workers.starmap_async(add, [(1, 2)]).get())
        workers.map(show, ["not a number"])
        workers.apply_async(show, (1,), callback=prepare)
        workers.close()
        workers.terminate()
        reveal_type(workers.join())


def results(one: pool.AsyncResult[str], many: pool.MapResult[int]) -> None:
    reveal_type(one.get())
    reveal_type(many.get())
    reveal_type(pool.ThreadPool(2).map(show, [1]))


def processes() -> None:
    process = mp.Process(target=show, name="a", args=(1,), kwargs={}, daemon=True)
    reveal_type(process)
    reveal_type(process.start())
    reveal_type(process.join(1))
    reveal_type(process.exitcode)
    reveal_type(process.pid)
    reveal_type(process.is_alive())
    reveal_type(process.sentinel)
    reveal_type(Job().name)
    reveal_type(mp.current_process())
    reveal_type(mp.parent_process())
    reveal_type(mp.active_children())
    reveal_type(mp.cpu_count())
    mp.Process(targett=show)


def use_queues() -> None:
    queue: mp.Queue[int] = mp.Queue(3)
    reveal_type(queue.get(timeout=1))
    reveal_type(queue.get_nowait())
    reveal_type(queue.put(3, block=False))
    reveal_type(queue.qsize())
    joinable: mp.JoinableQueue[str] = mp.JoinableQueue()
    reveal_type(joinable.get())
    reveal_type(joinable.task_done())
    simple: mp.SimpleQueue[bytes] = mp.SimpleQueue()
    reveal_type(simple.get())
    queue.put("not a number")
    unknown = mp.Queue()
    reveal_type(unknown.get())


def pipes() -> None:
    one, other = mp.Pipe(duplex=False)
    reveal_type(one)
    reveal_type(one.recv())
    reveal_type(other.send({}))
    reveal_type(one.poll(1.0))
    reveal_type(one.recv_bytes())
    reveal_type(one.fileno())
    with one as entered:
        reveal_type(entered)
    typed: connection.Connection[int, str] = one
    reveal_type(typed.recv())
    typed.send("not a number")
    reveal_type(connection.Client(("localhost", 1), authkey=b"key").recv())


def synchronization() -> None:
    with mp.Lock() as acquired:
        reveal_type(acquired)
    lock = mp.RLock()
    reveal_type(lock)
    reveal_type(lock.acquire(block=False, timeout=1))
    reveal_type(lock.release())
    reveal_type(mp.Semaphore(2))
    reveal_type(mp.BoundedSemaphore(2).get_value())
    condition = mp.Condition(lock)
    with condition:
        reveal_type(condition.wait(1))
        reveal_type(condition.wait_for(lambda: True))
        reveal_type(condition.notify_all())
    event = mp.Event()
    reveal_type(event)
    reveal_type(event.wait(1))
    reveal_type(event.is_set())
    barrier = mp.Barrier(2, timeout=3)
    reveal_type(barrier)
    reveal_type(barrier.wait())


def shared_values() -> None:
    number = mp.Value("d", 0.0)
    reveal_type(number)
    reveal_type(number.value)
    with number.get_lock():
        number.value += 1
    reveal_type(mp.Value(ctypes.c_int, 3))
    reveal_type(mp.Value(ctypes.c_int, 3, lock=mp.Lock()).value)
    reveal_type(mp.Value("i", lock=False))
    array = mp.Array("i", 10)
    reveal_type(array)
    reveal_type(array[0])
    reveal_type(mp.Array(ctypes.c_double, [1.0, 2.0], lock=mp.RLock())[0:1])
    reveal_type(mp.Array(ctypes.c_char, 10).value)
    reveal_type(mp.RawValue(ctypes.c_int, 3))
    reveal_type(mp.RawArray(ctypes.c_int, 3))
    reveal_type(mp.RawArray("d", 3))
    reveal_type(sharedctypes.synchronized(ctypes.c_int(3)))


def named_memory() -> None:
    memory = SharedMemory(create=True, size=10)
    reveal_type(memory.buf)
    reveal_type(ShareableList([1, 2]))
    reveal_type(ShareableList([1, 2])[0])


def use_managers() -> None:
    with mp.Manager() as manager:
        reveal_type(manager)
        reveal_type(manager.dict())
        reveal_type(manager.dict(a=1))
        reveal_type(manager.list([1, 2]))
        reveal_type(manager.list([1, 2])[0])
        reveal_type(manager.Value("i", 3).value)
        reveal_type(manager.Namespace())
        reveal_type(manager.Queue())
        reveal_type(manager.Lock())
        reveal_type(manager.Event())
        reveal_type(manager.Barrier(2))
        reveal_type(manager.Pool(2))
        reveal_type(manager.address)
    reveal_type(managers.SyncManager(authkey=b"key").start(prepare, (1,)))
    managers.BaseManager.register("show", show)
    reveal_type(managers.BaseManager(("", 0)).get_server)


def contexts() -> None:
    reveal_type(mp.get_context())
    spawn = mp.get_context("spawn")
    reveal_type(spawn)
    reveal_type(spawn.Pool(2))
    reveal_type(spawn.Process(target=show))
    reveal_type(mp.get_context().Process(target=show))
    reveal_type(spawn.Queue())
    reveal_type(spawn.Lock())
    reveal_type(mp.get_context("fork"))
    reveal_type(mp.get_context("forkserver").Event())
    reveal_type(mp.get_context("fork").Value("i", 3))
    reveal_type(mp.get_start_method())
    reveal_type(mp.get_all_start_methods())
    reveal_type(mp.set_start_method("spawn", force=True))
    reveal_type(mp.get_logger())
    reveal_type(mp.log_to_stderr(10))
    reveal_type(mp.freeze_support())


def errors() -> None:
    try:
        contexts()
    except mp.TimeoutError as error:
        reveal_type(error)
    except mp.ProcessError as error:
        reveal_type(error)
    mp.Poool(3)
    mp.Pool(prcesses=3)
    mp.Lock().aquire()
