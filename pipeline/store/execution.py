"""Runs work over recordings, seeds and data sets in processes of this machine (loky) or of a dask cluster, by
section `execution` of params.yaml."""

import contextlib
import functools
import importlib.metadata
import os
import pickle
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import joblib
from joblib.externals.loky.process_executor import TerminatedWorkerError

from pipeline.store import artifacts
from pipeline.store.params import Execution
from pipeline.store.pins import PINS

CODE = Path(__file__).resolve().parents[1]
# the packages whose order of summation is fixed by the pins of `run`
PACKAGES = ("numpy", "scipy", "jaxlib", "opencv-python-headless", "pyarrow", "scikit-learn")


def run_all(
    calls: Sequence[tuple[Callable, tuple, dict]], execution: Execution, *, remains: str = ""
) -> Iterator[Any]:
    """Yields the results of calls made with joblib.delayed, in their order, as they become available. Both
    back ends give the same results.

    The workers of a cluster must have the same code, packages and pins, and the same file system, under
    absolute paths. `remains`: what a killed run leaves behind. Raises ValueError if workers are killed
    repeatedly, if one differs from this process, or if there is no cluster.
    """
    if execution.backend == "dask" and calls:
        with _cluster(execution.scheduler, remains) as client:
            from distributed.protocol.pickle import dumps  # of local functions too

            # not by joblib, which keeps an array at one worker and loses it with this worker
            futures = client.map(_there, [*map(dumps, calls)], asked=surroundings(), pure=False)
            futures.reverse()
            while futures:
                yield futures.pop().result()
    elif len(calls) <= 1 or execution.jobs == 1:
        yield from (function(*arguments, **settings) for function, arguments, settings in calls)
    else:
        try:
            yield from joblib.Parallel(n_jobs=execution.jobs, backend="loky", return_as="generator")(calls)
        except TerminatedWorkerError:
            raise ValueError(
                f"params.yaml: execution.jobs: one of {execution.jobs} workers was killed at its work, "
                "as a system does that runs out of memory; "
                f"lower execution.jobs, and run it again{remains}"
            ) from None


# ---- a cluster


class Surroundings(NamedTuple):
    """What the bytes of a result depend on besides its call: SHA-256 of pipeline/, versions of PACKAGES, and
    those of PINS that are set."""

    code: str
    packages: dict[str, str]
    pins: dict[str, str]


@functools.cache
def surroundings() -> Surroundings:
    """Returns the surroundings of this process at the first call, because a worker keeps the code that it has
    imported."""
    packages = {name: importlib.metadata.version(name) for name in PACKAGES}
    pins = {name: os.environ[name] for name in PINS if name in os.environ}
    return Surroundings(artifacts.sha256(CODE), packages, pins)


def _there(call: bytes, asked: Surroundings) -> Any:
    """Returns the result of a pickled call in a worker. Raises ValueError if the worker's surroundings are
    not those `asked`."""
    if others := _differences(asked, surroundings()):
        import distributed

        raise ValueError(
            f"params.yaml: execution.scheduler: the worker {distributed.get_worker().address} has "
            f"{'; '.join(others)}: its results could differ; "
            "start it anew by `./run --group cluster dask worker` of this checkout"
        )
    function, arguments, settings = pickle.loads(call)
    return function(*arguments, **settings)


def _differences(asked: Surroundings, found: Surroundings) -> list[str]:
    """Returns the differences of a worker's surroundings from the required ones."""
    told = ["another pipeline/, or one of before a change"] if asked.code != found.code else []
    for wanted, there in ((asked.packages, found.packages), (asked.pins, found.pins)):
        told += [
            f"{name} {there.get(name, 'not set')}, expected {wanted.get(name, 'not set')}"
            for name in sorted(wanted | there)
            if wanted.get(name) != there.get(name)
        ]
    return told


@contextlib.contextmanager
def _cluster(scheduler: str, remains: str) -> Iterator[Any]:
    """Gives a client of the cluster with this address. Raises ValueError, one sentence, if the cluster
    fails."""
    try:
        import distributed
    except ImportError:
        raise ValueError(
            "params.yaml: execution.backend is dask but dask is not installed; "
            "write ./run --group cluster before the command, as in ./run --group cluster dvc repro, or set "
            "execution.backend: loky"
        ) from None
    with contextlib.ExitStack() as connected:
        try:
            client = connected.enter_context(distributed.Client(scheduler, timeout="20s"))
            client.wait_for_workers(1, timeout=20)
        except (OSError, ValueError) as error:
            raise ValueError(
                f"params.yaml: execution.scheduler: expected a dask scheduler with a worker at {scheduler}, "
                "found none within 20 s "
                f"({' '.join(str(error).split())}); start `./run --group cluster dask scheduler` and "
                f"`./run --group cluster dask worker {scheduler}`, "
                "or set execution.backend: loky"
            ) from None
        try:
            yield client
        except distributed.KilledWorker as error:
            raise ValueError(
                f"params.yaml: execution.scheduler: {error.allowed_failures + 1} workers of {scheduler} died "
                "over the same work; "
                f"give each worker more memory, and run it again{remains}"
            ) from None
        except distributed.CancelledError:
            raise ValueError(
                f"params.yaml: execution.scheduler: the scheduler {scheduler} ended, or could no longer be "
                f"reached; start it and its workers again, and run it again{remains}"
            ) from None
