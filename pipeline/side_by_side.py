"""The loops of a first `dvc repro` side by side, each in a DVC of its own: they share no file before certify,
and none of them keeps two cores busy. Only the standard library is imported."""

import ctypes
import os
import re
import selectors
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

# of each loop the stages whose results no other of its stages reads; what stands before them runs with them
ENDS = {
    "temperature": ("generate_probing", "evaluate_temperature"),
    "deposition": ("compose_parts",),
    "setpoint": ("evaluate_setpoint",),
}
# all three at once take 2.6 GB, one after another 1.6
NEEDED_KB = 4_000_000
CURSOR_UP = "\x1b[A"  # between nested progress bars
# what DVC says at the end of every run
HINTS = ("To track the changes", "To enable auto staging", "Use `dvc push`", "\tgit add", "\tdvc config")


def new_loops(
    loops: Mapping[str, bool], datasets: Path, memory: Path = Path("/proc/meminfo")
) -> dict[str, Sequence[str]]:
    """The ends of the loops that are on and have no result yet; of loops that have some, only DVC can tell
    what is new. None on one core, or if less memory is free than the loops need at once."""
    free = re.search(r"MemAvailable: +(\d+) kB", memory.read_text()) if memory.exists() else None
    if os.cpu_count() == 1 or (free and int(free[1]) < NEEDED_KB):
        return {}
    return {
        loop: ends
        for loop, ends in ENDS.items()
        if loops.get(loop) and not any((datasets / end).exists() for end in ends)
    }


def run_loops(ends: Mapping[str, Sequence[str]], dvc: Sequence[str]) -> int:
    """Runs `*dvc --wait-for-lock repro STAGE...` for each loop; every line that it prints begins with the
    loop's name. The highest exit status; a loop that fails stops no other, and an interrupt is handed on to
    all of them."""
    started = {
        loop: subprocess.Popen(
            [*dvc, "--wait-for-lock", "repro", *stages],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
            preexec_fn=_end_with_parent,
        )
        for loop, stages in ends.items()
    }
    with selectors.DefaultSelector() as pipes:
        for loop, process in started.items():
            for pipe, stream in ((process.stdout, sys.stdout), (process.stderr, sys.stderr)):
                if pipe is not None:
                    pipes.register(pipe, selectors.EVENT_READ, (loop, stream, bytearray()))
        while pipes.get_map():
            try:
                _forward(pipes)
            except KeyboardInterrupt:
                for process in started.values():
                    with suppress(ProcessLookupError):
                        os.killpg(process.pid, signal.SIGINT)
    statuses = {loop: process.wait() for loop, process in started.items()}
    failed = {loop: status if status > 0 else 128 - status for loop, status in statuses.items() if status}
    for loop, status in failed.items():
        print(f"run: {loop} ended with status {status}, see its lines above", file=sys.stderr)
    return max(failed.values(), default=0)


def _forward(pipes: selectors.BaseSelector) -> None:
    """Prints the whole lines that have come; of a progress bar its last state."""
    for key, _ in pipes.select():
        loop, stream, left = key.data
        part = os.read(key.fd, 1 << 16)
        left += part
        if not part:
            pipes.unregister(key.fileobj)
            left += b"\n"
        *lines, rest = left.split(b"\n")
        left[:] = rest.rpartition(b"\r")[2]
        for line in lines:
            text = line.decode(errors="replace").rstrip("\r").rpartition("\r")[2].replace(CURSOR_UP, "")
            if text.strip() and not text.startswith(HINTS):
                print(f"{loop}: {text}", file=stream, flush=True)


def _end_with_parent() -> None:
    """Asks Linux to kill this process if its parent is killed, so that no DVC stays that holds the locks."""
    if sys.platform == "linux":
        PR_SET_PDEATHSIG = 1
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
