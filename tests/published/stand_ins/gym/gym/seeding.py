"""The generator of random numbers of that time."""

import numpy as np


def np_random(seed=None):
    """Return a generator and its seed."""
    return np.random.RandomState(seed), seed
