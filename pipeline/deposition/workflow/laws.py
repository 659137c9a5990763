"""What train_ilc and compose_parts both stand on: the laws' settings and the noise of
section train_ilc, and the extruders of models.json."""

from typing import Any

import numpy as np

from pipeline.deposition.extruder import Extruder
from pipeline.deposition.learning.ilc import HoelzleSettings, InverseSettings
from pipeline.deposition.learning.training import LawSettings, Noise
from pipeline.deposition.workflow.settings import Printer, TrainIlc


def law_settings(settings: TrainIlc, printer: Printer) -> LawSettings:
    """Settings of both laws on this printer."""
    hoelzle, inverse = settings.hoelzle_2009, settings.model_inverse
    return LawSettings(
        printer.sample_time_s,
        printer.limits,
        HoelzleSettings(hoelzle.learning_gain, hoelzle.fast_zero_s, hoelzle.order, hoelzle.cutoff_hz),
        InverseSettings(inverse.identify_trials, inverse.floor, inverse.order, inverse.cutoff_hz),
        inverse.rise,
    )


def noise(settings: TrainIlc) -> Noise:
    """What does not repeat from trial to trial, as shares."""
    return Noise(
        settings.noise.white_percent / 100,
        settings.noise.drift_percent / 100,
        settings.noise.gain_percent / 100,
    )


def plain(extruder: Extruder) -> dict[str, float | None]:
    """As JSON: no lag is null."""
    return {name: float(value) if np.isfinite(value) else None for name, value in extruder._asdict().items()}


def extruders(models: dict[str, dict[str, Any]], which: str) -> dict[str, Extruder]:
    """The nominal extruders, or the true ones of simulated machines,
    of models.json by material: what `plain` made."""
    return {
        name: Extruder(**{key: np.inf if value is None else value for key, value in model[which].items()})
        for name, model in models.items()
        if which in model
    }
