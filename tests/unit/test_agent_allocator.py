"""An agent keeps the memory in which large messages were."""

from __future__ import annotations

import subprocess
import sys

_MESSAGES = """
import resource
from fiber._agent.allocator import keep_memory

def send():
    messages = [b"x" * (1 << 19) for _ in range(4)]

def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt

keep_memory()
send()
before = faults()
for _ in range(100):
    send()
print(faults() - before)
"""


def test_a_large_message_does_not_take_fresh_memory_each_time() -> None:
    run = subprocess.run(
        [sys.executable, "-c", _MESSAGES], capture_output=True, text=True, check=True
    )
    assert int(run.stdout) < 5_000, "51,200 pages were written"
