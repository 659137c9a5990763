"""What disturbances that are measured do to the outputs, learned from the record: a part fan, a filament's
feed, the speed of a screw, a sensor of the room. Every controller is learned without them and is told them
alike: inputs F (d - mean d) make up for what they do at rest.

A window model of the record, which is told inputs and disturbances, says both,

    y(t) = G_u u + G_d d + ...,    F = -pinv(G_u(1)) G_d(1),

with G(1) the steady gains.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pipeline.temperature.controllers import window
from pipeline.temperature.controllers.controller import FeedForward
from pipeline.temperature.plant import Plant, plant, simulate

LONGEST, ENOUGH = 24, 20  # samples of the window, and for each of its columns
BLOCKS = 8  # left out one by one: how sure a gain is
DETERMINED = 2.0  # deviations from zero of a gain that is fed forward


class Told(NamedTuple):
    """Disturbances d (q,): `effect` moves the outputs, from d less its `mean`, in °C; `high` is the level
    above which a twentieth of the record lies; `gain` F (m, q) in percent a unit, and its `deviation`."""

    effect: Plant
    mean: np.ndarray
    high: np.ndarray
    gain: np.ndarray
    deviation: np.ndarray

    @property
    def forward(self) -> FeedForward:
        """What is fed forward; a gain that the record does not tell from zero is not."""
        sure = np.abs(self.gain) >= DETERMINED * self.deviation
        return FeedForward(np.where(sure, self.gain, 0.0), self.mean)


def learn(acting: Sequence[np.ndarray], y: Sequence[np.ndarray], inputs: int) -> Told | None:
    """Of segments y (T, p) and `acting` (T, m + q), the disturbances after the `inputs` m. None if there are
    none, the record is too short for a window model, or that is unstable."""
    q, columns = acting[0].shape[1] - inputs, acting[0].shape[1] + y[0].shape[1]
    longest = min(LONGEST, sum(map(len, y)) // (ENOUGH * columns), min(map(len, y)) - 1)
    if q == 0 or longest < 1:
        return None
    model = _stable(acting, y, longest)
    if model is None:
        return None
    effect = model._replace(B=model.B[:, inputs:], D=model.D[:, inputs:], b=0 * model.b, d=0 * model.d)
    d = np.vstack(acting)[:, inputs:]
    left = [_stable(*_without(acting, y, k), longest) for k in range(BLOCKS)]
    gains = np.array([_forward(one, inputs) for one in left if one is not None])
    gain = _forward(model, inputs)
    # jackknife over blocks; a block without which there is no stable model leaves everything open
    whole = len(gains) == BLOCKS
    deviation = np.sqrt((BLOCKS - 1) * gains.var(axis=0)) if whole else np.full(gain.shape, np.nan)
    return Told(effect, d.mean(axis=0), np.quantile(d, 0.95, axis=0), gain, deviation)


def _stable(acting: Sequence[np.ndarray], y: Sequence[np.ndarray], longest: int) -> Plant | None:
    """The window model of a record; None if it is unstable, or the record too short for it."""
    long_enough = [k for k in range(len(y)) if len(y[k]) > longest]
    try:
        model = window.learn(
            [acting[k] for k in long_enough], [y[k] for k in long_enough], longest=longest, offset=True
        )
    except ValueError:
        return None
    form = window.observer_form(model)[0]
    return form if np.abs(np.linalg.eigvals(form.A)).max() < 1 else None


def _without(
    acting: Sequence[np.ndarray], y: Sequence[np.ndarray], block: int
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The record without one of BLOCKS equal parts of every segment."""

    def kept(parts: Sequence[np.ndarray]) -> list[np.ndarray]:
        ends = [np.linspace(0, len(part), BLOCKS + 1).astype(int)[block : block + 2] for part in parts]
        pieces = [(part[:first], part[last:]) for part, (first, last) in zip(parts, ends, strict=True)]
        return [piece for pair in pieces for piece in pair if len(piece)]

    return kept(acting), kept(y)


def _forward(model: Plant, inputs: int) -> np.ndarray:
    """F (m, q) of a window model."""
    steady = model.C @ np.linalg.solve(np.eye(model.n) - model.A, model.B) + model.D
    return -np.linalg.pinv(steady[:, :inputs]) @ steady[:, inputs:]


def at_mean(
    told: Told | None, acting: Sequence[np.ndarray], y: Sequence[np.ndarray], inputs: int
) -> list[np.ndarray]:
    """y (T, p) of each piece as it would be with every disturbance at its mean, at rest before the first
    sample; as recorded if nothing is told."""
    if told is None:
        return list(y)
    effect = told.effect
    moves = [piece[:, inputs:] - told.mean for piece in acting]
    rests = [np.linalg.solve(np.eye(effect.n) - effect.A, effect.B @ move[0]) for move in moves]
    return [
        piece - simulate(effect, move, rest)[1] for piece, move, rest in zip(y, moves, rests, strict=True)
    ]


def stored(told: Told) -> dict[str, tuple[np.ndarray, str, str]]:
    """As named arrays with unit and meaning, for an artifact; `restored` reads them back."""
    return {
        "A": (told.effect.A, "1", "state matrix of what disturbances do"),
        "B": (told.effect.B, "per unit", "how disturbances enter it"),
        "C": (told.effect.C, "degC", "how it moves the outputs"),
        "D": (told.effect.D, "degC per unit", "how disturbances move the outputs at once"),
        "sample_time_s": (np.array(told.effect.sample_time_s), "s", "one step"),
        "mean": (told.mean, "unit", "of each disturbance"),
        "high": (told.high, "unit", "95 % of the record lie below"),
        "gain": (told.gain, "percent per unit", "inputs that make up for a disturbance"),
        "deviation": (told.deviation, "percent per unit", "of the gain"),
    }


def restored(arrays: dict[str, np.ndarray]) -> Told:
    effect = plant(*(arrays[name] for name in "ABCD"), sample_time_s=float(arrays["sample_time_s"]))
    return Told(effect, *(arrays[name] for name in ("mean", "high", "gain", "deviation")))
