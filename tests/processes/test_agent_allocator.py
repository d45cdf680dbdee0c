"""An agent keeps the memory in which large messages were."""

from __future__ import annotations

import subprocess
import sys

import pytest

_MESSAGES = """
import resource, sys
from fiber._agent.main import keep_memory

def send():
    messages = [b"x" * (1 << 19) for _ in range(int(sys.argv[1]))]

def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt

keep_memory()
send()
before = faults()
for _ in range(100):
    send()
print(faults() - before)
"""


@pytest.mark.parametrize(
    ("messages", "most"),
    [
        pytest.param(4, 5_000, id="all of it"),
        pytest.param(40, 300_000, id="some of what is more than it keeps"),
    ],
)
def test_a_large_message_does_not_take_fresh_memory_each_time(messages: int, most: int) -> None:
    command = [sys.executable, "-c", _MESSAGES, str(messages)]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    assert int(run.stdout) < most, f"{12_800 * messages} pages were written"
