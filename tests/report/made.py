"""A small project with every artifact that the pages show, made by
hand: two inputs, two zones, seven contestants and the yardstick."""

from pathlib import Path

import numpy as np
import yaml

from pipeline.deposition.controllers import COMPOSERS
from pipeline.deposition.tables import FILMED, LESSONS, LIBRARY, LINES, PRINTS, SCORES, SIGNALS, TASKS, TRIALS
from pipeline.store import artifacts, params
from pipeline.temperature import tables
from pipeline.temperature.settings import Plant
from tests.report import made_certificate, made_setpoint

ROOT = Path(__file__).resolve().parents[2]
CONTESTANTS = (
    "hold",
    "pi_simc",
    "pi",
    "subspace_lqg",
    "varx_riccati",
    "learned_kernel",
    "predictive_control",
    "exact_model",
)
PLANTS, CASES = 6, 24
HOSTILE = '"><script>alert(1)</script><img src=http://evil.example/x onerror=alert(2)>\u202egpj.mcap'
PRINTER_PID = {
    "recording": "klippy.log",
    "input": "heater_1",
    "output": "zone_1",
    "Kp": 8.0,
    "Ki": 0.4,
    "Kd": 40.0,
    "most_percent": 100.0,
    "smooth_s": 1.0,
}
NEXT_EXPERIMENT = {
    "written": True,
    "reason": "",
    "samples": 400,
    "seconds": 400.0,
    "highest_degC": {"zone_1": 118.0, "zone_2": 104.0},
    "lowest_degC": {"zone_1": 88.0, "zone_2": 79.0},
    "limit_degC": {"zone_1": {"low": 0.0, "high": 140.0}, "zone_2": {"low": 0.0, "high": 140.0}},
    "target_degC": {"zone_1": 100.0, "zone_2": 90.0},
    "start_degC": {"zone_1": 98.0, "zone_2": 89.0},
    "centre_percent": {"heater_1": 40.0, "heater_2": 35.0},
    "amplitude_percent": {"heater_1": 5.0, "heater_2": 4.0},
    "excitation_order": 12,
    "excitation_rank": 24,
    "excitation_full_rank": 24,
    "excitation_condition": 18.0,
    "limited_share": 0.1,
    "level_percent_per_band": [[0.3, 0.4]] * 8,
    "information": 900.0,
    "expected_error_percent": {
        "zone_1": {"heater_1": {"gain": 1.2, "time_constant": 2.1}},
        "zone_2": {"heater_2": {"gain": 1.6, "time_constant": 3.0}},
    },
    "expected_gap_percent": 0.02,
}
DITHER = {"written": False, "reason": "PI needs an input for each of the 2 outputs; found 1 inputs"}
SCALED = {"change_percent": -60.0, "gain_difference": 1e-15}


def main():
    """The verdicts and the pages of the project in the working directory."""
    from stages import report, verdict

    verdict.main()
    report.main()


def figure(q90, low, high, **more):
    """A figure over all cases: its 90 % quantile with the band of that."""
    case = {"case": 7, "plant": 3, "kind": "ramp", "start_degC": 20.0}
    worst = None if q90 is None else 1.5 * q90
    half = None if q90 is None else 0.5 * q90
    return {"median": half, "q90": q90, "low": low, "high": high, "worst": worst, "worst_case": case} | more


def contestant(cost=2.0, **changed):
    """Figures that pass every rule of params.yaml."""
    return {
        "settled_error": figure(0.1, 0.05, 0.2),
        "peak": figure(0.3, 0.2, 0.4),
        "settling": figure(6.0, 5.0, 8.0),
        "heating": figure(20.0, 18.0, 24.0),
        "overshoot": figure(0.5, 0.3, 0.9),
        "at_limits": figure(1.0, 0.5, 2.0),
        "energy": figure(30.0, 29.0, 31.0),
        "travel": figure(0.4, 0.3, 0.5),
        "dip": figure(2.0, 1.8, 2.3),
        "cost": figure(cost, 0.9 * cost, 1.1 * cost),
        "rms": figure(4.0, 3.0, 5.0),
        "crossings": {"cases": 0, "of": CASES, "worst_degC": 0.0},
        "supervised": {"cases": 16, "left": 0, "percent": 0.0, "why": "", "plant": None},
        "never_settled_percent": 0.0,
        "gap": {
            "median_percent": 0.1,
            "q90_percent": 0.4,
            "convention": "Q = R = I, discounted 0.99, unclipped, without integrator, plant known at rest",
        },
        "margins": {
            "disk": {"q10": 0.7, "median": 0.9, "worst": 0.6},
            "delay_s": {"q10": 3.0, "median": 4.0, "worst": 2.5},
        },
        "stable": {"count": PLANTS, "of": PLANTS},
        "tuned": {"observer_tau": 3.0},
        "at_bound": [],
        "evaluations": 60,
    } | changed


def comparison():
    """The comparison as the stage writes it: subspace + LQG is the best, and wins the pair."""
    costs = {"pi_simc": 5.0, "pi": 4.0, "subspace_lqg": 2.0, "varx_riccati": 2.1, "learned_kernel": 2.2}
    held = {name: contestant(costs.get(name, 3.0)) for name in CONTESTANTS}
    held["hold"] = contestant(9.0, settling=figure(None, None, None), settled_error=figure(80.0, 70.0, 90.0))
    return {
        "simulated": True,
        "plants": PLANTS,
        "cases": CASES,
        "noise_degC": 0.1,
        "seed": 1,
        "steps": 600,
        "sample_time_s": 1.0,
        "band_degC": 1.0,
        "contestants": held,
        "order": list(CONTESTANTS),
        "redesigned": {
            name: {"excess_percent": 0.5, "broken": 0, "of": 7} for name in ("pi_simc", "pi", "subspace_lqg")
        },
        "best": "subspace_lqg",
        "best_reason": {"against": "pi", "p": 0.01, "difference": 40.0},
        "pair": {
            "a": "subspace_lqg",
            "b": "learned_kernel",
            "winner": "subspace_lqg",
            "p": 0.012,
            "difference": 6.2,
            "low": 3.1,
            "high": 9.4,
            "by_structure": [4.0, 6.0, 8.0],
            "kept": True,
            "plants": PLANTS,
            "figures": {"settling": [6.0, 6.0], "overshoot": [0.5, 0.5], "settled_error": [0.1, 0.1]},
        },
        "cost_curve": {
            "samples": [60, 240, 480],
            "plants": PLANTS,
            "pair": ["subspace_lqg", "learned_kernel"],
            "controllers": {
                "subspace_lqg": {"cost": [2.4, 2.1, 2.0], "low": [2.2, 1.9, 1.8], "high": [2.6, 2.3, 2.2]},
                "learned_kernel": {
                    "cost": [None, 2.0, 2.2],
                    "low": [None, 1.8, 2.0],
                    "high": [None, 2.2, 2.4],
                },
            },
            "crossing": {"samples": 300.0, "low": 270.0, "high": 420.0, "share": 1.0},
            "refused": {"60": {"learned_kernel": "record longer"}},
        },
        "deciding": {
            "plant": 3,
            "case": 7,
            "kind": "ramp",
            "best_without": "subspace_lqg",
            "pair_without": "subspace_lqg",
        },
        "limits": {
            "settled_error_degC": 0.5,
            "settling_s": 60.0,
            "overshoot_degC": 5.0,
            "source": "declared",
        },
        "infeasible": [],
        "refused": {},
    }


def metrics():
    return {
        "probe_machine": {
            "source": "simulated",
            "samples": 400,
            "excitation_order": 12,
            "excitation_rank": 24,
            "excitation_full_rank": 24,
            "excitation_condition": 18.0,
            "limited_share": 0.1,
            "level_percent_per_band": [[0.3, 0.4]] * 8,
        },
        "generate_probing": {
            "source": "simulated",
            "next_experiment": NEXT_EXPERIMENT,
            "closed_loop": DITHER,
        },
        "ingest": {"recordings": 2, "quarantined": 1, "samples": 400, "segments": 1, "findings": {}},
        "identify_plant": {
            "order": 2,
            "past": 5,
            "fit": "prediction",
            "feedthrough": {"zone_1": False, "zone_2": False},
            "validation": "blocks",
            "closed_loop": {
                "closed": False,
                "level": 0.00025,
                "p_value": {"heater_1": 0.4, "heater_2": 0.03},
            },
            "forbidden_gains": [],
            "fit_holdout_free_mean": {"zone_1": 90.5, "zone_2": 81.0},
            "fit_holdout_free_mean_band": {"zone_1": [88.0, 91.5], "zone_2": [76.0, 85.0]},
            "rows": 380,
            "dropped_rows": 0,
            "notes": [],
            "order_tolerance_percent": 2.0,
            "samples": 400,
            "samples_cut": 0,
            "samples_holdout": 120,
            "delays": {"heater_1": 0, "heater_2": 3},
            "ahead_steps": 10,
            "fit_holdout": {"zone_1": 90.0, "zone_2": 80.0},
            "fit_holdout_band": {"zone_1": [88.0, 91.0], "zone_2": [75.0, 84.0]},
            "fit_holdout_ahead": {"zone_1": 95.0, "zone_2": 91.0},
            "fit_holdout_ahead_band": {"zone_1": [94.0, 96.0], "zone_2": [89.0, 92.0]},
            "fit_holdout_held": {"zone_1": 20.0, "zone_2": -10.0},
            "whiteness_passed": {"zone_1": True, "zone_2": False},
            "independence_passed": {f"zone_{i}": {"heater_1": True, "heater_2": True} for i in (1, 2)},
            "excitation": {
                "rank": 10,
                "full": 10,
                "condition": 40.0,
                "lags": 5,
                "inputs": {f"heater_{i}": {"rank": 5, "level": 2.0} for i in (1, 2)},
            },
            "largest_pole": 0.99,
            "advice": [
                "the residuals of zone_2 are not white (correlation +0.42 at lag 1): lengthen the window, "
                "or model the disturbance"
            ],
        },
        "learn_kernel": {
            "window": 4,
            "samples": 380,
            "half_record_gap_percent": 0.01,
            "samples_needed_for_noise": 30,
            "allowed_gap_percent": 1.0,
            "state": "predicted state",
            "refused": None,
            "rank": 5,
            "identifiable": 15,
            "samples_needed": 15,
            "condition": 1e3,
            "candidates": {},
            "undetermined": {},
            "predictive": {"refused": None, "horizon": 40, "samples": 336, "samples_needed": 120},
        },
        "tune_weights": {"evaluations": 60},
        "evaluate_temperature": comparison(),
    }


def deposition_metrics():
    def law(ratio, **more):
        return {
            "ratio_trial_2": ratio,
            "last_ratio": ratio,
            "best_ratio": ratio,
            "best_trial": 2,
            "restarts": [],
            "trials": 2,
            "peak_over_steady": 20.0,
            "saturated": 0.0,
        } | more

    pixels = {"flow_error_percent": 2.0, "flow_error_corner_percent": 3.0, "rejected_percent": 1.0}
    before = {
        "gamma": 0.76,
        "gamma_worst": 1.2,
        "gamma_above_1_percent": 70.0,
        "gamma_model_inverse": 0.1,
        "gamma_model_inverse_worst": 0.3,
    }
    trained = before | {
        "hoelzle_2009_nominal": law(0.4),
        "model_inverse": law(0.02),
        "pixels": law(0.03, **pixels),
        "other_routines": [law(0.02)],
    }
    return {
        "train_ilc": {"A": trained},
        "segment_library": {"columns": 5},
        "compose_parts": {"square": {"A": {"chosen": "basis"}}},
    }


def declared(root):
    """params.yaml of the repository with a smaller machine and panel."""
    sections = params.read(ROOT / "params.yaml")
    sections["plant"] = {
        "sample_time_s": 1.0,
        "inputs": [{"name": f"heater_{i}", "unit": "percent", "low": 0, "high": 100} for i in (1, 2)],
        "outputs": [
            {"name": f"zone_{i}", "unit": "degC", "reference": 100.0 + i, "low": 0, "high": 150}
            for i in (1, 2)
        ],
    }
    (root / "params.yaml").write_text(yaml.safe_dump(sections))
    return params.load(Plant, "plant", root / "params.yaml")


def cases():
    """Every contestant on every case: four cases a plant, the cost of each by hand."""
    rows = [(name, case) for name in CONTESTANTS for case in range(CASES)]
    columns = {column.name: [0.0] * len(rows) for column in tables.CASES.columns}
    return columns | {
        "contestant": [name for name, _ in rows],
        "case": np.array([case for _, case in rows], np.int32),
        "plant": np.array([case // 4 for _, case in rows], np.int32),
        "kind": ["constant"] * len(rows),
        "settled_zone": ["zone_1"] * len(rows),
        "cost": [(2.0 + CONTESTANTS.index(name) % 3) * (1 + case / CASES) for name, case in rows],
    }


def trajectories(machine, steps=60):
    """Both cases of every contestant: 80 / 2^t - 0.05 below the references."""
    time = np.arange(float(steps))
    names = [(name, case) for name in CONTESTANTS for case in ("typical", "deciding")]
    columns = {
        "contestant": [name for name, _ in names for _ in time],
        "case_name": [case for _, case in names for _ in time],
        "time_s": np.tile(time, len(names)),
    }
    for output in machine.outputs:
        columns[output.name] = np.tile(output.reference - 80.0 * 0.5**time + 0.05, len(names))
        columns[f"{output.name}_reference"] = np.full(len(names) * steps, output.reference)
    for signal in machine.inputs:
        columns |= {
            f"{signal.name}_command": np.tile(50.0 * 0.5**time - 1.0, len(names)),
            f"{signal.name}_applied": np.tile(50.0 * 0.5**time, len(names)),
        }
    return columns


def record(machine, samples, recording):
    time = np.arange(float(samples))
    columns = {"recording": [recording] * samples, "segment": np.zeros(samples, np.int32), "time_s": time}
    for i, signal in enumerate([*machine.inputs, *machine.outputs]):
        masked = np.zeros(samples, bool)
        masked[100:110] = i == 2
        columns |= {signal.name: 50 + 10 * np.sin(time / (3 + i)), f"{signal.name}_masked": masked}
    return columns


def model(machine):
    """What the page of the identification shows: zone_2's errors are not noise,
    and heater_2 does nothing that is known to zone_1."""
    names = [s.name for s in machine.outputs], [s.name for s in machine.inputs]
    residuals = []
    for output in names[0]:
        residuals += [
            (output, output, k, 0.5 ** (4 * k) if output == "zone_1" else 0.42**k, 0.1, output == "zone_1")
            for k in range(6)
        ]
        residuals += [(output, name, k, 0.02 * k / 5, 0.1, True) for name in names[1] for k in range(-5, 6)]
    pairs = [(output, name) for output in names[0] for name in names[1]]
    time = np.arange(0.0, 50.0, 10.0)
    rise = [
        (o, i, t, 2 * (1 - np.exp(-t / 10)), 1.5 * (1 - np.exp(-t / 10)), 2.5 * (1 - np.exp(-t / 10)))
        for o, i in pairs
        for t in time
    ]
    dynamics = []
    for output, name in pairs:
        seen = (output, name) != ("zone_1", "heater_2")
        known = (10.0, 9.0, 11.0, 1.0, 0.5, 1.5) if seen else (np.nan,) * 6
        dynamics.append((output, name, seen, *(2.0, 1.5 if seen else -1.0, 2.5) * 2, *known))
    first_order = []
    for output, name in pairs:
        seen = (output, name) != ("zone_1", "heater_2")
        known = (10.0, 9.0, 11.0, 1.0, 0.5, 1.5, 99.0, 2.0, 0.2, 1.0) if seen else (np.nan,) * 10
        first_order.append((output, name, seen, 2.0, 1.5 if seen else -1.0, 2.5, *known))
    poles = [
        (0, 0, 0.99, 0.0),
        (0, 1, 0.9, 0.0),
        *((k, i, 0.99 - 0.001 * k - 0.09 * i, 0.0) for k in (1, 2) for i in (0, 1)),
        (1, -1, 0.2, 0.0),
    ]
    levels = [(name, np.pi * k / 8, np.pi * (k + 1) / 8, 0.5) for name in names[1] for k in range(8)]
    rows = {
        "residuals": (tables.RESIDUALS, residuals),
        "steps": (tables.STEPS, rise),
        "dynamics": (tables.DYNAMICS, dynamics),
        "first_order": (tables.FIRST_ORDER, first_order),
        "poles": (tables.POLES, poles),
        "levels": (tables.LEVELS, levels),
    }
    return {
        name: (
            schema,
            dict(zip((c.name for c in schema.columns), map(list, zip(*found, strict=True)), strict=True)),
        )
        for name, (schema, found) in rows.items()
    }


def accepted(**fields):
    """What `accept` keeps, without figures; `fields` take the place of its own."""
    run = {"accepted": {"on": "2026-11-20", "commit": "0a1b2c3d"}, "machine": {}, "winner": None}
    return run | {"metrics": {}, "params": {}, "hashes": {}, "figures": {}} | fields


def write(root, *, samples=400, recording="good.mcap"):
    """Every artifact below `root`, which is the working directory."""
    machine = declared(root)
    for stage, figures in metrics().items():
        artifacts.write_metrics(stage, figures)
    made_certificate.write()
    data = Path("datasets")
    artifacts.write_table(
        data / "ingest/record.parquet",
        tables.record(machine.inputs, machine.outputs),
        record(machine, samples, recording),
    )
    flaw = {
        "recording": [HOSTILE],
        "signal": ["zone_1"],
        "kind": ["quarantined"],
        "start_s": [np.nan],
        "end_s": [np.nan],
        "count": [1],
        "message": [HOSTILE],
    }
    artifacts.write_table(data / "ingest/quality.parquet", tables.QUALITY, flaw)
    plant = {
        "A": (np.diag([0.99, 0.9])[None], "1", "state matrix"),
        "C": (np.eye(2)[None], "1", "output matrix"),
    }
    artifacts.write_arrays(data / "identify_plant/plant.parquet", "plant", 1, plant)
    order = {
        "order": np.arange(1, 4, dtype=np.int32),
        "singular_value": [9.0, 5.0, 0.1],
        "noise_edge": [0.5] * 3,
        "parameters": [3, 6, 9],
        "error": [0.5, 0.1, np.nan],
        "chosen": [False, True, False],
    }
    artifacts.write_table(data / "identify_plant/order.parquet", tables.ORDER, order)
    seen = {"segment": np.repeat([0, 1], 25).astype(np.int32), "time_s": np.tile(np.arange(25.0), 2)}
    seen |= {
        f"{o.name}_{kind}": np.sin(np.arange(50.0))
        for o in machine.outputs
        for kind in ("measured", "simulated", "ahead")
    }
    seen["zone_2_measured"][5:9] = np.nan
    artifacts.write_table(data / "identify_plant/holdout.parquet", tables.holdout(machine.outputs), seen)
    for name, (schema, columns) in model(machine).items():
        artifacts.write_table(data / f"identify_plant/{name}.parquet", schema, columns)
    artifacts.write_json(
        data / "tune_weights/weights.json",
        {"contestants": {"subspace_lqg": {"q": [1.0, 2.0], "r": [0.1, 0.2], "cost": 2.0, "at_bound": []}}},
    )
    search()
    artifacts.write_json(data / "ingest/printer_pid.json", {"heaters": [PRINTER_PID]})
    folder = data / "evaluate_temperature"
    artifacts.write_table(folder / "cases.parquet", tables.CASES, cases())
    artifacts.write_table(
        folder / "trajectories.parquet",
        tables.trajectories(machine.inputs, machine.outputs),
        trajectories(machine),
    )
    deposition()
    made_setpoint.write()


def search():
    """The search of one contestant, whose first candidate failed."""
    table = {
        "contestant": ["subspace_lqg"] * 3,
        "evaluation": [1, 2, 3],
        "cost": [None, 3.0, 2.0],
        "incumbent": [None, 3.0, 2.0],
        "values": ["{}"] * 3,
        "chosen": [False, False, True],
        "failure": ["unstable", "", ""],
    }
    artifacts.write_table("datasets/tune_weights/history.parquet", tables.TUNING, table)


# ---- the deposition loop: one material, one part of one line, three trials of three laws


def deposition(scores=None):
    """Every artifact of the loop; `scores` {composer: (error, forecast, worst line)} in percent."""
    for stage, found in deposition_metrics().items():
        artifacts.write_metrics(stage, found)
    time = np.arange(200) / 50
    wanted = np.where((time > 1) & (time < 3) & ~((time > 1.8) & (time < 2.2)), 2.0, 0.0)
    folder = Path("datasets/train_ilc")
    runs = [(law, j) for law in ("hoelzle_2009", "model_inverse", "pixels") for j in range(3)]
    ratio = [1.0, 0.7, 0.4, 1.0, 0.1, 0.02, 1.0, 0.1, 0.03]
    rows = [
        ("A", law, 0, 8.0, 0.4, j, r, r + 0.05, r, 1.0 + 9.5 * j, 0.0, False)
        for (law, j), r in zip(runs, ratio, strict=True)
    ]
    artifacts.write_table(folder / "trials.parquet", TRIALS, _columns(TRIALS, rows))
    rows = [
        (
            "A",
            law,
            0,
            j,
            t,
            r,
            r * (1 + 10 * j * (t < 1.2)),
            r * (1 - found) if not 1.8 < t < 2.2 else np.nan,
            r * (1 - found),
        )
        for (law, j), found in zip(runs, ratio, strict=True)
        for t, r in zip(time, wanted, strict=True)
    ]
    artifacts.write_table(folder / "lessons.parquet", LESSONS, _columns(LESSONS, rows))
    filmed = [("A", 0, j, 100, 1, "no bead 1", 0.01, 0.9, 0) for j in range(3)]
    artifacts.write_table(folder / "filmed.parquet", FILMED, _columns(FILMED, filmed))
    chain = {
        "gain": 1.0,
        "time_constant_s": 2.7,
        "delay_s": 0.1,
        "lag_hz": None,
        "play": 0.01,
        "yield_": 0.1,
        "creep_share": 0.0,
        "creep_time_s": 20.0,
    }
    calibration = {"gain": 0.008, "offset": 0.0, "deviation": 0.0004, "residuals": [0.0]}
    artifacts.write_json(
        folder / "models.json", {"A": {"nominal": chain, "plant": chain, "calibration": calibration}}
    )
    frame = {
        "material": "A",
        "trial": 0,
        "recording": HOSTILE,
        "topic": "/image",
        "time_s": 1.0,
        "deviation_px": 0.1,
        "blur_px": 1.0,
    }
    frames = [("a.jpg", "start", "", 0.9), ("b.jpg", "rejected", "no bead", None)]
    artifacts.write_json(
        folder / "frames/frames.json",
        [frame | {"file": f, "place": p, "reason": why, "width_mm": w} for f, p, why, w in frames],
    )
    for name, *_ in frames:
        (folder / "frames" / name).write_bytes(b"\xff\xd8 a picture \xff\xd9")
    tasks = [
        ("Start", 0.0, 40, 51),
        ("Corner", 0.4, 28, 54),
        ("Stop", 0.0, 28, 57),
        ("Steady-State", 0.0, 0, 1),
        ("No-Flow", 0.0, 0, 1),
    ]
    rows = [
        (task, "A", 0.8, 8.0, pause, lead, n, [float(task != "No-Flow")] * n)
        for task, pause, lead, n in tasks
    ]
    artifacts.write_table("datasets/segment_library/library.parquet", LIBRARY, _columns(LIBRARY, rows))
    checks = [
        {"assumption": k, "claim": f"claim {k}: what", "material": "A", "nozzle_mm": 0.8, "percent": 10.0 * k}
        for k in range(1, 5)
    ]
    known = {"material": "A", "nozzle_mm": 0.8, "chain": {"extruder": chain, "held_out_percent": 0.6}}
    learned = {"sample_time_s": 0.02, "marks": {"Stop": [0.56, 0.58]}, "materials": [known], "checks": checks}
    learned["slicer"] = {
        "A": {
            "pressure_advance_s": [0.041, 0.0452, 0.05],
            "smooth_time_s": [0.03, 0.04, 0.2],
            "flow_ratio": [0.95, 0.98, 1.01],
            "Klipper": "SET_PRESSURE_ADVANCE ADVANCE=0.0452 SMOOTH_TIME=0.040",
            "Marlin": "M900 K0.0452",
            "OrcaSlicer": "pressure_advance = 0.0452",
        }
    }
    artifacts.write_json("datasets/segment_library/learned.json", learned)
    _composed(
        time,
        wanted,
        scores
        or {
            "on_off": (100.0, None, 60.0),
            "priority": (12.0, 11.0, 9.0),
            "superposition": (8.0, 7.0, 4.0),
            "basis": (2.0, 2.5, 1.0),
            "ilc": (1.5, None, 0.5),
        },
    )


def _composed(time, wanted, scores):
    folder = Path("datasets/compose_parts")
    absent = {one.name: scores["priority"] for one in COMPOSERS} | {"ilc": (np.nan,)}
    flows = {
        name: wanted * (1 - (absent | scores)[name][0] / 100) for name in (one.name for one in COMPOSERS)
    }
    rows = [
        ("square", 0, "A", t, 8 * t, 0.0, r, r, r, *(flows[name][k] for name in flows))
        for k, (t, r) in enumerate(zip(time, wanted, strict=True))
    ]
    artifacts.write_table(folder / "signals.parquet", SIGNALS, _columns(SIGNALS, rows))
    rows = [
        ("square", "A", name, name == "basis", error, predicted, line)
        for name, (error, predicted, line) in scores.items()
    ]
    artifacts.write_table(folder / "scores.parquet", SCORES, _columns(SCORES, rows))
    rows = [
        ("square", "A", name, prints, error * (1 + 1 / prints))
        for name, (error, _, _) in scores.items()
        for prints in (1, 8, 24)
        if name != "on_off"
    ]
    artifacts.write_table(folder / "prints.parquet", PRINTS, _columns(PRINTS, rows))
    artifacts.write_table(
        folder / "tasks.parquet", TASKS, _columns(TASKS, [("square", "Start", 0, 3, 1.0, 1.0, 8.0, 0.0, 0.0)])
    )
    lines = [
        ("square", 3, 0, 1.0, 2.0, 16.0, 4.0, 3.8, 1.0, -5.0, False, -6.0, -4.0),
        ("square", 7, 0, 3.0, 0.2, 1.6, 0.4, 0.4, 0.1, 0.0, True, -1.0, 1.0),
    ]
    artifacts.write_table(folder / "lines.parquet", LINES, _columns(LINES, lines))
    enough = {
        "ramp_s": 0.15,
        "amplitude_mm": 100.0,
        "speed_mm_per_s": 5000.0,
        "largest_command_mm": 45.0,
        "largest_speed_mm_per_s": 900.0,
        "peak_over_steady": 20.0,
        "share_percent": 0.0,
        "rms_percent_of_on_off": 0.1,
        "least_percent": 0.0,
        "enough": True,
    }
    report = {
        "printed_lines": 2,
        "runs": 2,
        "duration_s": 4.0,
        "shorter_than_lead": 1,
        "composer": {"A": "basis"},
        "forecast": {
            "A": {
                "low": 0.4,
                "median": 2.5,
                "high": 3.1,
                "composers": {"basis": {"low": 0.4, "high": 3.1}, "priority": {"low": 10.0, "high": 14.0}},
                "judged": True,
                "reason": "",
                "trial": "",
            }
        },
        "refused": [],
        "unknown_words": 1,
    }
    artifacts.write_json(
        folder / "conformance.json",
        {"square": report | {"saturation": {"A": enough}, "ramp_that_would_do_s": {"A": 0.15}}},
    )


def _columns(schema, rows):
    return dict(
        zip((column.name for column in schema.columns), map(list, zip(*rows, strict=True)), strict=True)
    )
