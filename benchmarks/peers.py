"""Contenders with one interface: each adapter does what measures ask for with its library's calls.

`chunksize` None means the library's default. If a library has no such call, the adapter names and
uses its closest natural one. Libraries are imported by name, since hardly any has types to check
against and most are not installed where types are checked.
"""

from __future__ import annotations

import abc
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent import futures
from importlib import import_module
from typing import Any

from benchmarks.model import WORKERS

Function = Callable[[Any], Any]


class Adapter(abc.ABC):
    """Pool of so many workers, which its constructor starts."""

    @abc.abstractmethod
    def map(self, function: Function, items: Sequence[Any], chunksize: int | None) -> Sequence[Any]:
        """Return all results, in order."""

    @abc.abstractmethod
    def apply(self, function: Function, item: Any) -> object:
        """Make one call and wait for its result."""

    @abc.abstractmethod
    def close(self) -> None:
        """Stop the workers and wait until they are gone."""

    def stream(self, function: Function, items: Sequence[Any], chunksize: int) -> Iterable[Any]:
        """Yield results as they come, in any order."""
        raise NotImplementedError(f"{type(self).__name__} has no results in any order")

    def submit(self, function: Function, items: Sequence[Any]) -> list[Any]:
        """Make one asynchronous call for each item, and then return all results."""
        raise NotImplementedError(f"{type(self).__name__} has no asynchronous calls")


class PoolAdapter(Adapter):
    """multiprocessing's Pool and those with its methods: Fiber's, Ray's."""

    def __init__(self, pool: Any) -> None:
        self.pool = pool

    def map(self, function: Function, items: Sequence[Any], chunksize: int | None) -> Sequence[Any]:
        return list(self.pool.map(function, items, chunksize))

    def stream(self, function: Function, items: Sequence[Any], chunksize: int) -> Iterable[Any]:
        results: Iterable[Any] = self.pool.imap_unordered(function, items, chunksize)
        return results

    def submit(self, function: Function, items: Sequence[Any]) -> list[Any]:
        return [each.get() for each in [self.pool.apply_async(function, (item,)) for item in items]]

    def apply(self, function: Function, item: Any) -> object:
        return self.pool.apply(function, (item,))

    def close(self) -> None:
        self.pool.terminate()
        self.pool.join()


def ray(workers: int) -> Any:
    """Ray, with a cluster of so many processors in this program unless it has one already."""
    module = import_module("ray")
    if not module.is_initialized():
        module.init(
            num_cpus=workers,
            include_dashboard=False,
            logging_level="ERROR",
            log_to_driver=False,
            _temp_dir=os.path.join(os.environ["TMPDIR"], "ray"),
        )
    return module


class Ray(PoolAdapter):
    """Ray's replacement for multiprocessing.Pool, on a separate Ray."""

    def __init__(self, workers: int) -> None:
        self.ray = ray(workers)
        super().__init__(import_module("ray.util.multiprocessing").Pool(workers))

    def close(self) -> None:
        super().close()
        self.ray.shutdown()


class Futures(Adapter):
    """concurrent.futures' executor and those with its methods: the default chunk is one item."""

    def __init__(self, executor: futures.Executor) -> None:
        self.executor = executor

    def map(self, function: Function, items: Sequence[Any], chunksize: int | None) -> Sequence[Any]:
        return list(self.executor.map(function, items, chunksize=chunksize or 1))

    def stream(self, function: Function, items: Sequence[Any], chunksize: int) -> Iterator[Any]:
        for future in futures.as_completed(
            [self.executor.submit(function, item) for item in items]
        ):
            yield future.result()

    def submit(self, function: Function, items: Sequence[Any]) -> list[Any]:
        return [each.result() for each in [self.executor.submit(function, item) for item in items]]

    def apply(self, function: Function, item: Any) -> object:
        return self.executor.submit(function, item).result()

    def close(self) -> None:
        self.executor.shutdown()


def fiber_executor(workers: int) -> Futures:
    """fiber.Executor."""
    return Futures(import_module("fiber").Executor(workers))


class Joblib(Adapter):
    """joblib.Parallel on loky's executor or another: its default chunk is batch_size="auto"."""

    def __init__(
        self, workers: int, executor: Any, backend: Any, close: Callable[[], object]
    ) -> None:
        self.workers = workers
        self.joblib = import_module("joblib")
        self.executor = executor
        self.backend = backend
        self._close = close

    def map(self, function: Function, items: Sequence[Any], chunksize: int | None) -> Sequence[Any]:
        return list(self._parallel(function, items, chunksize or "auto", "list"))

    def stream(self, function: Function, items: Sequence[Any], chunksize: int) -> Iterable[Any]:
        return self._parallel(function, items, chunksize, "generator_unordered")

    def submit(self, function: Function, items: Sequence[Any]) -> list[Any]:
        return [each.result() for each in [self.executor.submit(function, item) for item in items]]

    def apply(self, function: Function, item: Any) -> object:
        return self.executor.submit(function, item).result()

    def close(self) -> None:
        self._close()

    def _parallel(
        self, function: Function, items: Sequence[Any], batch: int | str, kind: str
    ) -> Iterable[Any]:
        # By the context, because nothing else knows the name "dask".
        with self.joblib.parallel_config(self.backend, n_jobs=self.workers):
            parallel = self.joblib.Parallel(batch_size=batch, return_as=kind)
        call = self.joblib.delayed(function)
        results: Iterable[Any] = parallel(call(item) for item in items)
        return results


def joblib_on_loky(workers: int) -> Joblib:
    """Make a loop with the executor that joblib.Parallel gets too."""
    executor = import_module("joblib.executor").get_memmapping_executor(workers)
    return Joblib(workers, executor, "loky", executor.shutdown)


def joblib_on_fiber(workers: int) -> Joblib:
    """Make a loop with an executor of Fiber's."""
    executor = import_module("fiber").Executor(workers)
    backend = import_module("fiber.joblib").FiberBackend(executor=executor)
    return Joblib(workers, executor, backend, executor.shutdown)


def joblib_on_dask(workers: int) -> Joblib:
    """Make a loop with a cluster of Dask's, which joblib finds by itself."""
    dask = Dask(workers)
    return Joblib(workers, dask.client.get_executor(), "dask", dask.close)


class Dask(Adapter):
    """dask.distributed with one thread a worker.

    Unchunked is Client.map, which has no chunks; default chunks are those of a dask.bag.
    """

    def __init__(self, workers: int) -> None:
        self.distributed = import_module("distributed")
        self.cluster = self.distributed.LocalCluster(
            n_workers=workers, threads_per_worker=1, dashboard_address=None
        )
        self.client = self.distributed.Client(self.cluster)

    def map(self, function: Function, items: Sequence[Any], chunksize: int | None) -> Sequence[Any]:
        if chunksize is None:
            bag = import_module("dask.bag").from_sequence(items)
            return list(bag.map(function).compute(scheduler=self.client))
        return list(self.client.gather(self.client.map(function, items, pure=False)))

    def stream(self, function: Function, items: Sequence[Any], chunksize: int) -> Iterator[Any]:
        tasks = self.client.map(function, items, pure=False)
        for _, result in self.distributed.as_completed(tasks, with_results=True):
            yield result

    def submit(self, function: Function, items: Sequence[Any]) -> list[Any]:
        tasks = [self.client.submit(function, item, pure=False) for item in items]
        return list(self.client.gather(tasks))

    def apply(self, function: Function, item: Any) -> object:
        return self.client.submit(function, item, pure=False).result()

    def close(self) -> None:
        self.client.close()
        self.cluster.close()


class IPyParallel(Adapter):
    """ipyparallel.

    Unchunked is the load-balanced view; default chunks are the direct view's, one for each
    engine.
    """

    def __init__(self, workers: int) -> None:
        self.cluster = import_module("ipyparallel").Cluster(n=workers, log_level=40)
        self.client = self.cluster.start_and_connect_sync(activate=False)
        self.balanced = self.client.load_balanced_view()
        self.direct = self.client[:]

    def map(self, function: Function, items: Sequence[Any], chunksize: int | None) -> Sequence[Any]:
        if chunksize is None:
            return list(self.direct.map_sync(function, items))
        return list(self.balanced.map_sync(function, items, chunksize=chunksize))

    def stream(self, function: Function, items: Sequence[Any], chunksize: int) -> Iterable[Any]:
        results: Iterable[Any] = self.balanced.map_async(
            function, items, chunksize=chunksize, ordered=False
        )
        return results

    def submit(self, function: Function, items: Sequence[Any]) -> list[Any]:
        return [
            each.get() for each in [self.balanced.apply_async(function, item) for item in items]
        ]

    def apply(self, function: Function, item: Any) -> object:
        return self.balanced.apply_sync(function, item)

    def close(self) -> None:
        self.client.close()
        self.cluster.stop_cluster_sync()


class Spark(Adapter):
    """PySpark with local[5].

    Unchunked is one partition an item, the default one partition a worker, apply a job of one
    task.
    """

    def __init__(self, workers: int) -> None:
        spark = import_module("pyspark")
        scratch = os.environ["TMPDIR"]
        conf = spark.SparkConf().setMaster(f"local[{workers}]").setAppName("benchmarks")
        for key, value in {
            "spark.ui.enabled": "false",
            "spark.ui.showConsoleProgress": "false",
            "spark.log.level": "ERROR",
            "spark.local.dir": scratch,
            "spark.driver.host": "127.0.0.1",
            "spark.driver.bindAddress": "127.0.0.1",
            "spark.driver.extraJavaOptions": f"-Djava.io.tmpdir={scratch} -XX:-UsePerfData",
        }.items():
            conf.set(key, value)
        self.context = spark.SparkContext(conf=conf)

    def map(self, function: Function, items: Sequence[Any], chunksize: int | None) -> Sequence[Any]:
        partitions = None if chunksize is None else max(1, len(items) // chunksize)
        return list(self.context.parallelize(items, partitions).map(function).collect())

    def apply(self, function: Function, item: Any) -> object:
        return self.context.parallelize([item], 1).map(function).collect()[0]

    def close(self) -> None:
        self.context.stop()


def processes_of(contender: str) -> Any:
    """Namespace with Process, Pipe and Pool: a context of multiprocessing, or the module fiber."""
    if contender.startswith("fiber"):
        return import_module("fiber")
    multiprocessing = import_module("multiprocessing")
    return multiprocessing.get_context("forkserver" if contender == "forkserver" else "fork")


_ADAPTERS: dict[str, Callable[[int], Adapter]] = {
    "concurrent.futures": lambda workers: Futures(futures.ProcessPoolExecutor(workers)),
    "fiber-executor": fiber_executor,
    "fiber-executor-loopback": fiber_executor,
    "fiber-executor-kubernetes": fiber_executor,
    "loky": lambda workers: Futures(
        import_module("joblib.externals.loky").ProcessPoolExecutor(workers)
    ),
    "fiber-joblib": joblib_on_fiber,
    "joblib": joblib_on_loky,
    "joblib-dask": joblib_on_dask,
    "dask": Dask,
    "ipyparallel": IPyParallel,
    "ray": Ray,
    "spark": Spark,
}


def start(contender: str, workers: int = WORKERS, *, lazily: bool = False) -> Adapter:
    """Return the contender's pool with workers started, or `lazily`: Fiber's pods start by the
    first task."""
    if make := _ADAPTERS.get(contender):
        return make(workers)
    pool = processes_of(contender).Pool(workers)
    if contender.startswith("fiber") and not lazily:
        pool.start_workers()
        pool.wait_until_workers_up()
    return PoolAdapter(pool)
