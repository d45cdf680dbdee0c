"""Named shared memory: who finds it, and that nothing of it outlives the program."""

from __future__ import annotations

import multiprocessing.shared_memory
import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any

import pytest

import fiber
from census import wait_until
from fiber.managers import SharedMemoryManager
from fiber.shared_memory import ShareableList, SharedMemory
from hosts import Hosts
from patience import PATIENCE


@pytest.fixture
def memory() -> Iterator[SharedMemory]:
    memory = SharedMemory(create=True, size=100)
    yield memory
    memory.close()
    memory.unlink()


def run(target: Callable[..., Any], *args: Any) -> None:
    process = fiber.Process(target=target, args=args)
    process.start()
    process.join(PATIENCE)
    assert process.exitcode == 0


def buffer(memory: SharedMemory) -> memoryview:
    assert memory.buf is not None
    return memory.buf


def write(memory: SharedMemory) -> None:
    buffer(memory)[:3] = b"abc"


def write_by_name(name: str) -> None:
    memory = SharedMemory(name)
    buffer(memory)[3:6] = b"def"
    memory.close()


def make(name: str) -> None:
    memory = SharedMemory(name, create=True, size=10)
    buffer(memory)[0] = 7


def double(numbers: ShareableList[int]) -> None:
    numbers[0] *= 2


def there_is(name: str) -> bool:
    return os.path.exists(f"/dev/shm/{name}")


def test_processes_find_it_by_name_and_as_an_argument(memory: SharedMemory) -> None:
    run(write, memory)
    run(write_by_name, memory.name)
    assert bytes(buffer(memory)[:6]) == b"abcdef"


def test_shared_memory_is_an_instance_of_multiprocessings_class(memory: SharedMemory) -> None:
    theirs = multiprocessing.shared_memory.SharedMemory
    assert isinstance(memory, theirs)
    buffer(memory)[0] = 5
    again = pickle.loads(pickle.dumps(memory))
    assert (again.buf[0], again.name, again.size) == (5, memory.name, memory.size)


def test_shared_memory_outlives_the_process_that_made_it() -> None:
    name = f"fiber-test-{os.getpid()}"
    run(make, name)
    memory = SharedMemory(name)
    assert buffer(memory)[0] == 7
    memory.close()
    memory.unlink()
    assert not there_is(name)


def test_a_name_is_given_once(memory: SharedMemory) -> None:
    with pytest.raises(FileExistsError):
        SharedMemory(memory.name, create=True, size=1)
    run(write_by_name, memory.name)  # it is still there
    with pytest.raises(FileNotFoundError, match=r"no shared memory .* fiber\.Array"):
        SharedMemory(memory.name + "-not")


@pytest.mark.parametrize(
    "options", [{"create": True}, {"create": True, "size": -1}, {"size": 5}, {}]
)
def test_bad_options(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError):
        SharedMemory(**options)


@pytest.mark.parametrize("name", [5, 0, b"name", ["name"]])
def test_an_invalid_name_is_refused(name: Any) -> None:
    every: list[dict[str, Any]] = [{}, {"create": True, "size": 5}]
    for options in every:
        with pytest.raises(TypeError, match="'name' must be a string, not"):
            SharedMemory(name, **options)


def test_a_list_is_shared() -> None:
    kind: Any = ShareableList  # typeshed knows no list of several types, and no iteration
    numbers = kind([21, "text", None, b"bytes"])
    run(double, numbers)
    assert list(numbers) == [42, "text", None, b"bytes"]
    assert isinstance(numbers, multiprocessing.shared_memory.ShareableList)
    numbers.shm.close()
    numbers.shm.unlink()


def test_a_manager_removes_its_shared_memory() -> None:
    manager = SharedMemoryManager(shutdown_timeout=PATIENCE)
    with pytest.raises(ValueError, match="does not run"):
        manager.SharedMemory(size=10)
    with manager:
        memory = manager.SharedMemory(size=10)
        numbers: Any = manager.ShareableList([1, 2])  # typeshed knows no iteration
        run(write, memory)
        assert bytes(buffer(memory)[:3]) == b"abc"
        assert list(numbers) == [1, 2]
        names = memory.name, numbers.shm.name
        assert all(map(there_is, names))
    assert not any(map(there_is, names))
    memory.close()
    numbers.shm.close()
    with pytest.raises(ValueError, match="does not run"):
        manager.ShareableList([])


@pytest.mark.parametrize("end", ["pass", "os.kill(os.getpid(), signal.SIGKILL)"])
def test_memory_that_was_never_unlinked_is_removed_at_the_end(end: str) -> None:
    program = (
        "import fiber, os, signal\n"
        "from fiber.shared_memory import SharedMemory\n"
        "if __name__ == '__main__':\n"
        "    memory = SharedMemory(create=True, size=10)\n"
        "    process = fiber.Process(target=print, args=(memory.name,))\n"
        "    process.start()\n"
        "    process.join()\n"
        f"    {end}\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, timeout=60)
    name = done.stdout.decode().strip()
    assert name, done.stderr
    assert done.returncode in (0, -signal.SIGKILL)
    assert wait_until(lambda: not there_is(name), PATIENCE)


def test_another_host_learns_the_replacement(memory: SharedMemory) -> None:
    hosts = Hosts()
    try:
        with hosts.at("here"):
            data = pickle.dumps(memory)
        with (
            hosts.at("there"),
            pytest.raises(pickle.UnpicklingError, match=r"of host 'here' .*fiber\.Array"),
        ):
            pickle.loads(data)
    finally:
        hosts.close()
