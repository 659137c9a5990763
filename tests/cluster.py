"""A dask scheduler and two workers on loopback, each a process of its own; what they import is paid once, in
the process that they are forked from."""

import asyncio
import multiprocessing
import os
import socket
import time
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path

from distributed import Client, Scheduler, Worker

from pipeline.store import params
from pipeline.store.execution import run_all

FORKED = multiprocessing.get_context("forkserver")
# pyarrow loads pandas with the first array that it makes
FORKED.set_forkserver_preload(
    [
        "distributed",
        "pandas",
        "pipeline.temperature.test_set.evaluation",
        "pipeline.recordings.recording_folders",
        "tests.cluster",
    ]
)


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def serve(scheduler: str, port: int, scratch: Path, environment: dict[str, str]) -> None:
    """A scheduler, or with the address of one a worker, until it is killed."""
    # another folder than the caller's: the workers of a cluster do not share its working directory
    os.chdir(scratch)
    os.environ |= environment

    async def run() -> None:
        here = {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0"}
        # no nanny: a killed worker stays dead
        node = (
            Worker(scheduler, nthreads=1, local_directory=str(scratch), **here)
            if scheduler
            else Scheduler(port=port, **here)
        )
        async with node:
            (scratch / f"{os.getpid()}.ready").touch()
            await node.finished()

    asyncio.run(run())


class Cluster:
    def __init__(self, scratch: Path, workers: int = 2, **environment: str):
        port = free_port()
        self.address, self.scratch = f"tcp://127.0.0.1:{port}", scratch
        self.execution = params.Execution(backend="dask", jobs=2, scheduler=self.address)
        self.scheduler = FORKED.Process(target=serve, args=("", port, scratch, {}))
        self.workers = [
            FORKED.Process(target=serve, args=(self.address, 0, scratch, environment)) for _ in range(workers)
        ]
        for process in (self.scheduler, *self.workers):
            process.start()
            self._wait_for(process)

    def killing(self, victim: BaseProcess) -> Callable:
        """run_all that kills this process of the cluster when the first result is there, with work before
        every worker."""

        def run(calls, execution, **settings):
            for k, result in enumerate(run_all(calls, execution, **settings)):
                if k == 0:
                    with Client(self.address, set_as_default=False) as client:
                        waiting = client.processing()
                    assert len(waiting) == len(self.workers) and all(waiting.values())
                    victim.kill()
                    victim.join()
                yield result

        return run

    def _wait_for(self, process, seconds: float = 120) -> None:
        """A busy machine takes its time."""
        until = time.monotonic() + seconds
        while not (self.scratch / f"{process.pid}.ready").exists():
            assert process.is_alive(), "a process of the cluster has ended"
            assert time.monotonic() < until, "the cluster did not start"
            time.sleep(0.02)

    def stop(self) -> None:
        for process in (*self.workers, self.scheduler):
            process.kill()
            process.join()
