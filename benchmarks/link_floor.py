"""Least cost of a vector step whose observations come from other hosts: no part of a run.

``python -m benchmarks.link_floor`` prints how long it takes to copy the bytes of 64 observations of
84x84x4, to seal them, to carry them over TCP on this machine, and to open them: each separately.
"""

from __future__ import annotations

import argparse
import os
import socket
import statistics
import threading
import time
from collections.abc import Callable

from cryptography.hazmat.primitives.ciphers.aead import AESGCM

OBSERVATIONS = 64 * 84 * 84 * 4
PIECE = 512 * 1024
"""Bytes that are sealed at once, as on a link."""

_TAG = 16
_NONCE = bytes(12)  # these bytes never leave the machine


def measure(size: int, rounds: int) -> dict[str, float]:
    """Return milliseconds of each, medians of so many rounds."""
    data, target = memoryview(os.urandom(size)), memoryview(bytearray(size))
    cipher = AESGCM(os.urandom(32))
    pieces = [data[start : start + PIECE] for start in range(0, size, PIECE)]
    sealed = [memoryview(cipher.encrypt(_NONCE, piece, None)) for piece in pieces]
    room = memoryview(bytearray(PIECE + _TAG))

    def copy() -> None:
        target[:] = data

    def seal() -> None:
        for piece in pieces:
            cipher.encrypt_into(_NONCE, piece, None, room[: len(piece) + _TAG])

    def unseal() -> None:
        for piece in sealed:
            cipher.decrypt_into(_NONCE, piece, None, room[: len(piece) - _TAG])

    with _Carrier(target) as carrier:
        return {
            "one copy": _median(copy, rounds),
            "seal": _median(seal, rounds),
            "carry": _median(lambda: carrier.carry(data), rounds),
            "open": _median(unseal, rounds),
        }


class _Carrier:
    """TCP connection within this process, read by a thread."""

    def __init__(self, target: memoryview) -> None:
        self._target = target
        with socket.create_server(("127.0.0.1", 0)) as server:
            self._ours = socket.create_connection(server.getsockname())
            self._theirs, _ = server.accept()
        self._reader = threading.Thread(target=self._read)

    def __enter__(self) -> _Carrier:
        self._reader.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ours.close()
        self._reader.join()
        self._theirs.close()

    def carry(self, data: memoryview) -> None:
        """Send the bytes and wait until they have arrived."""
        self._ours.sendall(data)
        self._ours.recv(1)

    def _read(self) -> None:
        arrived = 0
        while count := self._theirs.recv_into(self._target[arrived:]):
            arrived += count
            if arrived == len(self._target):
                arrived = 0
                self._theirs.sendall(b"!")


def _median(work: Callable[[], None], rounds: int) -> float:
    took = []
    for _ in range(rounds):
        begin = time.perf_counter()
        work()
        took.append(time.perf_counter() - begin)
    return statistics.median(took) * 1e3


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=200)
    for what, took in measure(OBSERVATIONS, parser.parse_args().rounds).items():
        print(f"{what:10}{took:8.2f} ms")


if __name__ == "__main__":
    main()
