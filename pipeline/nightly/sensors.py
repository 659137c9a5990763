"""Finds sensors of a recording that stand still while the machine moves, by the same test as a controller's
supervisor, sample by sample.

The supervisor's forecasts last 36 samples, in which a slow zone hardly moves. A record is available as a
whole, so it is also tested with samples 4 and 16 times as far apart. The model over s samples is

    x(t+s) = A^s x(t) + (I + A + ... + A^(s-1)) (B u + b),    u the mean of the inputs meanwhile

If a good loop holds a zone constant, the model predicts no move that could be missing. But a sensor whose
noise is not small compared with its step still turns back every few samples, and a stuck one does not.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from pipeline.deploy import assembly, supervise
from pipeline.deploy.supervise import OPEN, SPACING, STILL, WINDOWS, Signal, Supervision
from pipeline.temperature.controllers.law import Plant
from pipeline.temperature.plant import strictly_proper
from pipeline.temperature.settings import Plant as Machine

Segments = Sequence[tuple[np.ndarray, np.ndarray]]
KINDS = (OPEN, STILL)
SPACINGS = (1, 4, 16)  # distances between tested samples
GONE = 30  # samples without a number that an honest log may have in total
ON = 0.01  # fraction of its range above which a heater counts as on
LASTS = 60  # samples for which a sensor stays in doubt: one that only seems to stand still soon moves again
SHARE = 1 / 3  # of a record, unless the doubt lasts to its end: a good loop may hold a coarse sensor still
RESTLESS = 0.15  # fraction of samples at which a sensor turns back if its noise is 1/4 of its step or more
MISSING = 30.0  # missing reversals after which such a sensor counts as stuck


class SensorFault(NamedTuple):
    """An output that stands still or gives no number: its name, one of KINDS, the reason in one sentence, and
    the sample of the record at which it is certain."""

    output: str
    kind: int
    sentence: str
    sample: int

    @property
    def rank(self) -> tuple[int, int]:
        """Returns a key that sorts the most certain fault first."""
        return self.kind, self.sample


def smallest_changes(records: Sequence[Segments], unmoved: float = supervise.MOST_STEP_DEGC) -> np.ndarray:
    """Returns the smallest change (p,) of each sensor in the records, in °C; `unmoved` if it never
    changes."""
    moves = np.concatenate([np.abs(np.diff(y, axis=0)) for record in records for _, y in record])
    least = np.where(moves > 1e-9, moves, np.inf).min(axis=0)
    return np.where(np.isfinite(least), least, unmoved)


def reversals(records: Sequence[Segments]) -> np.ndarray:
    """Returns the fraction (p,) of samples of honest records at which each sensor turns back after one
    sample. It is low for a sensor with noise that is small compared with its step."""
    turns = np.concatenate([
        np.diff(y[:-1], axis=0) * np.diff(y[1:], axis=0) < 0 for record in records for _, y in record
    ])  # fmt: skip
    return turns.mean(axis=0)


def faults(
    model: Plant,
    machine: Machine,
    segments: Segments,
    *,
    noise: np.ndarray,
    steps: np.ndarray,
    reversals: np.ndarray,
) -> list[SensorFault]:
    """Returns the sensors in doubt in a record of inputs u (T, m) and readings y (T, p), including masked
    ones, the most certain first. `model`: of the machine; `noise` (p,) and `steps` (p,): of its sensors in
    °C; `reversals` (p,): their fraction of reversals in honest records."""
    wired = supervise.Machine(
        tuple(Signal(one.name, supervise.PERCENT, one.low, one.high) for one in machine.inputs),
        tuple(
            Signal(
                one.name,
                supervise.DEGC,
                -np.inf if one.low is None else one.low,
                np.inf if one.high is None else one.high,
            )
            for one in machine.outputs
        ),
        machine.sample_time_s,
    )
    supervision = assembly.supervision(strictly_proper(model), wired, noise)
    # the logger may now round to coarser steps, with which a healthy sensor turns back less often
    tonight = np.minimum(smallest_changes([segments], 0.0), supervise.MOST_STEP_DEGC)
    often = np.where(tonight > 2 * np.maximum(steps, noise), 0.0, reversals)
    steps = np.maximum(steps, tonight)
    found = {fault.output: fault for fault in _find_stuck(supervision, wired, segments, often)}
    for spacing in SPACINGS:
        rarer = wired._replace(sample_time_s=spacing * wired.sample_time_s)
        s = assembly.supervision(_rarer(strictly_proper(model), spacing), rarer, noise)
        for fault in _follow(s, rarer, segments, spacing, steps):
            before = found.get(fault.output, fault)
            found[fault.output] = min(before, fault, key=lambda one: one.rank)
    return sorted(found.values(), key=lambda one: one.rank)


def _find_stuck(
    s: Supervision, machine: supervise.Machine, segments: Segments, reversals: np.ndarray
) -> Iterator[SensorFault]:
    """Yields every sensor that gives the same reading for a third of the record while its heater is on,
    although it should have turned back many times meanwhile."""
    begin, samples = 0, sum(len(y) for _, y in segments)
    for u, y in segments:
        for i in np.flatnonzero(reversals >= RESTLESS):
            heater = _heater_of(s, int(i))
            ends = np.flatnonzero(np.diff(y[:, i], append=np.nan) != 0) + 1
            starts = np.r_[0, ends[:-1]]
            first, last = max(zip(starts, ends, strict=True), key=lambda run: run[1] - run[0])
            enough = int(np.ceil(max(SHARE * samples, LASTS, MISSING / reversals[i])))
            given = u[first:last, heater].mean() - s.low[heater]
            if last - first >= enough and given > ON * (s.high - s.low)[heater]:
                words = _sentence(s, machine, STILL, int(i), y[first, i])
                yield SensorFault(machine.outputs[i].name, STILL, words, begin + first + enough)
        begin += len(y)


def _heater_of(s: Supervision, output: int) -> int:
    """Returns the input to which an output responds most."""
    return int(s.input_of[int((s.of_input == output).argmax())])


def _rarer(model: Plant, spacing: int) -> Plant:
    """Returns the model over `spacing` samples."""
    total, power = np.zeros_like(model.A), np.eye(model.n)
    for _ in range(spacing):
        total, power = total + power, power @ model.A
    return model._replace(
        A=power, B=total @ model.B, b=total @ model.b, sample_time_s=spacing * model.sample_time_s
    )


def _follow(
    s: Supervision, machine: supervise.Machine, segments: Segments, spacing: int, steps: np.ndarray
) -> Iterator[SensorFault]:
    """Yields every sensor in doubt, once."""
    silent, told, begin = np.zeros(len(s.d), int), set(), 0
    last = sum(len(y) for _, y in segments) - 1
    heaters = [_heater_of(s, i) for i in range(len(s.d))]
    for u, y in segments:
        k, doubtful = supervise.kept(s), np.zeros((len(KINDS), len(s.d)), int)
        unfounded = doubtful > 0
        k.quantum[:] = steps
        for t in range(0, len(y), spacing):
            supervise.follow(s, k, y[t], u[max(t - spacing, 0) : max(t, 1)].mean(axis=0), min(t, 1))
            k.asked[:] = u[t]
            k.clock_s[1] += s.sample_time_s
            silent += spacing * (k.bad > 0)
            there = k.since[list(KINDS), : len(s.d)] >= 0
            if (there & (doubtful == 0)).any():
                before = u[max(t - spacing * WINDOWS * SPACING, 0) : t + 1, heaters]
                # moves of the model alone, with the machine cold and off, are no evidence
                off = before.max(axis=0) - s.low[heaters] < ON * (s.high - s.low)[heaters]
                unfounded[1:] |= (there & (doubtful == 0))[1:] & off
            unfounded &= there
            doubtful = np.where(there & ~unfounded, doubtful + spacing, 0)
            ends = begin + t + spacing > last
            enough = LASTS if ends else max(LASTS, SHARE * last)
            certain = np.vstack([there[:1] & (silent >= GONE), doubtful[1:] >= enough])
            for which, i in np.argwhere(certain):
                if i not in told:
                    told.add(i)
                    words = _sentence(s, machine, KINDS[which], int(i), y[t, i])
                    yield SensorFault(machine.outputs[i].name, KINDS[which], words, begin + t)
        begin += len(y)


def _sentence(s: Supervision, machine: supervise.Machine, kind: int, i: int, reading: float) -> str:
    if kind == OPEN:
        return supervise.sentence(s, machine, OPEN, i, reading)
    heater = machine.inputs[_heater_of(s, i)].name
    return f"{machine.outputs[i].name} stands still at {reading:.1f} °C while {heater} heats."
