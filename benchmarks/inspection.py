"""How long `beadline inspect` takes beside one plain read of all columns: `./run python -m
benchmarks.inspection`. The bar: at most 1.5 times, whatever the number of topics or columns."""

import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
from mcap.writer import CompressionType, Writer

from pipeline.reading.inspection import inspect
from pipeline.reading.recordings import Source, read
from tests.reading.klipper_machine import print_log

ROWS, COLUMNS, TOPICS, WIDE = 300_000, 12, 35, 20_000


def table(rng: np.random.Generator) -> pa.Table:
    columns = {"time_s": np.arange(ROWS) * 0.1}
    for j in range(COLUMNS):
        name = f"heater_{j}_pct" if j % 2 else f"zone_{j}_C"
        columns[name] = np.round(np.cumsum(rng.normal(0, 0.1, ROWS)) + 50, 3)
    return pa.table(columns)


def topics(path: Path, rng: np.random.Generator) -> None:
    """`data` on /plc/x, 35 topics, compressed chunks."""
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD)
        writer.start("", "benchmark")
        schema = writer.register_schema("std_msgs/msg/Float64", "ros2msg", b"float64 data")
        channels = [writer.register_channel(f"/plc/zone_{i}", "cdr", schema, {}) for i in range(TOPICS)]
        for k in range(ROWS // 10):
            for channel in channels:
                value = b"\0\1\0\0" + np.float64(rng.normal()).tobytes()
                writer.add_message(channel, k * 10**8, value, k * 10**8)
        writer.finish()


def seconds(work: Callable[[], object]) -> float:
    """The least of three runs, in CPU time: the machine may be shared."""
    taken = []
    for _ in range(3):
        start = time.process_time()
        work()
        taken.append(time.process_time() - start)
    return min(taken)


def main() -> None:
    rng, results = np.random.default_rng(0), {}
    with tempfile.TemporaryDirectory() as folder:
        made, root = table(rng), Path(folder)
        pa.csv.write_csv(made, root / "rig.csv")
        pa.parquet.write_table(made, root / "rig.parquet")
        topics(root / "plc.mcap", rng)
        (root / "klippy.log").write_text(
            print_log([(0, 200, 60), (4000, 210, 65)], longest_s=8000), encoding="utf-8"
        )
        wide = {f"tag_{j}": rng.normal(size=100) for j in range(WIDE)}
        pa.parquet.write_table(pa.table({"time_s": np.arange(100.0), **wide}), root / "wide.parquet")
        names = [name for name in made.column_names if name != "time_s"]
        sources = {
            "rig.csv": names,
            "rig.parquet": names,
            "wide.parquet": list(wide),
            "plc.mcap": [f"/plc/zone_{i}:data" for i in range(TOPICS)],
            "klippy.log": ["extruder.temp", "extruder.pwm", "heater_bed.temp", "heater_bed.pwm"],
        }
        for name, columns in sources.items():
            path, wanted = root / name, [Source(column, column, "") for column in columns]
            plain = seconds(lambda path=path, wanted=wanted: read(path, wanted))
            whole = seconds(lambda path=path: inspect(path))
            results[name] = {"read_s": plain, "inspect_s": whole, "ratio": whole / plain}
    json.dump(results, sys.stdout, indent=1)
    print()


if __name__ == "__main__":
    main()
