"""A ring whose members exchange numbers until one of them is lost.

Members print ``member N is in HOST``, and what they hear of the loss. The program says ``lost``.
"""

from __future__ import annotations

import json
import socket
import time

import fiber
from fiber.errors import MemberLost


def go_round(rank: int, size: int) -> None:
    """Exchange numbers until a member is lost; print the loss and pass it on."""
    member = fiber.ring.current()
    print(f"member {rank} is in {socket.gethostname()}.", flush=True)
    try:
        while True:
            member.exchange(rank)
            time.sleep(0.05)
    except MemberLost as loss:
        print(f"member {rank} is told: {loss}", flush=True)
        raise


def main() -> None:
    """Exit with status 0 if a member is lost, as the test expects."""
    try:
        fiber.Ring(4, go_round).run()
    except MemberLost as loss:
        print(
            json.dumps({"event": "lost", "rank": loss.rank, "text": str(loss)}) + "\n",
            end="",
            flush=True,
        )


if __name__ == "__main__":
    main()
