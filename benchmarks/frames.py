"""From frames to flow: bead width, empty frames, Q(t), learning through
pixels, and the time a frame takes, each beside its bar.

`./run python -m benchmarks.frames` writes its part of benchmarks/results.json. Figures are the worst over
seeds that nothing was tuned on; the scenes nominal and hard, and some like the others, were looked at while
the edge finder was made. Times are CPU milliseconds of one core, the quickest of several rounds.
"""

import itertools
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks import results
from benchmarks.results import Row
from pipeline.deposition.camera.bead import WidthCalibration, area, calibrate, measure, measure_all
from pipeline.deposition.camera.flow import Flow, View, estimate, sections
from pipeline.deposition.camera.rendering import HARD, NOMINAL, Scene, SimulatedCamera
from pipeline.deposition.drive import UNLIMITED
from pipeline.deposition.extruder import Extruder, disturb, draw, flow, routine
from pipeline.deposition.learning import ilc
from pipeline.recordings.trial_files import TrialConditions, TrialSignals, read_trial, write_trial

TS, SPEED, ANGLE_DEG, PX_PER_MM = 0.02, 8.0, 90.0, 125.0
AREA = float(area(0.88, ANGLE_DEG))
NOMINAL_FLOW = AREA * SPEED
VIEW, NOZZLE_MM, COLUMNS, LONGEST_BLUR_PX = View(1 / PX_PER_MM, 648.0), (0.25, 0.32), (0, 600), 6.0
R = routine(
    off_s=4, on_s=6, pause_s=0.6, tail_s=8, speed=SPEED, bead_area_mm2=AREA, ramp_s=0.15, sample_time_s=TS
)
CORNER = (R.time_s > R.pause_s[0] - 0.5) & (R.time_s < R.pause_s[1] + 0.5)
MATERIALS = {"A": Extruder(1.08, 2.7), "B": Extruder(0.89, 4.5)}
NOISE = {"white": 0.03, "drift": 0.01, "gain": 0.01}
INVERSE = ilc.InverseSettings(identify_trials=3, floor=0.1, order=4, cutoff_hz=5.0)
WIDTHS = np.array([60.0, 85.0, 110.0, 135.0, 160.0])
LEVELS = {"nominal": (NOMINAL, 0.12), "hard": (HARD, 0.30)}
OTHERS = {
    "blur_0.8_tilt_2": NOMINAL._replace(blur_px=0.8, tilt_deg=2.0),
    "tilt_-2_brighter": NOMINAL._replace(tilt_deg=-2.0, contrast=140.0, background=30.0),
    "dark_bead": NOMINAL._replace(background=150.0, contrast=-80.0),
    "blur_3_dim": NOMINAL._replace(blur_px=3.0, contrast=45.0),
    "hard_other_side": HARD._replace(specular_at=-0.6, tilt_deg=-2.0, offset_px=-40.0),
}


def millimetres(calibration: WidthCalibration, widths_px: np.ndarray) -> np.ndarray:
    """Widths in mm; 0 (bare substrate) stays 0 and NaN stays NaN."""
    return np.where(widths_px == 0, 0.0, calibration.gain * widths_px + calibration.offset)


def widths(scene: Scene, seed: int, frames: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Per width: mean error (px), deviation (px), and mean error after a calibration on the first, third and
    fifth, other frames than those judged."""
    rng = np.random.default_rng(seed)
    camera = SimulatedCamera(scene, rng)

    def measured(width):
        return [
            measure(
                camera.frame(width, stage_px=int(rng.integers(0, 10**6))),
                columns=COLUMNS,
                longest_blur_px=LONGEST_BLUR_PX,
            ).width
            for _ in range(frames)
        ]

    gauges = np.array([measured(w) for w in WIDTHS[::2]])
    calibration = calibrate(gauges.ravel(), np.repeat(WIDTHS[::2], frames) / PX_PER_MM)
    measured_px = np.array([measured(w) for w in WIDTHS])
    calibrated = millimetres(calibration, measured_px) * PX_PER_MM
    return measured_px.mean(axis=1) - WIDTHS, measured_px.std(axis=1), calibrated.mean(axis=1) - WIDTHS


def width_figures(seeds: int = 6, frames: int = 40) -> dict[str, Any]:
    out: dict[str, Any] = {
        "bars": "deviation <= 0.12 px nominal, 0.3 hard; bias <= 0.2 px; widths 60 to 160 px"
    }
    scenes = {name: (scene, range(100, 100 + seeds)) for name, (scene, _) in LEVELS.items()} | {
        name: (scene, range(200, 202)) for name, scene in OTHERS.items()
    }
    for name, (scene, drawn) in scenes.items():
        runs = [widths(scene, seed, frames) for seed in drawn]
        bias, deviation, calibrated = (np.array(part) for part in zip(*runs, strict=True))
        figures = {
            "worst_deviation_px": deviation.max(),
            "pooled_deviation_px": np.sqrt(np.mean(deviation**2)),
            "worst_bias_px": np.abs(bias).max(),
        }
        out[name] = {
            key: round(float(value), 3)
            for key, value in (figures | {"worst_bias_calibrated_px": np.abs(calibrated).max()}).items()
        }
        print(name, out[name], flush=True)
    return out


def empty_figures(frames: int = 500) -> dict[str, Any]:
    """Empty frames of 25 cameras a level, each with its own glare and texture."""
    out: dict[str, Any] = {"bar": "0 of 500 give a bead"}
    for name, (scene, _) in LEVELS.items():
        rng, beads = np.random.default_rng(300), []
        for _ in range(25):
            camera = SimulatedCamera(scene, rng)
            beads += [
                measure(
                    camera.empty(stage_px=int(rng.integers(0, 10**6))),
                    columns=COLUMNS,
                    longest_blur_px=LONGEST_BLUR_PX,
                )
                for _ in range(frames // 25)
            ]
        out[name] = {
            "frames": len(beads),
            "beads": sum(not bead.reason for bead in beads),
            "frames_with_any_width": sum(bool(np.nansum(bead.widths)) for bead in beads),
            "blocks_unread_percent": round(
                100 * float(np.mean([np.isnan(bead.widths) for bead in beads])), 3
            ),
        }
    return out


def flow_through_camera(camera: SimulatedCamera, Q: np.ndarray, calibration) -> Flow:
    frames = camera.trial(
        R.time_s,
        Q,
        R.position,
        view=VIEW,
        frame_rate_hz=30.0,
        nozzle_mm=NOZZLE_MM,
        contact_angle_deg=ANGLE_DEG,
    )
    times, beads = [], []
    while some := list(itertools.islice(frames, 16)):
        times += [t for t, _ in some]
        beads += measure_all([frame for _, frame in some], columns=COLUMNS, longest_blur_px=LONGEST_BLUR_PX)
    x = np.interp(times, R.time_s, R.position)
    mm = millimetres(calibration, np.array([bead.widths for bead in beads]))
    places = sections(
        x, beads[0].columns, mm, view=VIEW, nozzle_radius_mm=NOZZLE_MM[0], contact_angle_deg=ANGLE_DEG
    )
    return estimate(
        R.time_s,
        R.position,
        places,
        nozzle_radius_mm=NOZZLE_MM[0],
        shapes=R.r[None],
        contact_angle_deg=ANGLE_DEG,
        width_deviation_mm=calibration.deviation,
    )


def gauged(camera: SimulatedCamera, rng: np.random.Generator, each: int = 5):
    """A calibration on four known widths, as a user would make it."""
    widths_mm = np.repeat([0.55, 0.75, 0.95, 1.2], each)
    frames = [camera.frame(w * PX_PER_MM, stage_px=int(rng.integers(0, 10**6))) for w in widths_mm]
    return calibrate(
        np.array(
            [measure(frame, columns=COLUMNS, longest_blur_px=LONGEST_BLUR_PX).width for frame in frames]
        ),
        widths_mm,
    )


def errors(estimated: Flow, Q: np.ndarray) -> dict[str, float]:
    e, slope = 100 * (estimated.flow - Q) / NOMINAL_FLOW, np.gradient(Q, TS)
    speed = np.abs(np.gradient(R.position, TS))
    inside = speed <= 0.05 * speed.max()
    off = (estimated.flow - Q)[inside].sum() * TS
    steady = (R.time_s > R.start_s + 2) & (R.time_s < R.pause_s[0] - 0.5)
    return {
        "rms_percent": float(np.sqrt(np.mean(e**2))),
        "corner_percent": float(np.sqrt(np.mean(e[CORNER] ** 2))),
        "mean_steady_percent": float(abs(e[steady].mean())),
        "lag_ms": float(abs(1e3 * slope @ (estimated.flow - Q) / (slope @ slope))),
        "pause_volume_percent_of_0.6_s": float(100 * abs(off) / (0.6 * NOMINAL_FLOW)),
        "errors_over_deviation": float(
            np.sqrt(
                np.mean(
                    np.square(
                        (estimated.flow - Q)[estimated.observable] / estimated.deviation[estimated.observable]
                    )
                )
            )
        ),
    }


def plants(seed: int) -> list[tuple[str, Extruder]]:
    rng = np.random.default_rng(seed)
    return [
        (name, draw(rng, gain=m.gain, time_constant_s=m.time_constant_s, steady_flow=NOMINAL_FLOW))
        for name, m in MATERIALS.items()
    ]


def flow_figures(seeds: int = 3) -> dict[str, Any]:
    """Q(t) of three kinds of trial on drawn plants: the first (on-off), one half
    way to the wanted flow, one that prints as wanted."""
    out: dict[str, Any] = {
        "bars": "rms <= 2.5 % of nominal, <= 6 % within 0.5 s of the pause; lag below 33 ms"
    }
    for level, (scene, _) in LEVELS.items():
        rows: dict[str, list[dict[str, float]]] = {}
        for seed in range(400, 400 + seeds):
            rng = np.random.default_rng(seed)
            camera = SimulatedCamera(scene, rng)
            calibration = gauged(camera, rng)
            for name, plant in plants(seed):
                first = flow(plant, R.r / MATERIALS[name].gain, sample_time_s=TS)
                for kind, Q in {"on_off": first, "half_way": (first + R.r) / 2, "as_wanted": R.r}.items():
                    rows.setdefault(kind, []).append(errors(flow_through_camera(camera, Q, calibration), Q))
        out[level] = {
            kind: {f"worst_{key}": round(max(row[key] for row in of_kind), 2) for key in of_kind[0]}
            for kind, of_kind in rows.items()
        }
        print(level, out[level], flush=True)
    return out


def learned(name: str, plant: Extruder, scene: Scene, seed: int, trials: int) -> list[float]:
    """True error of each trial in percent of trial 0: trial -> frames -> widths
    -> Q(t) -> law, a fresh part of the stage each time.

    What is laid is the true flow with the trial noise of the plant family; the figure is the true flow's."""
    rng = np.random.default_rng(seed)
    camera = SimulatedCamera(scene, rng)
    calibration = gauged(camera, rng)

    def run(u):
        Q = flow(plant, u, sample_time_s=TS)
        laid = np.maximum(disturb(Q, rng, steady_flow=NOMINAL_FLOW, **NOISE), 0.0)
        estimated = flow_through_camera(camera, laid, calibration)
        return ilc.Trial(u, np.where(estimated.observable, estimated.flow, np.nan), Q)

    law = ilc.InverseLaw(R.r, INVERSE, drive=UNLIMITED, sample_time_s=TS)
    done = ilc.learn(law, run, R.r / MATERIALS[name].gain, R.r, trials=trials, rise=0.05)
    rows = ilc.table(
        done, R.r, steady=NOMINAL_FLOW / MATERIALS[name].gain, drive=UNLIMITED, sample_time_s=TS, rise=0.05
    )
    ratios = [round(100 * row.ratio, 2) for row in rows]
    return ratios + [ratios[-1]] * (trials + 1 - len(ratios))


def pixel_figures(trials: int = 15) -> dict[str, Any]:
    out: dict[str, Any] = {"bars": "percent of trial 0: <= 20 at trial 2, <= 10 at 4, <= 5 at 15"}
    for level, seeds in {"nominal": range(500, 503), "hard": range(510, 511)}.items():
        runs = []
        for seed, (name, plant) in itertools.chain.from_iterable(
            [(seed, pair) for pair in plants(seed)] for seed in seeds
        ):
            runs.append(learned(name, plant, LEVELS[level][0], seed, trials))
            print(level, name, seed, runs[-1], flush=True)
        out[level] = {
            "runs": len(runs),
            **{f"worst_at_{j}": max(run[j] for run in runs) for j in (1, 2, 4, 6, trials)},
        }
    return out


# ---- recorded trials

RECORDED, ROUNDS = 450, 5
CONDITIONS = TrialConditions(
    "A", "0.6 mm", 0, "on-off", 0, 8.0, 4.0, 6.0, 0.6, 8.0, 0.304, 125.0, 0.0, 90.0, -0.008, 60.0
)


def rendered(count: int) -> list[np.ndarray]:
    """Frames of the nominal scene, the bead at 80 to 120 px."""
    camera = SimulatedCamera(NOMINAL, np.random.default_rng(0))
    return [camera.frame(100.0 + 20 * np.sin(k), stage_px=33 * k) for k in range(count)]


def record(path: Path, frames: list[np.ndarray], encoding: str) -> None:
    t = np.arange(RECORDED // 30 * 50) / 50
    stream: Iterator = ((k / 30, frames[k % len(frames)]) for k in range(RECORDED))
    signals = TrialSignals(t, 8 * t, np.full(t.size, 8.0), np.sin(t), np.cos(t))
    write_trial(path, CONDITIONS, stream, signals, encoding=encoding)


def only_read(path: Path) -> int:
    """From the closed file on: signals read, everything checked, every frame decoded."""
    return sum(frame.shape[0] == 480 for _, frame in read_trial(path, unreadable_share=0.0).frames)


def read_and_measured(path: Path) -> int:
    frames = (frame for _, frame in read_trial(path, unreadable_share=0.0).frames)
    widths = []
    while batch := list(itertools.islice(frames, 16)):
        widths += [bead.width for bead in measure_all(batch, columns=(120, 640), longest_blur_px=3.5)]
    return int(np.isfinite(area(np.array(widths) / CONDITIONS.px_per_mm, CONDITIONS.contact_angle_deg)).sum())


def recorded_figures() -> dict[str, dict[str, float]]:
    """Frames a CPU second from a closed MCAP file, raw and as the recorder writes it by default, JPEG."""
    frames, out = rendered(60), {}
    with tempfile.TemporaryDirectory() as folder:
        for encoding in ("raw", "jpeg"):
            path = Path(folder) / f"{encoding}.mcap"
            record(path, frames, encoding)
            seconds = {
                way.__name__: min(_taken(way, path) for _ in range(ROUNDS))
                for way in (only_read, read_and_measured)
            }
            out[encoding] = {
                "decoded_per_s": RECORDED / seconds["only_read"],
                "measured_per_s": RECORDED / seconds["read_and_measured"],
            }
    return out


def _taken(way: Callable[[Path], int], path: Path) -> float:
    begun = time.process_time()
    if way(path) != RECORDED:
        raise ValueError(f"{path.name}: expected {RECORDED} frames")
    return time.process_time() - begun


# ---- the rows


def rows(found: dict[str, Any]) -> list[Row]:
    """Errors of widths, of empty frames and of Q(t); learning through pixels; frames a second."""
    out = []
    for level, deviation in (("nominal", 0.12), ("hard", 0.3)):
        one = found["width"][level]
        out.append(
            Row(
                f"bead width, {level} scene: worst deviation",
                f"{one['worst_deviation_px']:g} px",
                f"at most {deviation:g} px",
                f"worst bias {one['worst_bias_px']:g} px, {one['worst_bias_calibrated_px']:g} px calibrated",
            )
        )
        empty = found["empty"][level]
        out.append(Row(f"{empty['frames']} empty frames, {level}: beads found", f"{empty['beads']}", "0"))
        first = found["flow"][level]["on_off"]
        out.append(
            Row(
                f"Q(t) of an on-off trial, {level}: r.m.s. error",
                f"{first['worst_rms_percent']:g} %",
                "at most 2.5 %",
                f"near the pause {first['worst_corner_percent']:g} %, lag {first['worst_lag_ms']:g} ms",
            )
        )
        learned = found["pixels"][level]
        out.append(
            Row(
                f"learning through pixels, {level}, {learned['runs']} runs: true error after 15 updates",
                f"{learned['worst_at_15']:g} %",
                "at most 5 % of trial 0",
                f"after 2 updates {learned['worst_at_2']:g} %",
            )
        )
    for encoding, one in found["recorded"].items():
        out.append(
            Row(
                f"frames of a recorded trial, {encoding}, to the bead's area",
                f"{one['measured_per_s']:,.0f} frames/s",
                "at least 2,500 frames/s" if encoding == "raw" else "",
                f"only read and checked: {one['decoded_per_s']:,.0f} frames/s",
            )
        )
    return out


def main() -> None:
    cv2.setNumThreads(1)
    figures = {"width": width_figures(), "empty": empty_figures(), "flow": flow_figures()}
    results.write("frames", rows(figures | {"pixels": pixel_figures(), "recorded": recorded_figures()}))


if __name__ == "__main__":
    main()
