"""What a recording costs in memory grows by the numbers that are kept, and by nothing
else: no text, no messages, no copy of the file."""

import struct
import tracemalloc

import pytest

from pipeline.recordings.recordings import Source, read
from tests.mcap_writing import Written

SOURCES = [Source("u", "u", "percent"), Source("y", "y", "degC")]
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
    def peak(samples: int) -> float:
        path = tmp_path / "recording"
        path.write_bytes(written(samples))
        tracemalloc.start()
        raw = read(path, SOURCES)
        used = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        rows = len(raw.signals["y"][1])
        assert rows >= 0.9 * samples
        return used / max(1, rows // samples)

    peak(1000)  # what is loaded at the first time
    assert peak(LONG) - peak(SHORT) < BYTES_A_SAMPLE * (LONG - SHORT)
