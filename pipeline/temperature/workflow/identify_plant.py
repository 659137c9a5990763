"""What identify_plant does: it chooses order and window on the first part of every segment and judges them on
the last. The plant that it hands on is fitted to both parts. A family of plants around it shows its error."""

from typing import Any, NamedTuple

import numpy as np

from pipeline.store import artifacts
from pipeline.store.tables import Schema
from pipeline.temperature import plant
from pipeline.temperature.identification import model_choice as identification
from pipeline.temperature.identification import order, trust, validation
from pipeline.temperature.identification.closed_loop import LEVEL_CLOSED
from pipeline.temperature.workflow import tables
from pipeline.temperature.workflow.record import read_recordings
from pipeline.temperature.workflow.settings import IdentifyPlant
from pipeline.temperature.workflow.settings import Plant as Machine

Segments = list[np.ndarray]


class IdentifiedPlant(NamedTuple):
    """The plant, the plants of its spread, tables {name: (schema, columns)}
    for the page of the identification, and metrics."""

    plant: plant.Plant
    spread: list[plant.Plant]
    tables: dict[str, tuple[Schema, dict[str, Any]]]
    metrics: dict[str, Any]


class _Record(NamedTuple):
    """The record as it can be identified, u with disturbances after the inputs; the recording of each
    segment; `recorded` samples before any were cut, and what was clipped."""

    u: Segments
    y: Segments
    recordings: tuple[int, ...]
    recorded: int
    notes: list[str]

    @property
    def samples(self) -> int:
        return sum(map(len, self.u))


class _Judgement(NamedTuple):
    """The chosen model on the last part of the record, and what the first part excites; `still` (p,): its fit
    with the inputs held."""

    holdout: trust.Holdout
    residuals: validation.Residuals
    excitation: validation.Excitation
    samples: int
    still: np.ndarray


def identified(settings: IdentifyPlant, machine: Machine, path: str) -> IdentifiedPlant:
    """The plant of the record in `path`. Raises ValueError where the record cannot tell it."""
    acting, inputs = [signal.name for signal in machine.acting], len(machine.inputs)
    record = _read(settings, machine, path)
    first, last = _parted(record.u, record.y, settings.holdout_share)
    asked = choices(settings)._replace(recordings=record.recordings, inputs=inputs)
    with artifacts.about(path):
        chosen = identification.identify(
            *first, sample_time_s=machine.sample_time_s, settings=asked, names=acting
        )
    judgement = _judged(settings, chosen, first, last)
    fitted = identification.refit(record.u, record.y, chosen, names=acting)
    if not (observed := plant.observability(fitted.plant)).passed:
        raise ValueError(f"{path}: {observed.reason}")
    family = validation.bootstrap_spread(
        record.u,
        record.y,
        fitted,
        count=settings.spread_plants,
        order=fitted.order + 1,
        rng=np.random.default_rng(settings.seed),
    )
    # controllers are not told the disturbances: at their mean they are part of the offsets
    level = np.vstack(record.u).mean(axis=0)[inputs:]
    controlled, *family = (plant.at_disturbances(one, inputs, level) for one in (fitted.plant, *family))
    left_out = [
        plant.at_disturbances(one, inputs, level)
        for one in validation.left_out_plants(record.u, record.y, fitted)
    ]
    steps = trust.steps(controlled, family, max(map(len, record.u)), left_out=left_out)
    page_tables = {
        "order": (tables.ORDER, identification.rows(chosen)),
        **_judgement_tables(machine, last[1], judgement),
        **_model_tables(machine, record.u, controlled, family, steps),
    }
    metrics = _metrics(settings, machine, record, chosen, fitted, judgement) | _warnings(
        machine, fitted, steps
    )
    return IdentifiedPlant(controlled, family, page_tables, metrics)


def choices(settings: IdentifyPlant) -> identification.Settings:
    """What the stage gives, and what it leaves to the data."""
    return identification.Settings(
        order=settings.order or None,
        feedthrough=None if settings.feedthrough == "chosen" else False,
        offset=settings.offset,
        refinement=settings.refinement,
        max_order=settings.max_order,
    )


def _read(settings: IdentifyPlant, machine: Machine, path: str) -> _Record:
    u, y, names = read_recordings(path, machine.acting, machine.outputs)
    recorded = sum(map(len, u))
    pieces = [identification.gapless([a], [b]) for a, b in zip(u, y, strict=True)]
    order = {name: k for k, name in enumerate(dict.fromkeys(names))}
    recordings = tuple(order[name] for name, piece in zip(names, pieces, strict=True) for _ in piece[0])
    u, y = [a for piece in pieces for a in piece[0]], [b for piece in pieces for b in piece[1]]
    acting, outputs = [s.name for s in machine.acting], [o.name for o in machine.outputs]
    with artifacts.about(path):
        identification.check_inputs(u, offset=settings.offset, names=acting)
        identification.check_outputs(y, names=outputs)
    limits = [(i.low, i.high) for i in machine.inputs] + [(-np.inf, np.inf)] * len(machine.disturbances)
    u, clipped = identification.within_limits(u, tuple(zip(*limits, strict=True)), names=acting)
    return _Record(u, y, recordings, recorded, clipped)


def _judged(
    settings: IdentifyPlant,
    chosen: identification.Identified,
    first: tuple[Segments, Segments],
    last: tuple[Segments, Segments],
) -> _Judgement:
    holdout = trust.holdout(
        chosen.plant,
        *last,
        settings.ahead_steps,
        block=2 * chosen.past,
        rng=np.random.default_rng(settings.seed),
        drift=chosen.drift,
    )
    closed = chosen.feedback is not None and chosen.feedback.closed
    residuals = validation.residual_tests(
        chosen.plant, *last, lags=trust.residual_lags(last[0]), closed=closed
    )
    excitation = validation.excitation(first[0], chosen.past)
    still = trust.fit_of_held_inputs(chosen.plant, *last)
    return _Judgement(holdout, residuals, excitation, sum(map(len, last[0])), still)


def _judgement_tables(
    machine: Machine, measured: Segments, judgement: _Judgement
) -> dict[str, tuple[Schema, dict[str, Any]]]:
    inputs, outputs = [s.name for s in machine.acting], [o.name for o in machine.outputs]
    ahead = trust.holdout_rows(measured, judgement.holdout, outputs, machine.sample_time_s)
    return {
        "holdout": (tables.holdout(machine.outputs), ahead),
        "residuals": (tables.RESIDUALS, trust.residual_rows(judgement.residuals, outputs, inputs)),
    }


def _model_tables(
    machine: Machine, u: Segments, fitted: plant.Plant, family: list[plant.Plant], steps: trust.Steps
) -> dict[str, tuple[Schema, dict[str, Any]]]:
    inputs, outputs = [i.name for i in machine.inputs], [o.name for o in machine.outputs]
    shown, moved = (steps, outputs, inputs, machine.sample_time_s), [a[:, : len(inputs)] for a in u]
    return {
        "steps": (tables.STEPS, trust.step_rows(*shown)),
        "dynamics": (tables.DYNAMICS, trust.dynamics_rows(*shown)),
        "first_order": (tables.FIRST_ORDER, trust.first_order_rows(*shown)),
        "poles": (tables.POLES, trust.pole_rows(fitted, family)),
        "levels": (tables.LEVELS, trust.level_rows(trust.input_levels(moved), inputs)),
    }


def _metrics(
    settings: IdentifyPlant,
    machine: Machine,
    record: _Record,
    chosen: identification.Identified,
    fitted: identification.Identified,
    judgement: _Judgement,
) -> dict[str, Any]:
    holdout, residuals, excitation, holdout_samples, still = judgement
    inputs, outputs = [s.name for s in machine.acting], [o.name for o in machine.outputs]
    return {
        "order": fitted.order,
        "order_tolerance_percent": 100 * order.WORTH_A_STATE,
        "past": fitted.past,
        "fit": fitted.fit,
        # of what is not recorded; None where the left-out blocks do not prefer it, and in no controller
        "drift_samples": 1.0 / fitted.drift if fitted.drift else None,
        "feedthrough": dict(zip(outputs, fitted.feedthrough, strict=True)),
        "validation": "recordings" if len(set(record.recordings)) > 1 else "blocks",
        "rows": fitted.rows,
        "dropped_rows": fitted.dropped_rows,
        "samples": record.recorded,
        "samples_cut": record.recorded - record.samples,
        "samples_holdout": holdout_samples,
        "delays": dict(zip(inputs, fitted.delays, strict=True)),
        "notes": list(dict.fromkeys([*record.notes, *fitted.notes])),
        "ahead_steps": settings.ahead_steps,
        **trust.fit_figures(holdout, outputs),
        "fit_holdout_inputs_held": dict(zip(outputs, still.tolist(), strict=True)),
        **trust.outcome_figures(residuals, excitation, outputs, inputs),
        "controllable": plant.controllability(fitted.plant).passed,
        "largest_pole": np.abs(np.linalg.eigvals(fitted.plant.A)).max(),
        "advice": validation.advice(
            residuals,
            excitation,
            holdout.fit[0],
            outputs=outputs,
            inputs=inputs,
            still_percent=still,
            order_given=settings.order > 0,
        ),
    }


def _warnings(machine: Machine, fitted: identification.Identified, steps: trust.Steps) -> dict[str, Any]:
    """Whether the record was taken in closed loop, and the gains that physics forbids."""
    names, feedback = [i.name for i in machine.inputs], fitted.feedback
    forbidden = trust.forbidden_gains(
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
        "forbidden_gains": [gain._asdict() for gain in forbidden],
    }


def _parted(
    u: Segments, y: Segments, holdout_share: float
) -> tuple[tuple[Segments, Segments], tuple[Segments, Segments]]:
    """(u, y) of the first part of every segment, which chooses, and of the last, which judges."""
    cuts = [round(len(us) * (1 - holdout_share)) for us in u]
    first = tuple([signal[:cut] for signal, cut in zip(signals, cuts, strict=True)] for signals in (u, y))
    last = tuple([signal[cut:] for signal, cut in zip(signals, cuts, strict=True)] for signals in (u, y))
    return first, last
