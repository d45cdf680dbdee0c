"""Large numbers: workers, pipes, bytes, items.  Each within half a minute on two cores."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from faults.program import Program

pytestmark = pytest.mark.slow


WORKERS = """
    import fiber, resource, sys
    from faults import pool_targets
    if __name__ == "__main__":
        count = int(sys.argv[1])
        hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
        with fiber.Pool(count) as pool:
            pids = pool.broadcast(pool_targets.pid)
            print(len(pids), len(set(pids)))
            print(pool.map(abs, range(-5 * count, 0), chunksize=1) == list(range(5 * count, 0, -1)))
            pool.close()
            pool.join()
"""


@pytest.mark.parametrize("count", [128, 1024])
def test_workers_start_work_and_go(launch: Callable[..., Program], count: int) -> None:
    """128 is where the original's pids collided."""
    program = launch(WORKERS, str(count))
    assert program.finish() == f"{count} {count}\nTrue\n"
    assert program.stderr == ""


PIPES = """
    import fiber, resource
    from faults import targets
    if __name__ == "__main__":
        hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
        pipes = [fiber.Pipe() for _ in range(1024)]
        child = fiber.Process(target=targets.echo_each, args=([theirs for _, theirs in pipes],))
        child.start()
        for _, theirs in pipes:
            theirs.close()
        for number, (ours, _) in enumerate(pipes):
            ours.send(number)
        print(all(ours.recv() == number for number, (ours, _) in enumerate(pipes)))
        print(len(fiber.connection.wait([ours for ours, _ in pipes], 0)))
        child.kill()
        child.join()
        print(len(fiber.connection.wait([ours for ours, _ in pipes], 60)))
"""


def test_1024_pipes_into_one_process(launch: Callable[..., Program]) -> None:
    assert launch(PIPES).finish() == "True\n0\n1024\n"


PROCESSES = """
    import fiber, resource
    from faults import targets
    if __name__ == "__main__":
        hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
        children, ends = [], []
        for _ in range(256):
            ours, theirs = fiber.Pipe()
            child = fiber.Process(target=targets.echo, args=(theirs,))
            child.start()
            theirs.close()
            children.append(child)
            ends.append(ours)
        for number, end in enumerate(ends):
            end.send(number)
        print(all(end.recv() == number for number, end in enumerate(ends)))
        for end in ends:
            end.close()
        for child in children:
            child.join()
        print({child.exitcode for child in children})
"""


def test_256_processes_each_with_a_pipe(launch: Callable[..., Program]) -> None:
    assert launch(PROCESSES).finish() == "True\n{0}\n"


MESSAGE = """
    import fiber
    from faults import pool_targets, targets
    if __name__ == "__main__":
        size = 100_000_000
        ours, theirs = fiber.Pipe()
        child = fiber.Process(target=targets.echo_bytes, args=(theirs,))
        child.start()
        theirs.close()
        data = bytes(range(250)) * (size // 250)
        ours.send_bytes(data)
        print(len(ours.recv_bytes()))
        queue = fiber.Queue()
        queue.put(data)
        print(len(queue.get()))
        with fiber.Pool(1) as pool:
            print(pool.apply(len, (data,)), len(pool.apply(pool_targets.large, (size,))))
        ours.close()
        child.join()
"""


def test_a_message_of_100_megabytes(launch_on: Callable[..., Program]) -> None:
    output = launch_on(MESSAGE).finish()
    assert output == "100000000\n100000000\n100000000 100000000\n"


ITEMS = """
    import fiber, resource
    from faults import pool_targets

    def peak():
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    def numbers():
        global read
        for read in range(1_000_000):
            yield read

    if __name__ == "__main__":
        read = 0
        with fiber.Pool(2) as pool:
            sum(pool.imap_unordered(abs, range(10_000)))
            before, total, ahead = peak(), 0, 0
            for count, value in enumerate(pool.imap_unordered(abs, numbers())):
                total += value
                ahead = max(ahead, read - count)
        print(total == sum(range(1_000_000)), ahead < 500_000)
        print("grew by", peak() - before, "KiB")
"""


def test_a_million_items_with_flat_memory(launch_on: Callable[..., Program]) -> None:
    first, second = launch_on(ITEMS).finish().splitlines()
    assert first == "True True"
    assert int(second.split()[2]) < 40_000
