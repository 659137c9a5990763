"""The closed loop through pixels: 21 starts x runs, published wait and window beside those derived from
measurements, and what befalls camera and nozzle.

`./run python -m benchmarks.setpoint_pixels [runs]` prints the figures beside the bars and writes
benchmarks/results/setpoint_pixels.json; 10 runs are the whole. The classifier is the one that
datasets/train_classifier holds; make it with `./run dvc repro train_classifier`. Nothing was fitted to the
segments that the loop runs through: recorded windows and episodes have generators of their own.
"""

import functools
import json
import os
import sys
import time
from pathlib import Path
from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.waits import (
    autocorrelation,
    derived_waits,
    effective_frames,
    settling_s,
    step_response,
    window_frames,
)
from pipeline.setpoint import actuation, calibration, deployment, judging, nozzle_scene, pixels
from pipeline.setpoint.actuation import ACTS, Limits, Waits
from pipeline.setpoint.baselines import Proportional, proportional
from pipeline.setpoint.bayes import CameraErrorModel, bayes, watching_filter
from pipeline.setpoint.calibrated_classifier import CalibratedClassifier, read_frames
from pipeline.setpoint.pixels import Disturbances, Episodes, Loop, Machine, calm
from pipeline.setpoint.recorded import WindowTable
from pipeline.setpoint.window_flow import WindowFlow, window_flow
from pipeline.setpoint.workflow.classifier_files import restore_classifier
from pipeline.setpoint.workflow.settings import EvaluateSetpoint
from pipeline.statistics import wilson
from pipeline.store import params

RESULTS = Path(__file__).parent / "results" / "setpoint_pixels.json"
LEAST_SCORE, RATE_HZ, LONGEST = 10.0, 20.0, 20
MACHINE = Machine(heater_s=15.0, heater_delay_s=2.0, melt_s=1.2, softening_per_degC=0.02)
LIMITS = Limits(
    np.array([20.0, 180.0]), np.array([310.0, 240.0]), np.array([10.0, 20.0]), np.array([180.0, 40.0])
)
SEGMENT_S = 10.0
EDGES = np.r_[20, 30, 40, 50, 60, np.arange(70, 130.1, 2.5), 150, 180, 220, 260, 310]
SECTION = params.load(EvaluateSetpoint, "evaluate_setpoint")
ROBUST, TIP_TOLERANCE_PX = SECTION.baselines.bayes_robust, SECTION.pixels.tip_tolerance_px
SEGMENTS = 24  # whose windows are recorded
STORED = [f"datasets/train_classifier/{name}" for name in ("weights.safetensors", "calibration.parquet")]


class HeldOut(NamedTuple):
    """The classifier on frames of new segments: the share of images that it names rightly, and rho (LONGEST,)
    of its errors."""

    image_accuracy: float
    rho: np.ndarray


def held_out(model: CalibratedClassifier, segments: int = 180) -> HeldOut:
    """As `HeldOut` has it, on segments with the flows that it was calibrated with."""
    rng = np.random.default_rng(3)
    temperature = np.resize(nozzle_scene.TEMPERATURES, segments)
    flow = nozzle_scene.draw_flow(rng, segments)
    made = nozzle_scene.filmed(rng, flow, temperature, frames=LONGEST, least_score=LEAST_SCORE)
    prob = read_frames(model, made.images, made.temperature).prob
    wrong = np.where(made.valid, 1 - prob[np.arange(len(prob)), made.label], np.nan)
    right = float(np.mean((prob.argmax(axis=1) == made.label)[made.valid]))
    return HeldOut(right, autocorrelation(wrong.reshape(-1, LONGEST), longest=LONGEST))


def recorded(model: CalibratedClassifier, frames: int, segments: int) -> WindowTable:
    """Windows of segments, each at every bin of the flow."""
    rng, fitted, flows, seen = np.random.default_rng(4), model.calibration, [], []
    for _ in range(segments):
        segment, degrees = nozzle_scene.draw_segment(rng), rng.choice(nozzle_scene.TEMPERATURES)
        flow = rng.uniform(EDGES[:-1], EDGES[1:])
        made = nozzle_scene.render(segment, np.repeat(flow, frames), degrees, rng)
        areas = nozzle_scene.key_areas(made, least_score=LEAST_SCORE)
        read = read_frames(model, areas.images, made.temperature)
        rows = read.log_flow, read.deviation, areas.valid & (read.distance <= fitted.foreign_above)
        seen.append(window_flow(*(a.reshape(-1, frames) for a in rows), fitted.flow))
        flows.append(flow)
    windows = WindowFlow(*(np.concatenate(columns) for columns in zip(*seen, strict=True)))
    number = np.repeat(np.arange(segments), len(EDGES) - 1)
    return calibration.recorded(windows, np.concatenate(flows), number, flow_edges=EDGES)


def measured_waits(rng: np.random.Generator) -> tuple[Waits, dict]:
    """Waits from step records with sensors' noise: until the mean of a window's time stays within a tenth of
    a 10 % step, at the coldest nozzle, which is the slowest; of the target until the flow does so again, and
    until the nozzle is within 1 °C."""
    tick, at, window = 1 / RATE_HZ, 40, 20

    def settled(flow, temperature, column, band, noise, after):
        record = step_response(
            MACHINE, flow=flow, temperature=temperature, before_s=at * tick, after_s=after, tick_s=tick
        )[column]
        return settling_s(
            record + rng.normal(0, noise, len(record)), at=at, band=band, window=window, sample_time_s=tick
        )

    flow = max(
        settled((100.0, 100.0 + d), (190.0, 190.0), 0, 1.0, 1.0, 20.0)
        for d in (10.0, -10.0)
        for _ in range(3)
    )
    target = max(
        settled((100.0, 100.0), (210.0 - d, 210.0), 0, 1.0, 1.0, 80.0)
        for d in (20.0, -20.0)
        for _ in range(3)
    )
    heater = max(settled((100.0, 100.0), (210.0 - d, 210.0), 1, 1.0, 0.2, 120.0) for d in (20.0, -20.0))
    return derived_waits(flow, target, transport_s=0.1), {
        "flow_s": flow,
        "flow_after_target_s": target,
        "heater_s": heater,
    }


def summary(e: Episodes) -> dict:
    """Settled ten decisions before the end, with its Wilson interval; decisions and minutes of the settled,
    flow error of the last 20 windows, reasons, cuts."""
    decisions = e.time_s.shape[1]
    since = pixels.settled_since(e)
    ok = since <= decisions - 10
    minutes = e.time_s[np.arange(len(ok)), np.minimum(since, decisions - 1)][ok] / 60
    share = wilson(ok)
    return {
        "episodes": len(ok), "settled": round(share.percent, 1),
        "interval": [round(share.low, 1), round(share.high, 1)],
        "decisions_median_p90": np.percentile(since[ok], [50, 90]).round(1).tolist() if ok.any() else None,
        "minutes_median_p90": np.percentile(minutes, [50, 90]).round(2).tolist() if ok.any() else None,
        "flow_error": round(float(np.abs(e.flow[:, -20:] - 100).mean()), 2),
        "windows": reasons(e.windows.reason), "cuts": e.clipped.sum(axis=0).tolist(),
    }  # fmt: skip


def reasons(reason: np.ndarray) -> dict[str, float]:
    return dict(
        zip(
            actuation.REASONS,
            (np.bincount(reason.ravel(), minlength=len(actuation.REASONS)) / reason.size).round(3).tolist(),
            strict=True,
        )
    )


def held_after(e: Episodes) -> dict:
    """What was held from decision 10 on, why, and how far the flow setpoint
    went in that time; moves of held windows must be 0."""
    reason, sent = e.windows.reason[:, 10:], e.sent[:, 10:]
    return {
        "held": round(float(np.mean(reason != ACTS)), 3), "windows": reasons(reason),
        "moves while held": int((sent[reason != ACTS] != 0).sum()),
        "flow_moved": round(float(np.abs(sent[:, :, 0]).sum(axis=1).mean()), 1),
    }  # fmt: skip


def bursts(n: int) -> dict[str, Disturbances]:
    """What befalls the camera from decision 10 on."""
    ten = np.full(n, 10)
    return {
        "blur 4 px": calm(n)._replace(blur_px=np.full(n, 4.0), burst_at=ten, burst_for=ten),
        "blur 8 px": calm(n)._replace(blur_px=np.full(n, 8.0), burst_at=ten, burst_for=ten),
        "glare": calm(n)._replace(glare=np.full(n, 120.0), burst_at=ten, burst_for=ten),
        "shift 3 px": calm(n)._replace(shift_px=np.tile([3.0, -1.0], (n, 1)), shift_at=ten),
        "shift 14 px": calm(n)._replace(shift_px=np.tile([12.0, -8.0], (n, 1)), shift_at=ten),
    }


def main(runs: int) -> None:
    cv2.setNumThreads(1)
    model = restore_classifier(*STORED)
    fitted, new = model.calibration, held_out(model)
    waits, measured = measured_waits(np.random.default_rng(5))
    frames = window_frames(new.rho, wait_s=waits.flow_s, frame_rate_hz=RATE_HZ)
    effective = effective_frames(new.rho)
    report = {
        "command": f"./run python -m benchmarks.setpoint_pixels {runs}", "machine": {"cores": os.cpu_count()},
        "bar": "21 starts x 10: >= 95 % settled",
        "image_accuracy": round(new.image_accuracy, 3),
        "measured_waits_s": {k: round(v, 2) for k, v in measured.items()}, "window_frames": frames,
        "effective_frames": {str(frames): round(float(effective[frames - 1]), 2),
        "20": round(float(effective[19]), 2)}, "segment_s": SEGMENT_S, "cases": {},
    }  # fmt: skip
    print(json.dumps(report), flush=True)
    table = recorded(model, frames, SEGMENTS)
    judge = functools.partial(
        deployment.judge_window, least_frames=max(2, round(0.4 * frames)), correlation=fitted.correlation,
        foreign_above=fitted.foreign_above,
        conformal_level=fitted.level,
    )  # fmt: skip
    published = Loop(
        machine=MACHINE,
        classify=functools.partial(read_frames, model),
        frames=frames,
        frame_rate_hz=RATE_HZ,
        waits=Waits(6.0, 6.0, 6.0),
        limits=LIMITS,
        judge=judge,
        least_score=LEAST_SCORE,
        tip_tolerance_px=TIP_TOLERANCE_PX,
        segment_mean_s=SEGMENT_S,
        window_flow=functools.partial(window_flow, fitted=fitted.flow),
    )
    starts = np.array([[f, t] for f in judging.START_FLOWS for t in judging.START_TEMPERATURES])

    def robust(loop):
        decisions = max(SEGMENT_S / (loop.waits.flow_s + frames / RATE_HZ), 1.2)
        model = CameraErrorModel(**ROBUST.model_dump() | {"segment_mean_decisions": decisions})
        return bayes(ROBUST.hypotheses()), watching_filter(table, model)

    def case(name, controller, loop, disturbances, decisions, judged):
        began, n = time.process_time(), len(disturbances.clog)
        parameters = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), controller[1])
        start = np.tile(starts, (n // 21, 1))
        e = pixels.run(
            controller[0],
            parameters,
            start,
            loop,
            disturbances,
            decisions=decisions,
            rng=np.random.default_rng(6),
        )
        report["cases"][name] = judged(e) | {"cpu_s": round(time.process_time() - began, 1)}
        print(name, report["cases"][name], flush=True)
        RESULTS.write_text(json.dumps(report, indent=2) + "\n")

    derived, n, few = published._replace(waits=waits), 21 * runs, 21 * max(1, runs // 5)
    filtered = robust(published)
    clog = calm(few)._replace(clog=np.full(few, 0.6), clog_at=np.full(few, 60))
    case("Bayes, robust, wait 6 s", filtered, published, calm(n), 100, summary)
    case("Bayes, robust, derived wait", robust(derived), derived, calm(n), 100, summary)
    for name, disturbances in bursts(21).items():
        case(name, filtered, published, disturbances, 20, held_after)
    case("Bayes, robust, clog x 0.6 at 60 of 120", filtered, published, clog, 120, summary)
    case(
        "filtered proportional, wait 6 s",
        (proportional(), Proportional(gain=11.4, time_constant=11.2)),
        published,
        calm(few),
        100,
        summary,
    )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10)
