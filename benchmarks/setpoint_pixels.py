"""The closed loop through pixels: 21 starts x runs, published wait and window beside those derived from
measurements, and what befalls camera and nozzle.

`./run python -m benchmarks.setpoint_pixels [runs] [weights.npz]` prints the figures beside the bars and
writes benchmarks/results/setpoint_pixels.json; 10 runs are the whole. The small vision transformer is trained
here, or read from weights.npz (which is written where it does not exist). Nothing is fitted to the segments
that the loop runs through: network, calibration, recorded windows and episodes have generators of their own.
"""

import functools
import itertools
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
from pipeline.setpoint import calibration, deployment, judging, nozzle_scene, pixels
from pipeline.setpoint.baselines import Proportional, proportional
from pipeline.setpoint.bayes import CameraErrorModel, bayes, robust_filter
from pipeline.setpoint.classifier import Labelled, TrainingSettings, along_bead, predict, train, untrained
from pipeline.setpoint.deployment import ACTS, Limits, Waits
from pipeline.setpoint.pixels import Disturbances, Episodes, Loop, Machine, calm
from pipeline.setpoint.recorded import WindowTable
from pipeline.setpoint.vision_transformer import SMALL, from_named_arrays, named_arrays, vision_transformer
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
TRAINING = TrainingSettings(
    cycle_epochs=25,
    warmup_epochs=2,
    batch=64,
    learning_rate=1e-3,
    weight_decay=0.01,
    smoothing=0.0,
    averaging=0.99,
    patience=25,
)


class CameraModel(NamedTuple):
    """A calibrated classifier: classify(images, temperature) ->
    probabilities, scores; the rest as in calibration."""

    classify: object
    correlation: float
    level: float
    foreign_above: float
    rho: np.ndarray
    image_accuracy: float


def scenes(seed: int, segments: int, frames: int) -> tuple[Labelled, np.ndarray]:
    """Key areas of rendered scenes, and which are valid."""
    d = nozzle_scene.data_set(
        np.random.default_rng(seed), segments=segments, frames=frames, least_score=LEAST_SCORE
    )
    return Labelled(d.images, d.temperature.astype(np.float32), d.label, d.segment + 100_000 * seed), d.valid


def camera_model(weights: Path | None) -> CameraModel:
    """The small vision transformer, trained or read, and calibrated on segments that it never saw."""
    learned, learned_valid = scenes(1, 30, 10)
    network = vision_transformer(SMALL, np.random.default_rng(0))
    if weights and weights.exists():
        network = from_named_arrays(network, dict(np.load(weights)))
    else:
        held, held_valid = scenes(2, 4, 20)
        network = train(
            untrained(network, epochs=25),
            learned.take(np.flatnonzero(learned_valid)),
            held.take(np.flatnonzero(held_valid)),
            TRAINING,
            key=jax.random.key(0),
            augment=along_bead,
        ).best
        if weights:
            np.savez(weights, **named_arrays(network))
    familiar = calibration.fit_familiar(
        predict(network, learned.key_area[learned_valid], learned.temperature_degC[learned_valid]).features,
        learned.label[learned_valid],
    )
    held, valid = scenes(3, 12, LONGEST)
    prediction = predict(network, held.key_area, held.temperature_degC)
    T = calibration.fit_temperature(prediction.logits[valid], held.label[valid])
    log_p, shape = calibration.log_probabilities(prediction.logits, T), (-1, LONGEST)
    label, windows = held.label.reshape(shape)[:, 0], log_p.reshape(*shape, 3)
    correlation = calibration.fit_correlation(windows, valid.reshape(shape), label)
    p = calibration.window_probabilities(windows, valid.reshape(shape), correlation)
    level = calibration.conformal_level(
        p, label, held.segment.reshape(shape)[:, 0], coverage=0.9, confidence=0.5
    )
    foreign_above = calibration.foreign_above(
        calibration.mahalanobis(familiar, prediction.features[valid]), false_alarms=0.02
    )
    errors = np.where(valid, 1 - np.exp(log_p[np.arange(len(log_p)), held.label]), np.nan).reshape(shape)

    def classify(images, temperature):
        prediction = predict(network, images, temperature)
        return np.exp(calibration.log_probabilities(prediction.logits, T)), calibration.mahalanobis(
            familiar, prediction.features
        )

    right = float(np.mean((log_p.argmax(axis=1) == held.label)[valid]))
    rho = autocorrelation(errors, longest=LONGEST)
    return CameraModel(classify, correlation, level, foreign_above, rho, right)


def recorded(camera: CameraModel, frames: int, segments: int) -> WindowTable:
    """Windows of segments, each at every bin of the flow."""
    rng, rows = np.random.default_rng(4), []
    for s in range(segments):
        segment = nozzle_scene.draw_segment(rng)
        for low, high in itertools.pairwise(EDGES):
            flow, temperature = rng.uniform(low, high), rng.uniform(200, 220)
            made = nozzle_scene.render(segment, np.full(frames, flow), np.full(frames, temperature), rng)
            areas = nozzle_scene.key_areas(made, least_score=LEAST_SCORE)
            p, score = camera.classify(areas.images, made.temperature)
            rows.append(
                (np.log(np.clip(p, 1e-6, 1.0)), areas.valid & (score <= camera.foreign_above), flow, s)
            )
    log_p, valid, flow, segment = (np.array(column) for column in zip(*rows, strict=True))
    return calibration.recorded(log_p, valid, flow, segment, correlation=camera.correlation, flow_edges=EDGES)


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
            deployment.REASONS,
            (np.bincount(reason.ravel(), minlength=len(deployment.REASONS)) / reason.size).round(3).tolist(),
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


def main(runs: int, weights: Path | None) -> None:
    cv2.setNumThreads(1)
    camera = camera_model(weights)
    waits, measured = measured_waits(np.random.default_rng(5))
    frames = window_frames(camera.rho, wait_s=waits.flow_s, frame_rate_hz=RATE_HZ)
    effective = effective_frames(camera.rho)
    report = {
        "command": f"./run python -m benchmarks.setpoint_pixels {runs}", "machine": {"cores": os.cpu_count()},
        "bar": "21 starts x 10: >= 95 % settled",
        "image_accuracy": round(camera.image_accuracy, 3),
        "measured_waits_s": {k: round(v, 2) for k, v in measured.items()}, "window_frames": frames,
        "effective_frames": {str(frames): round(float(effective[frames - 1]), 2),
        "20": round(float(effective[19]), 2)}, "segment_s": SEGMENT_S, "cases": {},
    }  # fmt: skip
    print(json.dumps(report), flush=True)
    table = recorded(camera, frames, SEGMENTS)
    judge = functools.partial(
        deployment.judge_window, least_frames=max(2, round(0.4 * frames)), correlation=camera.correlation,
        foreign_above=camera.foreign_above,
        conformal_level=camera.level,
    )  # fmt: skip
    published = Loop(
        machine=MACHINE,
        classify=camera.classify,
        frames=frames,
        frame_rate_hz=RATE_HZ,
        waits=Waits(6.0, 6.0, 6.0),
        limits=LIMITS,
        judge=judge,
        least_score=LEAST_SCORE,
        tip_tolerance_px=TIP_TOLERANCE_PX,
        segment_mean_s=SEGMENT_S,
    )
    starts = np.array([[f, t] for f in judging.START_FLOWS for t in judging.START_TEMPERATURES])

    def robust(loop):
        decisions = max(SEGMENT_S / (loop.waits.flow_s + frames / RATE_HZ), 1.2)
        model = CameraErrorModel(**ROBUST.model_dump() | {"segment_mean_decisions": decisions})
        return bayes(ROBUST.hypotheses()), robust_filter(table, model)

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
    clog = calm(few)._replace(clog=np.full(few, 0.6), clog_at=np.full(few, 60))
    case("Bayes, robust, wait 6 s", robust(published), published, calm(n), 100, summary)
    case("Bayes, robust, derived wait", robust(derived), derived, calm(n), 100, summary)
    for name, disturbances in bursts(21).items():
        case(name, robust(published), published, disturbances, 20, held_after)
    case("Bayes, robust, clog x 0.6 at 60 of 120", robust(published), published, clog, 120, summary)
    case(
        "filtered proportional, wait 6 s",
        (proportional(), Proportional(gain=11.4, time_constant=11.2)),
        published,
        calm(few),
        100,
        summary,
    )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10, Path(sys.argv[2]) if len(sys.argv) > 2 else None)
