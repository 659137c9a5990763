"""A machine learns its routines trial by trial: on-off control first, then the paper's law or the model
inverse. Before anything runs, both laws' convergence is tested over a family of plants."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from pipeline.deposition.drive import Drive, obeyed
from pipeline.deposition.extruder import Extruder, Routine, disturb, draw, flow, frequency_response, to_json
from pipeline.deposition.learning import ilc
from pipeline.deposition.learning.ilc import Law, Trial
from pipeline.deposition.learning.trial_model import deviations, unmodelled

# the frequencies of the convergence test reach to half the sampling rate
FREQUENCIES = 2000
# an extruder is known to 30 %. A gain off by this factor means a wrong unit or scale, or a picture of another
# size, and the next command would be off by the same factor
WRONG_GAIN = 3.0


class LawSettings(NamedTuple):
    """The settings of both laws: sample time in s; the drive; the settings of each law; `rise`: the increase
    of the error, as share of trial 0's, that counts as a rise."""

    sample_time_s: float
    drive: Drive
    hoelzle_2009: ilc.HoelzleSettings
    model_inverse: ilc.InverseSettings
    rise: float


class Noise(NamedTuple):
    """Disturbances that do not repeat from trial to trial, as shares of the steady flow
    (`extruder.disturb`)."""

    white: float
    drift: float
    gain: float


class TrialSequence(NamedTuple):
    """The trials of one law on one routine: every trial, a row of figures for each (`ilc.TrialRow`), and the
    model if the law identified one."""

    law: str
    routine: Routine
    trials: list[Trial]
    rows: list[ilc.TrialRow]
    model: ilc.TrialModel | None


def hoelzle_2009(routine: Routine, nominal: Extruder, settings: LawSettings) -> Law:
    """Returns the paper's law (2) with Q forward and backward."""
    return ilc.hoelzle_law(
        routine.r,
        nominal,
        ilc.zero_phase,
        settings.hoelzle_2009,
        drive=settings.drive,
        sample_time_s=settings.sample_time_s,
    )


def model_inverse(routine: Routine, settings: LawSettings) -> ilc.InverseLaw:
    """Returns the law by the inverse of the model identified from the first trials."""
    return ilc.InverseLaw(
        routine.r, settings.model_inverse, drive=settings.drive, sample_time_s=settings.sample_time_s
    )


def simulated(
    plant: Extruder, rng: np.random.Generator, noise: Noise, *, steady_flow: float, settings: LawSettings
) -> Callable[[np.ndarray], Trial]:
    """Returns a machine that runs a command u (T,) in mm. A trial has the true flow, and the measured flow
    with the disturbances that do not repeat."""

    def measure(u: np.ndarray) -> Trial:
        truth = flow(plant, u, sample_time_s=settings.sample_time_s, drive=settings.drive)
        y = disturb(
            truth, rng, steady_flow=steady_flow, white=noise.white, drift=noise.drift, gain=noise.gain
        )
        return Trial(obeyed(u, settings.drive, sample_time_s=settings.sample_time_s), y, truth)

    return measure


def run_trials(
    name: str,
    law: Law,
    measure: Callable[[np.ndarray], Trial],
    routine: Routine,
    nominal: Extruder,
    *,
    trials: int,
    settings: LawSettings,
    on_step: Callable[[Trial], None],
) -> TrialSequence:
    """Runs `trials` updates after on-off control, with roll-back (`ilc.learn`)."""
    u0 = routine.r / nominal.gain
    done = ilc.learn(law, measure, u0, routine.r, trials=trials, rise=settings.rise, on_step=on_step)
    rows = ilc.table(
        done,
        routine.r,
        steady=float(u0.max()),
        drive=settings.drive,
        sample_time_s=settings.sample_time_s,
        rise=settings.rise,
    )
    return TrialSequence(name, routine, done, rows, getattr(law, "model", None))


def train(
    nominal: Extruder,
    plant: Extruder,
    routines: Sequence[Routine],
    rng: np.random.Generator,
    noise: Noise,
    *,
    trials: int,
    settings: LawSettings,
    on_step: Callable[[Trial], None],
) -> list[TrialSequence]:
    """Runs the paper's law on the reference routine and the model inverse on every routine, on the simulated
    machine. Last, it runs the paper's law on the law's own nominal model, as the paper did."""
    first, sequences = routines[0], []
    work = [
        ("hoelzle_2009", first, plant),
        *(("model_inverse", routine, plant) for routine in routines),
        ("hoelzle_2009_nominal", first, nominal),
    ]
    for name, routine, machine in work:
        measure = simulated(machine, rng, noise, steady_flow=float(routine.r.max()), settings=settings)
        law = (
            model_inverse(routine, settings)
            if name == "model_inverse"
            else hoelzle_2009(routine, nominal, settings)
        )
        sequences.append(
            run_trials(
                name, law, measure, routine, nominal, trials=trials, settings=settings, on_step=on_step
            )
        )
    return sequences


def figures(sequence: TrialSequence, *, rise: float) -> dict[str, float | list[int]]:
    """Returns the ratios by which the loop is judged: at some trials, of the last trial, and the lowest of
    the machine as it is now; the trials at which a change of the machine was found; and what the command
    needs."""
    rows = sequence.rows
    restarts = ilc.state_of(sequence.trials, sequence.routine.r, rise=rise).restarts
    now = rows[restarts[-1] if restarts else 0 :]
    best = min(now, key=lambda row: row.ratio)
    return {f"ratio_trial_{j}": rows[j].ratio for j in (2, 3, 4, 8, 15, 30) if j < len(rows)} | {
        "last_ratio": rows[-1].ratio,
        "best_ratio": best.ratio,
        "best_trial": best.trial,
        "restarts": restarts,
        "trials": len(rows) - 1,
        "peak_over_steady": max(row.peak_over_steady for row in rows),
        "saturated": rows[-1].saturated,
    }


def convergence(
    nominal: Extruder, rng: np.random.Generator, *, plants: int, steady_flow: float, settings: LawSettings
) -> tuple[float, np.ndarray]:
    """Returns gamma of the paper's law on the nominal plant, and on each of `plants` random plants around it,
    before anything runs. Below 1 the error shrinks at every trial.

        gamma = max_f |Q (1 - L P)|
    """
    f = np.linspace(0.0, 0.5 / settings.sample_time_s, FREQUENCIES)
    law, Ts = settings.hoelzle_2009, settings.sample_time_s
    Q = ilc.magnitude(f, order=law.order, cutoff_hz=law.cutoff_hz, sample_time_s=Ts) ** 2
    L = ilc.hoelzle_filter(f, nominal, law, sample_time_s=Ts)
    family = [
        draw(rng, gain=nominal.gain, time_constant_s=nominal.time_constant_s, steady_flow=steady_flow)
        for _ in range(plants)
    ]
    P = np.stack(
        [frequency_response(plant, f, sample_time_s=settings.sample_time_s) for plant in [nominal, *family]]
    )
    gammas = ilc.gamma(Q, L, P)
    return float(gammas[0]), gammas[1:]


def convergence_of_model_inverse(
    sequence: TrialSequence, rng: np.random.Generator, noise: Noise, *, plants: int, settings: LawSettings
) -> tuple[float, np.ndarray]:
    """Returns gamma of the model inverse once its model is identified: for that model, and for `plants`
    plants that the first trials cannot tell from it.

        gamma = max_f |Q| (|1 - L P| + |L P Delta|)

    That is the largest |Q (1 - L P (1 + Delta'))| of all |Delta'(f)| <= |Delta(f)|. Delta is the part that
    the model does not explain of the trials that identified it and of the next one, which it has not seen
    (`trial_model.unmodelled`).
    """
    e, law, Ts = sequence.model.extruder, settings.model_inverse, settings.sample_time_s
    # the model was identified from the first trials of the machine as it is now
    keep = ilc.state_of(sequence.trials, sequence.routine.r, rise=settings.rise).keep
    first = [sequence.trials[j] for j in keep[: law.identify_trials + 1]]
    u, y = [t.u for t in first], [t.y for t in first]
    n = law.identify_trials
    spread = deviations(
        sequence.model, u[:n], y[:n], drift=noise.drift, trial_gain=noise.gain, sample_time_s=Ts
    )
    near = np.array([e.gain, e.time_constant_s, e.delay_s]) + np.array(spread[:3]) * rng.standard_normal(
        (plants, 3)
    )
    f = np.linspace(0.0, 0.5 / Ts, FREQUENCIES)
    Q = ilc.magnitude(f, order=law.order, cutoff_hz=law.cutoff_hz, sample_time_s=Ts) ** 2
    Q = Q * ilc.known_share(f, e)
    L = ilc.inverse_filter(f, e, sample_time_s=Ts)
    family = [
        Extruder(K, tau, max(delay, 0.0), e.lag_hz) for K, tau, delay in np.maximum(near, 1e-6).tolist()
    ]
    P = np.stack([frequency_response(plant, f, sample_time_s=Ts) for plant in [e, *family]])
    gammas = ilc.gamma(Q, L, P, unmodelled(sequence.model, u, y, f, sample_time_s=Ts))
    return float(gammas[0]), gammas[1:]


def actuator_headroom(
    routine: Routine, nominal: Extruder, *, worst_ratio: float, settings: LawSettings
) -> ilc.ActuatorHeadroom:
    """Returns the headroom of the drive on the routine, by the nominal model, before anything runs. Raises
    ValueError if no law can bring the error below worst_ratio of on-off control's; the message names the ramp
    that would be enough."""
    headroom = ilc.actuator_headroom(
        routine.r,
        routine.r / nominal.gain,
        nominal,
        order=settings.model_inverse.order,
        cutoff_hz=settings.model_inverse.cutoff_hz,
        drive=settings.drive,
        sample_time_s=settings.sample_time_s,
    )
    ilc.check_headroom(headroom, drive=settings.drive, worst_ratio=worst_ratio)
    return headroom


def prospects(
    nominal: Extruder,
    routines: Sequence[Routine],
    rng: np.random.Generator,
    settings: LawSettings,
    *,
    plants: int,
    steady_flow: float,
    worst_ratio: float,
) -> dict[str, Any]:
    """Returns what is known before anything runs: gamma of the paper's law on the nominal model and over the
    family, and the headroom of the drive on each routine."""
    gamma, family = convergence(nominal, rng, plants=plants, steady_flow=steady_flow, settings=settings)
    headrooms = [
        actuator_headroom(routine, nominal, worst_ratio=worst_ratio, settings=settings)
        for routine in routines
    ]
    return {
        "gamma": gamma,
        "gamma_worst": family.max(),
        "gamma_above_1_percent": 100 * np.mean(family > 1),
        "actuator_headroom": [
            {"peak_over_steady": one.peak / one.steady, "least_ratio": one.ratio, "ramp_s": one.ramp_s}
            for one in headrooms
        ],
    }


def learn_in_flow(
    nominal: Extruder,
    plant: Extruder,
    routines: Sequence[Routine],
    rngs: Sequence[np.random.Generator],
    noise: Noise,
    *,
    trials: int,
    plants: int,
    settings: LawSettings,
    on_step: Callable[[Trial], None],
) -> tuple[dict[int, list[TrialSequence]], dict[str, Any], dict[str, Any]]:
    """Runs both laws on the measured flow of a simulated machine. Returns their sequences by number of the
    routine, figures, and the models as JSON. `rngs`: the first draws the disturbances that do not repeat, the
    second the plants of the convergence test."""
    sequences = train(
        nominal, plant, routines, rngs[0], noise, trials=trials, settings=settings, on_step=on_step
    )
    hoelzle, reference, *others, hoelzle_nominal = sequences
    gamma, family = convergence_of_model_inverse(reference, rngs[1], noise, plants=plants, settings=settings)
    rows = {
        "gamma_model_inverse": gamma,
        "gamma_model_inverse_worst": family.max(),
        "hoelzle_2009_nominal": figures(hoelzle_nominal, rise=settings.rise),
        "hoelzle_2009": figures(hoelzle, rise=settings.rise),
        "model_inverse": figures(reference, rise=settings.rise),
        "other_routines": [figures(sequence, rise=settings.rise) for sequence in others],
    }
    by_routine = {0: [hoelzle_nominal, hoelzle, reference]}
    by_routine |= {index: [sequence] for index, sequence in enumerate(others, 1)}
    models = {"nominal": to_json(nominal), "plant": to_json(plant)}
    return by_routine, rows, models | {"identified": model_figures(reference.model)}


def resume(
    trials: Sequence[Trial], routine: Routine, nominal: Extruder, settings: LawSettings
) -> tuple[TrialSequence | None, np.ndarray, dict[str, Any]]:
    """Returns the trials so far as a sequence (None without trials), the next command u (T,) in mm, and its
    figures. Trial 0 is on-off control. Raises ValueError if the trials show a gain that differs from the
    nominal one by more than WRONG_GAIN."""
    u0 = routine.r / nominal.gain
    if not trials:
        first = obeyed(u0, settings.drive, sample_time_s=settings.sample_time_s)
        return None, first, {"best_trial": 0, "rolled_back": False, "restarts": []}
    law = model_inverse(routine, settings)
    u, best, rolled_back, restarts = ilc.next_step(trials, routine.r, law, rise=settings.rise)
    gain_ratio = law.model.extruder.gain / nominal.gain if law.model else 1.0
    if not 1 / WRONG_GAIN < gain_ratio < WRONG_GAIN:
        raise ValueError(
            f"the trials show {gain_ratio:.3g} times the gain of printer.materials; "
            "check the units of the command, the calibration and the frames' size, or write the gain as it is"
        )
    rows = ilc.table(
        trials, routine.r, steady=float(u0.max()), drive=settings.drive,
        sample_time_s=settings.sample_time_s, rise=settings.rise,
    )  # fmt: skip
    sequence = TrialSequence("pixels", routine, list(trials), rows, law.model)
    return sequence, u, {"best_trial": best, "rolled_back": rolled_back, "restarts": restarts}


def model_figures(model: ilc.TrialModel | None) -> dict[str, float] | None:
    """Returns an identified model as JSON; None without a model."""
    if model is None:
        return None
    e = model.extruder
    return {
        "gain": e.gain, "time_constant_s": e.time_constant_s, "delay_s": e.delay_s,
        "lag_hz": e.lag_hz, "yield": e.yield_, "noise": model.noise,
        "fit_percent": model.fit_percent,
    }  # fmt: skip


def join(parts: Iterable[tuple[dict, dict, dict, dict]]) -> tuple[dict, dict, dict, dict]:
    """Joins all results: trial sequences and measured trials by (material, number of the routine), models and
    figures by material. Dictionaries of one material are merged."""
    sequences, measured, models, figures = {}, {}, {}, {}
    for part in parts:
        for key, of_routine in part[0].items():
            sequences.setdefault(key, []).extend(of_routine)
        measured.update(part[1])
        for joint, of_part in ((models, part[2]), (figures, part[3])):
            for name, values in of_part.items():
                joint.setdefault(name, {}).update(values)
    return sequences, measured, models, figures


# ---- as tables


def trial_rows(sequences: dict[tuple[str, int], list[TrialSequence]]) -> dict[str, np.ndarray]:
    """Returns one row per trial of every sequence, by (material, number of the routine)."""
    names = ("material", "law", "routine", "speed_mm_per_s", "pause_s", *ilc.TrialRow._fields)
    rows = [
        (material, one.law, index, one.routine.plan["speed_mm_per_s"], one.routine.plan["pause_s"], *row)
        for (material, index), of_routine in sequences.items()
        for one in of_routine
        for row in one.rows
    ]
    return {
        name: np.array([row[k] for row in rows], object if k < 2 else None) for k, name in enumerate(names)
    }


def sample_rows(sequences: dict[tuple[str, int], list[TrialSequence]]) -> dict[str, np.ndarray]:
    """Returns every sample of every trial of every sequence; a library is cut from them."""
    names = ("material", "law", "routine", "trial", "time_s", "wanted_mm3_per_s")
    names += ("command_mm", "measured_mm3_per_s", "true_mm3_per_s")
    parts = [
        (
            np.full(len(u), material, object), np.full(len(u), one.law, object), np.full(len(u), index),
            np.full(len(u), j), one.routine.time_s, one.routine.r, u, y,
            np.full(len(u), np.nan) if truth is None else truth,
        )
        for (material, index), of_routine in sequences.items()
        for one in of_routine
        for j, (u, y, truth) in enumerate(one.trials)
    ]  # fmt: skip
    columns = zip(*parts, strict=True) if parts else [[np.array([])]] * len(names)
    return {name: np.concatenate(values) for name, values in zip(names, columns, strict=True)}
