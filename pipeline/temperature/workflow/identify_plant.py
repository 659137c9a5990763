"""What identify_plant does: order and window chosen on the first part of every segment,
judged on the last; the plant that is handed on is fitted to both with what was chosen, and a
family of plants around it says how well it is known."""

from typing import Any, NamedTuple

import numpy as np

from pipeline.store import artifacts
from pipeline.store.tables import Schema
from pipeline.temperature import identification, order, plant, trust, validation
from pipeline.temperature.workflow import tables
from pipeline.temperature.workflow.record import read_record
from pipeline.temperature.workflow.settings import IdentifyPlant
from pipeline.temperature.workflow.settings import Plant as Machine

Segments = list[np.ndarray]


class Found(NamedTuple):
    """The plant, the plants of its spread, tables {name: (schema, columns)}
    for the page of the identification, and metrics."""

    plant: plant.Plant
    spread: list[plant.Plant]
    tables: dict[str, tuple[Schema, dict[str, Any]]]
    metrics: dict[str, Any]


def identified(p: IdentifyPlant, machine: Machine, path: str) -> Found:
    """The plant of the record in `path`. Raises ValueError where the record cannot tell it."""
    inputs, outputs = [i.name for i in machine.inputs], [o.name for o in machine.outputs]
    recorded = read_record(path, machine.inputs, machine.outputs)
    u, y = identification.gapless(*recorded)
    with artifacts.about(path):
        identification.check_inputs(u, offset=p.offset, names=inputs)
        identification.check_outputs(y, names=outputs)
    u, clipped = identification.within_limits(
        u, tuple(zip(*((i.low, i.high) for i in machine.inputs), strict=True)), names=inputs
    )
    first, last = _parted(u, y, p.holdout_share)
    samples, kept = sum(map(len, recorded[0])), sum(map(len, u))
    with artifacts.about(path):
        chosen = identification.identify(
            *first, sample_time_s=machine.sample_time_s, order=p.order or None, offset=p.offset,
            refinement=p.refinement,
            max_order=p.max_order,
            names=inputs,
        )  # fmt: skip
    judged = trust.holdout(
        chosen.plant, *last, p.ahead_steps, block=2 * chosen.past, rng=np.random.default_rng(p.seed)
    )
    tests = validation.residual_tests(chosen.plant, *last, lags=trust.residual_lags(last[0]))
    excited = validation.excitation(first[0], chosen.past)
    found = identification.refit(u, y, chosen, names=inputs)
    if not (observed := plant.observability(found.plant)).passed:
        raise ValueError(f"{path}: {observed.reason}")
    family = validation.bootstrap_spread(
        u, y, found, count=p.spread_plants, order=found.order + 1, rng=np.random.default_rng(p.seed)
    )
    steps = trust.steps(found.plant, family, max(map(len, u)))
    shown = {
        "order": (tables.ORDER, identification.rows(chosen)),
        "holdout": (
            tables.holdout(machine.outputs),
            trust.holdout_rows(last[1], judged, outputs, machine.sample_time_s),
        ),
        "residuals": (tables.RESIDUALS, trust.residual_rows(tests, outputs, inputs)),
        "steps": (tables.STEPS, trust.step_rows(steps, outputs, inputs, machine.sample_time_s)),
        "dynamics": (tables.DYNAMICS, trust.dynamics_rows(steps, outputs, inputs, machine.sample_time_s)),
        "poles": (tables.POLES, trust.pole_rows(found.plant, family)),
        "levels": (tables.LEVELS, trust.level_rows(trust.input_levels(u), inputs)),
    }
    metrics = {
        "order": found.order, "order_tolerance_percent": 100 * order.WORTH_A_STATE, "past": found.past,
        "fit": found.fit,
        "rows": found.rows,
        "dropped_rows": found.dropped_rows, "samples": samples, "samples_cut": samples - kept,
        "samples_holdout": sum(map(len, last[0])),
        "delays": dict(zip(inputs, found.delays, strict=True)),
        "notes": list(dict.fromkeys([*clipped, *chosen.notes, *found.notes])),
        "ahead_steps": p.ahead_steps, **trust.fit_figures(judged, outputs),
        **trust.outcome_figures(tests, excited, outputs, inputs),
        "controllable": plant.controllability(found.plant).passed,
        "largest_pole": np.abs(np.linalg.eigvals(found.plant.A)).max(),
        "advice": validation.advice(tests, excited, judged.fit[0], outputs=outputs, inputs=inputs),
    }  # fmt: skip
    return Found(found.plant, family, shown, metrics)


def _parted(
    u: Segments, y: Segments, holdout_share: float
) -> tuple[tuple[Segments, Segments], tuple[Segments, Segments]]:
    """(u, y) of the first part of every segment, which chooses, and of the last, which judges."""
    cuts = [round(len(us) * (1 - holdout_share)) for us in u]
    first = tuple([signal[:cut] for signal, cut in zip(signals, cuts, strict=True)] for signals in (u, y))
    last = tuple([signal[cut:] for signal, cut in zip(signals, cuts, strict=True)] for signals in (u, y))
    return first, last
