"""Rows or messages per second and peak memory of reading recordings of
three lengths, CRCs checked, on one core.

`./run python -m benchmarks.recordings` prints the figures beside the bars and writes
benchmarks/results/recordings.json.
"""

import json
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from mcap.reader import make_reader
from mcap.writer import Writer

LENGTHS = (25_000, 250_000, 1_000_000)  # 1, 10 and 40 times
BARS = {"json": 150_000, "cdr": 80_000, "cdr_header": 80_000}
NAMES = [f"heater_{i}" for i in range(1, 4)] + [f"temperature_{i}" for i in range(1, 6)]
RESULTS = Path(__file__).parent / "results" / "recordings.json"
HEADER = "std_msgs/Header header\n"
HEADER_TYPES = f"""{"=" * 80}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{"=" * 80}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""


def rows(count: int) -> Iterator[list[float]]:
    """Eight signals with all their digits, the same at every run."""
    rng = np.random.default_rng(0)
    for start in range(0, count, 10_000):
        yield from np.cumsum(rng.normal(size=(min(10_000, count - start), len(NAMES))), axis=0).tolist()


def write(path: Path, kind: str, count: int) -> None:
    """A recording of `count` rows or messages at 100 Hz; MCAP in chunks of 1 MiB, compressed with zstd."""
    if kind == "csv":
        with path.open("w") as stream:
            stream.write(",".join(["t_s", *NAMES]) + "\n")
            stream.writelines(
                f"{k / 100}," + ",".join(map(repr, row)) + "\n" for k, row in enumerate(rows(count))
            )
        return
    if kind == "parquet":
        columns = np.array(list(rows(count))).T
        pq.write_table(
            pa.table({"t_s": np.arange(count) / 100, **dict(zip(NAMES, columns, strict=True))}),
            path,
            row_group_size=count,
        )
        return
    numbers = "".join(f"float64 {name}\n" for name in NAMES)
    schema = {"json": b"", "cdr": numbers.encode(), "cdr_header": (HEADER + numbers + HEADER_TYPES).encode()}[
        kind
    ]
    fixed, headed = struct.Struct(f"<4x{len(NAMES)}d"), struct.Struct(f"<4xiII12s{len(NAMES)}d")

    def message(k: int, row: list[float]) -> bytes:
        if kind == "json":
            return json.dumps(dict(zip(NAMES, row, strict=True))).encode()
        if kind == "cdr":
            return b"\x00\x01\x00\x00" + fixed.pack(*row)[4:]
        return (
            b"\x00\x01\x00\x00"
            + headed.pack(k // 100, k % 100 * 10_000_000, 12, b"base_barrel\x00", *row)[4:]
        )

    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2" if kind != "json" else "", "benchmark")
        number = writer.register_schema("machine/msg/State", "ros2msg", schema) if schema else 0
        channel = writer.register_channel("/machine", "json" if kind == "json" else "cdr", number)
        for k, row in enumerate(rows(count)):
            writer.add_message(channel, k * 10_000_000, message(k, row), k * 10_000_000, k)
        writer.finish()


def ours(path: Path) -> int:
    """Reads three of the eight signals; returns how many samples came out."""
    from pipeline.reading.recordings import Source, read

    raw = read(path, [Source(name, name, "1") for name in (NAMES[0], NAMES[3], NAMES[7])])
    assert raw.signals[NAMES[7]][1][0] == next(rows(1))[7], "what is read is not what was written"
    return len(raw.signals[NAMES[7]][1])


def package(path: Path) -> int:
    """The mcap package's own reader, messages not even decoded: the yardstick."""
    with path.open("rb") as stream:
        return sum(1 for _ in make_reader(stream, validate_crcs=True).iter_messages(log_time_order=False))


def measure(reader: Callable[[Path], int], path: Path, kind: str) -> dict[str, float]:
    """CPU time and peak memory in this process; the imports are paid before, by reading the shortest one."""
    with tempfile.TemporaryDirectory() as folder:
        warm = Path(folder) / "warm"
        write(warm, kind, LENGTHS[0])
        reader(warm)
    before = peak_MB(again=True)
    start = time.process_time()
    count = reader(path)
    seconds = time.process_time() - start
    return {
        "rows": count,
        "rows_per_s": count / seconds,
        "peak_MB": peak_MB(),
        "above_warm_MB": peak_MB() - before,
    }


def peak_MB(*, again: bool = False) -> float:
    """The largest memory that this process has had, `again` from now on; what its
    parent had is not in it, as in getrusage it is."""
    if again:
        Path("/proc/self/clear_refs").write_text("5")
    line = next(
        line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM")
    )
    return int(line.split()[1]) / 1024


def apart(reader: str, path: Path, kind: str) -> dict[str, float]:
    """`measure` in a process of its own, so that its peak is its own."""
    call = f"b.measure(b.{reader}, Path({str(path)!r}), {kind!r})"
    code = (
        f"import json; from pathlib import Path; from benchmarks import recordings as b; "
        f"print(json.dumps({call}))"
    )
    return json.loads(
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    )


def main() -> None:
    results: dict[str, dict] = {}
    with tempfile.TemporaryDirectory() as folder:
        for kind in ("json", "cdr", "cdr_header", "csv", "parquet"):
            for count in LENGTHS:
                path = Path(folder) / f"{kind}_{count}"
                write(path, kind, count)
                figures = results[f"{kind}_{count}"] = apart("ours", path, kind)
                # the samples that stay: time and three signals of eight bytes
                figures["kept_MB"] = count * 4 * 8 / 2**20
                bar = f" (bar {BARS[kind]:,})" if kind in BARS else ""
                print(
                    f"{kind:>11} {count:>9,} rows: {figures['rows_per_s']:>9,.0f} per second{bar}, "
                    f"peak {figures['peak_MB']:.0f} MB, {figures['above_warm_MB']:.1f} MB above warm, "
                    f"of which kept {figures['kept_MB']:.1f} MB"
                )
                if kind in BARS and count == LENGTHS[1]:
                    undecoded = results[f"{kind}_mcap_package_undecoded"] = apart("package", path, kind)
                    print(
                        f"{'':>11} the mcap package, undecoded: {undecoded['rows_per_s']:>9,.0f} per second"
                    )
                path.unlink()
    RESULTS.parent.mkdir(parents=True, exist_ok=True)
    RESULTS.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
