"""`beadline shadow`: watches a printer's camera, decides every window as the deployed controller would, and
writes down what it would do and why. It sends nothing: nothing here opens a connection but to read
pictures."""

import contextlib
import signal
import sys
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from pipeline.commands.shadow.decide import DeployedLoop, Mind, ShadowDecision, WatchOptions
from pipeline.commands.shadow.decision_log import DecisionLog
from pipeline.commands.shadow.page import ENDED, render
from pipeline.commands.shadow.windows import GAP_S, FrameWindows
from pipeline.recordings.watch_sources import FrameSource, RecordingSource, Snapshots
from pipeline.setpoint.simulation.actuation import ACTS
from pipeline.store import artifacts
from pipeline.store.printable import counted, printable

# with --once, a recording without footer has ended where nothing came for so long
SILENT_S = 5.0
# with --once, a source that is not there is waited for so long
IN_VAIN_S = 30.0
# the page is written at least so often; decisions it lists
PAGE_S, LISTED = 2.0, 30


class Watched(NamedTuple):
    """What a watch saw: frames, decisions, how many of them would have changed a setpoint and how many were
    held, and the files; if there was no window, why; if no frame could be read, why the last could not."""

    frames: int
    decisions: int
    changes: int
    held: int
    page: Path
    log: Path
    why: str = ""
    unreadable: str = ""


def watch(
    source: FrameSource,
    deployed: DeployedLoop,
    asked: WatchOptions,
    out: Path,
    *,
    place: str,
    stopped: Callable[[], bool],
) -> Watched:
    """Watches until `stopped`, or with asked.once until the source ends; `place` is its name as shown.

    The page and the decisions stand in `out`; if no frame could be read, `out` is as it was before. Raises
    OSError if not even the first page can be written.
    """
    earlier = {path: path.read_bytes() for path in out.glob("index.html")} if out.is_dir() else None
    about = {"source": place, "controller": deployed.name, "sent": "nothing"}
    log, windows, mind = (
        DecisionLog(out, about),
        FrameWindows(deployed.window, deployed.settle_s),
        Mind(deployed),
    )
    page, frames, readable, first = out / "index.html", 0, 0, log.path
    changes, held, broken = 0, 0, ""
    decisions: list[ShadowDecision] = []

    def show(state: str, notes: list[str]) -> float:
        return _write_page(page, render(place, deployed, decisions, state, notes, log.trouble))

    artifacts.write_text(page, render(place, deployed, [], "The watch begins.", [], ""))
    shown_at = came_at = there_at = time.monotonic()
    remarks = 0
    while not stopped():
        came = False
        for shown in source.frames():
            came, frames, came_at = True, frames + 1, time.monotonic()
            if isinstance(shown.frame, str):
                broken = f"; {shown.name}: {shown.frame}"
            else:
                readable += 1
            full = windows.add(shown)
            if full is not None:
                notes, remarks = windows.taken_notes() + _damage(source)[remarks:], len(_damage(source))
                decision = mind.decide(full, asked, windows.first_s, notes)
                changes += bool(decision.would.any())
                held += bool(decision.judged.reason[0] != ACTS)
                # of those before, the page shows no pictures
                decisions = [*(one._replace(pictures=[]) for one in decisions[1 - LISTED :]), decision]
                log.add(_log_time(full[-1].time_s), decision.row)
                shown_at = show("", notes)
            if stopped():
                break
        silent = time.monotonic() - came_at
        there_at = time.monotonic() if source.waits_for else there_at
        quiet = silent if source.waits_for else time.monotonic() - max(came_at, there_at)
        if asked.once and _has_ended(source, came, quiet, len(decisions)):
            break
        if time.monotonic() - shown_at > PAGE_S:
            log.write_down()
            waits = f"No frame came for {silent:.0f} s." if silent > GAP_S else ""
            waits = f"Waiting: {source.waits_for}." if source.waits_for else waits
            shown_at = show(waits, windows.notes)
        _rest(source.rest_s, stopped)
    log.write_down()
    show(ENDED, windows.notes)
    if log.trouble:
        raise OSError(log.trouble)
    why = f"expected {counted(deployed.window, 'frame')} in a row at one flow{broken}"
    why = why if frames else source.waits_for or f"it lacks {source.lacks}"
    unreadable = "" if readable else broken.removeprefix("; ")
    if unreadable:
        _put_back(out, [page, *log.written], earlier)
    return Watched(frames, mind.number, changes, held, page, first, why, unreadable)


def _put_back(out: Path, written: Sequence[Path], earlier: Mapping[Path, bytes] | None) -> None:
    """Leaves nothing of a watch in `out`; `earlier` are its files of before that were written over, None if
    there was no such folder."""
    for path in written:
        path.unlink(missing_ok=True)
    for path, content in (earlier or {}).items():
        artifacts.write_bytes(path, content)
    if earlier is None:
        with contextlib.suppress(OSError):  # somebody has put a file there meanwhile
            out.rmdir()


def summary_lines(watched: Watched, place: str) -> str:
    """What the command prints at its end."""
    frames = counted(watched.frames, "frame")
    if not watched.decisions:
        why = printable(watched.why)
        return f"{place}: {frames}, no window of them: {why}; nothing was sent\nwritten: {watched.page}"
    return (
        f"{place}: {frames}, {counted(watched.decisions, 'decision')}: {watched.changes} would have changed "
        f"a setpoint, {watched.held} held; nothing was sent\nwritten: {watched.page}, {watched.log}"
    )


def _rest(seconds: float, stopped: Callable[[], bool]) -> None:
    """Waits; what ends the watch ends the wait within a fifth of a second."""
    until = time.monotonic() + seconds
    while (left := until - time.monotonic()) > 0 and not stopped():
        time.sleep(min(left, 0.2))


def _has_ended(source: FrameSource, came: bool, quiet_s: float, decisions: int) -> bool:
    """Whether a source that is looked at once has no more: nothing came for quiet_s since its last frame or
    since it is there. A camera that never ends has shown a window.

    Raises OSError if it was waited for in vain.
    """
    if isinstance(source, Snapshots) and decisions:
        return True
    if source.waits_for and quiet_s > IN_VAIN_S:
        raise OSError(f"{source.waits_for}; start the camera first, or watch without --once")
    return not came and not source.waits_for and (source.ended or quiet_s > SILENT_S)


def _damage(source: FrameSource) -> list[str]:
    """What a recording's reader has remarked."""
    return source.damage if isinstance(source, RecordingSource) else []


def _log_time(time_s: float) -> int:
    """ns of an MCAP file, which counts from 0 and in 64 bits."""
    return min(max(round(time_s * 1e9), 0), 2**63 - 1)


def _write_page(page: Path, text: str) -> float:
    """Writes the page, and gives the time; a full disk is told on the error stream, and the page of before
    stays."""
    try:
        artifacts.write_text(page, text)
    except OSError as error:
        print(f"shadow: {printable(str(error))}", file=sys.stderr)
    return time.monotonic()


@contextlib.contextmanager
def until_told() -> Generator[Callable[[], bool]]:
    """A function that says whether Ctrl-C or SIGTERM has come; a second Ctrl-C ends at once."""
    told = []

    def tell(number: int, frame: Any) -> None:
        if told and number == signal.SIGINT:
            raise KeyboardInterrupt
        told.append(number)

    before = {number: signal.signal(number, tell) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(told)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
