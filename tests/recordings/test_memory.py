"""What a recording costs in memory grows by the numbers that are kept, and by nothing
else: no text, no messages, no copy of the file."""

import json
import struct
import subprocess
import sys

import pytest

from tests.mcap_writing import Written

# In an interpreter of its own that never stops tracing: a reader's thread that ends while tracing is stopped
# crashes Python 3.11 (gh-128679). The first file pays for what is loaded once.
MEASURED = """
import json, sys, tracemalloc
from pipeline.recordings.recordings import Source, read
sources = [Source("u", "u", "percent"), Source("y", "y", "degC")]
tracemalloc.start()
found = []
for path in sys.argv[1:]:
    tracemalloc.reset_peak()
    before = tracemalloc.get_traced_memory()[0]
    raw = read(path, sources)
    found.append((tracemalloc.get_traced_memory()[1] - before, len(raw.signals["y"][1])))
    del raw
print(json.dumps(found))
"""
# time, two signals and the line of each row are 28 bytes; a clock is checked and counted from its start with
# a few copies more, thrice in all
BYTES_A_SAMPLE = 84
SHORT, LONG = 12_000, 30_000


def csv(samples: int) -> bytes:
    """Ten rows a sample: blocks of a MiB of text come and go meanwhile, and a few rows would pay for one."""
    samples = 10 * samples
    return b"t,u,y,note\n" + b"".join(
        b"%d,%d.25,%d.5,a remark that nobody reads\n" % (k, k % 50, k % 70) for k in range(samples)
    )


def mcap(encoding: str, samples: int, *, late: bool = False) -> bytes:
    made = Written(chunk_size=1 << 16)
    schema = ("rig/State", "ros2msg", b"float64 u\nfloat64 y\n") if encoding == "cdr" else ()
    channel = made.topic("/rig", encoding, *schema)
    for k in range(samples):
        u, y = k % 50 + 0.25, k % 70 + 0.5
        always = {"u": u, "note": "a remark that nobody reads"}
        made.message(
            channel,
            k,
            struct.pack("<4sdd", b"\0\1\0\0", u, y)
            if encoding == "cdr"
            else always | ({} if late and k < 500 else {"y": y}),
        )
    return made.bytes()


@pytest.mark.parametrize(
    "written",
    [
        csv,
        lambda n: mcap("json", n),
        lambda n: mcap("cdr", n),
        lambda n: mcap("json", n)[:-300],
        lambda n: mcap("json", n, late=True),
    ],
    ids=["CSV", "JSON", "CDR", "cut off", "a key that comes late"],
)
def test_a_longer_recording_costs_its_numbers_and_nothing_else(tmp_path, written):
    samples = (1000, SHORT, LONG)
    paths = [tmp_path / f"{count}" for count in samples]
    for path, count in zip(paths, samples, strict=True):
        path.write_bytes(written(count))
    found = subprocess.run(
        [sys.executable, "-c", MEASURED, *map(str, paths)], check=True, capture_output=True, text=True
    )
    (_, short, long), rows = zip(*json.loads(found.stdout), strict=True)
    assert all(many >= 0.9 * count for many, count in zip(rows, samples, strict=True))
    assert (long - short) / max(1, rows[-1] // LONG) < BYTES_A_SAMPLE * (LONG - SHORT)
