"""emcee: Markov chain Monte Carlo, with the pool passed in."""

from __future__ import annotations

import importlib
from typing import Any

from published.records import Package, Program
from published.runs import Run, Value

STEPS, WALKERS, DIMENSIONS = 50, 16, 3


def log_probability(theta: Any) -> float:
    """Return the logarithm of a density: a banana in the first two dimensions."""
    x, y, *rest = map(float, theta)
    return -((1 - x) ** 2) - 10 * (y - x * x) ** 2 - sum(each * each for each in rest)


def run(run: Run) -> dict[str, Value]:
    """Sample with a pool; compare the whole chain."""
    import numpy as np

    source = run.copy("src")
    # The build writes this file, so a clone has none.
    (source / "emcee" / "emcee_version.py").write_text('__version__ = "clone"\n')
    run.import_from(source)
    emcee = importlib.import_module("emcee")
    np.random.seed(1)
    start = np.random.randn(WALKERS, DIMENSIONS)
    with run.multiprocessing.Pool(2) as pool:
        sampler = emcee.EnsembleSampler(WALKERS, DIMENSIONS, log_probability, pool=pool)
        sampler.run_mcmc(start, STEPS)
    return {
        "chain": sampler.get_chain().tolist(),
        "log_probability": sampler.get_log_prob().tolist(),
        "accepted": sampler.acceptance_fraction.tolist(),
    }


PROGRAMS = [
    Program(
        name="emcee",
        upstream="https://github.com/dfm/emcee",
        clone="emcee",
        way="`pool=`",
        ran=f"`EnsembleSampler`, {WALKERS} walkers, {STEPS} steps",
        run=run,
        files=("src/emcee/ensemble.py",),
        packages=(Package("numpy", "numpy>=1.26"),),
    )
]
