"""Recordings damaged by chance, and what becomes of them: refused, equal, noted, or silently wrong."""

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipeline.recordings.inspection import inspect
from pipeline.recordings.isolated import Budget, isolated
from pipeline.recordings.recordings import Source, read
from tests.recordings import hostile

SOURCES = (Source("heater", "heater", "percent"), Source("zone", "zone", "degC"))
KLIPPER = (Source("heater", "extruder.pwm", "percent"), Source("zone", "extruder.temp", "degC"))
BUDGET = Budget(60.0, 2000.0)
REFUSED, EQUAL, NOTED, SILENT, ENDED = "refused", "equal", "noted", "silently wrong", "ended the process"


class Reading(NamedTuple):
    """Digest of the numbers, and the notes beside them."""

    digest: str
    notes: list[str]


def klippy_log(samples: int = 120) -> bytes:
    """Lines like those of a printer's log, with other lines between them."""
    lines = [
        "Start printer at Mon Jan  5 10:00:00 2026 (1767607200.0 5.2)",
        "===== Config file =====",
        "[extruder]",
    ]
    for k in range(samples):
        lines.append(
            f"Stats {100 + k}.0: gcodein=0 mcu: mcu_awake=0.001 extruder: target=200 "
            f"temp={20 + k % 50}.{k % 10} pwm=0.{k % 10}{k % 7} print_time={100 + k}.123 "
            "buffer_time=0.0 print_stall=0"
        )
    return ("\n".join(lines) + "\n").encode()


GOOD = {
    "mcap": hostile.good_mcap,
    "csv": hostile.good_csv,
    "parquet": hostile.good_parquet,
    "log": klippy_log,
}


def damaged(content: bytes, rng: np.random.Generator) -> bytes:
    """One to four bits flipped, or the file cut off, or a stretch of it zeroed, as disks and cables do."""
    kind = rng.integers(10)
    if kind < 6:
        changed = bytearray(content)
        for place in rng.integers(len(content), size=int(rng.integers(1, 5))):
            changed[place] ^= 1 << int(rng.integers(8))
        return bytes(changed)
    place = int(rng.integers(len(content)))
    if kind < 9:
        return content[:place]
    length = int(rng.integers(1, 600))
    return content[:place] + bytes(len(content[place : place + length])) + content[place + length :]


def numbers(path: Path) -> Reading:
    """What is read, in the child."""
    raw = read(path, KLIPPER if path.suffix == ".log" else SOURCES)
    digest = hashlib.sha256()
    for name, (time_s, values) in sorted(raw.signals.items()):
        digest.update(name.encode() + time_s.tobytes() + values.tobytes())
    inspect(path)
    return Reading(digest.hexdigest(), [note.message for note in raw.notes])


def outcome(path: Path, good: Reading) -> str:
    """What becomes of one file beside the reading of the whole one."""
    try:
        digest, notes = isolated(numbers, path, shown=path.name, budget=BUDGET)
    except ValueError as error:
        return ENDED if "ended the process" in str(error) else REFUSED
    if digest == good.digest:
        return EQUAL
    return NOTED if set(notes) - set(good.notes) else SILENT


def outcomes(folder: Path, kind: str, count: int, seed: int) -> Iterator[tuple[str, str]]:
    """(outcome, file) of `count` damaged files of a kind; those that ended badly are kept in `folder`."""
    content = GOOD[kind]()
    whole = folder / f"whole.{kind}"
    whole.write_bytes(content)
    good = Reading(*isolated(numbers, whole, shown=whole, budget=BUDGET))
    rng = np.random.default_rng(seed)
    for k in range(count):
        path = folder / f"{k}.{kind}"
        made = damaged(content, rng)
        if made == content:
            continue
        path.write_bytes(made)
        result = outcome(path, good)
        if result not in (SILENT, ENDED):
            path.unlink()
        yield result, path.name
