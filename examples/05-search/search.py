"""Two searches for the parameters of a classifier: a grid, by joblib, and a study, by Optuna."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, wait
from pathlib import Path
from typing import Any, NamedTuple

import joblib
import numpy as np
import optuna
from sklearn.datasets import load_digits
from sklearn.model_selection import GridSearchCV, cross_val_score
from sklearn.svm import SVC

import fiber.joblib  # registers the backend "fiber"

C, GAMMA = (0.1, 1000.0), (1e-5, 1e-1)
"""Range of each parameter."""


class Best(NamedTuple):
    """Best parameters that a search has found."""

    score: float
    c: float
    gamma: float

    def __str__(self) -> str:
        return f"{self.score:.1%} with C={self.c:.3g}, gamma={self.gamma:.3g}"


def search_grid(
    executor: fiber.Executor, images: Any, digits: Any, points: int
) -> tuple[Best, GridSearchCV]:
    """Search all combinations of so many values of each parameter, by scikit-learn."""
    values = {"C": np.geomspace(*C, points), "gamma": np.geomspace(*GAMMA, points)}
    grid = GridSearchCV(SVC(), values, cv=3)
    with joblib.parallel_config(backend="fiber", executor=executor, n_jobs=-1):
        grid.fit(images, digits)
    return Best(grid.best_score_, **_lower(grid.best_params_)), grid


def search_by_study(
    executor: fiber.Executor, images: Any, digits: Any, trials: int, workers: int
) -> tuple[Best, optuna.Study]:
    """Try so many trials where earlier ones promise the most; all workers always have one."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    sampler = optuna.samplers.TPESampler(seed=0, constant_liar=True)
    study = optuna.create_study(direction="maximize", sampler=sampler)
    running: dict[Future[float], optuna.Trial] = {}
    for _ in range(trials):
        trial = study.ask()
        parameters = {
            "C": trial.suggest_float("C", *C, log=True),
            "gamma": trial.suggest_float("gamma", *GAMMA, log=True),
        }
        running[executor.submit(evaluate, images, digits, parameters)] = trial
        if len(running) == workers:
            _tell(study, running)
    while running:
        _tell(study, running)
    return Best(study.best_value, **_lower(study.best_params)), study


def evaluate(images: Any, digits: Any, parameters: dict[str, float]) -> float:
    """Return the share of digits that are recognized, by cross-validation."""
    return float(np.mean(cross_val_score(SVC(**parameters), images, digits, cv=3)))


def _tell(study: optuna.Study, running: dict[Future[float], optuna.Trial]) -> None:
    done, _ = wait(running, return_when=FIRST_COMPLETED)
    for future in done:
        study.tell(running.pop(future), future.result())


def _lower(parameters: dict[str, float]) -> dict[str, float]:
    return {name.lower(): float(value) for name, value in parameters.items()}


def _timed(what: str, search: Callable[[], tuple[Best, Any]]) -> Any:
    begin = time.perf_counter()
    best, found = search()
    print(f"{what}: {best}, after {time.perf_counter() - begin:.1f} s")
    return found


def _number(text: str) -> int:
    if (number := int(text)) < 1:
        raise argparse.ArgumentTypeError(f"{number} is less than 1")
    return number


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--workers", type=_number, default=fiber.cpu_count())
    parser.add_argument("--samples", type=_number, default=1000, help="images of digits to use")
    parser.add_argument("--points", type=_number, default=7, help="of each parameter in the grid")
    parser.add_argument("--trials", type=_number, default=40, help="of the study")
    parser.add_argument("--picture", type=Path, help="file for a picture of the scores")
    options = parser.parse_args()
    images, digits = (each[: options.samples] for each in load_digits(return_X_y=True))
    with fiber.Executor(options.workers) as executor:
        grid = _timed(
            f"grid of {options.points} x {options.points}",
            lambda: search_grid(executor, images, digits, options.points),
        )
        study = _timed(
            f"study of {options.trials} trials",
            lambda: search_by_study(executor, images, digits, options.trials, options.workers),
        )
    if options.picture:
        from heatmap import draw

        draw(options.picture, grid, study)


if __name__ == "__main__":
    main()
