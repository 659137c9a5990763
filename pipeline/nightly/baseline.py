"""What the champion's own recordings say of its model: the yardstick of every later night.

A model is never right to the last digit. What it gets wrong on every record is taken up here, so that a new
one is held against records that are known to be good: the errors' size, how honest nights scatter in the air
around and in the level of each output, and what each cause seems to be on them.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.stats

from pipeline.nightly import drift
from pipeline.nightly.drift import DriftCause, DriftRecord, MachineChanges, ProductionModel, Scatter, Segments

OWN = 0.05  # share of its errors that a cause must explain of the champion's own records, to be taken up
VERSION = 2


class Floors(NamedTuple):
    """°C below which no scatter of honest nights is believed, since they are few: of an output's level and of
    the air around."""

    level: float
    ambient: float


class Baseline(NamedTuple):
    """Of the champion's own recordings: the scale, what of the model they already hold to be otherwise, and
    by cause the estimates of each night (nights, causes), their deviations and what they explain, by the
    models without that night and again by the champion's own. Then the
    logarithm of the variance of the noise (nights, p), its deviation, and the weighted error a sample
    (nights,)."""

    scale: Scatter
    changes: MachineChanges
    values: np.ndarray
    deviations: np.ndarray
    explained: np.ndarray
    noise: np.ndarray
    noise_deviation: np.ndarray
    misfit: np.ndarray

    def usual(self, causes: Sequence[DriftCause]) -> dict[DriftCause, float]:
        """What each cause explains of an honest record at most."""
        return dict(zip(causes, self.explained.max(axis=0).tolist(), strict=True))

    def to_json(self) -> dict[str, Any]:
        """As reference.json has it."""
        cap = np.where(np.isfinite(self.changes.cap), self.changes.cap, 1e9)
        return {
            "scale": _lists(self.scale),
            "changes": _lists(self.changes._replace(cap=cap)),
            **{name: np.asarray(getattr(self, name)).tolist() for name in self._fields[2:]},
        }

    @classmethod
    def read(cls, fields: dict[str, Any]) -> "Baseline":
        known = fields["scale"]
        variance, level, mean_level = (np.array(known[name]) for name in ("variance", "level", "mean_level"))
        scale = Scatter(variance, float(known["ambient"]), level, mean_level)
        changes = MachineChanges(**{name: np.array(value) for name, value in fields["changes"].items()})
        changes = changes._replace(cap=np.where(changes.cap < 1e8, changes.cap, np.inf))
        return cls(scale, changes, *(np.array(fields[name]) for name in cls._fields[2:]))


def _lists(fields: Scatter | MachineChanges) -> dict[str, Any]:
    return {name: np.asarray(value).tolist() for name, value in fields._asdict().items()}


def measured(
    machine: ProductionModel,
    nights: Sequence[Segments],
    floors: Floors,
    without: Sequence[ProductionModel] | None = None,
) -> Baseline:
    """The baseline of a champion's nights, each held against the model of `without` that was identified
    without it (None: the champion's own). Raises ValueError where they are too short."""
    plant, together = machine.plant, [pair for night in nights for pair in night]
    loose, none = _loose(machine, together), MachineChanges.none(plant.m, plant.p)
    record = drift.record(machine, together, loose)
    errors = drift.left(record, none)
    causes = drift.causes(plant)
    changes = drift.explain(record, none, dict.fromkeys(causes, OWN / 2 * float(errors @ errors))).changes
    models = without or [machine] * len(nights)
    scale = _scale(models, nights, loose, changes, floors)
    records = [rested(model, night, scale, changes) for model, night in zip(models, nights, strict=True)]
    # a new night is held against the champion's own model: what that one gets wrong of its own nights, and
    # those without them do not, is no change of the machine either
    held = [*records, *(rested(machine, night, scale, changes) for night in (nights if without else []))]
    fits = [drift.alone(one, changes) for one in held]
    rest = [drift.left(one, changes) for one in records]
    noises = [noise(drift.by_output(one, e)) for one, e in zip(records, rest, strict=True)]
    return Baseline(
        scale,
        changes,
        np.array([[fit.value for fit in night] for night in fits]),
        np.array([[fit.deviation for fit in night] for night in fits]),
        np.array([[fit.explained for fit in night] for night in fits]),
        np.array([value for value, _ in noises]),
        np.array([deviation for _, deviation in noises]),
        np.array([misfit(one, changes) for one in records]),
    )


def rested(
    machine: ProductionModel, segments: Segments, scale: Scatter, changes: MachineChanges
) -> DriftRecord:
    """A record in the surroundings that it was made in."""
    there, room = drift.room_of(machine, segments, scale, changes)
    return drift.record(machine, segments, there, room._replace(another_season=False))


def misfit(record: DriftRecord, changes: MachineChanges) -> float:
    """Weighted squared error a sample: near 1 on a record like the champion's own."""
    e = drift.left(record, changes)
    return float(e @ e) / max(sum(int(one.measured.sum()) for one in record.segments), 1)


def noise(errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Logarithm of the variance (p,) of errors (T, p) from one sample to the next, which nothing slow enters,
    and its standard deviation from their blocks."""
    steps = np.diff(errors, axis=0) ** 2 / 2
    whole = np.maximum(np.nanmean(steps, axis=0), 1e-12)
    parts = np.stack(
        [np.nan_to_num(np.nanmean(part, axis=0)) for part in np.array_split(steps, drift.BLOCKS)]
    )
    return np.log(whole), parts.std(axis=0, ddof=1) / np.sqrt(drift.BLOCKS) / whole


def _loose(machine: ProductionModel, together: Segments) -> Scatter:
    """The scale before any night is known: errors as large as they are."""
    plant = machine.plant
    scale = Scatter(np.ones(plant.p), 30.0, np.full(plant.p, 5.0), np.zeros(plant.p))
    for _ in range(2):
        record = drift.record(machine, together, scale)
        errors = drift.by_output(record, drift.left(record, MachineChanges.none(plant.m, plant.p)))
        scale = scale._replace(variance=np.maximum(np.nanmean(errors**2, axis=0), 1e-8))
    return scale


def _scale(
    models: Sequence[ProductionModel],
    nights: Sequence[Segments],
    loose: Scatter,
    changes: MachineChanges,
    floors: Floors,
) -> Scatter:
    """How honest nights scatter, from these. Of a few nights a standard deviation is small by chance:
    Student's quantile for it, and the new night's own share."""
    records = [rested(model, night, loose, changes) for model, night in zip(models, nights, strict=True)]
    airs, own = zip(*(drift.levels(record, changes) for record in records), strict=True)
    count = len(nights)
    wider = scipy.stats.t.ppf(0.841, count - 1) * np.sqrt(1 + 1 / count) if count > 1 else 1.0
    spread = (lambda v: wider * np.std(v, axis=0, ddof=1)) if count > 1 else (lambda v: np.zeros_like(v[0]))
    errors = [drift.by_output(record, drift.left(record, changes)) for record in records]
    return Scatter(
        np.maximum(np.nanmean(np.concatenate(errors) ** 2, axis=0), 1e-8),
        float(np.hypot(spread(np.array(airs)), floors.ambient)),
        np.hypot(spread(np.array(own)), floors.level),
        np.mean(airs) + np.mean(own, axis=0),
    )
