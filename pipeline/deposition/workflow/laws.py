"""What train_ilc and compose_parts both stand on: the laws' settings and the noise of
section train_ilc, and the extruders of models.json."""

import math
from typing import Any

import numpy as np

from pipeline.deposition.composition import Learned
from pipeline.deposition.extruder import Extruder
from pipeline.deposition.gcode import Kind, Moves
from pipeline.deposition.ilc import HoelzleSettings, InverseSettings
from pipeline.deposition.training import LawSettings, Noise
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


def printing_acceleration(printer: Printer, learned: Learned, moves: Moves) -> float:
    """mm/s^2 for the printed moves of a part, such that the drive follows the flow of each of its materials,
    as identified, at the part's highest printing speed; inf where the drive follows any."""
    prints = (moves.kind == Kind.EXTRUDE) & (moves.length > 0)
    feeds = np.where(np.isfinite(moves.feed), moves.feed, printer.speed_mm_per_s)[prints]
    names = {one.name for one in printer.materials if one.tool in set(moves.tool[prints].tolist())}
    chains = [one.chain.extruder for one in learned.materials if one.material in names]
    if not chains:
        return math.inf
    return printer.printing_acceleration(
        [Extruder(e.gain, e.time_constant_s, yield_=e.yield_) for e in chains],
        min(float(feeds.max()), printer.gantry_speed_limit_mm_per_s),
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
