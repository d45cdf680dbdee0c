"""Libraries that take an executor, a map or joblib's backend, on processes, agents and pods."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import as_completed

import joblib
import numpy as np
import optuna
import pytest
from scipy.optimize import brute, differential_evolution, rosen
from sklearn.datasets import load_digits
from sklearn.ensemble import RandomForestClassifier
from sklearn.model_selection import GridSearchCV
from sklearn.svm import SVC

import fiber.joblib
from examples.run_example import BACKENDS
from fakes.cluster import fake_cluster
from faults.runtime import running
from patience import PATIENCE
from unit.kubernetes_rig import kubeconfig


@pytest.fixture(scope="module", params=[*BACKENDS, "kubernetes"])
def executor(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[fiber.Executor]:
    backend = request.param
    with pytest.MonkeyPatch.context() as patch:
        if backend == "kubernetes":
            cluster = request.getfixturevalue("cluster_url")
            patch.setenv("KUBECONFIG", str(kubeconfig(tmp_path_factory.mktemp("cluster"), cluster)))
        with running(backend=backend), fiber.Executor(2) as executor:
            yield executor


@pytest.fixture(scope="module")
def cluster_url() -> Iterator[str]:
    with fake_cluster() as cluster:
        yield cluster.url


pytestmark = pytest.mark.may_leak("the executor and the cluster, which all tests use")


def test_scikit_learn_fits_and_searches(executor: fiber.Executor) -> None:
    images, digits = (each[:300] for each in load_digits(return_X_y=True))
    grid = GridSearchCV(SVC(), {"C": [0.01, 10.0], "gamma": [1e-3]}, cv=2)
    alone = GridSearchCV(SVC(), {"C": [0.01, 10.0], "gamma": [1e-3]}, cv=2).fit(images, digits)
    with joblib.parallel_config(backend="fiber", executor=executor, n_jobs=2):
        grid.fit(images, digits)
        # It shares memory with its tasks: joblib gives it threads with every backend.
        forest = RandomForestClassifier(20, random_state=0, n_jobs=2).fit(images, digits)
    assert grid.best_params_ == {"C": 10.0, "gamma": 1e-3}
    np.testing.assert_array_equal(
        grid.cv_results_["mean_test_score"], alone.cv_results_["mean_test_score"]
    )
    assert forest.score(images, digits) > 0.9


def test_scipy_runs_its_workers_on_an_executor(executor: fiber.Executor) -> None:
    lowest = brute(rosen, [slice(0, 2, 0.5)] * 2, workers=executor.map, finish=None)
    assert lowest.tolist() == [1.0, 1.0]
    found = differential_evolution(
        rosen, [(0, 2)] * 2, workers=executor.map, updating="deferred", maxiter=4, seed=1
    )
    alone = differential_evolution(rosen, [(0, 2)] * 2, updating="deferred", maxiter=4, seed=1)
    assert found.fun == alone.fun


def test_optuna_runs_its_trials_on_an_executor(executor: fiber.Executor) -> None:
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=1))
    trials = [study.ask() for _ in range(6)]
    points = [[trial.suggest_float(name, 0, 2) for name in "xy"] for trial in trials]
    values = {
        executor.submit(rosen, np.array(point)): trial
        for point, trial in zip(points, trials, strict=True)
    }
    for future in as_completed(values, PATIENCE):
        study.tell(values[future], future.result())
    assert study.best_value == min(rosen(np.array(point)) for point in points)
    assert len(study.trials) == 6
