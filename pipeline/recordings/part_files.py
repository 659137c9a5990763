"""Reads part programs in a folder, and the measured prints in it."""

import csv
from pathlib import Path

import numpy as np

from pipeline.recordings import recordings
from pipeline.recordings.formats import Source, file_format
from pipeline.recordings.mcap_files import topics
from pipeline.recordings.parquet_files import parquet_columns
from pipeline.recordings.plain_files import check_plain_file
from pipeline.recordings.trial_files import COMMAND as COMMAND_TOPIC

LARGEST_MB = 1000
COLUMNS, COMMAND = ("time_s", "flow_mm3_per_s"), "command_mm"
ENDINGS = (".csv", ".parquet", ".mcap")
# a signal on its own clock: time_s (n,), rising, and its values (n,)
Series = tuple[np.ndarray, np.ndarray]


def part_programs(folder: Path) -> list[Path]:
    """Returns the part programs in a folder, by name. Raises ValueError if there is none."""
    paths = sorted(
        path for path in folder.glob("*") if path.suffix.lower() in {".gcode", ".gco", ".g", ".nc"}
    )
    if not paths:
        raise ValueError(f"{folder}: expected part programs (*.gcode), found none; copy one there")
    return paths


def read_part_program(path: Path) -> bytes:
    """Returns the bytes of a part program. Raises ValueError if it is not a plain file, is too large, or
    cannot be read."""
    check_plain_file(path)
    try:
        size = path.stat().st_size / 1e6
        data = path.read_bytes() if size <= LARGEST_MB else b""
    except OSError as error:
        raise ValueError(f"{path} cannot be read ({error.strerror}); name a part program (G-code)") from None
    if size > LARGEST_MB:
        raise ValueError(
            f"{path}: expected at most {LARGEST_MB:,} MB of G-code, found {size:,.0f} MB; cut it"
        )
    return data


# ---- measured prints


def print_name(part: str, material: str, ending: str = ".csv") -> str:
    """Returns the name of the file that holds the measured flow of a part's print."""
    return f"{part}_{material}_measured{ending}"


def print_path(folder: Path, part: str, material: str) -> Path | None:
    """Returns the file in `folder` with the measured flow of a part's print, in any of its formats; None if
    there is none. Raises ValueError if there are several."""
    paths = [folder / print_name(part, material, ending) for ending in ENDINGS]
    present = [path for path in paths if path.exists()]
    if len(present) > 1:
        names = " and ".join(path.name for path in present)
        raise ValueError(
            f"{folder}: expected one measured print of {part}, {material}, found {names}; keep one"
        )
    return present[0] if present else None


def read_measured(path: Path, samples: int, sample_time_s: float) -> tuple[np.ndarray, np.ndarray | None]:
    """Returns the flow y (samples,) in mm^3/s of a measured print at the clock of the command, and the
    printed command u (samples,) in mm, None if the file does not have it. y is NaN before the first row,
    after the last row and in gaps longer than five samples. At time 0 the command begins: in a table its time
    0, in an MCAP recording the plunger's first message. Raises ValueError naming file and place."""
    flow, command = _rows(path) if path.suffix == ".csv" else _read_recorded(path)
    t, y = flow
    clock = np.arange(samples) * sample_time_s
    right = np.clip(np.searchsorted(t, clock), 1, len(t) - 1)
    covered = (clock >= t[0] - 1e-9) & (clock <= t[-1] + 1e-9)
    covered &= t[right] - t[right - 1] <= 5 * max(sample_time_s, float(np.median(np.diff(t))))
    u = None if command is None else np.interp(clock, *command)
    if u is not None and not np.isfinite(u).all():
        raise ValueError(
            f"{path}: expected a number in each row of {COMMAND}, found some without; fill them in"
        )
    return np.where(covered, np.interp(clock, t, y), np.nan), u


def _read_recorded(path: Path) -> tuple[Series, Series | None]:
    """Returns flow and, if it has one, command of a Parquet table or an MCAP recording."""
    kind, wanted = file_format(path), [Source(COLUMNS[1], COLUMNS[1], "mm^3/s")]
    if kind == "mcap":
        plunger = topics(path).get(COMMAND_TOPIC.source.partition(":")[0])
        wanted += [COMMAND_TOPIC] if plunger and plunger.count else []
    elif kind == "parquet":
        wanted += [Source(COMMAND, COMMAND, "mm")] * any(
            column.name == COMMAND for column in parquet_columns(path)
        )
    else:
        raise ValueError(f"{path}: expected a Parquet table or an MCAP recording, found {kind}; name it so")
    raw = recordings.read(path, wanted, time="" if kind == "mcap" else COLUMNS[0])
    if raw.breaks:
        raise ValueError(f"{path}: its clock starts over after {raw.breaks[0]:g} s; keep one print of it")
    flow, command = raw.signals[COLUMNS[1]], raw.signals.get(COMMAND)
    start = 0.0
    if kind == "mcap" and command is not None:
        start = float(command[0][0])
    elif any(note.kind == "clock" for note in raw.notes):
        raise ValueError(
            f"{path}: expected the command, {COMMAND_TOPIC.source}, for its first message is time 0 of the "
            "flow; record it too, or write a table with time 0 where the command begins"
        )
    if len(flow[0]) < 2:
        raise ValueError(f"{path}: expected at least two samples of {COLUMNS[1]}, found {len(flow[0])}")
    return (flow[0] - start, flow[1]), None if command is None else (command[0] - start, command[1])


def _rows(path: Path) -> tuple[Series, Series | None]:
    """Returns flow and, if it has one, command of a CSV table."""
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))
    names = tuple(name.strip() for name in rows[0]) if rows else ()
    if names not in (COLUMNS, (*COLUMNS, COMMAND)):
        header = ",".join(rows[0]) if rows else "an empty file"
        raise ValueError(
            f"{path}: expected the columns {','.join(COLUMNS)} but found {header}; "
            "write them as the first row"
        )
    values = []
    for number, row in enumerate(rows[1:], 2):
        try:
            figures = [float(cell) for cell in row]
        except ValueError:
            figures = []
        if len(figures) != len(names):
            raise ValueError(
                f"{path}, row {number}: expected {len(names)} numbers but found {','.join(row)}; mend it "
                "or leave the row out"
            )
        values.append(figures)
    t, y, *u = np.array(values, float).reshape(-1, len(names)).T
    if len(t) < 2 or np.any(np.diff(t) <= 0) or not np.isfinite(t).all():
        raise ValueError(
            f"{path}: expected at least two rows whose {COLUMNS[0]} rises; sort them, and leave out repeats"
        )
    return (t, y), (t, u[0]) if u else None
