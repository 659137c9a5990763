"""Record -> plant and its spread: reads datasets/ingest/record.parquet; writes datasets/identify_plant:
plant, spread, order, and what the page of the identification shows: holdout, residuals, steps, dynamics,
first_order, poles, levels.

Order and window are chosen on the first part of every segment and judged on the last. The plant that is
handed on is fitted to both parts. A family of plants around it shows its error."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from pydantic import Field

import stages
from pipeline.store import artifacts, params
from pipeline.store.params import Section
from pipeline.temperature import tables
from pipeline.temperature.settings import Plant as Machine
from pipeline.temperature.settings import recorded

if TYPE_CHECKING:
    import numpy as np

    from pipeline.store.tables import Schema
    from pipeline.temperature.identification.model_choice import Identified, Settings
    from pipeline.temperature.identification.validation import Holdout, RecordExcitation, Residuals, Steps
    from pipeline.temperature.plant import Plant

    Segments = list[np.ndarray]
    Tables = dict[str, tuple[Schema, dict[str, Any]]]


class IdentifyPlant(Section):
    """Section `identify_plant`."""

    seed: int = Field(ge=0, le=2**31)
    order: int = Field(ge=0, le=60)
    max_order: int = Field(ge=1, le=60)
    offset: bool
    feedthrough: Literal["chosen", "none"]
    refinement: Literal["none", "prediction", "simulation", "validated"]
    holdout_share: float = Field(gt=0, lt=0.9)
    ahead_steps: int = Field(ge=1, le=10_000)
    spread_plants: int = Field(ge=20, le=1000)


class RecordSegments(NamedTuple):
    """The record as it can be identified, u with disturbances after the inputs; the recording of each
    segment; `recorded` samples before any were cut, and what was clipped."""

    u: Segments
    y: Segments
    recordings: tuple[int, ...]
    recorded: int
    notes: list[str]


# figures of control that git keeps and that runs are compared by
METRICS = (
    "order",
    "samples*",
    "fit_holdout",
    "fit_holdout_ahead",
    "fit_holdout_band",
    "whiteness_passed",
    "excitation.rank",
    "excitation.condition",
    "largest_pole",
)


def main() -> None:
    with artifacts.stage("identify_plant") as out:
        from pipeline.temperature.plant import stored

        settings = params.load(IdentifyPlant, "identify_plant")
        machine = recorded(params.load(Machine, "plant"), "datasets/ingest/record.parquet")
        plant, spread, page_tables, figures = identify(settings, machine, "datasets/ingest/record.parquet")
        artifacts.write_arrays(out / "plant.parquet", "plant", 1, stored([plant]))
        artifacts.write_arrays(out / "spread.parquet", "spread", 1, stored(spread))
        for name, (schema, columns) in page_tables.items():
            artifacts.write_table(out / f"{name}.parquet", schema, columns)
        artifacts.write_metrics("identify_plant", figures, METRICS)


def identify(
    settings: IdentifyPlant, machine: Machine, path: str
) -> tuple[Plant, list[Plant], Tables, dict[str, Any]]:
    """The plant of the record in `path`, its spread, tables for the page of the identification, and figures.
    Raises ValueError if the record does not determine the plant."""
    import numpy as np

    from pipeline.temperature.identification import model_choice, validation
    from pipeline.temperature.identification.segments import split
    from pipeline.temperature.identification.validation import judge
    from pipeline.temperature.plant import at_disturbances, bandwidth_rad_s, observable_part

    acting, inputs = [signal.name for signal in machine.acting], len(machine.inputs)
    record = read_record(settings, machine, path)
    first, last = split(record.u, record.y, settings.holdout_share)
    rules = choices(settings, inputs, record.recordings)
    with artifacts.about(path):
        chosen = model_choice.identify(
            *first, sample_time_s=machine.sample_time_s, settings=rules, names=acting
        )
    rng = np.random.default_rng(settings.seed)
    judgement = judge(chosen, first, last, ahead_steps=settings.ahead_steps, rng=rng)
    fitted = model_choice.refit(record.u, record.y, chosen, names=acting)
    family = validation.bootstrap_spread(
        record.u,
        record.y,
        fitted,
        count=settings.spread_plants,
        order=fitted.order + 1,
        rng=np.random.default_rng(settings.seed),
    )
    # the model holds no disturbances: at their mean they are part of the offsets
    level = np.vstack(record.u).mean(axis=0)[inputs:]
    seen = observable_part(fitted.plant)
    plant, *spread = (at_disturbances(one, inputs, level) for one in (seen, *family))
    left_out = [
        at_disturbances(one, inputs, level) for one in validation.left_out_plants(record.u, record.y, fitted)
    ]
    steps = validation.steps(plant, spread, max(map(len, record.u)), left_out=left_out)
    page_tables = {
        "order": (tables.ORDER, model_choice.rows(chosen)),
        **judgement_tables(machine, last[1], judgement[0], judgement[1]),
        **model_tables(machine, record.u, plant, spread, steps),
    }
    figures = fit_figures(settings, machine, record, fitted, sum(map(len, last[0])), judgement)
    figures["bandwidth_rad_s"] = bandwidth_rad_s(plant)
    return plant, spread, page_tables, figures | warnings(machine, fitted, steps)


def choices(settings: IdentifyPlant, inputs: int, recordings: Sequence[int]) -> Settings:
    """What the identification is free to choose on segments of these `recordings`."""
    from pipeline.temperature.identification import model_choice

    return model_choice.Settings(
        order=settings.order or None,
        feedthrough=None if settings.feedthrough == "chosen" else False,
        offset=settings.offset,
        refinement=settings.refinement,
        max_order=settings.max_order,
        recordings=tuple(recordings),
        inputs=inputs,
    )


def read_record(settings: IdentifyPlant, machine: Machine, path: str) -> RecordSegments:
    from pipeline.temperature.identification import model_choice
    from pipeline.temperature.identification.segments import segments, without_gaps

    acting, outputs = [s.name for s in machine.acting], [o.name for o in machine.outputs]
    table = artifacts.read_table(path, tables.record(machine.acting, machine.outputs))
    u, y, names = segments(table, acting, outputs)
    recorded = sum(map(len, u))
    u, y, recordings = without_gaps(u, y, names)
    with artifacts.about(path):
        model_choice.check_inputs(u, offset=settings.offset, names=acting)
        model_choice.check_outputs(y, names=outputs)
    unlimited = [float("inf")] * len(machine.disturbances)
    low = [i.low for i in machine.inputs] + [-limit for limit in unlimited]
    high = [i.high for i in machine.inputs] + unlimited
    u, clipped = model_choice.within_limits(u, (low, high), names=acting)
    return RecordSegments(u, y, tuple(recordings), recorded, clipped)


# ---- tables and figures


def judgement_tables(machine: Machine, measured: Segments, held_out: Holdout, residuals: Residuals) -> Tables:
    from pipeline.temperature.identification import validation

    inputs, outputs = [s.name for s in machine.acting], [o.name for o in machine.outputs]
    ahead = validation.holdout_rows(measured, held_out, outputs, machine.sample_time_s)
    return {
        "holdout": (tables.holdout(machine.outputs), ahead),
        "residuals": (tables.RESIDUALS, validation.residual_rows(residuals, outputs, inputs)),
    }


def model_tables(machine: Machine, u: Segments, plant: Plant, spread: list[Plant], steps: Steps) -> Tables:
    from pipeline.temperature.identification import validation

    inputs, outputs = [i.name for i in machine.inputs], [o.name for o in machine.outputs]
    responses, moved = (steps, outputs, inputs, machine.sample_time_s), [a[:, : len(inputs)] for a in u]
    return {
        "steps": (tables.STEPS, validation.step_rows(*responses)),
        "dynamics": (tables.DYNAMICS, validation.dynamics_rows(*responses)),
        "first_order": (tables.FIRST_ORDER, validation.first_order_rows(*responses)),
        "poles": (tables.POLES, validation.pole_rows(plant, spread)),
        "levels": (tables.LEVELS, validation.level_rows(validation.input_levels(moved), inputs)),
    }


def fit_figures(
    settings: IdentifyPlant,
    machine: Machine,
    record: RecordSegments,
    fitted: Identified,
    samples_holdout: int,
    judgement: tuple[Holdout, Residuals, RecordExcitation, np.ndarray],
) -> dict[str, Any]:
    import numpy as np

    from pipeline.temperature.identification import order, validation
    from pipeline.temperature.plant import controllability

    inputs, outputs = [s.name for s in machine.acting], [o.name for o in machine.outputs]
    held_out, residuals, excited, still = judgement
    return {
        "order": fitted.order,
        "order_tolerance_percent": 100 * order.WORTH_A_STATE,
        "past": fitted.past,
        "fit": fitted.fit,
        # of what is not recorded; None if the left-out blocks do not prefer it, and in no controller
        "drift_samples": 1.0 / fitted.drift if fitted.drift else None,
        "feedthrough": dict(zip(outputs, fitted.feedthrough, strict=True)),
        "validation": "recordings" if len(set(record.recordings)) > 1 else "blocks",
        "rows": fitted.rows,
        "dropped_rows": fitted.dropped_rows,
        "samples": record.recorded,
        "samples_cut": record.recorded - sum(map(len, record.u)),
        "samples_holdout": samples_holdout,
        "delays": dict(zip(inputs, fitted.delays, strict=True)),
        "notes": list(dict.fromkeys([*record.notes, *fitted.notes])),
        "ahead_steps": settings.ahead_steps,
        **validation.fit_figures(held_out, outputs),
        "fit_holdout_inputs_held": dict(zip(outputs, still.tolist(), strict=True)),
        **validation.outcome_figures(residuals, excited, outputs, inputs),
        "controllable": not controllability(fitted.plant)[1],
        "largest_pole": np.abs(np.linalg.eigvals(fitted.plant.A)).max(),
        "advice": validation.advice(
            residuals,
            excited,
            held_out.fits["fit_holdout"][0],
            outputs=outputs,
            inputs=inputs,
            still_percent=still,
            order_given=settings.order > 0,
        ),
    }


def warnings(machine: Machine, fitted: Identified, steps: Steps) -> dict[str, Any]:
    """Whether the record was taken in closed loop, and the gains that physics forbids."""
    from pipeline.temperature.identification.closed_loop import LEVEL_CLOSED
    from pipeline.temperature.identification.validation import forbidden_gains

    names, feedback = [i.name for i in machine.inputs], fitted.feedback
    forbidden = forbidden_gains(
        steps,
        [o.name for o in machine.outputs],
        names,
        [i.heats for i in machine.inputs],
        [i.high - i.low for i in machine.inputs],
    )
    answers = [] if feedback is None else feedback.p_value.tolist()
    return {
        "closed_loop": {
            "closed": feedback is not None and feedback.closed,
            "level": LEVEL_CLOSED / (2 * len(names)),
            "p_value": dict(zip(names, answers, strict=False)),
        },
        "forbidden_gains": forbidden,
    }


if __name__ == "__main__":
    stages.run(main, "identify_plant", loop="temperature")
