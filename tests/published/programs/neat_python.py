"""neat-python: its ParallelEvaluator, on the genomes of its parallel example."""

from __future__ import annotations

import importlib

from published.records import Program, Version
from published.runs import Run, Value

EXAMPLE = "examples/parallel-reproducible"


def run(run: Run) -> dict[str, Value]:
    """Evaluate the example's first population, with one changed line; compare all fitnesses.

    The evolution that follows is not the same in each run with multiprocessing itself.
    """
    copied = run.copy()
    if run.on_fiber:
        imports = "from multiprocessing import Pool\n"
        run.replace(copied / "neat" / "parallel.py", imports, "from fiber import Pool\n")
    run.import_from(copied)
    run.import_from(copied / EXAMPLE)
    neat, example = map(importlib.import_module, ("neat", "evolve-parallel"))
    config = neat.Config(
        neat.DefaultGenome,
        neat.DefaultReproduction,
        neat.DefaultSpeciesSet,
        neat.DefaultStagnation,
        str(copied / EXAMPLE / "config-parallel"),
    )
    genomes = list(neat.Population(config, seed=42).population.items())
    with neat.ParallelEvaluator(2, example.eval_genome, seed=42) as evaluator:
        evaluator.evaluate(genomes, config)
    return {"fitness": [genome.fitness for _, genome in genomes]}


PROGRAMS = [
    Program(
        name="neat-python",
        upstream="https://github.com/CodeReclaimers/neat-python",
        clone="neat-python",
        way="one changed line",
        ran="`ParallelEvaluator` on the first population of its parallel example",
        run=run,
        files=("neat/parallel.py", f"{EXAMPLE}/evolve-parallel.py"),
        version=Version("neat/__init__.py", ">=2.0"),
    )
]
