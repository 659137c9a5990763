"""Learns from the record the effect of measured disturbances on the outputs: a part fan, a filament's feed,
the speed of a screw, a sensor of the room. Every controller is learned without them and gets the same
feed-forward: inputs F (d - mean d), which compensate their steady effect.

A window model of the record with inputs and disturbances gives both effects,

    y(t) = G_u u + G_d d + ...,    F = -pinv(G_u(1)) G_d(1),

with G(1) the steady gains. An input acts later than the disturbance: cold filament is in the block at once,
but a heater's power arrives only through the cartridge. So a change of d adds a kick to F d
(law.FeedForward). Its size gives the least error of the outputs over the AHEAD samples after a step of d.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pipeline.temperature.controllers import window
from pipeline.temperature.controllers.law import FADES, FeedForward
from pipeline.temperature.plant import Plant, plant, simulate

LONGEST, ENOUGH = 24, 20  # longest window in samples, and samples required for each of its columns
BLOCKS = 8  # of the record, left out one by one to find the deviation of a gain
DETERMINED = 2.0  # deviations: a smaller gain is not fed forward
AHEAD, LONGEST_LEAD = 60, 10.0  # samples
OWN = 0.005  # share of a disturbance's variance that inputs and other disturbances do not explain


class Told(NamedTuple):
    """The learned disturbances d (q,). `effect`: plant from d less its `mean` to the outputs in °C; `high`:
    the level that d exceeds in a twentieth of the record; `gain`: F (m, q) in percent per unit; `deviation`:
    standard deviation of the gain; `lead` (q,) in samples."""

    effect: Plant
    mean: np.ndarray
    high: np.ndarray
    gain: np.ndarray
    deviation: np.ndarray
    lead: np.ndarray

    @property
    def forward(self) -> FeedForward:
        """The feed-forward. A gain that cannot be told from zero in the record is zero."""
        sure = np.abs(self.gain) >= DETERMINED * self.deviation
        return FeedForward(np.where(sure, self.gain, 0.0), self.mean, self.lead)


def learn(acting: Sequence[np.ndarray], y: Sequence[np.ndarray], inputs: int) -> Told | None:
    """Learns the disturbances of segments y (T, p) and `acting` (T, m + q), which has the `inputs` m first. A
    disturbance that is constant, or only repeats other signals, has no effect and no gain. Returns None if
    all are like that, if the record is too short for a window model, or if the model is unstable."""
    whole = np.vstack(acting)
    q, columns = whole.shape[1] - inputs, whole.shape[1] + y[0].shape[1]
    tells = [k for k in range(q) if _own_share(whole, inputs + k) >= OWN]
    longest = min(LONGEST, len(whole) // (ENOUGH * columns), max(map(len, y)) - 1)
    if not tells or longest < 1:
        return None
    kept = [*range(inputs), *(inputs + k for k in tells)]
    acting = [piece[:, kept] for piece in acting]
    model = _stable(acting, y, longest)
    if model is None:
        return None
    B, D = np.zeros((model.n, q)), np.zeros((model.p, q))
    B[:, tells], D[:, tells] = model.B[:, inputs:], model.D[:, inputs:]
    effect = model._replace(B=B, D=D, b=0 * model.b, d=0 * model.d)
    left = [_stable(*_without(acting, y, k), longest) for k in range(BLOCKS)]
    gains = np.array([_forward(one, inputs) for one in left if one is not None])
    gain, deviation = np.zeros((inputs, q)), np.full((inputs, q), np.nan)
    gain[:, tells] = _forward(model, inputs)
    # jackknife over blocks; if the model without one block is unstable, the deviation is unknown (NaN)
    if len(gains) == BLOCKS:
        deviation[:, tells] = np.sqrt((BLOCKS - 1) * gains.var(axis=0))
    d, lead = whole[:, inputs:], np.zeros(q)
    # the median of the models without one block, because that of the whole record may be chance
    lead[tells] = np.median([_lead(one, inputs) for one in left if one is not None] or [[0.0]], axis=0)
    return Told(effect, d.mean(axis=0), np.quantile(d, 0.95, axis=0), gain, deviation, lead)


def _own_share(whole: np.ndarray, column: int) -> float:
    """Returns the share of a column's variance that the other columns (T, .) and a constant do not explain; 0
    if the column is constant."""
    others = np.column_stack([np.delete(whole, column, axis=1), np.ones(len(whole))])
    scale = np.maximum(np.abs(others).max(axis=0), 1e-300)
    mine = whole[:, column]
    left = mine - others @ (np.linalg.lstsq(others / scale, mine, rcond=None)[0] / scale)
    moves = np.ptp(mine) > 1e-9 * max(float(np.abs(mine).max()), 1.0)
    return float(left.var() / mine.var()) if moves else 0.0


def _stable(acting: Sequence[np.ndarray], y: Sequence[np.ndarray], longest: int) -> Plant | None:
    """Returns the window model of a record; None if it is unstable or the record is too short for it."""
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
    """Returns the record without one of BLOCKS equal parts of every segment."""

    def kept(parts: Sequence[np.ndarray]) -> list[np.ndarray]:
        ends = [np.linspace(0, len(part), BLOCKS + 1).astype(int)[block : block + 2] for part in parts]
        pieces = [(part[:first], part[last:]) for part, (first, last) in zip(parts, ends, strict=True)]
        return [piece for pair in pieces for piece in pair if len(piece)]

    return kept(acting), kept(y)


def _forward(model: Plant, inputs: int) -> np.ndarray:
    """Returns F (m, q) of a window model."""
    steady = model.C @ np.linalg.solve(np.eye(model.n) - model.A, model.B) + model.D
    return -np.linalg.pinv(steady[:, :inputs]) @ steady[:, inputs:]


def _lead(model: Plant, inputs: int) -> np.ndarray:
    """Returns the lead in samples (q,) with which the kick of each disturbance gives the least squares of the
    outputs after a step of it, without feedback."""
    F, q = _forward(model, inputs), model.B.shape[1] - inputs
    step, kick, lead = np.ones(AHEAD), FADES ** np.arange(AHEAD), np.zeros(q)
    still = model._replace(b=0 * model.b, d=0 * model.d)
    for k in range(q):
        acts = np.zeros((AHEAD, inputs + q))
        acts[:, :inputs], acts[:, inputs + k] = step[:, None] * F[:, k], step
        left = simulate(still, acts, np.zeros(model.n))[1]
        acts[:, :inputs], acts[:, inputs + k] = kick[:, None] * F[:, k], 0.0
        mends = simulate(still, acts, np.zeros(model.n))[1]
        energy = float((mends**2).sum())
        lead[k] = np.clip(-float((left * mends).sum()) / energy, 0.0, LONGEST_LEAD) if energy > 0 else 0.0
    return lead


def at_mean(
    told: Told | None, acting: Sequence[np.ndarray], y: Sequence[np.ndarray], inputs: int
) -> list[np.ndarray]:
    """Returns y (T, p) of each piece as it would be with every disturbance at its mean. Before the first
    sample the disturbances are assumed constant. If `told` is None, returns y as recorded."""
    if told is None:
        return list(y)
    effect = told.effect
    moves = [piece[:, inputs:] - told.mean for piece in acting]
    rests = [np.linalg.solve(np.eye(effect.n) - effect.A, effect.B @ move[0]) for move in moves]
    return [
        piece - simulate(effect, move, rest)[1] for piece, move, rest in zip(y, moves, rests, strict=True)
    ]


def stored(told: Told) -> dict[str, tuple[np.ndarray, str, str]]:
    """Returns the disturbances as named arrays with unit and meaning, for an artifact; `restored` reads them
    back."""
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
        "lead": (told.lead, "samples", "by which a change adds to what makes up for it"),
    }


def restored(arrays: dict[str, np.ndarray]) -> Told:
    effect = plant(*(arrays[name] for name in "ABCD"), sample_time_s=float(arrays["sample_time_s"]))
    return Told(effect, *(arrays[name] for name in ("mean", "high", "gain", "deviation", "lead")))
