"""The owner's whole path on drawn machines, the forecast against the machine, and two rivals that a person
makes: a PI tuned on the machine, and an ARX model with an LQG controller by python-control.

    ./run --group dev python -m tests.foreign.benchmark --seeds 25-36 --compare --out /tmp/benchmark

Writes machines.csv, a row a machine, and fits.csv, a row a fit, and prints what counts. Project folders stay
under BEADLINE_LIVES, if that is set, and are made once a seed.
"""

import argparse
import contextlib
import ctypes
import functools
import json
import os
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import control
import numpy as np
import pandas as pd
import pyarrow.parquet as pq

from stages.evaluate_temperature import load_problem
from tests.foreign import normal_life, thermal_machines
from tests.foreign.normal_life import COLD
from tests.foreign.thermal_machines import DOOR, ROOM, Machine, draw, pointer, quiet, sampled, start
from tests.mission import toy_temperature

STAGES = "ingest", "export_controllers"
PLANTS = 24  # of the judging half, where its cases are a forecast
LIKELY = 0.05, 0.95  # quantiles of the cases of a situation: the forecast's interval
# a settled output stays within the larger of these of its reference
BAND_DEGC, BAND_SHARE = 1.0, 0.01
OVERSHOOT_SHARE = 0.02  # of the step, that a person's tuning allows
AT_MOST_TIMES = 1.1  # the better rival's settling time from cold
HOURS = 6.0  # at one reference, while doors open and the room wanders
SETTLED_HOURS = 2.0  # before these count
TRIES = 20  # of a person on the machine, at most
PRICES = (0.001, 0.01, 0.1, 1.0)  # of a percent of duty, squared, against a degC
ORDERS = range(1, 13)


# ---- the owner's path


def walk(seed: int, folder: Path) -> dict[str, Any]:
    """Two recordings of the machine of a seed, `inspect`, `init`, limits, and the stages up to the export, in
    an empty folder. Writes path.json, which it returns: how far the path went, CPU s of each stage, and the
    error that ended it, "" for none."""
    folder.mkdir(parents=True)
    machine, project = draw(seed), toy_temperature.begin(folder / "project")
    found: dict[str, Any] = {"seed": seed, "structure": machine.structure, "error": "", "times": {}}
    rng, logs = np.random.default_rng([seed, 1]), [folder / "steps.csv", folder / "evening.csv"]
    thermal_machines.write_csv(logs[0], machine, thermal_machines.record(machine, rng))
    thermal_machines.write_csv(logs[1], machine, thermal_machines.evening(machine, rng))
    try:
        found["where"] = "inspect"
        for log in logs:
            toy_temperature.beadline(project, "inspect", str(log.resolve()))
        found["where"] = "init"
        normal_life.declare(project, machine, logs[::-1])
        _play(project, found, STAGES)
    except Exception as error:  # whatever ends an owner's path is a finding
        found["error"] = f"{type(error).__name__}: {error}"
    (folder / "path.json").write_text(json.dumps(found, indent=1), encoding="utf-8")
    return found


def _play(project: Path, found: dict[str, Any], first_last: tuple[str, str]) -> None:
    for stage in toy_temperature.stages_between(*first_last):
        found["where"], begin = stage, normal_life._cpu_s()
        toy_temperature.play(project, stage)
        found["times"][stage] = round(normal_life._cpu_s() - begin, 1)
    found["where"] = "end"


@functools.cache
def walked_folder(seed: int) -> Path:
    """The folder that `walk` filled for a seed; kept under BEADLINE_LIVES, if that is set."""
    folder = Path(os.environ.get(normal_life.KEPT) or tempfile.mkdtemp(prefix="paths_")) / f"path_{seed}"
    if not (folder / "path.json").exists():
        shutil.rmtree(folder, ignore_errors=True)
        walk(seed, folder)
    return folder


def read_outcome(project: Path) -> dict[str, Any]:
    """What the verdict says, and whether there is a file: "consistent" if "Ready" stands there exactly if the
    certificate of the controller passes and its files exist."""
    verdict = _json(project, "verdict/temperature.json")
    exported = _json(project, "export_controllers/exported.json")["temperature"]
    certified = _json(project, "verdict/certificates.json").get("temperature", {})
    rules = [line[0] for line in verdict["rules"]]
    file, ready = bool(exported["files"]), verdict["decision"].startswith("Ready")
    passed = bool(certified.get(verdict["winner"] or "", {}).get("passed"))
    return {
        "decision": verdict["decision"],
        "subject": verdict["subject"],
        "ready": ready,
        "file": file,
        "consistent": ready == file and (passed or not ready),
        "lead": verdict["lead"],
        "missing": [
            f"{one['name']} ({one['state']}): {one['reason']}"
            for one in rules
            if one["state"] != "passed" and one["name"] != "drift"
        ],
        "reason": "" if ready else f"{verdict['reason']} {verdict['remedy']}",
        "refused": {name: one["why"] for name, one in certified.items() if not one["passed"]},
    }


def _json(project: Path, name: str) -> Any:
    return json.loads((project / "datasets" / name).read_text(encoding="utf-8"))


def _copy(folder: Path, name: str) -> Path:
    """A fresh copy of the project."""
    shutil.rmtree(folder / name, ignore_errors=True)
    return Path(shutil.copytree(folder / "project", folder / name, symlinks=True))


def refit(folder: Path, nth: int, of: int) -> dict[str, Any]:
    """The path again from the stage after `ingest`, on the nth of `of` equal windows of the record that
    overlap by half: what read_outcome says, or the error."""
    project, found = _copy(folder, "refit"), {"where": "", "error": "", "times": {}}
    path = project / "datasets/ingest/record.parquet"
    table = pq.read_table(path)
    length = 2 * len(table) // (of + 1)
    pq.write_table(table.slice(nth * length // 2, length), path)
    try:
        _play(project, found, ("identify_plant", STAGES[1]))
    except toy_temperature.Refused as error:
        return found | {"error": str(error)}
    return found | read_outcome(project)


def count_limits(folder: Path, rng: np.random.Generator, count: int) -> Counter[str]:
    """Verdict and export of one fit under `count` draws of the limits of section `report`: how often "Ready"
    stands, a file is written, and the two agree."""
    project, seen = _copy(folder, "refit"), Counter[str]()
    for drawn in rng.uniform([0.05, 0.1, 0.2], [1, 0.9, 4], (count, 3)).tolist():
        names = "report.settled_error_degC", "report.disk_margin", "report.delay_margin_s"
        toy_temperature.declare(project, dict(zip(names, drawn, strict=True)))
        toy_temperature.play(project, "verdict", "export_controllers")
        found = read_outcome(project)
        seen.update(["fits", *(name for name in ("ready", "file", "consistent") if found[name])])
    return seen


# ---- the forecast against the machine


def forecast(folder: Path, name: str) -> dict[str, Any]:
    """The cases of a controller on the test set with PLANTS plants: by situation the intervals of settling in
    s and overshoot in degC, and the schedule of references that the machine has to follow."""
    project = folder / "forecast"
    if not project.exists():
        toy_temperature.declare(_copy(folder, "forecast"), {"panel.judging.plants": PLANTS})
        toy_temperature.play(project, "evaluate_temperature")
    with contextlib.chdir(project):
        half = load_problem().setting.rehearsal.judging
    table = pq.read_table(project / "datasets/evaluate_temperature/cases.parquet").to_pandas()
    mine, own = table[table.contestant == name], _json(project, "evaluate_temperature/figures.json")
    row = half.kind.tolist().index("sequence")
    steps = [half.references[k].H[:, 0] for k in half.asked[row]]
    held = [np.tile(half.starts[half.start[row]], (half.steps, 1))]
    return {
        "band_degC": own["band_degC"],
        "page_settling_s": own["contestants"][name]["settling"]["q90"],
        "page_overshoot_degC": own["contestants"][name]["overshoot"]["q90"],
        "cold": _interval(mine[mine.case % half.each == 0]),
        "steps": _interval(mine[mine.kind == "sequence"]),
        "start_degC": half.starts[0],
        "cold_schedule": np.tile(half.references[half.asked[0, 0]].H[:, 0], (half.steps, 1)),
        "steps_schedule": np.concatenate(held + [np.tile(r, (half.steps // len(steps), 1)) for r in steps]),
        "begins": half.steps + np.arange(len(steps)) * (half.steps // len(steps)),
    }


def _interval(cases: Any) -> dict[str, tuple[float, float]]:
    """Ends of LIKELY; what never settles needs forever."""
    filled = cases[["settling_s", "overshoot_degC"]].fillna(np.inf)
    return {name: tuple(np.quantile(filled[name], LIKELY, method="nearest").tolist()) for name in filled}


def follow(
    folder: Path, machine: Machine, r: np.ndarray, outside: np.ndarray, noise: int, degC: float | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """True sensors (T, p), duties (T, m) and modes (T,) of a machine under an exported controller, after COLD
    samples in manual with the heaters off, for which the first rows of r (T, p) and outside (T, 4) are
    repeated; from rest at room temperature unless told."""
    r, outside = (np.concatenate([np.tile(a[0], (COLD, 1)), a]) for a in (r, outside))
    r, outside = np.ascontiguousarray(r, float), np.ascontiguousarray(outside, float)
    (T, p), m, modes = r.shape, len(machine.inputs), np.zeros((4, len(r)), np.int8)
    y, sensor, u, visible = np.zeros((T, p)), np.zeros((T, p)), np.zeros((T, m)), np.ones(p)
    result = normal_life.build(folder).normal_life(
        ctypes.byref(machine.parts), ctypes.c_double(machine.room_degC if degC is None else degC),
        ctypes.c_uint64(noise), T, COLD, 0, pointer(r), pointer(outside), 0, 0, T, ctypes.c_double(0.0),
        pointer(visible), *map(pointer, (y, sensor, u)),
        *[ctypes.c_void_p(row.ctypes.data) for row in modes], (ctypes.c_int * 2)(),
        pointer(normal_life.told(folder, machine, outside)),
    )  # fmt: skip
    if result:
        raise RuntimeError(f"a call of the exported controller ended with result {result}")
    return sensor[COLD:], u[COLD:], modes[0, COLD:]


def settling_s(y: np.ndarray, r: np.ndarray, band: np.ndarray | float, sample_time_s: float) -> float:
    """Seconds to the last sample of y (T, p) further than `band` from r (T, p); inf if that is the last."""
    outside = np.flatnonzero((np.abs(y - r) > band).any(axis=1))
    last = int(outside[-1]) + 1 if len(outside) else 0
    return float("inf") if last == len(y) else last * sample_time_s


def overshoot_degC(y: np.ndarray, r: np.ndarray, before: np.ndarray) -> float:
    """How far y (T, p) goes past r (T, p), seen from `before` (p,), in the worst zone."""
    way = np.where(before <= r[0], 1.0, -1.0)
    return float(max((way * (y - r)).max(), 0.0))


def against_forecast(folder: Path, machine: Machine, name: str) -> dict[str, Any]:
    """Forecast and truth of a cold start and of the test set's set-point steps, and whether each lies
    within."""
    told, dt, row = forecast(folder, name), machine.sample_time_s, {}
    for kind, begins in (("cold", [0]), ("steps", told["begins"].tolist())):
        r = told[f"{kind}_schedule"]
        y, _, modes = follow(folder, machine, r, quiet(machine, len(r)), 7)
        ends = [*begins[1:], len(r)]
        pieces = [(y[a:b], r[a:b], y[a]) for a, b in zip(begins, ends, strict=True)]
        settled = max(settling_s(one, aim, told["band_degC"], dt) for one, aim, _ in pieces)
        past = max(overshoot_degC(*piece) for piece in pieces)
        for figure, truth in (("settling_s", settled), ("overshoot_degC", past)):
            low, high = told[kind][figure]
            row[f"{kind}_{figure}"], row[f"{kind}_{figure}_forecast"] = truth, f"{low:.4g} to {high:.4g}"
            row[f"{kind}_{figure}_inside"] = low <= truth <= high
        row[f"{kind}_crossed"] = bool(((y > machine.high_degC) | (y < machine.low_degC)).any())
        row[f"{kind}_safe_percent"] = 100 * float((modes != 0).mean())
    r = told["cold_schedule"]
    y, *_ = follow(folder, machine, r, quiet(machine, len(r)), 7, float(told["start_degC"].mean()))
    row["nearer_start_settling_s"] = settled = settling_s(y, r, told["band_degC"], dt)
    row["nearer_start_degC"] = round(float(told["start_degC"].mean()), 1)
    row["nearer_start_inside"] = told["cold"]["settling_s"][0] <= settled <= told["cold"]["settling_s"][1]
    keys = "band_degC", "page_settling_s", "page_overshoot_degC"
    return row | {key: told[key] for key in keys}


# ---- what a person makes in an hour


def tune_pi(machine: Machine) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The PI that settles soonest from cold with little overshoot on the machine: SIMC after a step test
    (thermal_machines.tune), then gains and integral times halved and doubled as long as that helps."""
    K, integral, _ = machine.own_control
    scores: dict[tuple[int, int], tuple[float, float]] = {}

    def score(at: tuple[int, int]) -> tuple[float, float]:
        if at not in scores:
            gain, longer = 2.0 ** np.array(at)
            y, r = _pi_from_cold(machine, (gain * K, gain * integral / longer, 0 * K))
            excess = overshoot_degC(y, r, y[0]) / (r[0] - y[0]).min() - OVERSHOOT_SHARE
            scores[at] = max(excess, 0.0), settling_s(y, r, _band(r[0]), machine.sample_time_s)
        return scores[at]

    best = 0, 0
    while len(scores) < TRIES:
        moves = [(best[0] + a, best[1] + b) for a, b in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))]
        better = min(moves, key=score)
        if better == best:
            break
        best = better
    gain, longer = 2.0 ** np.array(best)
    return gain * K, gain * integral / longer, 0 * K


def _band(r: np.ndarray) -> np.ndarray:
    return np.maximum(BAND_DEGC, BAND_SHARE * np.abs(r))


def _steps(machine: Machine) -> int:
    return round((6 * machine.tau_s + 1800) / machine.sample_time_s)


def _pi_from_cold(machine: Machine, gains: tuple[np.ndarray, ...]) -> tuple[np.ndarray, np.ndarray]:
    r = np.tile(machine.reference_degC, (_steps(machine), 1))
    y, _ = thermal_machines.control(machine, start(machine, 2), gains, r, quiet(machine, len(r)))
    return y, r


def fit_arx(u: list[np.ndarray], y: list[np.ndarray]) -> tuple[int, np.ndarray, np.ndarray]:
    """Order n, coefficients (1 + n (p + m), p) and covariance (p, p) of the ARX model of smallest AIC,

        y_k = c + sum_i A_i y_{k-i} + B_i u_{k-i} + e_k

    by least squares on segments u (T, m) and y (T, p), all orders on the same rows."""
    best: tuple[float, int, np.ndarray, np.ndarray] | None = None
    for n in ORDERS:
        X, Y = (np.concatenate(part) for part in zip(*map(_regression, u, y, [n] * len(u)), strict=True))
        theta = np.linalg.lstsq(X, Y, rcond=None)[0]
        sigma = np.atleast_2d(np.cov((Y - X @ theta).T, bias=True))
        aic = len(Y) * np.linalg.slogdet(sigma)[1] + 2 * theta.size
        if best is None or aic < best[0]:
            best = aic, n, theta, sigma
    assert best is not None
    return best[1:]


def _regression(u: np.ndarray, y: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    most = ORDERS[-1]
    past = [a[most - i : len(a) - i] for a in (y, u) for i in range(1, n + 1)]
    return np.hstack([np.ones((len(y) - most, 1)), *past]), y[most:]


Act = Callable[[np.ndarray, np.ndarray], np.ndarray]  # readings and references (p,) to duties (m,)


def lqg(theta: np.ndarray, sigma: np.ndarray, n: int, price: float, machine: Machine) -> Act:
    """LQG with integral action on an ARX model of order n: x = [y_k .. y_{k-n+1}, u_{k-1} .. u_{k-n+1}],

        u = u_r - K (x - x_r) - K_i xi    xi' = xi + dt (r - y)    x' = A x + B u + c + L (y - C x)

    with K from dlqr and L from dlqe; u is clipped, and an output whose heater is clipped is not integrated.
    Raises ValueError or LinAlgError if there is no such gain."""
    p, m, dt = theta.shape[1], len(machine.inputs), machine.sample_time_s
    of_y, of_u = theta[1 : 1 + n * p].T, theta[1 + n * p :].T
    size = n * p + (n - 1) * m
    A, B, C, c = np.zeros((size, size)), np.zeros((size, m)), np.eye(p, size), np.zeros(size)
    A[:p], B[:p], c[:p] = np.hstack([of_y, of_u[:, m:]]), of_u[:, :m], theta[0]
    A[p : n * p, : (n - 1) * p] = np.eye((n - 1) * p)
    if n > 1:
        B[n * p : n * p + m] = np.eye(m)
        A[n * p + m :, n * p : size - m] = np.eye((n - 2) * m)
    whole = np.block([[A, np.zeros((size, p))], [-dt * C, np.eye(p)]])
    weights = np.diag(np.r_[np.ones(p), np.zeros(size - p), np.full(p, (3 / machine.tau_s) ** 2)])
    K, _, _ = control.dlqr(whole, np.vstack([B, np.zeros((p, m))]), weights, price * np.eye(m))
    L, _, _ = control.dlqe(A, C.T, C, sigma, sigma)
    rest = np.block([[np.eye(size) - A, -B], [C, np.zeros((p, m))]])
    solve, x, xi, begun = np.linalg.pinv(rest), np.zeros(size), np.zeros(p), False

    def act(y: np.ndarray, r: np.ndarray) -> np.ndarray:
        nonlocal x, xi, begun
        if not begun:
            x[: n * p], begun = np.tile(y, n), True
        target = solve @ np.r_[c, r]
        wish = target[size:] - K @ np.r_[x - target[:size], xi]
        u = np.clip(wish, 0, 100)
        xi = xi + dt * (r - y) * (u == wish)
        x = A @ x + B @ u + c + L @ (y - C @ x)
        return u

    return act


def pi(machine: Machine, gains: tuple[np.ndarray, ...]) -> Act:
    """The person's PI of thermal_machine.c, a sample at a time."""
    m, memory = len(machine.inputs), thermal_machines.Pid()
    u = np.zeros(m)
    for name, gain in zip(("proportional", "integral", "derivative"), gains, strict=True):
        getattr(memory, name)[:m] = list(gain)

    def act(y: np.ndarray, r: np.ndarray) -> np.ndarray:
        thermal_machines.library().thermal_control(
            ctypes.byref(memory), ctypes.byref(machine.parts), *map(pointer, (r, y, u))
        )
        return u.copy()

    return act


def close(machine: Machine, act: Act, r: np.ndarray, outside: np.ndarray) -> np.ndarray:
    """True sensors (T, p) of the machine from cold, under r (T, p) and what acts from outside (T, 4)."""
    state, p = start(machine, 7), len(machine.outputs)
    at, y, sensor = (ctypes.byref(state), ctypes.byref(machine.parts)), np.zeros(p), np.zeros(r.shape)
    r, outside = np.ascontiguousarray(r, float), np.ascontiguousarray(outside, float)
    for k in range(len(r)):
        thermal_machines.library().thermal_read(*at, pointer(y))
        sensor[k] = state.sensor[:p]
        u = np.ascontiguousarray(act(y, r[k]), float)
        thermal_machines.library().thermal_advance(*at, pointer(u), pointer(outside[k]))
    return sensor


def tune_lqg(machine: Machine, logs: list[Path]) -> tuple[int, float, Act | None]:
    """ARX order, price and controller of the price that settles soonest from cold on the machine; None if
    python-control finds no gain. Logs are averaged over its sample time."""
    m, segments = len(machine.inputs), []
    for log in logs:
        rows = np.loadtxt(log, delimiter=",", skiprows=1)
        every = max(round(machine.sample_time_s / (rows[1, 0] - rows[0, 0])), 1)
        rows = rows[: len(rows) // every * every].reshape(-1, every, rows.shape[1])
        segments.append((rows[:, :, 1 : 1 + m].mean(axis=1), rows[:, 0, 1 + m :]))
    n, theta, sigma = fit_arx(*map(list, zip(*segments, strict=True)))
    r, tried = np.tile(machine.reference_degC, (_steps(machine), 1)), []
    for price in PRICES:
        with contextlib.suppress(ValueError, np.linalg.LinAlgError):
            y = close(machine, lqg(theta, sigma, n, price, machine), r, quiet(machine, len(r)))
            settled = settling_s(y, r, _band(r[0]), machine.sample_time_s)
            tried.append((settled, overshoot_degC(y, r, y[0]), price))
    if not tried:
        return n, 0.0, None
    price = min(tried)[2]
    return n, price, lqg(theta, sigma, n, price, machine)


def schedule(machine: Machine, seed: int) -> tuple[np.ndarray, np.ndarray, list[float]]:
    """A cold start, three set-point changes, and HOURS at the reference while doors open and the room
    wanders: r (T, p), what acts from outside (T, 4), and the times in s at which each part begins."""
    dt, reference = machine.sample_time_s, machine.reference_degC
    low, high = machine.lowest_degC, machine.highest_degC
    aims = [reference, low + 0.2 * (high - low), high - 0.2 * (high - low), reference]
    cold, each = _steps(machine), round((3 * machine.tau_s + 1800) / dt)
    lengths = [cold, each, each, each]
    r = np.concatenate([np.tile(aim, (n, 1)) for aim, n in zip(aims, lengths, strict=True)])
    _, moved = thermal_machines.life(machine, np.random.default_rng([seed, 3]), HOURS)
    last = quiet(machine, len(moved))
    last[:, [ROOM, DOOR]] = moved[:, [ROOM, DOOR]]
    begins = [*np.cumsum([0, *lengths]) * dt]
    r = np.concatenate([r, np.tile(reference, (len(last), 1))])
    return r, np.concatenate([quiet(machine, sum(lengths)), last]), begins


def against_person(folder: Path, seed: int, machine: Machine) -> dict[str, Any]:
    """Figures of the exported controller on `machine`, sampled at its sample time, of the PI tuned on
    the machine as its firmware samples it, and of ARX + LQG at the sample time of the controller."""
    native = draw(seed)
    logs = [folder / "steps.csv", folder / "evening.csv"]
    r, outside, begins = schedule(native, seed)
    n, price, made = tune_lqg(machine, logs)
    row: dict[str, Any] = {"arx_order": n, "lqg_price": price}

    def at(one: Machine) -> tuple[np.ndarray, np.ndarray]:
        rows = np.arange(int(len(r) * native.sample_time_s / one.sample_time_s))
        rows = (rows * one.sample_time_s / native.sample_time_s).astype(int)
        return r[rows], outside[rows]

    sensors = {"own": (machine, follow(folder, machine, *at(machine), 7)[0])}
    sensors["pi"] = native, close(native, pi(native, tune_pi(native)), *at(native))
    if made is not None:
        sensors["lqg"] = machine, close(machine, made, *at(machine))
    for name, (one, y) in sensors.items():
        row |= {f"{name}_{key}": value for key, value in _figures(one, y, at(one)[0], begins).items()}
    rivals = [row[f"{name}_cold_s"] for name in ("pi", "lqg") if name in sensors]
    return row | {"cold_within": row["own_cold_s"] <= AT_MOST_TIMES * min(rivals)}


def _figures(machine: Machine, y: np.ndarray, r: np.ndarray, begins: list[float]) -> dict[str, float]:
    dt = machine.sample_time_s
    rows = np.ceil(np.array(begins) / dt - 1e-6).astype(int).tolist()
    parts = [(y[a:b], r[a:b]) for a, b in zip(rows, rows[1:], strict=False)]
    settled = [settling_s(one, aim, _band(aim[0]), dt) for one, aim in parts]
    past = [overshoot_degC(one, aim, one[0]) for one, aim in parts]
    quiet_until = rows[-1] + round(SETTLED_HOURS * 3600 / dt)
    error = (y - r)[quiet_until:]
    return {
        "cold_s": settled[0],
        "steps_s": max(settled[1:]),
        "cold_overshoot_degC": past[0],
        "steps_overshoot_degC": max(past[1:]),
        "rms_degC": float(np.sqrt((error**2).mean(axis=0)).max()),
    }


# ---- the table


def judge(seed: int, *, compare: bool) -> dict[str, Any]:
    """The row of a machine. If the controller is not exported, the C that `certify` prepared is compared."""
    folder = walked_folder(seed)
    path = json.loads((folder / "path.json").read_text(encoding="utf-8"))
    row = {key: path[key] for key in ("seed", "structure", "where", "error")}
    row["cpu_s"] = round(sum(path["times"].values()), 1)
    if path["error"]:
        return row
    row |= read_outcome(folder / "project")
    prepared = folder / "project/datasets/certify/temperature" / row["subject"] / "c"
    if not compare or not prepared.exists():
        return row
    shutil.copytree(prepared, folder / "c", dirs_exist_ok=True)
    machine = sampled(draw(seed), normal_life.sample_time_s(folder))
    return row | against_forecast(folder, machine, row["subject"]) | against_person(folder, seed, machine)


def print_totals(rows: list[dict[str, Any]]) -> None:
    """The verdicts, and how many rows hold each of the bars, of those that have the figure."""
    print(f"\n{len(rows)} rows; {sum(not row['error'] for row in rows)} ran to the end.")
    print(Counter(row.get("decision", "error").split(":")[0] for row in rows))
    bars = [(name, value) for row in rows for name, value in row.items() if isinstance(value, bool)]
    for name, of in Counter(name for name, _ in bars).items():
        print(f"  {name}: {bars.count((name, True))} of {of}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=normal_life._seeds, default=normal_life._seeds("25-36"))
    parser.add_argument("--compare", action="store_true", help="with the forecast, and what a person makes")
    parser.add_argument("--refits", type=int, default=0, help="windows of each record that are learned again")
    parser.add_argument("--limits", type=int, default=0, help="draws of the limits for each fit")
    parser.add_argument("--out", type=Path, default=Path("."))
    asked, seen = parser.parse_args(), Counter[str]()
    asked.out.mkdir(parents=True, exist_ok=True)
    tables: dict[str, list[dict[str, Any]]] = {"machines": [], "fits": []}
    for seed in asked.seeds:
        tables["machines"].append(judge(seed, compare=asked.compare))
        folder, ended = walked_folder(seed), not tables["machines"][-1]["error"]
        for nth in range(asked.refits * ended):
            tables["fits"].append({"seed": seed, "nth": nth} | refit(folder, nth, asked.refits))
        seen += count_limits(folder, np.random.default_rng([seed, 4]), asked.limits * ended)
        for name, rows in tables.items():
            pd.DataFrame(rows).to_csv(asked.out / f"{name}.csv", index=False)
    for name, rows in tables.items():
        print(f"\n{name}", *map(json.dumps, rows), sep="\n")
        print_totals(rows)
    print("\nLimits drawn:", dict(seen))


if __name__ == "__main__":
    main()
