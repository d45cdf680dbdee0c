"""Programs whose main module starts threads when it is imported, which no fork may copy."""

from __future__ import annotations

import importlib.metadata
import re
import textwrap
from collections.abc import Callable

import pytest

from faults import test_pods
from faults.program import Program

pytestmark = [
    pytest.mark.may_leak("the operator's connections, for as long as the cluster is there"),
    pytest.mark.timeout(180),
]

cluster = test_pods.cluster

# Each kind of program starts threads when it is imported, and needs them to compute a square.
KINDS = {
    "native": """
        import ctypes, os
        libc, thread = ctypes.CDLL(None), ctypes.c_ulong()
        libc.pthread_create(ctypes.byref(thread), None, libc.pause, None)
        libc.pthread_setname_np(thread, b"helper")

        def names():
            for task in os.listdir("/proc/self/task"):
                with open(f"/proc/self/task/{task}/comm") as comm:
                    yield comm.read().strip()

        def square(x): return x * x if "helper" in names() else "the thread is gone"
    """,
    "jax": """
        import jax, jax.numpy as jnp
        ONES = jnp.ones((8, 8))
        mean = jax.jit(lambda x: (ONES @ x).mean() / 8)

        def square(x): return float(mean(jnp.full((8,), float(x * x))))
    """,
    "openmp": """
        import os
        os.environ["OMP_NUM_THREADS"] = "2"
        from sklearn.cluster import KMeans
        POINTS = np.arange(4000.0).reshape(-1, 2)

        def clusters(): return len(KMeans(4, n_init=1).fit(POINTS).cluster_centers_)
        clusters()

        def square(x): return x * x * clusters() // 4
    """,
    "torch": """
        import torch
        torch.set_num_threads(2)
        ONES = torch.ones(1024, 1024)

        def mean(): return float((ONES @ ONES).mean() / 1024)
        mean()

        def square(x): return x * x * mean()
    """,
}
NAMES = {"native": "helper", "jax": "tf_XLAEigen"}

IMPORTS = """
    import fiber, fiber.joblib, fiber.vector, gymnasium, joblib, numpy as np
    from fiber.managers import BaseManager
"""
USE = """
    class Squares:
        def get(self, x): return square(x)

    class Manager(BaseManager): pass

    Manager.register("Squares", Squares)

    class Env(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(0, 100, (), np.float64)
        action_space = gymnasium.spaces.Discrete(10)
        def reset(self, *, seed=None, options=None): return np.float64(0), {}
        def step(self, action): return np.float64(square(int(action))), 0.0, False, False, {}

    def put(queue): queue.put(square(3))

    if __name__ == "__main__":
        with fiber.Pool(2) as pool:
            print("pool", pool.map(square, range(4)) == [0, 1, 4, 9], flush=True)
        queue = fiber.SimpleQueue()
        process = fiber.Process(target=put, args=(queue,))
        process.start()
        print("process", queue.get() == 9, flush=True)
        process.join()
        with Manager() as manager:
            print("manager", manager.Squares().get(3) == 9, flush=True)
        with fiber.Executor(2) as executor:
            print("executor", executor.submit(square, 3).result() == 9, flush=True)
        env = fiber.vector.VectorEnv([Env] * 2)
        env.reset()
        print("vector", env.step([2, 3])[0].tolist() == [4, 9], flush=True)
        env.close()
        with joblib.parallel_config(backend="fiber", n_jobs=2):
            squares = joblib.Parallel()(joblib.delayed(square)(x) for x in (2, 3))
        print("joblib", squares == [4, 9], flush=True)
"""
GOOD = [f"{name} True" for name in ("pool", "process", "manager", "executor", "vector", "joblib")]


def written(kind: str) -> str:
    """The program of that kind."""
    return "".join(map(textwrap.dedent, (IMPORTS, KINDS[kind], USE)))


def is_installed(package: str) -> bool:
    try:
        return bool(importlib.metadata.version(package))
    except importlib.metadata.PackageNotFoundError:
        return False


CASES = [
    pytest.param(
        kind,
        backend,
        marks=pytest.mark.skipif(
            kind in ("jax", "torch") and not is_installed(kind), reason=f"{kind} is not installed"
        ),
    )
    for kind, backend in [
        *(("native", backend) for backend in ("local", "kubernetes")),
        *(("jax", backend) for backend in ("local", "loopback", "kubernetes")),
        ("openmp", "local"),
        ("torch", "local"),
    ]
]


@pytest.mark.parametrize(("kind", "backend"), CASES)
def test_programs_whose_imports_start_threads_work(
    launch: Callable[..., Program], request: pytest.FixtureRequest, kind: str, backend: str
) -> None:
    if backend == "kubernetes":
        request.getfixturevalue("cluster")  # this fixture sets KUBECONFIG
    program = launch(written(kind), env={"FIBER_BACKEND": backend, "FIBER_AGENTS": "1"})
    assert [program.line() for _ in GOOD] == GOOD
    assert program.wait() == 0
    if backend == "local" and kind in NAMES:
        told = rf"fiber: importing {program.script} starts threads \([^)]*{NAMES[kind]}"
        assert len(re.findall(told, program.stderr)) == 1, program.stderr


def test_libraries_that_end_their_threads_before_a_fork_need_no_second_zygote(
    launch: Callable[..., Program],
) -> None:
    program = launch("""
        import os
        os.environ["OPENBLAS_NUM_THREADS"] = "2"
        import numpy as np, fiber
        ONES = np.ones((512, 512)) @ np.ones((512, 512))
        with open("imports", "a") as log: log.write(".")
        def square(x): return x * x * float((ONES @ ONES).mean()) / 512 ** 3
        if __name__ == "__main__":
            with fiber.Pool(3) as pool: print(pool.map(square, range(3), 1), flush=True)
            print(open("imports").read())
    """)
    assert program.line() == "[0.0, 1.0, 4.0]"
    assert program.line() == "..", "the program and the zygote import the main module"
    assert program.finish() == ""
    assert program.stderr == ""
