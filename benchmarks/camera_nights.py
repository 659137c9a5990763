"""Nights of the camera that rides with the nozzle: a trial a night, recorded as MCAP, held against six trials
of the champion; first nothing changes, then the camera, ink or light.

`nice ./run python -m benchmarks.camera_nights --seed 1` prints the
figures and adds them to benchmarks/results/nights.json.
"""

import argparse
import json
import tempfile
import zlib
from pathlib import Path

import cv2
import numpy as np

from benchmarks.nights import RESULTS
from pipeline.deposition import rendering
from pipeline.deposition.workflow import trial_files
from pipeline.nightly import pictures
from pipeline.nightly.settings import Drift
from pipeline.report.shared.night import LoopDrift
from pipeline.store import artifacts
from tests.nightly.toy_nights import SETTINGS


def filmed(path: Path, seed: int, **changes) -> None:
    """A trial of one and a half seconds under a camera whose scene is changed so."""
    rng, scene = np.random.default_rng(seed), rendering.NOMINAL._replace(**changes)
    camera, time_s = rendering.Camera(scene, rng), 0.02 * np.arange(76)
    frames = (
        (k / 30, camera.frame(float(rng.uniform(100, 116)), stage_px=int(rng.integers(10_000))))
        for k in range(45)
    )
    signals = trial_files.Signals(time_s, 8 * time_s, np.full(76, 8.0), np.ones(76), np.ones(76))
    conditions = trial_files.Conditions(
        "A", "0.8 mm", 0, "model_inverse", 8.0, 0.6, 0.304, 125.0, 0.0, 90.0, -0.008, 30.0
    )
    trial_files.write_trial(path, conditions, frames, signals, encoding="jpeg")


def camera(seed: int, count: int, folder: Path) -> dict:
    """A trial a night before a camera that stays as it is, `count` nights, and before one that was moved, or
    sees other ink or light: held against six trials of the champion."""
    limits, nominal = Drift(**SETTINGS["drift"]), rendering.NOMINAL
    for k in range(6):
        filmed(folder / f"champion/trial_{k}.mcap", 1000 * seed + k)
    reference = {"camera": pictures.of_trials(folder / "champion", 6)}

    def look(name: str, pending: set[str], **changes) -> LoopDrift:
        drift = LoopDrift.none("deposition")
        path = folder / "new.mcap"
        filmed(path, 1000 * seed + zlib.crc32(name.encode()) % 10**6, **changes)
        pictures.trials_of(limits, [str(path)], reference, pending, drift)
        return drift

    false, pending = [], set()
    for k in range(count):
        drift = look(f"night {k}", pending)
        pending = {alarm.key for alarm in drift.watched + drift.alarms}
        false += [alarm.cause for alarm in drift.alarms]
    result = {"nights": count, "false_alarms": len(false), "alarms": false}
    for name, changes in {
        "camera 4 px lower": {"offset_px": nominal.offset_px + 4},
        "camera 4 px higher": {"offset_px": nominal.offset_px - 4},
        "camera tilted by 0.5 degrees": {"tilt_deg": nominal.tilt_deg + 0.5},
        "ink of 70 % contrast": {"contrast": 0.7 * nominal.contrast, "specular": 0.7 * nominal.specular},
        "light 25 % brighter": {"background": 1.25 * nominal.background, "contrast": 1.25 * nominal.contrast,
        "specular": 1.25 * nominal.specular},
        "out of focus": {"blur_px": 4.0},
    }.items():  # fmt: skip
        nights, drift, pending = 0, LoopDrift.none("deposition"), set()
        while nights < 2 and not drift.alarms:
            nights += 1
            drift = look(f"{name} {nights}", pending, **changes)
            pending = {alarm.key for alarm in drift.watched}
        result[name] = {
            "nights": nights if drift.alarms else None,
            "causes": [alarm.cause for alarm in drift.alarms],
        }
        print(f"  {name}: {result[name]}", flush=True)
    return result


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--nights", type=int, default=60)
    a = parser.parse_args()
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory(prefix="nights-") as folder:
        figures = camera(a.seed, a.nights, Path(folder))
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    artifacts.write_json(RESULTS, results | {f"camera_seed_{a.seed}": figures})
    print(json.dumps(figures, indent=1, ensure_ascii=False))


if __name__ == "__main__":
    main()
