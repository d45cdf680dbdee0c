"""Sum of an array over all members of a ring, each of which sends at most twice the array's size.

The algorithm is Patarasuk and Yuan's (2009), as Baidu and Horovod made it known. The array is cut
into as many parts as there are members. In one trip round the ring each part gathers its sum, one
member after the other. In a second trip all members get all sums.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from fiber.ring import Member


def all_reduce(ring: Member, array: Any) -> Any:
    """Return the sum of the members' arrays, which have one shape; the same, bit for bit, in
    all."""
    parts = np.array_split(array.copy().ravel(), ring.size)
    for step in range(ring.size - 1):
        mine = ring.rank - step
        parts[(mine - 1) % ring.size] += ring.exchange(parts[mine % ring.size])
    for step in range(ring.size - 1):
        mine = ring.rank + 1 - step
        parts[(mine - 1) % ring.size] = ring.exchange(parts[mine % ring.size])
    return np.concatenate(parts).reshape(array.shape)
