"""Work over recordings, seeds and data sets -> processes of this machine (loky) or of a dask cluster, by
section `execution` of params.yaml."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import joblib
from joblib.externals.loky.process_executor import TerminatedWorkerError

from pipeline.store.params import Execution


def run_all(
    calls: Sequence[tuple[Callable, tuple, dict]], execution: Execution, *, remains: str = ""
) -> Iterator[Any]:
    """The results of calls made with joblib.delayed, in their order, as they come. Both back ends give the
    same results.

    The workers of a cluster have the same code and the same file system, under absolute paths. `remains` says
    what a killed run leaves behind. Raises ValueError if a worker is killed, or if there is no cluster.
    """
    if execution.backend == "dask" and calls:
        with _cluster(execution.scheduler, remains):
            # only a configuration loads joblib's back end for dask
            with joblib.parallel_config(backend="dask"):
                parallel = joblib.Parallel(return_as="generator")
            yield from parallel(calls)
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


@contextlib.contextmanager
def _cluster(scheduler: str, remains: str) -> Iterator[None]:
    """joblib's back end `dask` is the cluster of this address. A failure of the cluster is one sentence."""
    try:
        import distributed
    except ImportError:
        raise ValueError(
            "params.yaml: execution.backend is dask but dask is not installed; "
            "run with ./run --group cluster, or set execution.backend: loky"
        ) from None
    with contextlib.ExitStack() as connected:
        try:
            connected.enter_context(distributed.Client(scheduler, timeout="20s")).wait_for_workers(
                1, timeout=20
            )
        except (OSError, ValueError) as error:
            raise ValueError(
                f"params.yaml: execution.scheduler: expected a dask scheduler with a worker at {scheduler}, "
                "found none within 20 s "
                f"({' '.join(str(error).split())}); start `dask scheduler` and `dask worker {scheduler}`, "
                "or set execution.backend: loky"
            ) from None
        try:
            yield
        except distributed.KilledWorker as error:
            raise ValueError(
                f"params.yaml: execution.scheduler: {error.allowed_failures + 1} workers of {scheduler} died "
                "over the same work; "
                f"give each worker more memory, and run it again{remains}"
            ) from None
