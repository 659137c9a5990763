"""The next experiment on the identified family, to be played instead of the controller or added to its
commands: reads datasets/identify_plant and datasets/ingest/record.parquet; writes datasets/generate_probing:
next_experiment.csv and next_experiment_closed_loop.csv. Either is left out if no forecast holds it within
plant.outputs.low and high; forecast.json says why."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import stages
from pipeline.store import artifacts, params
from pipeline.temperature import tables
from pipeline.temperature.settings import (
    GenerateProbing,
    Plant,
    PlantSignal,
    Tracking,
    check_output_limits,
    given_centre,
    recorded,
)

if TYPE_CHECKING:
    import numpy as np

    from pipeline.temperature.experiment import Dither, Experiment, Family, Lesson
    from pipeline.temperature.plant import Plant as Model

EXCITED = 12  # lags over which the experiment's excitation is counted
Columns = dict[str, "np.ndarray"]

# figures of control that git keeps and that runs are compared by
METRICS = (
    "next_experiment.seconds",
    "next_experiment.highest_degC",
    "next_experiment.lowest_degC",
    "next_experiment.expected_gap_percent",
    "closed_loop.at_limits_percent",
)


def main() -> None:
    with artifacts.stage("generate_probing") as out:
        from pipeline.temperature.identification.segments import segments
        from pipeline.temperature.plant import restored

        settings = params.load(GenerateProbing, "generate_probing")
        machine = recorded(params.load(Plant, "plant"), "datasets/ingest/record.parquet")
        tracking = params.load(Tracking, "tracking")
        check_output_limits(machine, settings.source)
        shapes = {"D": (None, len(machine.outputs), len(machine.inputs))}
        plant = artifacts.read_arrays("datasets/identify_plant/plant.parquet", "plant", 1, shapes=shapes)
        spread = artifacts.read_arrays("datasets/identify_plant/spread.parquet", "spread", 1, shapes=shapes)
        family = [*restored(plant), *restored(spread)]
        schema = tables.record(machine.acting, machine.outputs)
        record = artifacts.read_table("datasets/ingest/record.parquet", schema)
        u, y, _ = segments(record, [i.name for i in machine.inputs], [o.name for o in machine.outputs])
        commands, dither, figures = design(settings, machine, tracking, family, u, y)
        if commands:
            artifacts.write_csv(out / "next_experiment.csv", commands)
        if dither:
            artifacts.write_csv(out / "next_experiment_closed_loop.csv", dither)
        artifacts.write_json(out / "forecast.json", figures)
        artifacts.write_metrics("generate_probing", figures, METRICS)


def design(
    settings: GenerateProbing,
    machine: Plant,
    tracking: Tracking,
    plants: Sequence[Model],
    u: Sequence[np.ndarray],
    y: Sequence[np.ndarray],
) -> tuple[Columns, Columns, dict[str, Any]]:
    """Columns of the commands to play and of those to add to a controller's, empty if they are not safe, and
    figures, for the machine of the record u, y and of the identified `plants`, the model first. What makes an
    experiment unsafe is a reason in the figures, not an error."""
    import numpy as np

    from pipeline.temperature import experiment

    lacking = [o.name for o in machine.outputs if o.low is None or o.high is None]
    if lacking:
        return refuse(settings, f"declare low and high of {', '.join(lacking)} under plant.outputs")
    centre = given_centre(settings, machine)
    asked = experiment.Wish(
        samples=settings.samples,
        signal=settings.signal,
        amplitude_percent=settings.amplitude_percent,
        rate_percent_per_step=settings.rate_percent_per_step,
        shortest_steps=settings.shortest_steps,
        doubt_input_gain=settings.doubt_input_gain,
        doubt_ambient_degC=settings.doubt_ambient_degC,
        doubt_delay_steps=settings.doubt_delay_steps,
    )
    low, high = np.array([(i.low, i.high) for i in machine.inputs]).T
    y_low, y_high = np.array([(o.low, o.high) for o in machine.outputs], float).T
    reference = np.array([o.reference for o in machine.outputs], float)
    names = [i.name for i in machine.inputs], [o.name for o in machine.outputs]
    try:
        family = experiment.family_of(
            plants,
            (list(u), list(y)),
            asked,
            (low, high, y_low, y_high),
            reference,
            centre=centre,
            names=names,
        )
        plan = experiment.design(family, np.random.default_rng(settings.seed))
    except (ValueError, np.linalg.LinAlgError) as error:
        return refuse(settings, " ".join(str(error).split()))
    dither, why_not = design_dither(family, settings.seed)
    step = machine.sample_time_s
    figures = {
        "source": settings.source,
        "next_experiment": plan_figures(machine, family, plan, tracking.gamma),
        "closed_loop": {"written": False, "reason": why_not}
        if dither is None
        else dither_figures(machine, dither),
    }
    played = columns(plan.u, family.inputs, step) if plan.written else {}
    if dither is None or dither.reason:
        return played, {}, figures
    return played, columns(dither.u, [f"{name}_dither" for name in family.inputs], step), figures


def refuse(settings: GenerateProbing, reason: str) -> tuple[Columns, Columns, dict[str, Any]]:
    none = {"written": False, "reason": reason}
    return {}, {}, {"source": settings.source, "next_experiment": none, "closed_loop": none}


def design_dither(family: Family, seed: int) -> tuple[Dither | None, str]:
    """What may be added to the commands of a PI a zone, tuned by SIMC; None with the reason if the machine
    has none."""
    import numpy as np

    from pipeline.temperature import experiment
    from pipeline.temperature.controllers import baseline
    from pipeline.temperature.identification.validation import horizon

    try:
        rise = horizon(family.model, family.asked.samples)
        pairs = baseline.pairing(family.model, family.low, family.high, horizon=rise)
        law = baseline.pi_law(pairs, inputs=family.model.m)
        return experiment.dither(family, law, np.random.default_rng(seed)), ""
    except (ValueError, np.linalg.LinAlgError) as error:
        return None, f"no simple controller to add it to: {' '.join(str(error).split())}"


# ---- figures


def columns(u: np.ndarray, names: Sequence[str], sample_time_s: float) -> Columns:
    import numpy as np

    return {"time_s": sample_time_s * np.arange(len(u)), **{name: u[:, k] for k, name in enumerate(names)}}


def by_signal(signals: Sequence[PlantSignal], values: np.ndarray) -> dict[str, float | None]:
    """{name: value}, None if it is not finite."""
    return {
        signal.name: float(value) if abs(value) < float("inf") else None
        for signal, value in zip(signals, values, strict=True)
    }


def plan_figures(machine: Plant, family: Family, plan: Experiment, gamma: float) -> dict[str, Any]:
    import numpy as np

    from pipeline.temperature.experiment import expected_gap
    from pipeline.temperature.probing import excitation

    inputs, outputs, begin, asked = machine.inputs, machine.outputs, family.begin, family.asked
    figures = {
        "written": plan.written,
        "reason": plan.reason,
        "highest_degC": by_signal(outputs, plan.extremes.highest),
        "lowest_degC": by_signal(outputs, plan.extremes.lowest),
        "limit_degC": {
            o.name: {"low": low, "high": high}
            for o, low, high in zip(outputs, family.y_low, family.y_high, strict=True)
        },
        "band_degC": by_signal(outputs, family.band.width),
        "doubt": {
            "input_gain": asked.doubt_input_gain,
            "ambient_degC": asked.doubt_ambient_degC,
            "delay_steps": asked.doubt_delay_steps,
        },
        "start_percent": by_signal(inputs, begin.u),
        "start_degC": by_signal(outputs, begin.y),
        "slowest_time_constant_s": family.seconds(family.pace.slowest),
    }
    if not plan.written or plan.lesson is None:
        return figures
    # lags that span the fastest time constant: over closer ones a slow signal repeats itself
    most = len(plan.u) // (len(inputs) + 1)
    order = max(min(EXCITED, most), 1)
    lag = max(min(round(family.pace.fastest / EXCITED), most // order), 1)
    rank = excitation(plan.u[::lag], order)
    try:
        gap = expected_gap(family.model, plan.lesson, gamma)
    except (ValueError, np.linalg.LinAlgError):  # no controller of a perturbed model holds the machine
        gap = np.inf
    return figures | {
        "centre_percent": by_signal(inputs, plan.centre),
        "amplitude_percent": by_signal(inputs, plan.amplitude),
        "target_degC": by_signal(outputs, plan.target),
        "samples": len(plan.u),
        "seconds": family.seconds(len(plan.u)),
        "excitation_order": rank.order,
        "excitation_lag_s": family.seconds(lag),
        "excitation_rank": rank.rank,
        "excitation_full_rank": rank.full,
        "excitation_condition": rank.condition if np.isfinite(rank.condition) else None,
        "level_percent_per_band": excitation(plan.u, 1).level,
        "information": plan.lesson.information,
        "expected_error_percent": expected_errors(machine, family, plan.lesson),
        "expected_gap_percent": 100 * gap if np.isfinite(gap) else None,
    }


def expected_errors(machine: Plant, family: Family, lesson: Lesson) -> dict[str, Any]:
    """{output: {input: {gain, time_constant}}}: expected standard errors in percent of each seen pair."""
    return {
        output.name: {
            signal.name: {
                "gain": 100 * float(lesson.gain_error[o, j]),
                "time_constant": 100 * float(lesson.time_constant_error[o, j]),
            }
            for j, signal in enumerate(machine.inputs)
            if family.pace.seen[o, j]
        }
        for o, output in enumerate(machine.outputs)
    }


def dither_figures(machine: Plant, dither: Dither) -> dict[str, Any]:
    figures: dict[str, Any] = {
        "written": not dither.reason,
        "reason": dither.reason,
        "highest_degC": by_signal(machine.outputs, dither.extremes.highest),
        "lowest_degC": by_signal(machine.outputs, dither.extremes.lowest),
    }
    if dither.reason:
        return figures
    return figures | {
        "amplitude_percent": by_signal(machine.inputs, dither.amplitude),
        "seconds": machine.sample_time_s * len(dither.u),
        "at_limits_percent": 100 * dither.limited,
    }


if __name__ == "__main__":
    stages.run(main, "generate_probing", loop="temperature")
