"""Libraries that search: print their results, which are the same with Fiber and without."""

from __future__ import annotations

from typing import Any

import joblib
import numpy as np
import optuna
from scipy.optimize import differential_evolution
from sklearn.datasets import load_digits
from sklearn.model_selection import GridSearchCV
from sklearn.svm import SVC

import fiber.joblib

BOUNDS = [(-4.0, 4.0)] * 3
TRIALS, AT_A_TIME = 12, 4


def valley(place: Any) -> float:
    """Rosenbrock's, whose lowest point is at 1, 1, 1."""
    return float(np.sum(100 * (place[1:] - place[:-1] ** 2) ** 2 + (1 - place[:-1]) ** 2))


def height(x: float, y: float) -> float:
    return (x - 2) ** 2 + (y + 1) ** 2


def grid() -> GridSearchCV:
    """Search by joblib, without a hint about where the work is done."""
    images, digits = (each[:200] for each in load_digits(return_X_y=True))
    search = GridSearchCV(SVC(), {"C": [0.01, 1.0, 100.0], "gamma": [1e-4, 1e-3]}, cv=3)
    return search.fit(images, digits)


def evolved(workers: Any) -> tuple[list[float], int]:
    """The lowest point that SciPy finds, and after how many looks."""
    found = differential_evolution(
        valley, BOUNDS, rng=1, maxiter=30, polish=False, updating="deferred", workers=workers
    )
    return found.x.tolist(), int(found.nfev)


def studied(executor: fiber.Executor | None) -> list[float]:
    """Return the values of Optuna's trials, some of which run at a time, all in order."""
    sampler = optuna.samplers.TPESampler(seed=0, constant_liar=True)
    study = optuna.create_study(sampler=sampler)
    for _ in range(TRIALS // AT_A_TIME):
        trials = [study.ask() for _ in range(AT_A_TIME)]
        places = [(t.suggest_float("x", -5, 5), t.suggest_float("y", -5, 5)) for t in trials]
        mapped = (map if executor is None else executor.map)(height, *zip(*places, strict=True))
        for trial, value in zip(trials, mapped, strict=True):
            study.tell(trial, value)
    return [float(trial.value) for trial in study.trials if trial.value is not None]


def main() -> None:
    """Each alone, and then by Fiber."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    alone = grid()
    with joblib.parallel_config(backend="fiber", n_jobs=2):
        by_fiber = grid()
    scores = [each.cv_results_["mean_test_score"].tolist() for each in (alone, by_fiber)]
    assert scores[0] == scores[1]
    print("scikit-learn:", by_fiber.best_params_, *np.round(scores[1], 6))
    with fiber.Executor(2) as executor, fiber.Pool(2) as pool:
        lowest = evolved(1)
        assert evolved(executor.map) == evolved(pool.map) == lowest
        print("SciPy:", *np.round(lowest[0], 6), lowest[1])
        values = studied(executor)
        assert values == studied(None)
        print("Optuna:", *np.round(values, 6))


if __name__ == "__main__":
    main()
