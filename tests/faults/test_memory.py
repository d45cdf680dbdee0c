"""Shortage of memory: a process without room for a message gets an error; the program goes on."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from faults.program import Program

RESULT = """
    import fiber, resource
    from faults import targets

    def mapped():
        with open("/proc/self/statm") as file:
            return int(file.read().split()[0]) * resource.getpagesize()

    if __name__ == "__main__":
        with fiber.Pool(1) as pool:
            pool.map(abs, range(10))
            soft, hard = resource.getrlimit(resource.RLIMIT_AS)
            resource.setrlimit(resource.RLIMIT_AS, (mapped() + (128 << 20), hard))
            ask = {ask}
            try:
                ask(bytes, 256 << 20)
            except fiber.WorkerDied as error:
                print("no memory is left to receive a message of" in str(error))
            print(pool.apply(abs, (-1,)), pool.map(abs, [-2]))
"""


@pytest.mark.parametrize(
    "ask",
    [
        "lambda function, size: pool.apply(function, (size,))",
        "lambda function, size: pool.apply_async(function, (size,)).get()",
        "lambda function, size: pool.map(function, [size])",
    ],
    ids=["apply", "apply_async", "map"],
)
def test_a_result_for_which_the_program_has_no_memory_is_an_error(
    launch: Callable[..., Program], ask: str
) -> None:
    program = launch(RESULT.replace("{ask}", ask))
    assert program.rest() == "True\n1 [2]\n"
    assert program.wait() == 0
    assert "Traceback" not in program.stderr
