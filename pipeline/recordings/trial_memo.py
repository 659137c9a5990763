"""A recording of a trial is read once: the readings of its frames are kept under a hash of its bytes, of the
camera's settings and of the code that reads."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import joblib
import numpy as np

from pipeline.store import artifacts
from pipeline.store.tables import BYTES, FLOAT, NONE, TEXT, Column, Schema

READINGS = Schema(
    "trial_readings",
    1,
    (
        Column("time_s", FLOAT, "s", "of the frame, as stamped"),
        Column("reason", TEXT, NONE, "why the frame has no usable bead; empty if it has"),
        Column("columns", BYTES, "px", "measured columns, 64-bit floats"),
        Column("widths", BYTES, "px", "widths there, 64-bit floats; 0 bare, NaN unread"),
        Column("latency_s", FLOAT, "s", "how late the frames are against the gantry, of the whole recording"),
        Column("latency_deviation_s", FLOAT, "s", "its standard deviation; missing: not told", nullable=True),
    ),
)
# the readings of F frames: time_s (F,), columns (m,), widths (F, m), reasons (F,), latency and its deviation
Values = tuple[np.ndarray, np.ndarray, np.ndarray, list[str], tuple[float, float]]


def recall(
    folder: Path,
    recording: str,
    settings: Mapping[str, Any],
    code: Sequence[Path],
    read: Callable[[], Values],
) -> Values:
    """The readings of a recording out of `folder`, else those that `read` makes, which are kept if there is a
    frame. An entry is named by the hash of the recording, of the settings, and of the code that reads."""
    what = ((artifacts.sha256(recording), settings), [artifacts.sha256(path) for path in code])
    place = folder / f"{joblib.hash(what)}.parquet"
    known = _remembered(place)
    if known is not None:
        return known
    values = read()
    if len(values[0]):
        _remember(place, values)
    return values


def _remember(place: Path, values: Values) -> None:
    time_s, columns, widths, reasons, (latency_s, deviation_s) = values
    count = len(time_s)
    table = {
        "time_s": time_s,
        "reason": np.array(reasons, object),
        "columns": [columns.astype("<f8").tobytes()] * count,
        "widths": [row.astype("<f8").tobytes() for row in widths],
        "latency_s": np.full(count, latency_s),
        "latency_deviation_s": np.full(count, deviation_s if np.isfinite(deviation_s) else np.nan),
    }
    artifacts.write_table(place, READINGS, table)


def _remembered(place: Path) -> Values | None:
    """The readings of an entry; None if there is none, or if the checksums of its pages do not hold."""
    try:
        table = artifacts.read_table(place, READINGS)
    except ValueError:
        return None
    if not len(table["time_s"]):
        return None
    deviation_s = float(table["latency_deviation_s"][0])
    return (
        np.asarray(table["time_s"], float),
        np.frombuffer(table["columns"][0], "<f8"),
        np.stack([np.frombuffer(row, "<f8") for row in table["widths"]]),
        [str(reason) for reason in table["reason"]],
        (float(table["latency_s"][0]), deviation_s if np.isfinite(deviation_s) else np.inf),
    )
