"""Recording mistakes: a record whose signals are not what they are labelled as.

Examples are swapped sensors or inputs, °F or K instead of °C, a factor of ten, or a clock shift between
inputs and outputs. A mistake is accepted if undoing it makes the record fit BETTER times as well, if the
remaining error is no more than on an honest record, and if no change of the machine explains as much. A
drifted machine must never be dismissed as a badly written record. If the machine would have had to change
impossibly, the likeliest mistake is still named.
"""

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from pipeline.nightly import baseline, drift
from pipeline.nightly.baseline import Baseline
from pipeline.nightly.drift import ProductionModel, Segments

BETTER = 30.0  # by which the mean squared error must fall
HONEST = 2.0  # times the largest error of the champion's own records that an honest record may leave
AS_MUCH = 2.0  # a change of the machine that leaves up to this many times the error explains as much
ROOM = drift.RESTLESS._replace(another_season=False)  # the air is not 48 °C warmer: that is °F
# ratio of the remaining errors up to which a record cannot distinguish two mistakes, such as one sensor or
# every one
ALIKE = 2.0
# clock shifts in samples that are tried first, before those between them
CLOCKS = [late for far in (2, *range(4, 129, 4)) for late in (far, -far)]
# what was written, and the factor and the offset that undo it
OF_SENSORS = (
    ("in °F where °C is declared", 1 / 1.8, -32 / 1.8),
    ("in K where °C is declared", 1.0, -273.15),
    ("written 10 times too large", 0.1, 0.0),
    ("written 10 times too small", 10.0, 0.0),
)
OF_INPUTS = (
    ("in shares of 1 where percent is declared", 100.0, 0.0),
    ("in counts of 255 where percent is declared", 100 / 255, 0.0),
    *OF_SENSORS[2:],
)


class Mistake(NamedTuple):
    """`words`: what is wrong with a record; `undone`: the record without the mistake; `left`: its mean
    squared error then; `better`: by what factor the error was larger."""

    words: str
    undone: Segments
    left: float
    better: float

    @property
    def reason(self) -> str:
        """Returns why the record is set aside, in one sentence."""
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
    """Returns the recording mistake of a record; None if it has none, or if a change of the machine explains
    it as well. Raises ValueError if the record is too short."""
    asked = drift.record(machine, segments, own.scale, ROOM)
    as_is = baseline.misfit(asked, own.changes)
    if as_is < BETTER:
        return None
    mistake = likeliest(machine, segments, own, inputs=inputs, outputs=outputs)
    if mistake.left > honest(own) or mistake.better < BETTER:
        return None
    samples = sum(int(one.measured.sum()) for one in asked.segments)
    every_delay = drift.DriftCause("delay", -1)  # this is the same as a shifted clock
    explained = [fit.explained for fit in drift.alone(asked, own.changes) if fit.cause != every_delay]
    return None if as_is - max(explained) / samples < AS_MUCH * mistake.left else mistake


def honest(own: Baseline) -> float:
    """Returns the largest mean squared error of an honest record, in units of that of the champion's own."""
    return HONEST * float(max(own.misfit.max(), 1.0))


def likeliest(
    machine: ProductionModel,
    segments: Segments,
    own: Baseline,
    *,
    inputs: Sequence[str],
    outputs: Sequence[str],
) -> Mistake:
    """Returns the mistake that, if undone, explains the record best, whether that is good enough or not.
    Mistakes that explain as much are named with it. Raises ValueError if the record is too short.

    Sensors that are scaled down err less for that reason alone. So the likelihood of the record as written is
    compared,
    e|^2 / samples - 2 log scale, which converts the density of the undone record to the written units.
    """

    def left(undone: Segments) -> float:
        try:
            return baseline.misfit(drift.record(machine, undone, own.scale, ROOM), own.changes)
        except ValueError:  # nothing is left of it
            return np.inf

    as_is = baseline.misfit(drift.record(machine, segments, own.scale, ROOM), own.changes)
    tried = []
    for words, side, order, factor, offset in _list_written(inputs, outputs):
        undone: Segments = [
            (u, y[:, order] * factor + offset) if side else (u[:, order] * factor + offset, y)
            for u, y in segments
        ]
        rest = left(undone)
        scale = np.log(factor).mean() if side else 0.0
        tried.append((rest - 2 * scale, rest, words, undone))
    costs = {late: left(_move(segments, late)) for late in CLOCKS}
    nearest = min(costs, key=costs.__getitem__)
    costs |= {late: left(_move(segments, late)) for late in range(nearest - 3, nearest + 4) if late}
    late = min(costs, key=costs.__getitem__)
    words = f"{abs(late) * machine.plant.sample_time_s:g} s {'late' if late > 0 else 'early'}"
    words = f"the clock of the outputs is {words} against that of the inputs"
    tried.append((costs[late], costs[late], words, _move(segments, late)))
    (least, rest, words, undone), *others = sorted(tried, key=lambda one: one[0])
    as_good = [
        other
        for cost, remainder, other, _ in others[:2]
        if cost < least + (ALIKE - 1) * rest and remainder < (as_is + rest) / 2
    ]
    return Mistake(", or ".join([words, *as_good]), undone, rest, as_is / rest)


def _list_written(
    inputs: Sequence[str], outputs: Sequence[str]
) -> Iterator[tuple[str, int, np.ndarray, np.ndarray, np.ndarray]]:
    """Yields swapped signals, and wrong units and factors of all signals and of each. Each mistake is given
    in words, with its side, inputs (0) or outputs (1), and what undoes it: the order of the columns, their
    factors and offsets."""
    for side, noun, names, kinds in ((1, "sensor", outputs, OF_SENSORS), (0, "input", inputs, OF_INPUTS)):
        order, every = np.arange(len(names)), np.ones(len(names))
        for i, j in itertools.combinations(order, 2):
            swapped = order.copy()
            swapped[[i, j]] = j, i
            yield f"the {noun}s {names[i]} and {names[j]} are swapped", side, swapped, every, 0 * every
        for name, at in ((f"every {noun}", every), *zip(names, np.eye(len(names)), strict=True)):
            for words, factor, offset in kinds:
                yield f"{name} is {words}", side, order, factor**at, offset * at


def _move(segments: Segments, late: int) -> Segments:
    """Moves the outputs forward by `late` samples; samples without a partner are left out."""
    if late > 0:
        return [(u[:-late], y[late:]) for u, y in segments if len(y) > late]
    return [(u[-late:], y[:late]) for u, y in segments if len(y) > -late]
