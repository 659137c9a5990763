"""Frames per second on one core from an MCAP trial to the bead's section, beside bare cv2 decoding of the
same bytes and the mcap package's reader; and of writing.

`./run python -m benchmarks.trial_frames` prints the figures beside the bars and writes
benchmarks/results/trial_frames.json. Frames are rendered, 640 x 480 mono8, at 30 a second for 15 s. Times are
CPU seconds, the best of five rounds in which the ways take turns.
"""

import itertools
import json
import struct
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from mcap.reader import make_reader

from pipeline.deposition.bead import area, measure_all
from pipeline.deposition.rendering import NOMINAL, Camera
from pipeline.deposition.workflow.trial_files import Conditions, Signals, read_trial, write_trial
from pipeline.store.mcap_frames import IMAGE_TOPIC

FRAMES, ROUNDS = 450, 5
# at least: of bare decoding for what is encoded, frames a second for what is not
BARS = {"jpeg": 0.65, "png": 0.65, "raw": 2500}
CONDITIONS = Conditions("A", "0.6 mm", 0, "on-off", 8.0, 0.6, 0.304, 125.0, 0.0, 90.0, -0.008, 60.0)
RESULTS = Path(__file__).parent / "results" / "trial_frames.json"


def rendered(count: int) -> list[np.ndarray]:
    """Frames of the nominal scene, the bead at 80 to 120 px."""
    camera = Camera(NOMINAL, np.random.default_rng(0))
    return [camera.frame(100.0 + 20 * np.sin(k), stage_px=33 * k) for k in range(count)]


def write(path: Path, frames: list[np.ndarray], encoding: str) -> None:
    t = np.arange(FRAMES // 30 * 50) / 50
    stream: Iterator = ((k / 30, frames[k % len(frames)]) for k in range(FRAMES))
    signals = Signals(t, 8 * t, np.full(t.size, 8.0), np.sin(t), np.cos(t))
    write_trial(path, CONDITIONS, stream, signals, encoding=encoding)


def encoded(path: Path) -> list[np.ndarray]:
    """The bytes of every picture, in memory: what bare decoding begins with."""
    return [
        np.frombuffer(bytes(picture.data), np.uint8)
        for _, picture in read_trial(path, unreadable_share=0.0).frames.pictures()
    ]


def bare(pictures: list[np.ndarray]) -> int:
    return sum(cv2.imdecode(picture, cv2.IMREAD_GRAYSCALE).shape[0] == 480 for picture in pictures)


def decoded(path: Path) -> int:
    """From the closed file on: signals read, everything checked, every frame decoded."""
    return sum(frame.shape[0] == 480 for _, frame in read_trial(path, unreadable_share=0.0).frames)


def measured(path: Path) -> int:
    frames = (frame for _, frame in read_trial(path, unreadable_share=0.0).frames)
    widths = []
    while batch := list(itertools.islice(frames, 16)):
        widths += [bead.width for bead in measure_all(batch, columns=(120, 640), longest_blur_px=3.5)]
    return int(np.isfinite(area(np.array(widths) / CONDITIONS.px_per_mm, CONDITIONS.contact_angle_deg)).sum())


def package(path: Path) -> int:
    """The mcap package's reader with its CRCs on, messages cut open by hand, decoded: no signals."""
    count = 0
    with path.open("rb") as stream:
        for _, channel, message in make_reader(stream, validate_crcs=True).iter_messages(
            log_time_order=False
        ):
            if channel.topic == IMAGE_TOPIC:
                count += (
                    np.frombuffer(message.data, np.uint8, 480 * 640, len(message.data) - 480 * 640)
                    .reshape(480, 640)
                    .shape[0]
                    == 480
                )
            elif channel.topic.startswith(IMAGE_TOPIC):
                start = 28 + struct.unpack_from("<I", message.data, 24)[0]
                start += -start % 4 + 4
                count += (
                    cv2.imdecode(
                        np.frombuffer(message.data, np.uint8, offset=start), cv2.IMREAD_GRAYSCALE
                    ).shape[0]
                    == 480
                )
    return count


def rates(ways: dict[str, Callable[[], int]]) -> dict[str, float]:
    """Frames per CPU second of each way, the best of ROUNDS."""
    best = dict.fromkeys(ways, np.inf)
    for _ in range(ROUNDS):
        for name, way in ways.items():
            start = time.process_time()
            count = way()
            best[name] = min(best[name], time.process_time() - start)
            assert count == FRAMES, (name, count)
    return {f"{name}_per_s": round(FRAMES / seconds, 1) for name, seconds in best.items()}


def main() -> None:
    cv2.setNumThreads(1)
    frames, results = rendered(60), {}
    with tempfile.TemporaryDirectory() as folder:
        for encoding, bar in BARS.items():
            path = Path(folder) / f"{encoding}.mcap"
            start = time.process_time()
            write(path, frames, encoding)
            figures = {
                "written_per_s": round(FRAMES / (time.process_time() - start), 1),
                "MB": round(path.stat().st_size / 1e6, 1),
            }
            ways = {
                "decoded": lambda p=path: decoded(p),
                "measured": lambda p=path: measured(p),
                "mcap_package": lambda p=path: package(p),
            }
            if encoding != "raw":
                pictures = encoded(path)
                ways["bare"] = lambda p=pictures: bare(p)
            figures |= rates(ways)
            share = (
                figures["measured_per_s"] / figures["bare_per_s"]
                if encoding != "raw"
                else figures["measured_per_s"]
            )
            figures |= {
                "measured_of_bare" if encoding != "raw" else "raw_measured_per_s": round(share, 3),
                "bar": bar,
            }
            results[encoding] = figures
            print(
                f"{encoding:>5}: {share:.3g} (bar {bar:g}); "
                + ", ".join(f"{name} {value:g}" for name, value in figures.items())
            )
    RESULTS.parent.mkdir(parents=True, exist_ok=True)
    RESULTS.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
