"""Refuses things among recordings that are not recordings: pipes, sockets, devices, and links that lead out
of the folder.

A pipe without a writer blocks every program that opens it, `dvc status` too. A link out of the folder is a
recording that may change or vanish although nobody touched the folder. Both are therefore refused by name
before anything is opened. Recordings may be on another disk: datasets/raw, datasets/raw/<loop> and folders of
images directly below datasets/raw/setpoint may be links.

Incomplete copies are passed over. They are recognised by their names, or by a change a moment ago.
"""

import os
import stat
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

# a file that has not changed for this long is complete
REST_S = 10.0
# endings of downloads and copies, an open workbook's lock, and what systems leave in folders
_PARTIAL_ENDS = (".part", ".partial", ".crdownload", ".download", ".filepart")
_PARTIAL_NAMES = ("thumbs.db", ".ds_store", "desktop.ini")
_KINDS = (
    (stat.S_ISFIFO, "a named pipe (FIFO)"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a character device"),
    (stat.S_ISBLK, "a block device"),
)


def check_plain_files(folder: str | Path) -> None:
    """Raises ValueError, naming the first, if something below `folder` is neither a file nor a folder, or is
    a link that leads out of it."""
    problems = list(_problems(Path(folder), Path(folder).resolve()))
    if problems:
        suffix = f" (and {len(problems) - 1} more like it)" if len(problems) > 1 else ""
        raise ValueError(f"{problems[0]}{suffix}")


def check_plain_file(path: str | Path) -> None:
    """Raises ValueError if a path that a person named is a pipe, a socket or a device."""
    path = Path(path)
    if path.exists():
        for problem in _special(path, path.stat().st_mode):
            raise ValueError(problem)


def _problems(folder: Path, top: Path) -> Iterator[str]:
    if not folder.is_dir():
        return
    with os.scandir(folder) as entries:
        in_order = sorted(entries, key=lambda entry: entry.name)
    for entry in in_order:
        path = folder / entry.name
        if entry.is_symlink():
            yield from _link(path, top)
        elif entry.is_dir():
            yield from _problems(path, top)
        elif not entry.is_file():
            yield from _special(path, path.lstat().st_mode)


def _link(path: Path, top: Path) -> Iterator[str]:
    try:
        target = path.resolve(strict=True)
    except (OSError, RuntimeError):
        yield f"{path} is a link to {os.readlink(path)}, which is not there; remove the link"
        return
    if not target.is_relative_to(top):
        # a folder of datasets/raw holds all recordings of a loop. Images come by the hundred thousand, and
        # their reader follows links to folders
        whole_loop = path.parent.resolve() == top and top.name == "raw"
        if target.is_dir() and (whole_loop or path.parent.name == "setpoint"):
            yield from _problems(path, target)
            return
        yield (
            f"{path} is a link that leads out of {top.name} to {target}; copy the recording here, "
            "or let the whole folder be a link (datasets/raw/<loop>)"
        )
    else:
        yield from _special(path, target.stat().st_mode)


def _special(path: Path, mode: int) -> Iterator[str]:
    for is_kind, kind in _KINDS:
        if is_kind(mode):
            yield (
                f"{path} is {kind}, which is no recording and stops whoever reads it; "
                f"remove it (rm {path}) and copy the recording itself there"
            )


# ---- copies that are not complete


def is_partial(name: str) -> bool:
    """Returns whether a file's name is that of an incomplete copy, or of a system's own file."""
    lower = name.lower()
    return lower.endswith(_PARTIAL_ENDS) or lower.startswith("~$") or lower in _PARTIAL_NAMES


def wait_until_still(
    paths: Sequence[Path],
    *,
    rest_s: float | None = None,
    clock: Callable[[], float] = time.time,
    sleep: Callable[[float], None] | None = None,
) -> list[Path]:
    """Waits until no file has changed for `rest_s` (default REST_S), but `rest_s` at most. Returns the files
    that changed meanwhile and are still being written. A change in the future, from a wrong clock, is not
    waited for."""
    rest_s = REST_S if rest_s is None else rest_s
    states = {path: _state(path) for path in paths}
    now_s = clock()
    ages = [now_s - changed for state in states.values() for changed, _ in state.values()]
    youngest = min((age for age in ages if age >= 0), default=rest_s)
    if youngest >= rest_s:
        return []
    (sleep or time.sleep)(rest_s - youngest)
    return [path for path, state in states.items() if _state(path) != state]


def _state(path: Path) -> dict[Path, tuple[float, int]]:
    """Returns {file: (time of change in s, bytes)} of a file, or of the files of a bag; empty if it is
    gone."""
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    try:
        return {file: (status.st_mtime, status.st_size) for file in files for status in [file.stat()]}
    except OSError:
        return {}
