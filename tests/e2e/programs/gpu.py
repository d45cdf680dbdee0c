"""Program with one process that asks for a GPU and prints where it runs."""

from __future__ import annotations

import json
import socket
from typing import Any

import fiber


@fiber.meta(gpu=1)
def tell(connection: Any) -> None:
    """The child."""
    connection.send(socket.gethostname())


def main() -> None:
    here, there = fiber.Pipe()
    process = fiber.Process(target=tell, args=(there,))
    process.start()
    print(json.dumps({"event": "ran", "host": here.recv()}) + "\n", end="", flush=True)
    process.join()


if __name__ == "__main__":
    main()
