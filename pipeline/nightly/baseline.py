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
from pipeline.nightly.drift import Changes, DriftCause, DriftRecord, ProductionModel, Scatter, Segments

OWN = 0.05  # share of its errors that a cause must explain of the champion's own records, to be taken up
VERSION, BEFORE = 3, 2  # of reference.json; that before it is read too
# the changes of a machine as version 2 named them, each a list by channel
KINDS_BEFORE = {
    "gain": "gain", "rate": "time constant", "delay": "delay", "cap": "saturation", "offset": "offset",
    "late": "late sensor",
}  # fmt: skip


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
    changes: Changes
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
        arrays = {name: np.asarray(getattr(self, name)).tolist() for name in self._fields[2:]}
        changes = [[*cause, value] for cause, value in self.changes]
        return {"scale": [np.asarray(one).tolist() for one in self.scale], "changes": changes, **arrays}

    @classmethod
    def read(cls, fields: dict[str, Any]) -> "Baseline":
        changes = tuple((DriftCause(kind, channel), value) for kind, channel, value in fields["changes"])
        scale = Scatter(*map(np.array, fields["scale"]))
        return cls(scale, changes, *(np.array(fields[name]) for name in cls._fields[2:]))


def rewrite(fields: dict[str, Any]) -> dict[str, Any]:
    """A baseline of version 2 as version 3 has it; an input without a cap had one of 1e9."""
    changes = [
        (KINDS_BEFORE[name], channel, value)
        for name, values in fields["changes"].items()
        for channel, value in enumerate(values)
        if value not in (0.0, 1e9)
    ]
    return fields | {"scale": [fields["scale"][name] for name in Scatter._fields], "changes": changes}


def measured(
    machine: ProductionModel,
    nights: Sequence[Segments],
    floors: Floors,
    without: Sequence[ProductionModel] | None = None,
) -> Baseline:
    """The baseline of a champion's nights, each held against the model of `without` that was identified
    without it (None: the champion's own). Raises ValueError if they are too short."""
    together = [pair for night in nights for pair in night]
    loose = _loose(machine, together)
    record = drift.record(machine, together, loose)
    errors = drift.left(record, ())
    usual = dict.fromkeys(drift.causes(machine.plant), OWN / 2 * float(errors @ errors))
    changes = drift.explain(record, (), usual).changes
    models = without or [machine] * len(nights)
    scale = _scale(models, nights, loose, changes, floors)
    records = [rested(model, night, scale, changes) for model, night in zip(models, nights, strict=True)]
    # a new night is held against the champion's own model: what that one gets wrong of its own nights, and
    # those without them do not, is no change of the machine either
    held = [*records, *(rested(machine, night, scale, changes) for night in (nights if without else []))]
    estimates = np.array([[fit[1:] for fit in drift.alone(one, changes)] for one in held])
    noises = [noise(drift.by_output(one, drift.left(one, changes))) for one in records]
    misfits = np.array([misfit(one, changes) for one in records])
    return Baseline(
        scale, changes, *np.moveaxis(estimates, 2, 0), *map(np.array, zip(*noises, strict=True)), misfits
    )


def rested(machine: ProductionModel, segments: Segments, scale: Scatter, changes: Changes) -> DriftRecord:
    """A record in the surroundings that it was made in."""
    there, room = drift.room_of(machine, segments, scale, changes)
    return drift.record(machine, segments, there, room._replace(another_season=False))


def misfit(record: DriftRecord, changes: Changes) -> float:
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
        errors = drift.by_output(record, drift.left(record, ()))
        scale = scale._replace(variance=np.maximum(np.nanmean(errors**2, axis=0), 1e-8))
    return scale


def _scale(
    models: Sequence[ProductionModel],
    nights: Sequence[Segments],
    loose: Scatter,
    changes: Changes,
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
