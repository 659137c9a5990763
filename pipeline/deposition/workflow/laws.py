"""What train_ilc and compose_parts both stand on: the laws' settings and the noise of
section train_ilc, and the extruders of models.json."""

from typing import Any

import numpy as np

from pipeline.deposition.extruder import Extruder
from pipeline.deposition.training import Noise, Settings
from pipeline.deposition.workflow.settings import Printer, TrainIlc


def settings(p: TrainIlc, printer: Printer) -> Settings:
    """Of the paper's law and of ours, on this printer."""
    paper, law = p.paper, p.law
    return Settings(
        printer.sample_time_s, printer.limit, paper.learning_gain, paper.fast_zero_s, paper.order,
        paper.cutoff_hz,
        law.identify_trials, law.floor, law.order, law.cutoff_hz, law.rise,
    )  # fmt: skip


def noise(p: TrainIlc) -> Noise:
    """What does not repeat from trial to trial, as shares."""
    return Noise(p.noise.white_percent / 100, p.noise.drift_percent / 100, p.noise.gain_percent / 100)


def plain(extruder: Extruder) -> dict[str, float | None]:
    """As JSON: no lag is null."""
    return {name: float(value) if np.isfinite(value) else None for name, value in extruder._asdict().items()}


def extruders(models: dict[str, dict[str, Any]], which: str) -> dict[str, Extruder]:
    """The nominal extruders, or the true ones of simulated machines,
    of models.json by material: what `plain` made."""
    return {
        name: Extruder(**{key: np.inf if value is None else value for key, value in found[which].items()})
        for name, found in models.items()
        if which in found
    }
