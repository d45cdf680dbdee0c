"""Programs and workers that may not write large files (RLIMIT_FSIZE): shared memory counts, too."""

from __future__ import annotations

from processes.pool_programs import run_program

LIMIT = """
import resource
import fiber

LARGE = 1 << 20

def limit(size):
    hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))

def attempt(function, *args):
    try:
        print(function(*args))
    except fiber.FileTooLarge as error:
        print(f"{error.doing}: {error.limit}")
"""


def test_a_worker_that_may_write_no_file_works_and_reports_large_results() -> None:
    done = run_program(f"""{LIMIT}
with fiber.Pool(1, limit, (0,)) as pool:
    attempt(pool.apply, len, (bytes(LARGE),))
    attempt(pool.apply, bytes, (LARGE,))
    attempt(pool.map, bytes, [LARGE])
    attempt(pool.apply, abs, (-3,))
""")
    assert done.stdout == "1048576\nsending a message: 0\nsending a message: 0\n3\n", done.stderr


def test_a_program_gets_an_error_for_an_argument_that_it_cannot_send() -> None:
    done = run_program(f"""{LIMIT}
with fiber.Pool(1) as pool:
    limit(1 << 17)
    attempt(pool.apply, len, (bytes(LARGE),))
    attempt(pool.map, len, [bytes(LARGE)])
    attempt(pool.apply, len, (bytes(100_000),))
    one, other = fiber.Pipe()
    attempt(one.send, bytes(LARGE))
""")
    refused = "sending a message: 131072\n"
    assert done.stdout == f"{refused}{refused}100000\n{refused}", done.stderr


def test_a_program_whose_agents_cannot_start_gets_the_reason_without_a_traceback() -> None:
    done = run_program(
        f"""{LIMIT}
limit(1 << 19)
try:
    with fiber.Pool(1) as pool:
        pool.apply(abs, (-3,))
except fiber.StartError as error:
    print(error)
""",
        {"FIBER_BACKEND": "loopback"},
    )
    assert "file too large while starting an agent" in done.stdout, done.stderr
    assert "with `ulimit -f`" in done.stdout
    assert "Traceback" not in done.stderr


def test_a_program_that_cannot_start_gets_the_reason() -> None:
    done = run_program(f"""{LIMIT}
limit(1 << 10)
attempt(fiber.Pool, 1)
""")
    assert done.stdout == "starting Fiber: 1024\n", done.stderr
