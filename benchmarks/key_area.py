"""The front end and the scenes: frames a second from a decoded frame to its key area, the verdicts on real
frames, and how hard the scenes are for the yardsticks.

`./run python -m benchmarks.key_area` prints the tables with their bars and writes
benchmarks/results/key_area.json; `... key_area speed real` runs only the parts named (speed, real,
difficulty) and leaves the others as they were. Rates are frames a CPU second of one core, the quickest of
several rounds. The real frames are the eight of caxton_samples and those of fast_caxton_frames in
BEADLINE_SHARED (default ../shared); eight pictures allow no claim about real printers.
"""

import functools
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from pipeline.setpoint import key_area, nozzle_scene, yardsticks

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "key_area.json"
DATA = ROOT / os.environ.get("BEADLINE_SHARED", "../shared") / "data"
LEAST = 10.0
TIPS = {
    "0021": (614, 550), "0022": (637, 551), "1011": (571, 511), "1111": (450, 515),
    "1221": (453, 518), "2011": (434, 514), "2120": (581, 497), "2122": (573, 518),
}  # fmt: skip
WANTED = {"0021": False, "0022": False, "1111": False, "1221": False, "2120": False, "1011": True}


@functools.cache
def gathered() -> np.ndarray:
    """The gather table of the sweep: (87, 360) places in the crop, from the tip outward."""
    angle, radius = np.deg2rad(np.arange(360)), np.arange(1, key_area.LENGTH + 1)[:, None]
    column, row = (
        np.rint(key_area.SIDE // 2 + radius * v).astype(np.intp) for v in (np.cos(angle), np.sin(angle))
    )
    return row * key_area.SIDE + column


def sweep(crop: key_area.Crop) -> np.ndarray:
    """(360,) mean equalised level of the 87 px from the tip outward at each whole degree;
    the paper takes the brightest as the fresh line."""
    samples = crop.levels.take(crop.gray.ravel().take(gathered(), mode="clip"))
    return samples.sum(axis=0, dtype=np.uint16) / key_area.LENGTH  # 87 x 255 fits in 16 bits


def published(frame: np.ndarray, tip: tuple[float, float]) -> key_area.KeyArea:
    """The key area as the paper takes it: along the brightest ray, never
    rejected; its score is the mean level of that ray."""
    c = key_area.crop(frame, tip)
    rays = sweep(c)
    angle = int(rays.argmax())
    return key_area.KeyArea(
        key_area._rectangle(c, angle, 0.0), float(angle), 0.0, float(rays[angle]), c.padded_share, ""
    )


def rate(call: Callable[[], object], *, rounds: int = 15, calls: int = 100) -> float:
    """Calls a CPU second, the quickest of several rounds."""
    best = np.inf
    for _ in range(rounds):
        begin = time.process_time()
        for _ in range(calls):
            call()
        best = min(best, time.process_time() - begin)
    return round(calls / best)


def speed() -> dict:
    rng = np.random.default_rng(0)
    small = nozzle_scene.render(nozzle_scene.draw_segment(rng), np.array([100.0]), 210.0, rng).frames[0]
    full = np.tile(small, (3, 4))[:720, :1280]
    full[200:550, 400:750] = small
    cases = {
        "350x350_gray": (small, (175, 175)),
        "1280x720_gray": (full, (575, 375)),
        "1280x720_colour": (np.ascontiguousarray(np.dstack([full] * 3)), (575, 375)),
    }
    table: dict[str, float] = {}
    for name, (frame, tip) in cases.items():
        table[f"{name}_sweep"] = rate(lambda f=frame, t=tip: key_area.find(f, t, least_score=LEAST))
        table[f"{name}_direction_known"] = rate(
            lambda f=frame, t=tip: key_area.find(f, t, least_score=LEAST, direction_deg=90.0)
        )
        table[f"{name}_published"] = rate(lambda f=frame, t=tip: published(f, t))
    crop = key_area.crop(small, (175, 175))
    table["published_sweep_alone"] = rate(lambda: sweep(crop))
    begin = time.process_time()
    made = nozzle_scene.data_set(rng, segments=2, frames=20, least_score=LEAST)
    table["scenes_with_key_areas"] = round(len(made.label) / (time.process_time() - begin))
    return {"frames_per_s": table, "bar_frames_per_s": 2500, "bar_scenes_per_s": 300}


def real() -> dict:
    """Verdicts at the clicked tip, and the share of 25 tips within 10 px of it that give the same."""
    out = {}
    for name, (x, y) in TIPS.items():
        frame = cv2.imread(str(DATA / f"caxton_samples/full/sample{name}.jpg"))
        at = key_area.find(frame, (x, y), least_score=LEAST)
        near = [
            not key_area.find(frame, (x + i, y + j), least_score=LEAST).reason
            for i in range(-10, 11, 5)
            for j in range(-10, 11, 5)
        ]
        out[name] = {
            "angle_deg": round(at.angle_deg, 1),
            "score": round(at.score, 1),
            "accepted": not at.reason,
            "wanted": WANTED.get(name),
            "accepted_near": round(float(np.mean(near)), 2),
        }
    video, frames = cv2.VideoCapture(str(DATA / "fast_caxton_frames/nozzle_video.gif")), []
    while (read := video.read())[0]:
        frames.append(read[1])
    areas = key_area.find_all(frames, (301, 190), least_score=LEAST)
    out["nozzle_video"] = {
        "frames": len(frames),
        "accepted": int(areas.valid.sum()),
        "least_score": round(float(areas.score.min()), 1),
    }
    stills = [cv2.imread(str(path)) for path in sorted((DATA / "fast_caxton_frames/imgs").glob("*.jpg"))]
    areas = key_area.find_all(stills, (134, 120), least_score=LEAST)
    out["stills"] = {
        "frames": len(stills),
        "accepted": int(areas.valid.sum()),
        "least_score": round(float(areas.score.min()), 1),
    }
    return out


def difficulty() -> dict:
    """Accuracy on segments never seen, three seeds: 60 segments x 5 images
    for each combination to train, 14 x 20 to test."""
    rows = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        learned = nozzle_scene.data_set(rng, segments=60, frames=5, least_score=LEAST)
        test = nozzle_scene.data_set(rng, segments=14, frames=20, least_score=LEAST)
        v, w = learned.valid, test.valid
        rule = yardsticks.fit_width_rule(learned.images[v], learned.label[v])
        begin = time.process_time()
        fitted = yardsticks.fit_profile_machine(
            learned.images[v], learned.temperature[v], learned.label[v], learned.segment[v]
        )
        took = time.process_time() - begin
        p = yardsticks.profile_probabilities(fitted, test.images[w], test.temperature[w])
        label, segment = test.label[w], test.segment[w]
        window = [
            np.log(p[segment == s]).sum(axis=0).argmax() == label[segment == s][0] for s in np.unique(segment)
        ]
        rows.append(
            {
                "valid": round(float(w.mean()), 3),
                "width_rule": round(float(np.mean(yardsticks.width_class(rule, test.images[w]) == label)), 3),
                "profile_machine": round(float(np.mean(p.argmax(axis=1) == label)), 3),
                "profile_machine_window": round(float(np.mean(window)), 3),
                "fit_s": round(took, 1),
            }
        )
    return {
        "seeds": rows,
        "notes": {"width_rule": 0.638, "profile_machine": 0.747, "profile_machine_window": 0.860},
    }


def main() -> None:
    cv2.setNumThreads(1)
    parts: dict[str, Callable[[], dict]] = {"speed": speed, "real": real, "difficulty": difficulty}
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    for name in sys.argv[1:] or parts:
        results[name] = parts[name]()
        print(name, json.dumps(results[name], indent=1))
    RESULTS.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
