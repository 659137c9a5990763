"""How many frames a second the watch decides on: `taskset -c 0 ./run python -m benchmarks.shadow_rate`.

Frames of 1280 x 720 px as JPEG in a folder and as MCAP, read, judged and written down as by
`./run beadline shadow --once`, with the small network (its weights do not matter to its speed) and the robust
filter's size of belief. The first window, in which everything is compiled, is told apart. Beside other work
on the same core the processor's time tells what the core alone would do.
"""

import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from pipeline.setpoint import actuation, bayes, calibration, deployment, nozzle_scene
from pipeline.setpoint.calibrated_classifier import CalibratedClassifier, read_frames
from pipeline.setpoint.vision_transformer import SMALL, vision_transformer
from pipeline.setpoint.window_flow import KNOTS_PERCENT, FlowCalibration, window_flow
from pipeline.setpoint.workflow import shadow
from pipeline.setpoint.workflow.frame_mcap import Topics
from pipeline.setpoint.workflow.shadow.decide import Asked, Deployed
from pipeline.setpoint.workflow.watch_sources import Folder, Recording
from pipeline.store.mcap_frames import write_frames

WINDOW, WINDOWS, SIZE, HZ = 20, 16, (720, 1280), 20.0


def frames(count: int) -> tuple[list[np.ndarray], tuple[float, float]]:
    """A rendered nozzle in the middle of a larger, noisy ground."""
    rng = np.random.default_rng(0)
    segment = nozzle_scene.draw_segment(rng)
    scene = nozzle_scene.render(segment, np.full(20, 100.0), 210.0, rng)
    h, w = scene.frames.shape[1:]
    top, left = (SIZE[0] - h) // 2, (SIZE[1] - w) // 2
    ground = rng.integers(60, 90, SIZE).astype(np.uint8)
    pictures = []
    for k in range(count):
        picture = ground.copy()
        picture[top : top + h, left : left + w] = scene.frames[k % 20]
        picture[k % 50, :] = k % 256  # no two alike
        pictures.append(picture)
    return pictures, (left + float(scene.tip[0]), top + float(scene.tip[1]))


def deployed() -> Deployed:
    network = vision_transformer(SMALL, np.random.default_rng(0))
    rng = np.random.default_rng(1)
    f = network.head.classes.W.shape[0] + calibration.appearance(np.zeros((1, 16, 48), np.uint8)).shape[1]
    knots = np.log(np.array(KNOTS_PERCENT) / 100)
    flow = FlowCalibration(knots, np.ones(len(knots)), 0.5)
    familiar = calibration.Familiar(rng.standard_normal((3, f)), np.eye(f))
    model = CalibratedClassifier(network, calibration.Calibration(1.0, 0.5, 0.1, familiar, 1e9, flow))
    limits = actuation.Limits(
        np.array([20.0, 180.0]), np.array([310.0, 240.0]), np.array([10.0, 20.0]), np.array([40.0, 40.0])
    )

    def judge(*window, flows):
        return deployment.judge_window(
            *window, flows=flows, least_frames=8, correlation=0.5, foreign_above=1e9, conformal_level=0.1
        )

    parameters = bayes.class_filter(accuracy=0.8, hazard=0.02, move_cost=0.5, outside_cost=5.0)
    return Deployed(
        lambda images, temperature: read_frames(model, images, temperature),
        partial(window_flow, fitted=flow), None, "Bayes",
        bayes.bayes(1), parameters, WINDOW, 10.0, judge, limits, 6.0, 10.0,
    )  # fmt: skip


def main() -> None:
    pictures, tip = frames(WINDOW * WINDOWS)
    with tempfile.TemporaryDirectory() as folder:
        here = Path(folder)
        (here / "in").mkdir()
        for k, picture in enumerate(pictures):
            (here / f"in/f{k}.jpg").write_bytes(cv2.imencode(".jpg", picture)[1].tobytes())
        times = np.arange(len(pictures)) / HZ
        write_frames(here / "a.mcap", {}, {}, times, ("jpeg", zip(times.tolist(), pictures, strict=True)))
        for name, source in (
            ("folder", Folder(here / "in")),
            ("MCAP", Recording(here / "a.mcap", Topics("", "", {}))),
        ):
            ends: list[tuple[float, float]] = []
            ready = deployed()
            read = ready.read

            def timed(images, temperature, read=read, ends=ends):
                ends.append((time.perf_counter(), time.process_time()))
                return read(images, temperature)

            asked = Asked(100.0, 210.0, tip, once=True)
            ready = ready._replace(read=timed)
            shadow.watch(source, ready, asked, here / name, place=name, stopped=lambda: False)
            wall, processor = WINDOW / np.median(np.diff(np.array(ends)[1:], axis=0), axis=0)
            print(
                f"{name}: {wall:.0f} frames/s, {processor:.0f} by processor time, {SIZE[1]} x {SIZE[0]} px; "
                f"first window {ends[1][0] - ends[0][0]:.1f} s",
                file=sys.stdout,
            )


if __name__ == "__main__":
    main()
