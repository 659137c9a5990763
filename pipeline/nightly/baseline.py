"""The results of the champion's own recordings with its model: the reference for every later night.

A model is never exact. Its errors that appear on every record are included here, so that a new record is
compared with records that are known to be good: the errors' size, how honest nights scatter in the ambient
air and in the level of each output, and the estimate of each cause on them.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.stats

from pipeline.nightly import drift
from pipeline.nightly.drift import Changes, DriftCause, DriftRecord, ProductionModel, Scatter, Segments

OWN = 0.05  # fraction of the errors on the champion's own records that a cause must explain to be included
VERSION, BEFORE = 3, 2  # of reference.json; the previous version is read too
# the changes of a machine as version 2 named them, each a list by channel
KINDS_BEFORE = {
    "gain": "gain", "rate": "time constant", "delay": "delay", "cap": "saturation", "offset": "offset",
    "late": "late sensor",
}  # fmt: skip


class Floors(NamedTuple):
    """Least standard deviations of honest nights in °C, since these nights are few: of an output's level, and
    of the ambient air."""

    level: float
    ambient: float


class Baseline(NamedTuple):
    """Results of the champion's own recordings: `scale`; `changes` that they already show against the model;
    and for each cause the estimates of each night (nights, causes), their standard deviations and what they
    explain, first with the models without that night and again with the champion's own model. Then the
    logarithm of the noise variance (nights, p), its standard deviation, and the weighted squared error per
    sample (nights,)."""

    scale: Scatter
    changes: Changes
    values: np.ndarray
    deviations: np.ndarray
    explained: np.ndarray
    noise: np.ndarray
    noise_deviation: np.ndarray
    misfit: np.ndarray

    def usual(self, causes: Sequence[DriftCause]) -> dict[DriftCause, float]:
        """Returns the most that each cause explains of an honest record."""
        return dict(zip(causes, self.explained.max(axis=0).tolist(), strict=True))

    def to_json(self) -> dict[str, Any]:
        """Returns the baseline as in reference.json."""
        arrays = {name: np.asarray(getattr(self, name)).tolist() for name in self._fields[2:]}
        changes = [[*cause, value] for cause, value in self.changes]
        return {"scale": [np.asarray(one).tolist() for one in self.scale], "changes": changes, **arrays}

    @classmethod
    def read(cls, fields: dict[str, Any]) -> "Baseline":
        changes = tuple((DriftCause(kind, channel), value) for kind, channel, value in fields["changes"])
        scale = Scatter(*map(np.array, fields["scale"]))
        return cls(scale, changes, *(np.array(fields[name]) for name in cls._fields[2:]))


def rewrite(fields: dict[str, Any]) -> dict[str, Any]:
    """Converts a baseline of version 2 to version 3. In version 2 an input without a cap had one of 1e9."""
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
    """Returns the baseline of a champion's nights. Each is compared with the model of `without` that was
    identified without it (None: with the champion's own). Raises ValueError if the nights are too short."""
    together = [pair for night in nights for pair in night]
    loose = _loose(machine, together)
    record = drift.record(machine, together, loose)
    errors = drift.left(record, ())
    usual = dict.fromkeys(drift.causes(machine.plant), OWN / 2 * float(errors @ errors))
    changes = drift.explain(record, (), usual).changes
    models = without or [machine] * len(nights)
    scale = _scale(models, nights, loose, changes, floors)
    records = [rested(model, night, scale, changes) for model, night in zip(models, nights, strict=True)]
    # a new night is compared with the champion's own model, so its errors on its own nights, which the models
    # without them do not have, are no change of the machine either
    held = [*records, *(rested(machine, night, scale, changes) for night in (nights if without else []))]
    estimates = np.array([[fit[1:] for fit in drift.alone(one, changes)] for one in held])
    noises = [noise(drift.by_output(one, drift.left(one, changes))) for one in records]
    misfits = np.array([misfit(one, changes) for one in records])
    return Baseline(
        scale, changes, *np.moveaxis(estimates, 2, 0), *map(np.array, zip(*noises, strict=True)), misfits
    )


def rested(machine: ProductionModel, segments: Segments, scale: Scatter, changes: Changes) -> DriftRecord:
    """Returns a record prepared with the surroundings in which it was made."""
    there, room = drift.room_of(machine, segments, scale, changes)
    return drift.record(machine, segments, there, room._replace(another_season=False))


def misfit(record: DriftRecord, changes: Changes) -> float:
    """Returns the weighted squared error per sample: near 1 on a record like the champion's own."""
    e = drift.left(record, changes)
    return float(e @ e) / max(sum(int(one.measured.sum()) for one in record.segments), 1)


def noise(errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the logarithm of the variance (p,) of errors (T, p) from one sample to the next, which slow
    changes do not affect, and its standard deviation from blocks."""
    steps = np.diff(errors, axis=0) ** 2 / 2
    whole = np.maximum(np.nanmean(steps, axis=0), 1e-12)
    parts = np.stack(
        [np.nan_to_num(np.nanmean(part, axis=0)) for part in np.array_split(steps, drift.BLOCKS)]
    )
    return np.log(whole), parts.std(axis=0, ddof=1) / np.sqrt(drift.BLOCKS) / whole


def _loose(machine: ProductionModel, together: Segments) -> Scatter:
    """Returns the scale before any night is known, with the variance of the errors as they are."""
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
    """Estimates the scatter of honest nights. With few nights a standard deviation may be too small by
    chance, so it is enlarged by Student's quantile and by the new night's own share."""
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
