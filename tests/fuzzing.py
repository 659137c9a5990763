"""Files that were made wrong in many ways, for what reads files: damage drawn by hypothesis, and who must
answer it with one sentence.

`TARGETS` is {name: (a good file's bytes, its suffix, who reads it)}. A reader may take the file, or refuse it
by one of `REFUSALS`, which stages and commands turn into one line. Anything else would be a traceback, and
more than `LONGEST_S` seconds of CPU a hang.
"""

import contextlib
import functools
import shutil
import signal
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from hypothesis import strategies as st

from pipeline.deposition.toolpath import gcode
from pipeline.recordings import recordings
from pipeline.recordings.inspection import inspect
from pipeline.store import artifacts, params, tables
from pipeline.temperature.settings import Panel, Plant
from tests.recordings import damaging, hostile

ROOT = Path(__file__).resolve().parents[1]
# what `artifacts.stage` and `beadline` answer with one sentence
REFUSALS = (ValueError, OSError, np.linalg.LinAlgError, pa.ArrowException)
LONGEST_S = 20.0
SCHEMA = tables.Schema(
    "fuzzed",
    2,
    (tables.Column("t", tables.FLOAT, "s", "time"), tables.Column("y", tables.FLOAT, "degC", "temperature")),
)
PROGRAM = b"""; G28 as slicers write it
G21
G90
M82
G92 E0
G1 Z0.4 F600
G1 X10 Y10 F3000
G1 X40 Y10 E1.5 F1200
G3 X50 Y20 I0 J10 E2.2
G4 P500
M106 S255
T0
M221 S95
G1 X10 Y40 E4.1
M84
"""
# what means something to one of the readers
WORDS = (
    b"nan", b"inf", b"1e400", b"-1", b"0", b"9" * 25, b",", b";", b"\t", b"\n", b"\r\n", b"\x00", b"\xff\xfe",
    b'"', b"'", b"{}", b"[]", b"null", b"true", b":", b"- ", b"&a *a", b"!!python/name:os", b"G2 R0", b"G1 E",
    b"T99999999999", b"M104 S", b"G92", b"(", b"\xc2\xb2", b"version", b"PAR1", b"2026-13-45T99:99:99",
)  # fmt: skip


class Target(NamedTuple):
    """A good file and its reader."""

    good: Callable[[], bytes]
    suffix: str
    read: Callable[[Path], Any]


class Hang(BaseException):
    """A reader that does not come back."""


# ---- damage


class Edit(NamedTuple):
    """One change: what is done, where (a share of the length), how far, and with what."""

    kind: str
    at: float
    length: int
    word: bytes


EDITS = st.builds(
    Edit,
    st.sampled_from(("flip", "cut", "zero", "drop", "twice", "word", "swap")),
    st.floats(0, 1, exclude_max=True),
    st.integers(1, 64),
    st.sampled_from(WORDS) | st.binary(max_size=8),
)
DAMAGE = st.lists(EDITS, min_size=1, max_size=6)


def damaged(content: bytes, edits: list[Edit]) -> bytes:
    """The content after the edits, one after the other."""
    for edit in edits:
        k = int(edit.at * len(content))
        before, piece, after = content[:k], content[k : k + edit.length], content[k + edit.length :]
        match edit.kind:
            case "flip":
                flipped = bytes(piece[:1][0] ^ (1 << edit.length % 8) for _ in piece[:1])
                content = before + flipped + piece[1:] + after
            case "cut":
                content = before
            case "zero":
                content = before + bytes(len(piece)) + after
            case "drop":
                content = before + after
            case "twice":
                content = before + piece + piece + after
            case "word":
                content = before + edit.word + after
            case "swap":
                content = before + after[: edit.length] + piece + after[edit.length :]
    return content


# ---- readers


def _recording(path: Path) -> None:
    recordings.read(path, damaging.KLIPPER if path.suffix == ".log" else damaging.SOURCES)
    inspect(path)


def _params(path: Path) -> None:
    named = path.with_name("params.yaml")
    path.replace(named)
    shutil.copy(ROOT / "params.expert.yaml", path.with_name("params.expert.yaml"))
    params.load(Plant, "plant", named)
    params.load(Panel, "panel", named)


def _table(path: Path) -> None:
    artifacts.read_table(path, SCHEMA)


def _arrays(path: Path) -> None:
    artifacts.read_arrays(path, "fuzzed", 1, shapes={"A": (2, 2)})


def _written(write: Callable[[Path], None], suffix: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"good{suffix}"
        write(path)
        return path.read_bytes()


@functools.cache
def _good_table() -> bytes:
    columns = {"t": np.arange(30.0), "y": np.sin(np.arange(30.0))}
    return _written(lambda path: artifacts.write_table(path, SCHEMA, columns), ".parquet")


@functools.cache
def _good_arrays() -> bytes:
    made = {"A": (np.eye(2), "1", "dynamics"), "b": (np.ones(2), "1", "gain")}
    return _written(lambda path: artifacts.write_arrays(path, "fuzzed", 1, made), ".parquet")


@functools.cache
def _good_weights() -> bytes:
    made = {"w": np.ones((3, 2)), "b": np.zeros(2)}
    return _written(
        lambda path: artifacts.write_weights(path, "fuzzed", made, {"sizes": "3 2"}), ".safetensors"
    )


def _good_params() -> bytes:
    return (ROOT / "params.yaml").read_bytes()


def _good_metrics() -> bytes:
    return (ROOT / "reports/metrics/learn_kernel.json").read_bytes()


TARGETS = {
    "CSV": Target(hostile.good_csv, ".csv", _recording),
    "MCAP": Target(hostile.good_mcap, ".mcap", _recording),
    "Parquet": Target(hostile.good_parquet, ".parquet", _recording),
    "printer's log": Target(damaging.klippy_log, ".log", _recording),
    "G-code": Target(lambda: PROGRAM, ".gcode", lambda path: gcode.parse(path.read_bytes())),
    "parameters": Target(_good_params, ".yaml", _params),
    "table": Target(_good_table, ".parquet", _table),
    "arrays": Target(_good_arrays, ".parquet", _arrays),
    "weights": Target(_good_weights, ".safetensors", lambda path: artifacts.read_weights(path, "fuzzed")),
    "metrics": Target(_good_metrics, ".json", artifacts.read_json),
}


def versions(change: int, drop: str, rename: str) -> bytes:
    """A table of another version: its number moved, a column left out, one under another name."""
    columns = [
        column._replace(name=rename if column.name == drop and rename else column.name)
        for column in SCHEMA.columns
        if rename or column.name != drop
    ]
    schema = SCHEMA._replace(version=SCHEMA.version + change, columns=tuple(columns))
    values = {column.name: np.arange(5.0) for column in columns}
    return _written(lambda path: artifacts.write_table(path, schema, values), ".parquet")


# ---- judgement


@contextlib.contextmanager
def within(seconds: float) -> Iterator[None]:
    """Raises Hang where the body takes more seconds of this process's CPU."""

    def late(*_):
        raise Hang(f"more than {seconds:g} s of CPU")

    before = signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def answer(target: Target, content: bytes) -> str:
    """ "read", or "refused"; raises what is neither."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"fuzzed{target.suffix}"
        path.write_bytes(content)
        try:
            with within(LONGEST_S):
                target.read(path)
        except REFUSALS as error:
            if not str(error).strip():
                raise AssertionError(f"a refusal without a word: {error!r}") from error
            return "refused"
    return "read"
