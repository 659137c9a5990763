"""Mistakes of recording: a record that is not what it says it is.

Swapped sensors or inputs, °F or K for °C, a factor of ten, a clock that is shifted between inputs and
outputs. One is believed if undoing it explains the record BETTER times as well as taking it at its word, what
is left is no more than on an honest record, and no change of the machine explains as much: a drifted machine
must never be silenced as a badly written record. If the machine would have had to change as none can, the
likeliest mistake is named all the same.
"""

import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from pipeline.nightly import baseline, drift
from pipeline.nightly.baseline import Baseline
from pipeline.nightly.drift import ProductionModel, Segments

BETTER = 30.0  # by which the mean squared error must fall
HONEST = 2.0  # of the largest of the champion's own records: what an honest one may leave
AS_MUCH = 2.0  # a change of the machine that leaves up to so much more explains as much
ROOM = drift.RESTLESS._replace(another_season=False)  # the air is not 48 °C warmer: that is °F
# what is left with two mistakes undone that a record does not tell apart: one sensor, or every one
ALIKE = 2.0
FARTHEST = 128  # samples by which a clock is looked for

Undo = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


class Mistake(NamedTuple):
    """What is wrong with a record in words, the record with that undone, the mean squared error that it then
    leaves, and how many times that was larger."""

    words: str
    undone: Segments
    left: float
    better: float

    @property
    def reason(self) -> str:
        """Why the record is set aside, in one sentence."""
        return (
            f"{self.words}: undone, the record fits the champion's model {self.better:.0f} times better; "
            "mend it and put it back"
        )


def found(
    machine: ProductionModel,
    segments: Segments,
    own: Baseline,
    *,
    inputs: Sequence[str],
    outputs: Sequence[str],
) -> Mistake | None:
    """The mistake that was made in writing a record; None if it is what it says, or if a change of the
    machine explains it as well. Raises ValueError if the record is too short."""
    asked = drift.record(machine, segments, own.scale, ROOM)
    as_is = baseline.misfit(asked, own.changes)
    if as_is < BETTER:
        return None
    mistake = likeliest(machine, segments, own, inputs=inputs, outputs=outputs)
    if mistake.left > honest(own) or mistake.better < BETTER:
        return None
    samples = sum(int(one.measured.sum()) for one in asked.segments)
    every_delay = drift.DriftCause("delay", -1)  # which is a shifted clock by another name
    explained = [fit.explained for fit in drift.alone(asked, own.changes) if fit.cause != every_delay]
    return None if as_is - max(explained) / samples < AS_MUCH * mistake.left else mistake


def honest(own: Baseline) -> float:
    """The mean squared error that an honest record may leave, in that of the champion's own."""
    return HONEST * float(max(own.misfit.max(), 1.0))


def likeliest(
    machine: ProductionModel,
    segments: Segments,
    own: Baseline,
    *,
    inputs: Sequence[str],
    outputs: Sequence[str],
) -> Mistake:
    """Of all mistakes the one that explains the record best with it undone, be that well or not; mistakes
    that explain as much are named with it. Raises ValueError if the record is too short.

    Sensors that are scaled down err less for that alone: what is compared is the likelihood of the record as
    it was written, |e|^2 / samples - 2 log scale, which takes the density of what was undone to its units.
    """
    as_is = baseline.misfit(drift.record(machine, segments, own.scale, ROOM), own.changes)

    def left(undone: Segments) -> float:
        try:
            return baseline.misfit(drift.record(machine, undone, own.scale, ROOM), own.changes)
        except ValueError:  # nothing is left of it
            return np.inf

    tried = []
    for words, undo, scale in (*_swaps(inputs, outputs), *_units(inputs, outputs)):
        undone = [undo(u, y) for u, y in segments]
        rest = left(undone)
        tried.append((rest - 2 * np.log(scale), rest, words, undone))
    rest, words, undone = _clock(segments, left, machine.plant.sample_time_s)
    tried.append((rest, rest, words, undone))
    (least, rest, words, undone), *others = sorted(tried, key=lambda one: one[0])
    as_good = [
        other
        for cost, remainder, other, _ in others[:2]
        if cost < least + (ALIKE - 1) * rest and remainder < (as_is + rest) / 2
    ]
    return Mistake(", or ".join([words, *as_good]), undone, rest, as_is / rest)


def _swaps(inputs: Sequence[str], outputs: Sequence[str]) -> Iterator[tuple[str, Undo, float]]:
    for j, i in itertools.combinations(range(len(outputs)), 2):
        words = f"the sensors {outputs[j]} and {outputs[i]} are swapped"
        yield words, lambda u, y, at=(i, j): (u, _swapped(y, at)), 1.0
    for j, i in itertools.combinations(range(len(inputs)), 2):
        words = f"the inputs {inputs[j]} and {inputs[i]} are swapped"
        yield words, lambda u, y, at=(i, j): (_swapped(u, at), y), 1.0


def _swapped(values: np.ndarray, at: tuple[int, int]) -> np.ndarray:
    values = values.copy()
    values[:, list(at)] = values[:, list(at)[::-1]]
    return values


def _units(inputs: Sequence[str], outputs: Sequence[str]) -> Iterator[tuple[str, Undo, float]]:
    """Wrong units and factors, of every signal and of each; last the factor by which undoing it scales the
    outputs' errors, their geometric mean."""
    every = slice(None)
    sensors = (
        ("in °F where °C is declared", 1 / 1.8, -32 / 1.8),
        ("in K where °C is declared", 1.0, -273.15),
        ("written 10 times too large", 0.1, 0.0),
        ("written 10 times too small", 10.0, 0.0),
    )
    heaters = (
        ("in shares of 1 where percent is declared", 100.0),
        ("in counts of 255 where percent is declared", 100 / 255),
        ("written 10 times too large", 0.1),
        ("written 10 times too small", 10.0),
    )
    for at, name in ((every, "every sensor"), *enumerate(outputs)):
        for unit, factor, offset in sensors:
            change = (at, factor, offset)
            scale = factor if at == every else factor ** (1 / len(outputs))
            yield f"{name} is {unit}", lambda u, y, change=change: (u, _scaled(y, *change)), scale
    for at, name in ((every, "every input"), *enumerate(inputs)):
        for unit, factor in heaters:
            change = (at, factor, 0.0)
            yield f"{name} is {unit}", lambda u, y, change=change: (_scaled(u, *change), y), 1.0


def _scaled(values: np.ndarray, at: int | slice, factor: float, offset: float) -> np.ndarray:
    values = values.copy()
    values[:, at] = factor * values[:, at] + offset
    return values


def _clock(
    segments: Segments, left: Callable[[Segments], float], sample_time_s: float
) -> tuple[float, str, Segments]:
    """Outputs written so many samples later than inputs, or earlier: the best of a grid, then of its
    neighbours."""
    grid = [k * side for k in (2, *range(4, FARTHEST + 1, 4)) for side in (1, -1)]
    costs = {k: left(_moved(segments, k)) for k in grid}
    at, step = min(costs, key=costs.__getitem__), 2
    while step:
        for k in (at - step, at + step):
            if k and k not in costs:
                costs[k] = left(_moved(segments, k))
        at, step = min(costs, key=costs.__getitem__), step // 2
    word = "late" if at > 0 else "early"
    words = f"the clock of the outputs is {abs(at) * sample_time_s:g} s {word} against that of the inputs"
    return costs[at], words, _moved(segments, at)


def _moved(segments: Segments, late: int) -> Segments:
    """The outputs brought forward by so many samples; what has no partner is left out."""
    if late > 0:
        return [(u[:-late], y[late:]) for u, y in segments if len(y) > late]
    return [(u[-late:], y[:late]) for u, y in segments if len(y) > -late]
