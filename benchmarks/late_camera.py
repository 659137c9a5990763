"""A machine learns its reference routine through a camera that nobody drew for it: turned, late, before dark
or light beads on four grounds, whose edges look wider than they are; calibrated on pictures of five lines.

`./run python -m benchmarks.late_camera` (`--only 0,3` for some cases, `--trials 4` for a look) prints the
true error, the latency told and the flow's bias, and writes benchmarks/results/late_camera.json.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.foreign_camera import GROUNDS, Eye, Stage, tip_of, trial
from pipeline.deposition import training
from pipeline.deposition.extruder import Extruder, disturb, draw, flow
from pipeline.deposition.ilc import Trial
from pipeline.deposition.workflow import calibrate_camera, laws, trial_files, trial_video
from pipeline.deposition.workflow.settings import Camera, Printer, TrainIlc
from pipeline.store import params

RESULTS = Path(__file__).parent / "results" / "late_camera.json"
WIDTHS_MM = (0.5, 0.7, 0.9, 1.1, 1.3)
# at most
BARS = {"true_error_percent": 4.0, "latency_error_ms": 5.0, "flow_bias_percent": 1.5}
HZ, PICTURES, TRIALS = 30, 3, 15
WHITE, DRIFT, GAIN = 0.03, 0.01, 0.01


def eyes() -> list[Eye]:
    """One a ground and colour; directions, latencies and biases drawn."""
    rng, out = np.random.default_rng(19), []
    for ground in GROUNDS:
        for dark in (False, True):
            out.append(
                Eye(
                    angle_deg=float(rng.uniform(0, 360)), mirrored=bool(rng.integers(2)), dark=dark,
                    ground=ground, edge_bias_px=float(rng.uniform(0, 1.5)), widening=0.3,
                    latency_s=float(rng.uniform(0, 0.1)), height=360, width=480, mm_per_px=0.0105,
                )
            )  # fmt: skip
    return out


def calibrated(eye: Eye, camera: Camera, printer: Printer, rng: np.random.Generator) -> Camera:
    """Section `camera` as the command would write it, from pictures of lines of WIDTHS_MM with the tip given
    to two pixels."""
    pictures = []
    for width in WIDTHS_MM:
        stage = Stage(eye, np.full(round(20 / eye.mm_per_px), width), -10.0, rng)
        pictures.append([stage.frame(x) for x in np.linspace(0, 3, PICTURES)])
    x, y = tip_of(eye)
    tip = (round(x + rng.uniform(-2, 2)), round(y + rng.uniform(-2, 2)))
    asked = calibrate_camera.Asked([Path(f"{width}") for width in WIDTHS_MM], WIDTHS_MM, tip, float("nan"))
    done = calibrate_camera.calibrated(pictures, asked, camera, printer)
    return calibrate_camera.settings_of(camera, done.values)


def learned(eye: Eye, number: int, trials: int) -> dict[str, Any]:
    """Figures of one camera: `trials` updates from on-off control through recordings."""
    settings, printer = params.load(TrainIlc, "train_ilc"), params.load(Printer, "printer")
    rng = np.random.default_rng([19, number])
    camera = calibrated(eye, params.load(Camera, "camera"), printer, rng)
    material, routine = printer.materials[0], printer.trained()[0]
    nominal = Extruder(material.gain_mm3_per_s_per_mm, material.time_constant_s)
    plant = draw(
        rng, gain=nominal.gain, time_constant_s=nominal.time_constant_s, steady_flow=printer.steady_flow
    )
    law_settings, measured = laws.law_settings(settings, printer), []
    none = trial_video.bead.Calibration(abs(camera.mm_per_px), 0.0, 0.0, np.zeros(0))
    conditions = trial_video.conditions(
        material, routine, 0, "on_off", printer=printer, camera=camera, calibration=none
    )

    def measure(u: np.ndarray) -> Trial:
        truth = flow(plant, u, sample_time_s=printer.sample_time_s, limit=printer.limit)
        laid = np.maximum(
            disturb(truth, rng, steady_flow=routine.r.max(), white=WHITE, drift=DRIFT, gain=GAIN), 0.0
        )
        pictures = trial(
            eye,
            routine.time_s,
            laid,
            routine.position,
            rng,
            hz=HZ,
            contact_angle_deg=camera.contact_angle_deg,
        )
        signals = trial_files.Signals(routine.time_s, routine.position, routine.speed, u, truth)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "trial.mcap"
            trial_files.write_trial(path, conditions, pictures, signals, encoding="jpeg")
            earlier = [one.latency for one in measured]
            measured.append(
                trial_video.measure_trial(path, routine, printer=printer, camera=camera, earlier=earlier)
            )
        steady = routine.r > 0.99 * routine.r.max()
        bias.append(100 * float(np.nanmean(measured[-1].flow.flow[steady]) / np.mean(laid[steady]) - 1))
        return measured[-1].trial

    bias: list[float] = []
    done = training.run_trials(
        "pixels", training.model_inverse(routine, law_settings), measure, routine, nominal,
        trials=trials, settings=law_settings, on_step=lambda _: None,
    )  # fmt: skip
    last = measured[-1].of_camera
    return eye._asdict() | {
        "rotation_deg": camera.rotation_deg,
        "edge_bias_told_px": camera.edge_bias_px,
        "true_error_percent": 100 * training.ratio_at(done, trials, rise=settings.model_inverse.rise),
        "ratios": [round(row.ratio, 5) for row in done.rows],
        "latency_told_s": last.latency_s,
        "latency_error_ms": 1e3 * abs(last.latency_s - eye.latency_s),
        "latency_deviation_ms": 1e3 * last.deviation_s if np.isfinite(last.deviation_s) else None,
        "flow_bias_percent": float(np.median(bias)),
        "rejected_percent": 100
        * sum(sum(one.rejected.values()) for one in measured)
        / sum(one.frames for one in measured),
    }


def main() -> None:
    cv2.setNumThreads(1)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="numbers of the cameras")
    parser.add_argument("--trials", type=int, default=TRIALS)
    arguments = parser.parse_args()
    cameras = eyes()
    chosen = [int(k) for k in arguments.only.split(",") if k] or range(len(cameras))
    results = {}
    for k in chosen:
        start = time.monotonic()
        one = results[f"{cameras[k].ground}, {'dark' if cameras[k].dark else 'light'}"] = learned(
            cameras[k], k, arguments.trials
        )
        print(
            f"{k} {cameras[k].ground}, {'dark' if cameras[k].dark else 'light'}, "
            f"{cameras[k].angle_deg:.0f} deg, {cameras[k].edge_bias_px:.2f} px, "
            f"{1e3 * cameras[k].latency_s:.0f} ms: "
            + ", ".join(f"{name} {one[name]:.2f} (bar {bar:g})" for name, bar in BARS.items())
            + f"; {time.monotonic() - start:.0f} s",
            flush=True,
        )
        if arguments.trials == TRIALS:
            known = json.loads(RESULTS.read_text())["cameras"] if RESULTS.exists() else {}
            RESULTS.write_text(json.dumps({"bars": BARS, "cameras": known | results}, indent=2) + "\n")


if __name__ == "__main__":
    main()
