"""A machine learns its routines: on-off first, then the paper's law or ours, trial after trial; and the
convergence of both over a family of plants before anything runs."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from pipeline.deposition import ilc
from pipeline.deposition.extruder import Extruder, Routine, disturb, draw, flow, frequency_response
from pipeline.deposition.ilc import Law, Trial
from pipeline.deposition.trial_model import deviations

# the frequencies of the convergence test reach to half the sampling rate
FREQUENCIES = 2000


class Settings(NamedTuple):
    """What a law is built from: sample time in s, limit of the command in mm (infinite where
    there is none); of the paper's law (2) gain, fast zero in s, order and cut-off of Q; of ours
    the trials that identify, the least weight of a new trial, order and cut-off; `rise` of the
    error, as share of trial 0's, that counts as one."""

    sample_time_s: float
    limit: float
    learning_gain: float
    fast_zero_s: float
    paper_order: int
    paper_cutoff_hz: float
    identify_trials: int
    floor: float
    order: int
    cutoff_hz: float
    rise: float


class Noise(NamedTuple):
    """What does not repeat from trial to trial, as shares of the steady flow (`extruder.disturb`)."""

    white: float
    drift: float
    gain: float


class Run(NamedTuple):
    """What one law did with one routine: every trial, a row of figures for each (`ilc.Row`), and the model
    that it identified where it did."""

    law: str
    routine: Routine
    trials: list[Trial]
    rows: list[ilc.Row]
    model: ilc.TrialModel | None


class Lesson(NamedTuple):
    """What a material is taught: nominal model, the machine that it
    runs on, and its routines, the reference first."""

    nominal: Extruder
    plant: Extruder
    routines: list[Routine]


class Convergence(NamedTuple):
    """gamma of the nominal plant and of each plant of the family (N,), of the
    paper's law; below 1 the error shrinks at every trial."""

    nominal: float
    family: np.ndarray


def on_off(r: np.ndarray, model: Extruder) -> np.ndarray:
    """u_0 = r / K (T,) in mm: what a machine does that knows only the gain of its nominal model."""
    return r / model.gain


def paper(routine: Routine, nominal: Extruder, s: Settings) -> Law:
    """The paper's law (2) with Q both ways."""
    return ilc.paper_law(
        routine.r, nominal, ilc.zero_phase, learning_gain=s.learning_gain, fast_zero_s=s.fast_zero_s,
        order=s.paper_order,
        cutoff_hz=s.paper_cutoff_hz, limit=s.limit, sample_time_s=s.sample_time_s,
    )  # fmt: skip


def ours(routine: Routine, s: Settings) -> ilc.InverseLaw:
    """The inverse of the model identified from the first trials."""
    return ilc.InverseLaw(
        routine.r,
        identify_trials=s.identify_trials,
        floor=s.floor,
        order=s.order,
        cutoff_hz=s.cutoff_hz,
        limit=s.limit,
        sample_time_s=s.sample_time_s,
    )


def simulated(
    plant: Extruder, rng: np.random.Generator, noise: Noise, *, steady_flow: float, s: Settings
) -> Callable[[np.ndarray], Trial]:
    """A machine that runs a command u (T,) in mm: the true flow, and
    the measured one with what does not repeat."""

    def measure(u: np.ndarray) -> Trial:
        truth = flow(plant, u, sample_time_s=s.sample_time_s, limit=s.limit)
        y = disturb(
            truth, rng, steady_flow=steady_flow, white=noise.white, drift=noise.drift, gain=noise.gain
        )
        return Trial(np.clip(u, -s.limit, s.limit), y, truth)

    return measure


def run(
    name: str,
    law: Law,
    measure: Callable[[np.ndarray], Trial],
    routine: Routine,
    nominal: Extruder,
    *,
    trials: int,
    s: Settings,
    on_step: Callable[[Trial], None],
) -> Run:
    """`trials` updates from on-off control, with roll-back (`ilc.learn`)."""
    u0 = on_off(routine.r, nominal)
    done = ilc.learn(law, measure, u0, routine.r, trials=trials, rise=s.rise, on_step=on_step)
    rows = ilc.table(done, routine.r, steady=float(u0.max()), limit=s.limit, rise=s.rise)
    return Run(name, routine, done, rows, getattr(law, "model", None))


def teach(
    lesson: Lesson,
    rng: np.random.Generator,
    noise: Noise,
    *,
    trials: int,
    s: Settings,
    on_step: Callable[[Trial], None],
) -> list[Run]:
    """The paper's law on the reference routine and ours on every routine, on the simulated machine; last the
    paper's law on its own nominal model, as the paper ran it."""
    first, done = lesson.routines[0], []
    work = [
        ("paper", first, lesson.plant),
        *(("ours", routine, lesson.plant) for routine in lesson.routines),
        ("paper_nominal", first, lesson.nominal),
    ]
    for name, routine, plant in work:
        measure = simulated(plant, rng, noise, steady_flow=float(routine.r.max()), s=s)
        law = ours(routine, s) if name == "ours" else paper(routine, lesson.nominal, s)
        done.append(run(name, law, measure, routine, lesson.nominal, trials=trials, s=s, on_step=on_step))
    return done


def ratio_at(run: Run, trial: int, *, rise: float) -> float:
    """Error after so many updates as share of trial 0's; where learning
    stopped before, that of the trial that it stopped at."""
    if trial < len(run.rows):
        return run.rows[trial].ratio
    return run.rows[ilc.judge([row.rms_measured for row in run.rows], rise=rise).best].ratio


def figures(run: Run, *, rise: float) -> dict[str, float]:
    """The ratios that the loop is judged by, the least of all trials, and what the command needs."""
    found = {
        f"ratio_trial_{j}": ratio_at(run, j, rise=rise)
        for j in (2, 3, 4, 8, 15, 30)
        if j < len(run.rows) or len(run.rows) > 30
    }
    best = min(run.rows, key=lambda row: row.ratio)
    peak = max(row.peak_over_steady for row in run.rows)
    return found | {
        "best_ratio": best.ratio,
        "best_trial": best.trial,
        "trials": len(run.rows) - 1,
        "peak_over_steady": peak,
        "saturated": run.rows[-1].saturated,
    }


def convergence(
    nominal: Extruder, rng: np.random.Generator, *, plants: int, steady_flow: float, s: Settings
) -> Convergence:
    """gamma = max |Q (1 - L P)| of the paper's law over `plants` draws
    around the nominal model, before anything runs."""
    f = np.linspace(0.0, 0.5 / s.sample_time_s, FREQUENCIES)
    Q = ilc.magnitude(f, order=s.paper_order, cutoff_hz=s.paper_cutoff_hz, sample_time_s=s.sample_time_s) ** 2
    L = ilc.paper_filter(
        f, nominal, learning_gain=s.learning_gain, fast_zero_s=s.fast_zero_s, sample_time_s=s.sample_time_s
    )
    family = [
        draw(rng, gain=nominal.gain, time_constant_s=nominal.time_constant_s, steady_flow=steady_flow)
        for _ in range(plants)
    ]
    P = np.stack(
        [frequency_response(plant, f, sample_time_s=s.sample_time_s) for plant in [nominal, *family]]
    )
    found = ilc.gamma(Q, L, P)
    return Convergence(float(found[0]), found[1:])


def convergence_of_ours(
    run: Run, rng: np.random.Generator, noise: Noise, *, plants: int, s: Settings
) -> Convergence:
    """gamma = max |Q (1 - L P)| of our law once its model is identified: of that model, and over plants that
    the first trials cannot tell from it."""
    e, first = run.model.extruder, run.trials[: s.identify_trials]
    spread = deviations(
        run.model,
        [t.u for t in first],
        [t.y for t in first],
        drift=noise.drift,
        trial_gain=noise.gain,
        sample_time_s=s.sample_time_s,
    )
    near = np.array([e.gain, e.time_constant_s, e.delay_s]) + np.array(spread[:3]) * rng.standard_normal(
        (plants, 3)
    )
    f = np.linspace(0.0, 0.5 / s.sample_time_s, FREQUENCIES)
    Q = ilc.magnitude(f, order=s.order, cutoff_hz=s.cutoff_hz, sample_time_s=s.sample_time_s) ** 2
    L = ilc.inverse_filter(f, e, sample_time_s=s.sample_time_s)
    family = [Extruder(K, tau, max(delay, 0.0)) for K, tau, delay in np.maximum(near, 1e-6).tolist()]
    P = np.stack([frequency_response(plant, f, sample_time_s=s.sample_time_s) for plant in [e, *family]])
    found = ilc.gamma(Q, L, P)
    return Convergence(float(found[0]), found[1:])


def authority(routine: Routine, nominal: Extruder, *, worst_ratio: float, s: Settings) -> ilc.Authority:
    """What the limit of the command leaves of the routine, on the nominal model, before anything
    runs. Raises ValueError where no law can come below worst_ratio of the error of on-off
    control; the sentence names the ramp that would do."""
    found = ilc.authority(
        routine.r,
        on_off(routine.r, nominal),
        nominal,
        order=s.order,
        cutoff_hz=s.cutoff_hz,
        limit=s.limit,
        sample_time_s=s.sample_time_s,
    )
    ilc.check_authority(found, limit=s.limit, worst_ratio=worst_ratio)
    return found


# ---- as tables


def rows(runs: dict[tuple[str, int], list[Run]]) -> dict[str, np.ndarray]:
    """One row a trial of every run, by (material, number of the routine)."""
    columns: dict[str, list] = {
        name: [] for name in ("material", "law", "routine", "speed_mm_per_s", "pause_s", *ilc.Row._fields)
    }
    for (material, index), found in runs.items():
        for done in found:
            for row in done.rows:
                speed, pause = (
                    float(done.routine.speed.max()),
                    round(done.routine.pause_s[1] - done.routine.pause_s[0], 9),
                )
                for name, value in zip(columns, (material, done.law, index, speed, pause, *row), strict=True):
                    columns[name].append(value)
    return {
        name: np.array(values, object if name in ("material", "law") else None)
        for name, values in columns.items()
    }


def lessons(runs: dict[tuple[str, int], list[Run]]) -> dict[str, np.ndarray]:
    """Every sample of every trial of every run: what a library is cut from."""
    parts: dict[str, list[np.ndarray]] = {
        name: []
        for name in (
            "material",
            "law",
            "routine",
            "trial",
            "time_s",
            "wanted_mm3_per_s",
            "command_mm",
            "measured_mm3_per_s",
            "true_mm3_per_s",
        )
    }
    for (material, index), found in runs.items():
        for done in found:
            for j, (u, y, truth) in enumerate(done.trials):
                n, r = len(u), done.routine
                names = [np.full(n, text, object) for text in (material, done.law)]
                values = (
                    *names,
                    np.full(n, index),
                    np.full(n, j),
                    r.time_s,
                    r.r,
                    u,
                    y,
                    np.full(n, np.nan) if truth is None else truth,
                )
                for name, value in zip(parts, values, strict=True):
                    parts[name].append(value)
    return {name: np.concatenate(values) if values else np.array([]) for name, values in parts.items()}
