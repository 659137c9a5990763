"""Every artifact of the setpoint loop, made up: four controllers, the cases of both simulators and of the
pictures, and a classifier. No figure here was measured."""

import itertools
import math
from pathlib import Path

import cv2
import numpy as np

from pipeline.setpoint import tables
from pipeline.store import artifacts

HOSTILE = '"><script>alert(1)</script><img src=http://evil.example/x onerror=alert(2)>'
KINDS = {
    "Bayes filter": "model-based",
    "sequential test": "baseline",
    "paper's agent": "data-driven",
    "do nothing": "baseline",
}
PAPER_CASES = ("accuracy 0.7",)
RECORDED_CASES = (
    "recorded, fresh, clog", "recorded, sticky", "recorded, sticky, clog", "recorded, sticky, half clog",
)  # fmt: skip
HARM_CASES = ("perfect", "in band", "in band, another camera")
# runs that are lost in per cent, and how much more of them in a harder case
LOST = {
    "Bayes filter": (0.2, 0.1),
    "sequential test": (0.1, 1.5),
    "paper's agent": (15.0, 10.0),
    "do nothing": (90.0, 1.0),
}
DEFAULT, AGENT = "Bayes filter", "paper's agent"
RUNS = 2100


def columns(schema, rows):
    return dict(
        zip((column.name for column in schema.columns), map(list, zip(*rows, strict=True)), strict=True)
    )


def wilson(percent, runs):
    p, z = percent / 100, 1.96
    centre, half = (
        (p + z * z / 2 / runs) / (1 + z * z / runs),
        z * math.sqrt(p * (1 - p) / runs + z * z / 4 / runs**2) / (1 + z * z / runs),
    )
    return percent, 100 * max(centre - half, 0.0), 100 * min(centre + half, 1.0), float(runs)


def scoreboard(lost=LOST, runs=RUNS):
    """`lost` {controller: (percent of runs lost, more of them for each step of difficulty)}; good starts,
    which are left in half as many runs; and a case of the pictures, whose runs are too short to stay."""
    rows, nothing = [], (math.nan,) * 4
    for name, (least, more) in lost.items():
        who = (name, KINDS[name])
        for simulator, cases in (("paper", PAPER_CASES), ("recorded", RECORDED_CASES), ("harm", HARM_CASES)):
            counts = simulator != "harm"
            for place, case in enumerate(cases):
                hard = min(place, 5)
                settled, stay = (
                    max(100 - least - more * hard, 0.0),
                    max(100 - 1.5 * least - 1.5 * more * hard, 0.0),
                )
                clogged = wilson(max(settled - 1, 0.0), runs) if case.endswith("clog") else nothing
                harmed = 0.0 if name == "do nothing" else min((least + more * hard) / 2, 100.0)
                shares = [wilson(settled, runs), wilson(stay, runs), clogged, clogged]
                shares += [nothing if counts else wilson(harmed / k, RUNS) for k in (1, 2, 8)]
                steps = (9.0 + hard, 22.0 + 4 * hard, 12.0 if case.endswith("clog") else math.nan)
                errors = (12.0, 0.8 + 0.2 * hard, 300.0, 230.0, settled)
                rows.append((*who, simulator, case, counts, runs, *sum(shares, ()), *steps, *errors))
        if name in (DEFAULT, AGENT):
            shares = wilson(max(100 - 3 * least, 0.0), 21) + 6 * nothing
            steps, errors = (14.0, 30.0, math.nan), (15.0, 2.0, 30.0, 190.0, 100.0)
            rows.append((*who, "pixels", "as published", False, 21, *shares, *steps, *errors))
    artifacts.write_table(
        "datasets/evaluate_setpoint/scoreboard.parquet", tables.SCOREBOARD, columns(tables.SCOREBOARD, rows)
    )


PAIR = {
    "a": DEFAULT, "b": AGENT, "cases": 5, "segments": 600, "difference": 41.0, "low": 38.5, "high": 43.5,
    "winner": DEFAULT, "needed": None,
}  # fmt: skip


def choice(name=DEFAULT, **more):
    said = {
        "name": name,
        "worst": 98.95,
        "case": "recorded, sticky, half clog",
        "refused": {"sequential test": "leaves +-25 % in 24.0 % of the runs (in band), of at most 2 %"},
        "sentence": f"{name} is the default.",
        "pair": PAIR,
    }
    artifacts.write_json("datasets/evaluate_setpoint/choice.json", said | more)


def _walk(rng, flow, temperature, steps, error):
    """Flow and temperature of one made-up run: moves towards the middle, wrong with probability `error`."""
    q, u = [flow], [temperature]
    for k in range(steps):
        told = q[-1] + (rng.normal(0, 30) if rng.random() < error else 0.0)
        move = float(np.clip(np.round((100 - told) / 10) * 5, -10, 10))
        q.append(float(np.clip(q[-1] + move, 20, 310)))
        warm = float(np.clip(np.round((210 - u[-1]) / 10) * 10, -20, 20)) if k % 10 == 0 else 0.0
        u.append(u[-1] + warm)
    return q, u


STARTS = [(q, u) for q in (30.0, 60.0, 80.0, 120.0, 150.0, 200.0, 300.0) for u in (190.0, 210.0, 230.0)]
# the worst case of the default
DECIDES = ("recorded", "recorded, sticky, half clog")
CLOG_STEP, CLOG = 60, 0.6


def paths(steps=100, decides=DECIDES):
    """Two cases of everybody; and the one that decides, to decision 200."""
    rng, rows = np.random.default_rng(0), []
    for name in KINDS:
        error = 0.05 if name == DEFAULT else 0.5
        for case in (("paper", "accuracy 0.7"), ("recorded", "recorded, sticky")):
            rows += _runs(rng, name, case, steps, error)
    for name in KINDS if decides else ():
        rows += _runs(rng, name, decides, 200, 0.05, clog=CLOG)
    artifacts.write_table(
        "datasets/evaluate_setpoint/paths.parquet", tables.PATHS, columns(tables.PATHS, rows)
    )


def _runs(rng, name, case, steps, error, clog=1.0):
    """Rows of one made-up run from each start; what is left alone stays, and loses what a clog takes."""
    rows = []
    for k, start in enumerate(STARTS):
        if name == "do nothing":
            gain = np.where(np.arange(steps + 1) < CLOG_STEP, 1.0, clog)
            q, u = start[0] * gain, np.full(steps + 1, start[1])
        elif clog < 1:
            before, warm = _walk(rng, *start, CLOG_STEP - 1, error)
            after, same = _walk(rng, clog * before[-1], warm[-1], steps - CLOG_STEP, error)
            q, u = before + after, warm + same
        else:
            q, u = _walk(rng, *start, steps, error)
        rows += [(name, *case, k, step, a, b) for step, (a, b) in enumerate(zip(q, u, strict=True))]
    return rows


def decisions(steps=50, why=""):
    rng, rows = np.random.default_rng(1), []
    for episode, flow, target in (
        ("from 30 % and 190 °C", 30.0, 190.0),
        ("clogged to 60 % at decision 16, out of focus from 37", 120.0, 210.0),
    ):
        setpoint, degrees = flow, target
        for k in range(steps):
            gain = 0.6 if flow > 100 and k >= 16 else 1.0
            true = setpoint * gain + rng.normal(0, 1)
            over, under = 1 / (1 + math.exp(-(true - 110) / 4)), 1 / (1 + math.exp((true - 90) / 4))
            p = np.clip([under, max(1 - under - over, 0.0), over], 0, 1)
            held = (flow > 100 and 37 <= k < 42) or rng.random() < 0.06
            reason = (
                "out of distribution" if flow > 100 and 37 <= k < 42 else "the classes cannot be told apart"
            )
            move = (
                0.0
                if held or abs(true - 100) < 4
                else float(np.clip(np.round((100 - true) / 5) * 5, -10, 10))
            )
            warm = 10.0 if k in (0, 10) and flow < 100 else 0.0
            text = f"{8.0 * k:6.1f} s: 20 frames valid, 20 count, " + (
                f"held: {reason}" if held else f"good {p[1]:.2f}; flow {move:+g} %"
            )
            rows.append(
                (
                    episode,
                    DEFAULT,
                    k,
                    8.0 * k,
                    max(true, 0.0),
                    degrees,
                    setpoint,
                    target,
                    *(p / p.sum()),
                    4 if held else 20,
                    9.0,
                    move,
                    warm,
                    bool(held),
                    why or text,
                )
            )
            setpoint, target, degrees = (
                setpoint + move,
                target + warm,
                degrees + 0.6 * (target + warm - degrees),
            )
    table = columns(tables.DECISIONS, rows)
    artifacts.write_table("datasets/evaluate_setpoint/decisions.parquet", tables.DECISIONS, table)


def classifier(seed=0):
    """Frames, windows, diagrams and courses whose accuracy is about what the metrics say."""
    rng, folder = np.random.default_rng(seed), Path("datasets/train_classifier")
    n = 1500
    artifacts.write_json("datasets/render_frames/frames.json", {"judged": {"frames": n, "segments": 75}})
    flow, heat = rng.uniform(40, 250, n), rng.choice([190.0, 200.0, 210.0, 220.0, 230.0], n)
    label = np.searchsorted([90.0, 110.0], flow, side="right")
    seen = np.searchsorted([90.0, 110.0], flow + rng.normal(0, 14, n), side="right")
    p = 0.1 + 0.7 * np.eye(3)[seen]
    table = {
        "segment": np.arange(n) // 20,
        "flow_percent": flow,
        "temperature_degC": heat,
        "label": label,
        "p_under": p[:, 0],
        "p_good": p[:, 1],
        "p_over": p[:, 2],
        "named": seen,
        "distance": rng.chisquare(8, n),
    }
    artifacts.write_table(folder / "classified.parquet", tables.CLASSIFIED, table)
    rows = []
    for of, method, off in (
        ("image", "raw", 0.07),
        ("image", "calibrated", 0.01),
        ("window", "hard_counts", 0.1),
        ("window", "flow", 0.02),
    ):
        rows += [
            (
                of,
                method,
                k / 10,
                (k + 1) / 10,
                20 * k if k > 3 else 0,
                k / 10 + 0.05 if k > 3 else math.nan,
                min(k / 10 + 0.05 - off, 1.0) if k > 3 else math.nan,
            )
            for k in range(10)
        ]
    artifacts.write_table(
        folder / "reliability.parquet", tables.RELIABILITY, columns(tables.RELIABILITY, rows)
    )
    rows = [
        (
            learner,
            k,
            1.1 * math.exp(-k / 15) + 0.4,
            1.1 * math.exp(-k / 12) + 0.5,
            0.79 - 0.45 * math.exp(-k / 8),
        )
        for learner, last in (("vision transformer", 40),)
        for k in range(1, last + 1)
    ]
    artifacts.write_table(
        folder / "course.parquet", tables.CLASSIFIER_CURVE, columns(tables.CLASSIFIER_CURVE, rows)
    )
    edges = [20.0, 40.0, 60.0, 80.0, 90.0, 100.0, 110.0, 120.0, 150.0, 200.0, 310.0]
    rows = []
    for part in ("learn", "choose", "judge"):
        for b, (low, high) in enumerate(itertools.pairwise(edges)):
            for segment in range(4):
                middle = (low + high) / 2 + rng.normal(0, 5)
                shares = np.exp([-((middle - c) ** 2) / 800 for c in (60.0, 100.0, 140.0)])
                shares = (
                    np.array([1.0, 0, 0])
                    if middle < 60
                    else np.array([0, 0, 1.0])
                    if middle > 140
                    else shares / shares.sum()
                )
                number, named = 10 * b + segment, int(shares.argmax())
                seen = max(middle + rng.normal(0, 8), 10.0)
                rows.append((part, max(middle, 1.0), b, low, high, number, *shares, named, seen, 0.09))
    artifacts.write_table(folder / "windows.parquet", tables.WINDOWS, columns(tables.WINDOWS, rows))
    frames()


def frames():
    folder, rows = Path("datasets/train_classifier/frames"), []
    folder.mkdir(parents=True, exist_ok=True)
    wanted = [
        ("under", "", 0),
        ("good", "", 1),
        ("over", "", 2),
        ("rejected", f"no line stands out: 4 of 10 gray levels {HOSTILE}", 1),
        ("out of focus", "foreign: further from what was learned than allowed", 1),
    ]
    for k, (place, reason, label) in enumerate(wanted):
        picture = np.full((175, 175, 3), 60 + 10 * k, np.uint8)
        cv2.line(picture, (88, 88), (30, 120), (190, 190, 190), 6 + 3 * label)
        cv2.circle(picture, (88, 70), 24, (30, 30, 30), -1)
        ok, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 60])
        assert ok
        (folder / f"frame_{k:02d}.jpg").write_bytes(data.tobytes())
        seen = place != "rejected"
        rows.append(
            {
                "file": f"frame_{k:02d}.jpg",
                "place": place,
                "reason": reason,
                "score": 4.0 if not seen else 27.3,
                "direction_deg": 144.0,
                "flow_percent": 60.0 + 40 * label,
                "temperature_degC": 210.0,
                "label": label,
                "named": label if seen else None,
                "p": [0.1, 0.8, 0.1] if seen else None,
                "distance": 9.0 if seen else None,
                "foreign_above": 20.0,
            }
        )
    artifacts.write_json(folder / "frames.json", rows)


def by_flow():
    """Right in 65 % beside a border and 90 % elsewhere but 40 % from 105 to 110 %."""
    rows = []
    for low in range(70, 150, 5):
        percent = 40.0 if low == 105 else 65.0 if low in (85, 90, 110) else 90.0
        ends = {"percent": percent, "low": percent - 4, "high": percent + 3}
        rows.append({"flow_low": float(low), "flow_high": low + 5.0, "windows": 200} | ends)
    return rows


def metrics():
    out = {kind: {"auroc": 0.95 - 0.01 * i, "found": 0.7} for i, kind in enumerate(("blur", "transposed"))}
    seen = {
        "right_70_150": {"percent": 82.5, "low": 80.1, "high": 84.9},
        "by_flow": by_flow(),
        "proof": {"verdict": "right in 88 % of 300 windows of 300 rendered segments never learned from: "
        "may judge"},
        "image_accuracy": 0.797, "window_accuracy": 0.931, "svc_image_accuracy": 0.747,
        "svc_window_accuracy": 0.86, "width_image_accuracy": 0.638,
        "intervals_percent": {"image": [78.9, 80.5], "window": [90.2, 95.1], "svc_image": [73.9, 75.5],
        "width_image": [62.9, 64.7]},
        "ece_image": 0.018, "ece_image_raw": 0.07, "ece_window": 0.029, "ece_window_counts": 0.099,
        "out_of_distribution": out | {"false_alarms": 0.05},
        "size": "small", "source": "simulated", "parameters": 75_843,
        "best_epoch": {"vision transformer": 38},
        "data": {"frames": 13_800, "valid": 12_950,
        "rejected": {"no line stands out": 800, "the line passes the border": 50}, "segments": 690},
    }  # fmt: skip
    taught = {
        "phase3": {"settled": 100.0, "stay": 100.0, "median_steps": 7.0, "runs": 2100},
        "phase4": {"settled": 31.0, "stay": 0.0, "median_steps": 82.0, "runs": 2100},
        "phase4_at_1": {"settled": 63.0, "stay": 12.0, "median_steps": 70.0, "runs": 2100},
        "claims": {
            "300 %, 230 °C": {
                "printed": {"rests_at": 95.0, "least": 75.0, "most": 130.0},
                "measured": {"rests_at": 91.0, "least": None, "most": 112.0, "flow_range": 50.0},
            },
            "232 %, 190 °C after phase 1": {"printed": {}, "measured": {"flow_range": 0.0}},
        },
        "guesses": {"delta": 5.0, "flow_limits_percent": [20.0, 310.0], "replay_capacity": 131_072},
        "parameters": {"li_2025": 47_082},
    }
    judged = {
        DEFAULT: {"paper": {"accuracy 0.7": {"settled": 99.5, "stay": 99.3, "median_steps": 12.0}}},
        "default": DEFAULT,
        "pair": PAIR,
    }
    return {"train_classifier": seen, "train_agent": taught, "evaluate_setpoint": judged}


def agents():
    rows = []
    for phase in range(1, 5):
        rows += [
            ("li_2025", phase, 500 * (10 * (phase - 1) + k), 0.8 - 0.6 * math.exp(-k / 3) - 0.1 * phase)
            for k in range(1, 11)
        ]
    artifacts.write_table(
        "datasets/papers/train_agent/agents.parquet", tables.AGENT_CURVE, columns(tables.AGENT_CURVE, rows)
    )


def write():
    """Everything below the working directory; the filter is the default and passes its rules."""
    figures = metrics()
    artifacts.write_json("datasets/papers/train_agent/figures.json", figures.pop("train_agent"))
    for stage, found in figures.items():
        artifacts.write_metrics(stage, found)
    scoreboard()
    choice()
    paths()
    decisions()
    agents()
    classifier()
