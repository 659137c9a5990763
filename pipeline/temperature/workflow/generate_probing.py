"""What generate_probing does: the next experiment on the identified family, forecast within plant.outputs.low
and high, to be played instead of the controller or added to its commands; or one sentence why not."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from pipeline.temperature import experiment, forecast
from pipeline.temperature.controllers import baseline
from pipeline.temperature.experiment import Dither, Experiment, Family, Limits, Wish
from pipeline.temperature.identification.subspace import Segments
from pipeline.temperature.identification.trust import horizon
from pipeline.temperature.plant import Plant as Model
from pipeline.temperature.probing import excitation
from pipeline.temperature.workflow.probe_machine import given_centre, input_limits
from pipeline.temperature.workflow.record import read_record
from pipeline.temperature.workflow.settings import GenerateProbing, Plant, Tracking

EXCITED = 12  # lags over which the experiment's excitation is counted


class Designed(NamedTuple):
    """Columns of the commands to play and of those to add to a controller's, empty where they are not safe,
    and metrics."""

    commands: dict[str, np.ndarray]
    dither: dict[str, np.ndarray]
    metrics: dict[str, Any]


def designed(
    settings: GenerateProbing, machine: Plant, tracking: Tracking, plants: Sequence[Model], path: str
) -> Designed:
    """The next experiment of the machine whose record lies in `path`, on the identified `plants`, the model
    first. Whatever makes it unsafe is a reason in the metrics, not an error."""
    lacking = [o.name for o in machine.outputs if o.low is None or o.high is None]
    if lacking:
        return _refused(settings, f"declare low and high of {', '.join(lacking)} under plant.outputs")
    limits, wish = _limits(settings, machine), _wish(settings, machine)
    u, y = read_record(path, machine.acting, machine.outputs)
    try:
        family = _family(settings, machine, plants, ([a[:, : len(machine.inputs)] for a in u], y))
        tried = experiment.design(family, wish, limits, np.random.default_rng(settings.seed))
    except (ValueError, np.linalg.LinAlgError) as error:
        return _refused(settings, " ".join(str(error).split()))
    added, why_not = _dithered(family, wish, limits, settings.seed)
    step, names = machine.sample_time_s, [i.name for i in machine.inputs]
    metrics = {
        "source": settings.source,
        "next_experiment": _figures(machine, limits, family, tried, tracking.gamma),
        "closed_loop": {"written": False, "reason": why_not}
        if added is None
        else _dither_figures(machine, added),
    }
    dither = {} if added is None or added.reason else _columns(added.u, [f"{n}_dither" for n in names], step)
    return Designed(_columns(tried.u, names, step) if tried.written else {}, dither, metrics)


def _refused(settings: GenerateProbing, reason: str) -> Designed:
    none = {"written": False, "reason": reason}
    return Designed({}, {}, {"source": settings.source, "next_experiment": none, "closed_loop": none})


def _limits(settings: GenerateProbing, machine: Plant) -> Limits:
    y_low, y_high = np.array([(o.low, o.high) for o in machine.outputs], float).T
    return Limits(*input_limits(machine), settings.rate_percent_per_step, y_low, y_high)


def _wish(settings: GenerateProbing, machine: Plant) -> Wish:
    reference = np.array([o.reference for o in machine.outputs], float)
    return Wish(
        reference,
        settings.amplitude_percent,
        settings.samples,
        settings.signal,
        settings.shortest_steps,
        given_centre(settings, machine),
    )


def _family(
    settings: GenerateProbing, machine: Plant, plants: Sequence[Model], record: tuple[Segments, Segments]
) -> Family:
    low, high = input_limits(machine)
    doubt = forecast.Doubt(settings.doubt_input_gain, settings.doubt_ambient_degC, settings.doubt_delay_steps)
    names = experiment.Names([i.name for i in machine.inputs], [o.name for o in machine.outputs])
    return experiment.family_of(
        plants, record, reach=high - low, longest=settings.samples, doubt=doubt, names=names
    )


def _dithered(family: Family, wish: Wish, limits: Limits, seed: int) -> tuple[Dither | None, str]:
    """What may be added to the commands of a PI a zone, tuned by SIMC; None with the reason where the machine
    has none."""
    try:
        rise = horizon(family.model, wish.samples)
        controller = baseline.controller(family.model, (limits.low, limits.high), horizon=rise)
        law = controller.design(np.ones(family.model.p), np.ones(family.model.m), 0.0)
        return experiment.dither(family, law, wish, limits, np.random.default_rng(seed)), ""
    except (ValueError, np.linalg.LinAlgError) as error:
        return None, f"no simple controller to add it to: {' '.join(str(error).split())}"


# ---- figures


def _columns(u: np.ndarray, names: Sequence[str], sample_time_s: float) -> dict[str, np.ndarray]:
    columns = {name: u[:, k] for k, name in enumerate(names)}
    return {"time_s": sample_time_s * np.arange(len(u)), **columns}


def _by(signals: Sequence, values: np.ndarray) -> dict[str, float | None]:
    """{name: value}, None where it is not finite."""
    return {
        signal.name: float(value) if np.isfinite(value) else None
        for signal, value in zip(signals, values, strict=True)
    }


def _figures(
    machine: Plant, limits: Limits, family: Family, tried: Experiment, gamma: float
) -> dict[str, Any]:
    inputs, outputs, begin = machine.inputs, machine.outputs, family.begin
    figures = {
        "written": tried.written,
        "reason": tried.reason,
        "highest_degC": _by(outputs, tried.extremes.highest),
        "lowest_degC": _by(outputs, tried.extremes.lowest),
        "limit_degC": {
            o.name: {"low": low, "high": high}
            for o, low, high in zip(outputs, limits.y_low, limits.y_high, strict=True)
        },
        "band_degC": _by(outputs, family.band.width),
        "doubt": family.doubt,
        "start_percent": _by(inputs, begin.u),
        "start_degC": _by(outputs, begin.y),
        "slowest_time_constant_s": family.seconds(family.pace.slowest),
    }
    if not tried.written or tried.lesson is None:
        return figures
    # lags that span the fastest time constant: over closer ones a slow signal repeats itself
    most = len(tried.u) // (len(inputs) + 1)
    order = max(min(EXCITED, most), 1)
    lag = max(min(round(family.pace.fastest / EXCITED), most // order), 1)
    rank = excitation(tried.u[::lag], order)
    return figures | {
        "centre_percent": _by(inputs, tried.centre),
        "amplitude_percent": _by(inputs, tried.amplitude),
        "target_degC": _by(outputs, tried.target),
        "samples": len(tried.u),
        "seconds": family.seconds(len(tried.u)),
        "excitation_order": rank.order,
        "excitation_lag_s": family.seconds(lag),
        "excitation_rank": rank.rank,
        "excitation_full_rank": rank.full,
        "excitation_condition": rank.condition if np.isfinite(rank.condition) else None,
        "level_percent_per_band": excitation(tried.u, 1).level,
        "information": tried.lesson.information,
        "expected_error_percent": _errors(machine, family, tried.lesson),
        "expected_gap_percent": _gap_percent(family, tried.lesson, gamma),
    }


def _gap_percent(family: Family, taught: experiment.Lesson, gamma: float) -> float | None:
    """None where no controller of the perturbed model holds the machine."""
    try:
        gap = experiment.expected_gap(family.model, taught, gamma)
    except (ValueError, np.linalg.LinAlgError):
        return None
    return 100 * gap if np.isfinite(gap) else None


def _errors(machine: Plant, family: Family, taught: experiment.Lesson) -> dict[str, Any]:
    """{output: {input: {gain, time_constant}}}: expected standard errors in percent of each seen pair."""
    return {
        output.name: {
            signal.name: {
                "gain": 100 * float(taught.gain_error[o, j]),
                "time_constant": 100 * float(taught.time_constant_error[o, j]),
            }
            for j, signal in enumerate(machine.inputs)
            if family.pace.seen[o, j]
        }
        for o, output in enumerate(machine.outputs)
    }


def _dither_figures(machine: Plant, added: Dither) -> dict[str, Any]:
    figures = {"written": not added.reason, "reason": added.reason}
    if added.extremes is not None:
        figures |= {
            "highest_degC": _by(machine.outputs, added.extremes.highest),
            "lowest_degC": _by(machine.outputs, added.extremes.lowest),
        }
    if added.reason:
        return figures
    return figures | {
        "amplitude_percent": _by(machine.inputs, added.amplitude),
        "seconds": machine.sample_time_s * len(added.u),
        "at_limits_percent": 100 * added.limited,
    }
