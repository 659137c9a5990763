"""Learning under a drive of limited travel and speed, on extruders of other kinds than the model's, beside
the best that any command could reach there.

Each plant of benchmarks/foreign_extruders.py learns the reference routine of params.yaml with the model
inverse, by `training.run_trials` as train_ilc does, measured with a camera's noise, under two drives: 10 mm
and 20 mm/s, and 3 x its own steady command. Beside the true error at trial 30 stands the least one that the
drive allows, found from the true plant:

  linear plants (plain, late, third order, creep): y = A^-1 B u with the poles of the plant and B from its
  impulse response; the nearest response is a convex problem (`reachable.nearest_response`);
  monotone flow of a linear pressure (exponent, yield): Gauss-Newton on it;
  up and down apart: the pressure's pole changes with its direction, which is iterated;
  sticky: whatever the seal lets through obeys the same limits, so that the plant without it bounds the error
  from below; no command need reach it.

`reachable` is the true simulator's error under the best command found; `two_starts` how far two searches,
from rest and from the learned command, end apart. Run: python -m
benchmarks.foreign_drive [learning | parts] [plants of a kind and material] [workers]
"""

import json
import math
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import joblib
import numpy as np
import scipy.signal

from benchmarks.foreign_extruders import STATIC, STEP_S, ForeignExtruder, drawn, flow, seen
from pipeline.deposition import composition, reachable, training
from pipeline.deposition.drive import Drive, follows, obeyed
from pipeline.deposition.extruder import Extruder, Routine
from pipeline.deposition.ilc import Trial, rms
from pipeline.deposition.library import Training
from pipeline.deposition.workflow import compose_parts, laws, settings
from pipeline.deposition.workflow.settings import ComposeParts, Printer, TrainIlc
from pipeline.store import params

TRIALS, JUDGED = 30, 1.2
# the drives: the first also with ramps of the gantry that it can follow
DRIVE, LIMIT, SLOW = "10 mm, 20 mm/s", "3 x steady", "10 mm, 20 mm/s, longer ramps"
RESULT = Path("benchmarks/results/foreign_drive.json")
PARTS, FOLDER = ("dashes", "fig9"), Path("datasets/parts")
# Gauss-Newton steps of a plant that is not linear
STEPS = 12
# plants of a kind whose least error is sought from two starts
TWICE = 5


DRIVEN = settings.Drive(amplitude_mm=10.0, speed_mm_per_s=20.0, backlash_mm=0.0)


class Row(NamedTuple):
    """One plant under one drive: its errors at trial 30 and the least reachable one, in % of on-off control
    under the same drive; their ratio; how far two searches for the least end apart, in % of it; whether every
    command obeyed the drive."""

    kind: str
    material: str
    plant: int
    drive: str
    learned_percent: float
    reachable_percent: float
    ratio: float
    two_starts_percent: float
    obeyed: bool


# ---- the best reachable


def best(e: ForeignExtruder, r: np.ndarray, drive: Drive, Ts: float, start: np.ndarray) -> np.ndarray:
    """u (N,) in mm within the drive whose flow comes nearest to r (N,), sought from the command `start` (N,)
    on by Gauss-Newton steps, each halved until the true plant's error falls."""
    # without delay, beside the flow that is wanted so much later
    late, at = round(e.delay_s / STEP_S) * STEP_S / Ts, np.arange(len(r))
    e, r = e._replace(stick_mm=0.0, delay_s=0.0), np.interp(at + late, at, r, right=0.0)
    u, least = start, rms(r - flow(e, start, sample_time_s=Ts))
    for _ in range(STEPS):
        towards, length = _step(e, u, r, drive, Ts), 1.0
        error = rms(r - flow(e, towards, sample_time_s=Ts))
        while error > least and length > 0.05:
            length /= 2
            error = rms(r - flow(e, u + length * (towards - u), sample_time_s=Ts))
        gained = least - error
        if gained > 0:
            u, least = u + length * (towards - u), error
        if gained < 1e-4 * least:
            break
    return u


def _step(e: ForeignExtruder, u: np.ndarray, r: np.ndarray, drive: Drive, Ts: float) -> np.ndarray:
    """The best command for the plant linearised along that of u (N,)."""
    output, command, q = _pressure(e, u, Ts)
    ratio = np.maximum(q / e.level, 1e-3)
    x = e.gain * e.level * ratio**e.exponent - e.yield_
    y = np.maximum((x + np.sqrt(x**2 + e.soft**2)) / 2 - (math.hypot(e.yield_, e.soft) - e.yield_) / 2, 0.0)
    slope = e.exponent * ratio ** (e.exponent - 1) * (1 + x / np.sqrt(x**2 + e.soft**2)) / 2
    slope = np.clip(slope, 0.2, 3.0)
    # no flow below this pressure
    still = e.level * (e.yield_ / (e.gain * e.level)) ** (1 / e.exponent)
    target = np.where(r > 0, q + (r - y) / (e.gain * slope), still)
    z = reachable.nearest_response(
        target,
        r <= 0,
        output=output,
        command=command,
        bound=drive.amplitude_mm,
        step=drive.speed_mm_per_s * Ts,
        weight=np.where(r > 0, slope**2, 1.0),
    )
    return obeyed(_of(z, command), drive, sample_time_s=Ts)


def _pressure(e: ForeignExtruder, u: np.ndarray, Ts: float) -> tuple[list, list, np.ndarray]:
    """Taps B and A of the pressure q = B z, u = A z, along the command u (N,), and that q (N,): the mean over
    each sample."""
    if e.lags_s or e.creep:
        poles = [math.exp(-Ts / tau) for tau in (*e.lags_s, e.tau_up_s, *([e.creep_s] if e.creep else []))]
        A, linear = np.poly(poles), e._replace(gain=1.0, soft=1e-12)
        impulse = flow(linear, np.append(1.0, np.zeros(len(poles) + 1)), sample_time_s=Ts)
        B = np.convolve(A, impulse)[: len(poles) + 1]
        return list(B), list(A), scipy.signal.lfilter(B, A, u)
    a = {tau: math.exp(-Ts / tau) for tau in (e.tau_up_s, e.tau_down_s)}
    fine = round(Ts / STEP_S)
    mean = {tau: float(np.mean(a[tau] ** (np.arange(1, fine + 1) / fine))) for tau in a}
    p, pole, share, q = 0.0, np.empty(len(u)), np.empty(len(u)), np.empty(len(u))
    for k, value in enumerate(u.tolist()):
        tau = e.tau_up_s if value > p else e.tau_down_s
        pole[k], share[k] = a[tau], mean[tau]
        q[k] = value + (p - value) * mean[tau]
        p = value + (p - value) * a[tau]
    A = [1 / (1 - pole), -pole / (1 - pole)]
    return [(1 - share) * A[0], share + (1 - share) * A[1]], A, q


def _of(z: np.ndarray, taps: list) -> np.ndarray:
    """sum_k taps[k] z(t-k) (N,), from rest."""
    late = [np.concatenate([np.zeros(k), z[: len(z) - k]]) for k in range(len(taps))]
    return sum(tap * one for tap, one in zip(taps, late, strict=True))


# ---- learning


def learned(
    e: ForeignExtruder,
    nominal: Extruder,
    routine: Routine,
    both: training.LawSettings,
    rng: np.random.Generator,
    trials: int = TRIALS,
) -> training.TrialSequence:
    """What the model inverse does with the plant, measured with noise."""
    Ts, drive, steady_flow = both.sample_time_s, both.drive, float(routine.r.max())

    def measure(u: np.ndarray) -> Trial:
        done = obeyed(u, drive, sample_time_s=Ts)
        truth = flow(e, done, sample_time_s=Ts)
        return Trial(done, seen(truth, rng, steady_flow=steady_flow), truth)

    law = training.model_inverse(routine, both)
    return training.run_trials(
        "model_inverse", law, measure, routine, nominal, trials=trials, settings=both, on_step=lambda _: None
    )


def judged(printer: Printer, section: TrainIlc, kind: str, index: int, plant: int, which: str) -> Row:
    """Learning and the least error of one plant under one drive."""
    change = {"drive": None if which == LIMIT else DRIVEN}
    if which != SLOW:
        change["longest_ramp_s"] = None
    printer = printer.model_copy(update=change)
    material, routine = printer.materials[index], printer.trained()[0]
    nominal = Extruder(material.gain_mm3_per_s_per_mm, material.time_constant_s)
    rng = np.random.default_rng([7, STATIC.index(kind), index, plant])
    e = drawn(
        kind, rng, gain=nominal.gain, time_constant_s=nominal.time_constant_s, steady_flow=printer.steady_flow
    )
    drive = Drive(3 * e.level, math.inf, 0.0) if which == LIMIT else printer.limits
    both = laws.law_settings(section, printer)._replace(drive=drive)
    Ts, r = both.sample_time_s, routine.r
    sequence = learned(e, nominal, routine, both, rng)
    errors = [rms(r - trial.truth) for trial in sequence.trials]
    at_30 = errors[-1]
    last = sequence.trials[-1].u
    least = [
        rms(r - flow(e._replace(stick_mm=0.0), best(e, r, drive, Ts, start), sample_time_s=Ts))
        for start in (np.zeros(len(r)), last)[: 2 if plant < TWICE else 1]
    ]
    return Row(
        kind,
        material.name,
        plant,
        which,
        100 * at_30 / errors[0],
        100 * min(least) / errors[0],
        at_30 / min(least),
        100 * abs(least[0] - least[-1]) / min(least),
        all(follows(trial.u, drive, sample_time_s=Ts) for trial in sequence.trials),
    )


# ---- parts, composed and not learned again


class PartRow(NamedTuple):
    """One part composed for one plant under the drive, in % of on-off control under the same drive: the true
    error, its forecast with both ends, whether that was judged, and the least reachable error; whether the
    command obeyed."""

    kind: str
    material: str
    plant: int
    part: str
    ramps: str
    true_percent: float
    low_percent: float
    forecast_percent: float
    high_percent: float
    judged: bool
    reachable_percent: float
    ratio: float
    obeyed: bool


def composed(printer: Printer, section: TrainIlc, parts: ComposeParts, plant: tuple) -> list[PartRow]:
    """The parts for one plant (kind, material, number) that was learned on the library's routines, with the
    part's own ramps and with ramps that the drive can follow."""
    kind, index, number = plant
    one, rows = printer.materials[index], []
    nominal = Extruder(one.gain_mm3_per_s_per_mm, one.time_constant_s)
    for ramps, longest_s in (("own", None), ("longer", printer.longest_ramp_s)):
        machine = printer.model_copy(update={"drive": DRIVEN, "longest_ramp_s": longest_s})
        rng = np.random.default_rng([8, STATIC.index(kind), index, number])
        family = {"gain": nominal.gain, "time_constant_s": nominal.time_constant_s}
        e = drawn(kind, rng, **family, steady_flow=machine.steady_flow)
        both = laws.law_settings(section, machine)
        trainings = []
        for routine in machine.trained()[1:]:
            trials = learned(e, nominal, routine, both, rng, trials=8).trials
            u, y = np.array([trial.u for trial in trials]), np.array([trial.y for trial in trials])
            trainings.append(Training(one.name, machine.nozzle_mm, routine, u, y))
        library = composition.learn(trainings, sample_time_s=machine.sample_time_s)
        # the parts name tool 0, whatever the material
        machine = machine.model_copy(update={"materials": [one.model_copy(update={"tool": 0})]})
        for name in PARTS:
            part = compose_parts.compose(FOLDER / f"{name}.gcode", library, machine, parts)
            rows.append(_judged_part(e, nominal, part, machine, (kind, one.name, number, name, ramps)))
    return rows


def _judged_part(
    e: ForeignExtruder, nominal: Extruder, part: compose_parts.Part, machine: Printer, of: tuple
) -> PartRow:
    """The first stream of a part, on the true plant."""
    stream, drive, Ts = part.composed.streams[0], machine.limits, machine.sample_time_s
    r, free = stream.r, e._replace(stick_mm=0.0)
    first = obeyed(r / nominal.gain, drive, sample_time_s=Ts)
    true, on_off = (rms(r - flow(e, u, sample_time_s=Ts)) for u in (stream.u, first))
    least = min(true, rms(r - flow(free, best(e, r, drive, Ts, stream.u), sample_time_s=Ts)))
    told = next(one for one in part.composed.predictions if one.chosen and one.tool == stream.tool)
    percents = (100 * true / on_off, told.low, told.median, told.high, stream.judged.judged)
    return PartRow(
        *of, *percents, 100 * least / on_off, true / least, follows(stream.u, drive, sample_time_s=Ts)
    )


def covered(rows: list[PartRow]) -> float | None:
    """Share in % of the judged forecasts that hold the true error; None where none is judged."""
    told = [row.low_percent <= row.true_percent <= row.high_percent for row in rows if row.judged]
    return 100 * float(np.mean(told)) if told else None


def part_summary(rows: list[PartRow]) -> dict:
    """By part, ramps and kind: medians of true error, forecast and least reachable error, and the ratio."""
    groups: dict[tuple, list[PartRow]] = {}
    for row in rows:
        for kind in (row.kind, "all"):
            groups.setdefault((row.part, row.ramps, kind), []).append(row)
    out: dict = {}
    for (part, ramps, kind), some in groups.items():
        out.setdefault(part, {}).setdefault(ramps, {})[kind] = {
            "plants": len(some),
            "true_percent": float(np.median([row.true_percent for row in some])),
            "forecast_percent": float(np.median([row.forecast_percent for row in some])),
            "judged_percent": 100 * float(np.mean([row.judged for row in some])),
            "covered_percent": covered(some),
            "reachable_percent": float(np.median([row.reachable_percent for row in some])),
            "ratio_median": float(np.median([row.ratio for row in some])),
            "ratio_worst": float(np.max([row.ratio for row in some])),
            "obeyed": all(row.obeyed for row in some),
        }
    return out


def summary(rows: list[Row]) -> dict:
    """By drive, kind and material: median and largest ratio, plants within the bar, errors."""
    out: dict = {}
    for which in (DRIVE, LIMIT, SLOW):
        mine = [row for row in rows if row.drive == which]
        if not mine:
            continue
        groups = {(row.kind, row.material): [] for row in mine} | {("all", "A, B"): []}
        for row in mine:
            groups[row.kind, row.material].append(row)
        groups["all", "A, B"] = mine
        for (kind, material), some in groups.items():
            ratio = np.array([row.ratio for row in some])
            out.setdefault(which, {}).setdefault(kind, {})[material] = {
                "plants": len(some),
                "ratio_median": float(np.median(ratio)),
                "ratio_95": float(np.quantile(ratio, 0.95)),
                "within_percent": float(100 * np.mean(ratio <= JUDGED)),
                "learned_percent": float(np.median([row.learned_percent for row in some])),
                "reachable_percent": float(np.median([row.reachable_percent for row in some])),
                "two_starts_percent_95": float(
                    np.quantile([row.two_starts_percent for row in some if row.plant < TWICE], 0.95)
                ),
                "obeyed": all(row.obeyed for row in some),
            }
    return out


def main() -> None:
    what, plants, workers = (*sys.argv[1:], *("learning", "20", "1")[len(sys.argv) - 1 :])
    printer, section = params.load(Printer, "printer"), params.load(TrainIlc, "train_ilc")
    parallel = joblib.Parallel(n_jobs=int(workers), return_as="generator")
    drawn_ones = [
        (kind, index, plant) for plant in range(int(plants)) for kind in STATIC for index in range(2)
    ]
    if what == "parts":
        parts = params.load(ComposeParts, "compose_parts")
        work = (joblib.delayed(composed)(printer, section, parts, one) for one in drawn_ones)
        result = part_summary([row for rows in _told(parallel(work)) for row in rows])
    else:
        work = (
            joblib.delayed(judged)(printer, section, *one, which)
            for one in drawn_ones
            for which in (DRIVE, LIMIT, SLOW)
        )
        result = summary(list(_told(parallel(work))))
    print(json.dumps(result, indent=2))
    before = json.loads(RESULT.read_text()) if RESULT.exists() else {}
    RESULT.write_text(json.dumps(before | {what: {"plants": int(plants)} | result}, indent=2) + "\n")


def _told(rows: Iterable) -> Iterator:
    """The rows, each printed as it comes."""
    for row in rows:
        print(json.dumps(row), flush=True)
        yield row


if __name__ == "__main__":
    main()
