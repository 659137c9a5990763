"""Does the panel's promise hold on the machine itself? Ten simulated small machines, written apart from
`Plant`, and, where the folder is present, records of real ones.

`./run python -m benchmarks.small_machines` prints the table and writes
benchmarks/results/small_machines.json; names behind it play only these. Each machine goes the way of a user's
record: identified with its spread, window and kernel learned, every contestant tuned and judged by what
follows from the record. Then the best contestant, or the one that leads where none passes, runs the true
machine as deployed, from the panel's starts to its references, and its settled error and overshoot stand
beside the panel's median and 90 % quantile.
"""

import json
import os
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.optimize

from benchmarks.identification import resampled
from pipeline.store import params
from pipeline.temperature import controller, window
from pipeline.temperature.judging import CheckRun, kernel_candidates
from pipeline.temperature.plant import Plant, strictly_proper
from pipeline.temperature.scenario_defaults import steady_map
from pipeline.temperature.scorecard import Yardstick
from pipeline.temperature.workflow import cases, contestants, evaluate_temperature, learned, tune_weights
from pipeline.temperature.workflow.settings import (
    EvaluateTemperature,
    LearnKernel,
    Panel,
    TemperatureRules,
    Tracking,
    TuneWeights,
)
from pipeline.temperature.workflow.settings import Plant as Machine
from tests.temperature import small_machines
from tests.temperature.small_machines import MACHINES, SmallMachine

RESULTS = Path(__file__).parent / "results" / "small_machines.json"
SHARED = Path(os.environ.get("BEADLINE_SHARED", "../shared")) / "data"
# few of everything, so that all machines take less than four minutes on one core
PLANTS = {"judging": 12, "training": 6}
BUDGET = {"practical_initial": 6, "practical_evaluations": 10}
LIMIT_SHARE = 0.3  # of the recorded span, by which outputs may leave what was recorded
RUN_SHARE = 0.7  # of the samples of a real record, below where its outputs are to settle
SETTLED_SHARE = 6  # the last sixth of a run is its settled part, as in the panel


class Recording(NamedTuple):
    """u (T, m) in percent, y (T, p) in °C, the sample time, and where each output should settle."""

    u: np.ndarray
    y: np.ndarray
    sample_time_s: float
    reference: list[float]


class Rehearsed(NamedTuple):
    """What the stages find: the identified plant, what contestants are designed from, what they share, their
    designs, and the summary of evaluate_temperature."""

    plant: Plant
    problem: contestants.Problem
    setting: cases.Setting
    designs: dict[str, contestants.Design]
    summary: dict[str, Any]


def real_records() -> dict[str, Recording]:
    """Records of real machines, and RUN_SHARE of the recorded temperatures as what is asked for; none where
    the folder is absent."""
    if not SHARED.is_dir():
        return {}
    lab, binary = SHARED / "tclab_apmonitor", SHARED / "tclab_mlid_prbs" / "prbs.csv"
    prbs = np.genfromtxt(binary, delimiter=",", skip_header=1)
    dryer = np.loadtxt(SHARED / "daisy_a" / "dryer.dat")
    made = {
        "real kit, steps": (*resampled(lab / "energy_balance_mimo.csv", 1.0, ([1, 2], [3, 4])), 1.0),
        "real kit, random": (*resampled(lab / "second_order_mimo.csv", 3.0, ([1, 2], [3, 4])), 3.0),
        "real kit, binary": (prbs[:, 1:3], prbs[:, 3:5], 1.0),
        # volts: ten times as many, as if percent and °C
        "real hair dryer": (10 * dryer[:, :1], 10 * dryer[:, 1:], 0.08),
    }
    return {
        name: Recording(u, y, step, np.quantile(y, RUN_SHARE, axis=0).tolist())
        for name, (u, y, step) in made.items()
    }


def of_machine(machine: SmallMachine) -> Recording:
    return Recording(*small_machines.record(machine), machine.sample_time_s, list(machine.reference))


def declared(recording: Recording) -> Machine:
    """The section `plant` of its user."""
    span, low, high = np.ptp(recording.y, axis=0), recording.y.min(axis=0), recording.y.max(axis=0)
    names = [f"zone_{j + 1}" for j in range(recording.y.shape[1])]
    outputs = [
        {
            "name": name,
            "unit": "degC",
            "reference": reference,
            "low": float(lowest - LIMIT_SHARE * wide),
            "high": float(max(highest, reference) + LIMIT_SHARE * wide),
        }
        for name, reference, lowest, highest, wide in zip(
            names, recording.reference, low, high, span, strict=True
        )
    ]
    inputs = [
        {"name": f"heater_{i + 1}", "unit": "percent", "low": 0, "high": 100}
        for i in range(recording.u.shape[1])
    ]
    return Machine.model_validate(
        {"inputs": inputs, "outputs": outputs, "sample_time_s": recording.sample_time_s}
    )


def learnt(recording: Recording, of: small_machines.IdentifiedMachine, tracking: Tracking) -> learned.Learned:
    """Window and kernel of the record, as stage learn_kernel has them."""
    settings, steps = params.load(LearnKernel, "learn_kernel"), params.load(Panel, "panel").steps
    u, y, options = [recording.u], [recording.y], {"offset": settings.offset}
    long = window.learn(u, y, longest=settings.longest_window, gain_spread=settings.gain_spread, **options)
    yardstick = Yardstick(np.ones(of.plant.p), np.ones(of.plant.m), tracking.gamma)
    check = CheckRun(float(np.quantile(recording.y, 0.1)), np.array(recording.reference), steps)
    tried = kernel_candidates(u, y, long, yardstick, check, largest=settings.largest_kernel_window, **options)
    best = min(tried, key=lambda candidate: candidate.gap).learned
    spread = [strictly_proper(one) for one in of.family]
    return learned.Learned(strictly_proper(of.plant), long, best, spread)


def rehearsed(recording: Recording) -> Rehearsed:
    """From a record to the judged contestants, as the stages do it."""
    machine, m = declared(recording), recording.u.shape[1]
    tracking, tuning = params.load(Tracking, "tracking"), params.load(TuneWeights, "tune_weights")
    panel = params.load(Panel, "panel")
    halves = {
        half: getattr(panel, half).model_copy(update={"plants": plants}) for half, plants in PLANTS.items()
    }
    panel, tuning = panel.model_copy(update=halves), tuning.model_copy(update=BUDGET)
    limits = np.zeros(m), np.full(m, 100.0)
    of = small_machines.identified_record(
        np.clip(recording.u, *limits), recording.y, recording.sample_time_s, limits
    )
    made = learnt(recording, of, tracking)
    family = [made.model, *made.spread]
    recorded = cases.Recorded([recording.u], [recording.y], [0])
    rehearsal = cases.from_record(panel, machine, family, recorded)
    setting = cases.shared(tuning, machine, tracking, panel, rehearsal, family)
    problem = learned.problem(made, tracking, setting, None)
    execution = params.load(params.Execution, "execution").model_copy(update={"jobs": 1})
    weights = tune_weights.tuned(tuning, problem, setting, execution).weights["contestants"]
    rules = evaluate_temperature.resolved(params.load(TemperatureRules, "report"), panel, rehearsal)
    judged = evaluate_temperature.judged(
        params.load(EvaluateTemperature, "evaluate_temperature"),
        machine,
        setting,
        problem,
        weights,
        rules,
        execution,
    )
    designs = evaluate_temperature.designed(problem, weights)[0]
    return Rehearsed(made.model, problem, setting, designs, judged.summary)


# ---- the machine itself


def rest_input(machine: SmallMachine, y: np.ndarray) -> np.ndarray:
    """Inputs (m,) within 0..100 % at which the true machine rests nearest to outputs y (p,); of several the
    least."""

    def off(u: np.ndarray) -> np.ndarray:
        at = small_machines.true_outputs(small_machines.at_rest(machine, u))
        return np.r_[at - y, 1e-3 * u]

    return scipy.optimize.least_squares(off, np.full(machine.m, 20.0), bounds=(0.0, 100.0)).x


def driven(
    machine: SmallMachine, of: Rehearsed, name: str, start: np.ndarray, r: np.ndarray
) -> dict[str, Any]:
    """The true machine under a contestant as deployed: handed over from rest near `start` (p,), then held to
    r (p,) for as long as a case of the panel lasts."""
    design, setting = of.designs[name], of.setting
    running, rng = (
        controller.RunningController(cases.as_deployed(design, setting), design.model),
        np.random.default_rng(3),
    )
    u = rest_input(machine, start)
    state, judging = small_machines.at_rest(machine, u), setting.rehearsal.judging
    begun = small_machines.true_outputs(state)
    for _ in range(judging.hold):
        running.watch(u, small_machines.measured(machine, state, rng), r)
        state = small_machines.advanced(machine, state, u)
    running.hand_over(small_machines.measured(machine, state, rng))
    y = np.empty((judging.steps, machine.p))
    for t in range(judging.steps):
        y[t] = small_machines.true_outputs(state)
        u = running.step(small_machines.measured(machine, state, rng), r, t)
        state = small_machines.advanced(machine, state, u)
    settled = y[-(judging.steps // SETTLED_SHARE) :]
    way = np.where(begun <= r, 1.0, -1.0)
    return {
        "settled_error_degC": float(np.abs(settled.mean(axis=0) - r).max()),
        "overshoot_degC": float(max((way * (y - r)).max(), 0.0)),
    }


def promise(machine: SmallMachine, of: Rehearsed, name: str) -> dict[str, Any]:
    """Worst figures on the true machine over the panel's starts and references, beside the panel's."""
    judging = of.setting.rehearsal.judging
    constants = sorted({int(judging.asked[row, 0]) for row in np.flatnonzero(judging.kind == "constant")})
    runs = [
        driven(machine, of, name, start, judging.references[index].H[:, 0])
        for start in judging.starts
        for index in constants
    ]
    figures = of.summary["contestants"][name]
    result = {}
    for key in ("settled_error", "overshoot"):
        true = max(run[f"{key}_degC"] for run in runs)
        result[f"{key}_degC"] = {
            "true_machine": true,
            "panel_median": figures[key]["median"],
            "panel_q90": figures[key]["q90"],
            "panel_worst": figures[key]["worst"],
            "within_worst": figures[key]["worst"] is not None and true <= figures[key]["worst"],
        }
    return result


# ---- the table


def true_gains(machine: SmallMachine) -> np.ndarray:
    """Signs (p, m) of the steady gains of the machine itself about the record's centre."""
    centre = np.asarray(machine.centre)
    rest = small_machines.true_outputs(small_machines.at_rest(machine, centre))
    raised = [
        small_machines.true_outputs(small_machines.at_rest(machine, centre + one)) - rest
        for one in np.eye(machine.m)
    ]
    return np.column_stack(raised)


def pi_sign_right(of: Rehearsed, machine: SmallMachine | None) -> bool | None:
    """Whether PI pushes each zone the right way: by the machine itself, by the identified steady gain of a
    real one. None where PI is refused."""
    if "pi_simc" not in of.designs:
        return None
    push = -of.designs["pi_simc"].law.D.T  # of each zone's error on each input
    gains = steady_map(of.plant)[0] if machine is None else true_gains(machine)
    return bool((np.sign(push[push != 0]) == -np.sign(gains[push != 0])).all())


def all_finite(value: Any) -> bool:
    """No figure of a summary is NaN, infinite, or beyond meaning; null says that there is none."""
    if isinstance(value, dict):
        return all(all_finite(part) for part in value.values())
    if isinstance(value, list):
        return all(all_finite(part) for part in value)
    return not isinstance(value, float) or (np.isfinite(value) and abs(value) < 1e6)


def row(recording: Recording, machine: SmallMachine | None) -> dict[str, Any]:
    began, of = time.perf_counter(), rehearsed(recording)
    summary = of.summary
    reason = summary["best_reason"]
    result = {
        "pi_sign_right": pi_sign_right(of, machine),
        "best": summary["best"],
        "leading": reason["leading"],
        "passes": [name for name, able in reason["passes"].items() if able],
        "refused": summary["refused"],
        "infeasible": summary["infeasible"],
        "settling_limit_s": summary["limits"]["settling_s"],
        "band_degC": summary["band_degC"],
        "figures_finite": all_finite(summary),
    }
    if machine is not None:
        result["driven"] = summary["best"] or reason["leading"]
        result |= promise(machine, of, result["driven"])
    return result | {"seconds": round(time.perf_counter() - began, 1)}


def printed(name: str, one: dict[str, Any]) -> str:
    words = [f"{name}: best {one['best']}", f"passes {', '.join(one['passes']) or 'nobody'}"]
    words.append(f"PI sign right {one['pi_sign_right']}, finite {one['figures_finite']}")
    for key in ("settled_error_degC", "overshoot_degC"):
        if key in one:
            of = one[key]
            words.append(
                f"{key} {of['true_machine']:.3f} beside {of['panel_median']:.3f}..{of['panel_q90']:.3f}"
            )
    return "; ".join([*words, f"{one['seconds']:.0f} s"])


def main() -> None:
    wanted = sys.argv[1:]
    made = [(one.name, of_machine(one), one) for one in MACHINES]
    real = [(name, recording, None) for name, recording in real_records().items()]
    result = {}
    for name, recording, machine in (*made, *real):
        if wanted and name not in wanted:
            continue
        result[name] = row(recording, machine)
        print(printed(name, result[name]), flush=True)
    if not wanted:
        RESULTS.write_text(json.dumps(result, indent=1, allow_nan=False) + "\n")


if __name__ == "__main__":
    main()
