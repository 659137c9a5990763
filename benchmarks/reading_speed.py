"""CPU time of reading tables of a million rows and 12 columns beside Arrow's own readers on one thread,
and of protobuf messages beside the official package.

`./run python -m benchmarks.reading_speed` prints every ratio beside its bar and writes its part
of benchmarks/results.json. The two readers take turns; the ratio is that of the least times, which other work
on the machine moves least.

Rows "checked" hold all that ingest does before it writes. Their limit is the checks: each output takes two
sorts of its windows (two devices under one name), a median of seven (spikes) and the sort of two fifths of
its values (steps of a converter), of a coarse signal of all of them three times.
"""

import operator
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq

from benchmarks import results
from benchmarks.results import Row

ROWS, COLUMNS, REPEATS = 1_000_000, 12, 5
INPUTS = 5
BARS = {
    "csv": 1.5,
    "csv_iso": 1.5,
    "csv_comma": 1.5,
    "csv_some_empty": 1.5,
    # read, resampled and flagged, as ingest does; a plain read beside it
    "csv_checked": 1.5,
    "csv_checked_coarse": 1.5,
    "parquet": 1.3,
    "parquet_stamps": 1.3,
}
# the fields are named by the recording and not by hand
PROTOBUF_BAR = 1.5
NAMES = [f"signal_{i}" for i in range(1, COLUMNS)]


def write(path: Path, kind: str, count: int) -> None:
    """A table with a clock at 100 Hz and eleven signals with all their digits, the same at every run."""
    rng = np.random.default_rng(0)
    values = np.cumsum(rng.normal(size=(count, len(NAMES))), axis=0)
    stamps = np.datetime64("2025-11-21T13:00:00", "ms") + 10 * np.arange(count)
    if kind.startswith("parquet"):
        clock = pa.array(stamps) if kind == "parquet_stamps" else pa.array(np.arange(count) / 100)
        columns = {"time": clock} | dict(zip(NAMES, values.T, strict=True))
        pq.write_table(pa.table(columns), path)
        return
    if kind == "csv_checked_coarse":
        values = np.round(values, 1)  # as sensors are, with values that rest and come back
    clock = map(str, stamps) if kind == "csv_iso" else (repr(k / 100) for k in range(count))
    delimiter = ";" if kind == "csv_comma" else ","
    with path.open("w") as stream:
        stream.write(delimiter.join(["time", *NAMES]) + "\n")
        for k, (at, row) in enumerate(zip(clock, values, strict=True)):
            fields = list(map(repr, row.tolist()))
            if kind == "csv_some_empty" and k % 10 == 3:
                fields[3] = ""
            line = delimiter.join([at, *fields])
            stream.write((line.replace(".", ",") if kind == "csv_comma" else line) + "\n")


def ours(path: Path) -> int:
    """Every column as float64, quality checks apart."""
    from pipeline.recordings.recordings import Source, read

    raw = read(path, [Source(name, name, "1") for name in NAMES])
    return len(raw.signals[NAMES[-1]][1])


def checked(path: Path) -> int:
    """Every column as float64, on one sample time, with every check: what ingest does before it writes."""
    from pipeline.recordings.quality import flag
    from pipeline.recordings.recordings import Source, read
    from pipeline.recordings.resampling import resample

    inputs, outputs = NAMES[:INPUTS], NAMES[INPUTS:]
    raw = read(path, [Source(name, name, "1") for name in NAMES])
    table = resample(raw, sample_time_s=0.01, inputs=inputs, outputs=outputs)
    table = flag(table, units=dict.fromkeys(NAMES, "degC"), limits=dict.fromkeys(inputs, (0.0, 100.0)))
    return len(table.values[NAMES[-1]])


def arrow(path: Path) -> int:
    """Arrow's own reader on one thread, with what it must know to read numbers."""
    if path.name.startswith("parquet"):
        return pq.read_table(path, use_threads=False).num_rows
    comma = path.name.startswith("csv_comma")
    return pa.csv.read_csv(
        path,
        read_options=pa.csv.ReadOptions(use_threads=False),
        parse_options=pa.csv.ParseOptions(delimiter=";" if comma else ","),
        convert_options=pa.csv.ConvertOptions(decimal_point="," if comma else "."),
    ).num_rows


def protobuf_s(count: int = 200_000) -> dict[str, float]:
    """Seconds for the numbers of `count` messages: ours, and the package with its fields named by hand."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    from pipeline.recordings.messages import message_types
    from pipeline.recordings.messages import protobuf_decoder as decoder

    file = descriptor_pb2.FileDescriptorProto(name="machine.proto", package="machine", syntax="proto3")
    state = file.message_type.add(name="State")
    for i, name in enumerate(NAMES):
        state.field.add(name=name, number=i + 1, type=1, label=1)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    made = message_factory.GetMessageClass(pool.FindMessageTypeByName("machine.State"))
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(count, len(NAMES)))
    messages = [made(**dict(zip(NAMES, row, strict=True))).SerializeToString() for row in rows.tolist()]
    schema = descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()
    decode, by_hand = decoder(message_types(schema), "machine.State", NAMES), operator.attrgetter(*NAMES)
    seconds = {}
    for reader, read in (
        ("package", lambda: np.array([by_hand(made.FromString(message)) for message in messages])),
        ("ours", lambda: decode(messages)),
    ):
        start = time.process_time()
        assert np.array_equal(read(), rows), "what is read is not what was written"
        seconds[reader] = time.process_time() - start
    return seconds


def cpu_s(reader: Callable[[Path], int], path: Path, warm: Path) -> float:
    """The CPU time of one reading in this process; imports are paid before by a short table."""
    reader(warm)
    start = time.process_time()
    count = reader(path)
    seconds = time.process_time() - start
    assert count == ROWS, "a row is missing"
    return seconds


def apart(reader: str, path: Path, warm: Path) -> float:
    """`cpu_s` in a process of its own."""
    call = f"b.cpu_s(b.{reader}, Path({str(path)!r}), Path({str(warm)!r}))"
    code = f"from pathlib import Path; from benchmarks import reading_speed as b; print({call})"
    return float(subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout)


TITLES = {
    "csv": "CSV of a million rows and 12 columns, only read",
    "csv_iso": "the same with ISO stamps",
    "csv_comma": "the same with decimal commas",
    "csv_some_empty": "the same with some empty cells",
    "csv_checked": "CSV, checked as ingest does it",
    "csv_checked_coarse": "CSV of coarse sensors, checked",
    "parquet": "Parquet of the same size",
    "parquet_stamps": "Parquet with stamps",
    "protobuf": "200,000 protobuf messages",
}


def measured() -> dict[str, dict[str, float]]:
    found: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for kind, bar in BARS.items():
            path, warm = Path(folder) / kind, Path(folder) / f"{kind}_warm"
            write(path, kind, ROWS)
            write(warm, kind, 2000)
            own = "checked" if "checked" in kind else "ours"
            pairs = [(apart("arrow", path, warm), apart(own, path, warm)) for _ in range(REPEATS)]
            arrow_s, ours_s = (min(column) for column in zip(*pairs, strict=True))
            found[kind] = {"arrow_s": arrow_s, "ours_s": ours_s, "bar": bar}
            path.unlink()
    seconds = protobuf_s()
    found["protobuf"] = {"package_s": seconds["package"], "ours_s": seconds["ours"], "bar": PROTOBUF_BAR}
    return found


def rows(found: dict[str, dict[str, float]]) -> list[Row]:
    """Our seconds beside the peer's on one thread."""
    out = []
    for kind, title in TITLES.items():
        one = found[kind]
        theirs = one.get("arrow_s", one.get("package_s", float("nan")))
        peer = "pyarrow" if "arrow_s" in one else "the protobuf package"
        ratio = one["ours_s"] / theirs
        note = f"limit {one['bar']:g} times: {'met' if ratio <= one['bar'] else 'missed'}"
        out.append(Row(title, f"{one['ours_s']:.3f} s, {ratio:.2f} times", f"{theirs:.3f} s ({peer})", note))
    return out


def main() -> None:
    results.write("reading_speed", rows(measured()))


if __name__ == "__main__":
    main()
