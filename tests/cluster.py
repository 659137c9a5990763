"""A dask scheduler and two workers on loopback, each a process of its own; what they import is paid once, in
the process that they are forked from."""

import asyncio
import multiprocessing
import os
import socket
import time
from pathlib import Path

FORKED = multiprocessing.get_context("forkserver")
# pyarrow loads pandas with the first array that it makes
FORKED.set_forkserver_preload(
    ["distributed", "pandas", "pipeline.temperature.workflow.ingest", "tests.cluster"]
)


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def serve(scheduler: str, port: int, scratch: Path) -> None:
    """A scheduler, or with the address of one a worker, until it is killed."""
    # another folder than the caller's: the workers of a cluster do not share its working directory
    os.chdir(scratch)

    async def run() -> None:
        from distributed import Scheduler, Worker

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
    def __init__(self, scratch: Path):
        port = free_port()
        self.address, self.scratch = f"tcp://127.0.0.1:{port}", scratch
        self.scheduler = FORKED.Process(target=serve, args=("", port, scratch))
        self.workers = [FORKED.Process(target=serve, args=(self.address, 0, scratch)) for _ in range(2)]
        for process in (self.scheduler, *self.workers):
            process.start()
            self._wait_for(process)

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
