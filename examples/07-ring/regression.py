"""Gradient descent by several processes: each has a part of the data, a ring sums the gradients."""

from __future__ import annotations

import argparse
import importlib.util
import socket
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from all_reduce import all_reduce

import fiber
from fiber.ring import Member

FEATURES = 2000
Sum = Callable[[Any], Any]
"""Function that sums an array over all members."""


def data(rank: int, size: int, samples: int) -> tuple[Any, Any]:
    """Return member `rank`'s part of a regression problem: inputs, and outputs with a little
    noise."""
    truth = np.random.default_rng(0).normal(size=FEATURES)
    inputs = np.random.default_rng(1).normal(size=(samples, FEATURES))[rank::size]
    noise = np.random.default_rng(2).normal(size=samples)[rank::size]
    return inputs, inputs @ truth + noise


def train(samples: int, steps: int, by_gloo: bool, rank: int, size: int) -> list[float]:
    """Return the mean squared error before each step; the same in all members."""
    inputs, outputs = data(rank, size, samples)
    add_up: Sum = with_gloo if by_gloo else partial(all_reduce, fiber.ring.current())
    weights = np.zeros(FEATURES)
    errors = []
    for _ in range(steps):
        off = inputs @ weights - outputs
        total = add_up(np.append(inputs.T @ off, off @ off)) / samples
        errors.append(float(total[-1]))
        weights -= 0.3 * total[:-1]
    return errors


def start_gloo(member: Member) -> None:
    """Meet the others in torch.distributed, at an address that rank 0 tells all round the ring."""
    import torch.distributed as distributed

    where = member.recv() if member.rank else _free_address()
    if member.rank < member.size - 1:
        member.send(where)
    distributed.init_process_group("gloo", f"tcp://{where}", None, member.size, member.rank)


def with_gloo(array: Any) -> Any:
    """Return the sum of all members' arrays, by torch.distributed."""
    import torch
    import torch.distributed as distributed

    tensor = torch.from_numpy(array)
    distributed.all_reduce(tensor)
    return tensor.numpy()


def _free_address() -> str:
    with socket.create_server(("", 0)) as server:
        port = server.getsockname()[1]
    try:
        return f"{socket.gethostbyname(socket.gethostname())}:{port}"
    except OSError:  # a machine that does not know its own name
        return f"127.0.0.1:{port}"


def _number(text: str) -> int:
    if (number := int(text)) < 1:
        raise argparse.ArgumentTypeError(f"{number} is less than 1")
    return number


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--members", type=_number, default=4)
    parser.add_argument("--samples", type=_number, default=8000)
    parser.add_argument("--steps", type=_number, default=40)
    parser.add_argument(
        "--gloo", action="store_true", help="sum by torch.distributed, not by pipes"
    )
    parser.add_argument("--picture", type=Path, help="file for a picture of the error")
    options = parser.parse_args()
    if options.gloo and importlib.util.find_spec("torch") is None:
        parser.error("--gloo needs torch: pip install torch")
    work = partial(train, options.samples, options.steps, options.gloo)
    ring = fiber.Ring(options.members, work, start_gloo if options.gloo else None)
    errors = ring.run()
    print(f"error before: {errors[0][0]:.4g}, after {options.steps} steps: {errors[0][-1]:.4g}")
    same = all(each == errors[0] for each in errors)
    print(f"{options.members} members went the {'same way' if same else 'different ways'}")
    if options.picture:
        from descent import draw

        draw(options.picture, errors[0], options.members)


if __name__ == "__main__":
    main()
