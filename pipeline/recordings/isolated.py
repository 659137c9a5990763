"""Reads an unknown file in a warm child process, within a budget of time and memory.

A child serves one call after the other, each in the folder of its caller. A call that exceeds its budget, or
ends the process, fails alone, because the next one gets a fresh child. Calls are sent to the child pickled,
because they are our own. Results come back as JSON, so that nothing a file did to the child runs here.
"""

import contextlib
import json
import os
import pickle
import signal
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any, NamedTuple

if sys.platform != "win32":
    import resource

ROOT = Path(__file__).parents[2]
_LENGTH = struct.Struct("<Q")
# a child that still holds this much after a call is replaced, so the next call has its whole budget
KEPT_MB = 256
# the last words of C++, Python and Arrow if they get no memory; Arrow then ends the process
OUT_OF_MEMORY = ("bad_alloc", "MemoryError", "Out of memory", "memory allocation of")
# the child's own code; -P: a folder `pipeline` in the working directory is not ours
_SERVE = "from pipeline.recordings.isolated import serve; serve()"


class Budget(NamedTuple):
    """The limits for one file: seconds of wall-clock time, and megabytes beyond what the child itself
    needs."""

    longest_s: float
    largest_mb: float


class Child(NamedTuple):
    """A warm process, and the file that receives what it prints."""

    process: subprocess.Popen
    printed: IO[bytes]


# children that wait for work; append and pop are atomic, so that threads share them
_waiting: list[Child] = []


def isolated(work: Callable[..., Any], *arguments: Any, shown: str | Path, budget: Budget) -> Any:
    """Returns work(*arguments), computed in a child, as far as JSON can hold it. `work` is a function of a
    module.

    Raises ValueError and OSError as `work` does. Raises ValueError with a sentence about the file `shown` if
    the call takes longer or needs more memory than its budget, or ends the process.
    """
    child = _take()
    call = pickle.dumps((os.getcwd(), budget, work, arguments))
    reply: dict[str, Any] = {}
    try:
        pipe_in, pipe_out = child.process.stdin, child.process.stdout
        assert pipe_in is not None and pipe_out is not None
        with contextlib.suppress(BrokenPipeError):
            pipe_in.write(_LENGTH.pack(len(call)) + call)
            pipe_in.flush()
        head = pipe_out.read(_LENGTH.size)
        if len(head) == _LENGTH.size:
            body = pipe_out.read(_LENGTH.unpack(head)[0])
            reply = json.loads(body)
    except ValueError:
        reply = {}
    finally:
        # also if a person stops the run, so that no working child remains
        ended = (0, "")
        if reply.get("ready"):
            _waiting.append(child)
        else:
            ended = _end(child)
    if "result" in reply:
        return reply["result"]
    if "refused" in reply:
        raise ValueError(reply["refused"])
    if "failed" in reply:
        raise OSError(reply["failed"])
    raise ValueError(f"{shown}: {_sentence(budget, 'memory' in reply, *ended)}")


def _take() -> Child:
    """Returns a waiting child, or a new one."""
    while _waiting:
        child = _waiting.pop()
        if child.process.poll() is None:
            return child
    printed = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the child
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")]))
    process = subprocess.Popen(
        [sys.executable, "-P", "-c", _SERVE],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=printed,
        # Arrow's own allocator takes a GiB at once, of which most is never used
        env=os.environ | {"PYTHONPATH": path, "ARROW_DEFAULT_MEMORY_POOL": "system"},
    )
    return Child(process, printed)


def _end(child: Child) -> tuple[int, str]:
    """Ends a child. Returns its exit status, and the last line that it printed."""
    with contextlib.suppress(subprocess.TimeoutExpired):
        # a child that ended by itself closes its pipes a moment before wait() returns
        child.process.wait(timeout=1)
    child.process.kill()
    with contextlib.suppress(BrokenPipeError), child.process as process:
        process.wait()
    with child.printed as printed:
        end = printed.seek(0, os.SEEK_END)
        printed.seek(max(0, end - 2000))
        lines = printed.read().decode(errors="replace").split("\n")
    return child.process.returncode, next((line.strip() for line in reversed(lines) if line.strip()), "")


# ---- the sentences


def _sentence(budget: Budget, no_memory: bool, status: int, last: str) -> str:
    """Returns why a call gave no result: the first reason that holds."""
    how = signal.Signals(-status).name if status < 0 else last[:200] or f"exit status {status}"
    reasons = (
        (
            status == -signal.SIGALRM,
            f"reading it takes longer than the {budget.longest_s:g} s that a recording may take; "
            "split the recording, or raise ingest.longest_s in params.expert.yaml if it is as long as that",
        ),
        (
            no_memory or any(words in last for words in OUT_OF_MEMORY),
            f"reading it needs more memory than the {budget.largest_mb:g} MB that a recording may "
            "take; split the recording, or raise ingest.largest_mb in params.expert.yaml if it is as large "
            "as that",
        ),
        (
            status == -signal.SIGKILL,
            "the process that read it was killed, as a system does that runs out of memory; "
            "lower execution.jobs or ingest.largest_mb, and run it again",
        ),
        (
            True,
            f"reading it ended the process that read it ({how}); "
            "copy the recording again, and report it with the file if that does not help",
        ),
    )
    return next(sentence for holds, sentence in reasons if holds)


# ---- in the child


def serve() -> None:
    """Answers the calls on standard input until it is closed, or until the child must be replaced."""
    calls, replies = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints is no reply
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    ready = True
    while ready and len(head := calls.read(_LENGTH.size)) == _LENGTH.size:
        folder, budget, work, arguments = pickle.loads(calls.read(_LENGTH.unpack(head)[0]))
        os.chdir(folder)
        ready = _answer(replies, budget, work, arguments)


def _answer(replies: IO[bytes], budget: Budget, work: Callable[..., Any], arguments: tuple) -> bool:
    """Replies with the result of one call. Returns False if the child ran out of memory or keeps much of it,
    so that the next call needs another child."""
    base, reply = _data_mb(), {}
    _limit_memory(base + budget.largest_mb)
    signal.setitimer(signal.ITIMER_REAL, budget.longest_s)
    try:
        reply = {"result": work(*arguments)}
    except MemoryError:
        reply = {"memory": True}
    except ValueError as error:
        reply = {"refused": str(error)}
    except OSError as error:
        reply = {"failed": str(error)}
    signal.setitimer(signal.ITIMER_REAL, 0)
    _limit_memory(None)
    ready = "memory" not in reply and _data_mb() <= base + KEPT_MB
    content = json.dumps(reply | {"ready": ready}).encode()
    replies.write(_LENGTH.pack(len(content)) + content)
    replies.flush()
    return ready


def _limit_memory(largest_mb: float | None) -> None:
    hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
    limit = hard if largest_mb is None else int(largest_mb * 2**20)
    if hard != resource.RLIM_INFINITY:
        limit = min(limit, hard)
    resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))


def _data_mb() -> float:
    """Returns the private memory of this process in MB; 0 on a system that does not report it."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[5])
    except OSError:
        return 0.0
    return pages * resource.getpagesize() / 2**20
