"""The supervisor round a law: fifteen kinds of fault, each with a declared safe mode, its reason in one
sentence, and the way back.

Every sample it compares what was measured with what the model forecast (innovations.py). Some faults are seen
as they are: a reading that is no number, out of range, or the same for too long; a clock, a command, a
reference out of reach; a zone that is heated and does not warm (Klipper's verify_heater). The others show in
the innovation. Two-sided sums of it (CUSUM) raise the alarm, from which the inputs are held; then the bank of
hypotheses says which input or sensor explains it, within DECIDED_BY samples.

What one record cannot tell apart is said so: a cause names the other that would show the same, and its mode
is safe for both. `Kept` is all that is remembered: arrays of fixed size, plain arithmetic.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from pipeline.runtime import innovations
from pipeline.runtime.signals import Machine
from pipeline.temperature.plant import Plant, markov_parameters, strictly_proper

KINDS = (
    "heater_stuck_on",
    "heater_stuck_off",
    "heater_weak",
    "thermal_runaway",
    "out_of_range",
    "sensor_nan",
    "sensor_frozen",
    "sensor_offset",
    "sensor_slow",
    "sensor_noisy",
    "command_not_applied",
    "clock_jump",
    "deadline_missed",
    "model_no_longer_right",
    "reference_out_of_reach",
)
(ON, OFF, WEAK, RUNAWAY, RANGE, NAN, FROZEN, OFFSET, SLOW, NOISY, COMMAND, CLOCK, DEADLINE, MODEL, REACH) = (
    range(len(KINDS))
)
MODES = ("law", "hold", "pi", "off")
LAW, HOLD, PI, OFF_MODE = range(4)
# off wins over hold, hold over PI: where several causes are there
SEVERITY = np.array([0, 2, 1, 3])
# the declared safe mode of each kind
SAFE = {
    "heater_stuck_on": "off",
    "heater_stuck_off": "off",
    "heater_weak": "pi",
    "thermal_runaway": "off",
    "out_of_range": "off",
    "sensor_nan": "hold",
    "sensor_frozen": "hold",
    "sensor_offset": "hold",
    "sensor_slow": "hold",
    "sensor_noisy": "hold",
    "command_not_applied": "off",
    "clock_jump": "hold",
    "deadline_missed": "hold",
    "model_no_longer_right": "pi",
    "reference_out_of_reach": "pi",
}
# kinds that stay until a person acknowledges them: in their safe mode nothing could show that they are gone
LATCHED = ("heater_stuck_on", "heater_stuck_off", "heater_weak", "thermal_runaway", "sensor_slow")
OF_INPUT = (ON, OFF, WEAK, COMMAND)
OF_OUTPUT = (RUNAWAY, RANGE, NAN, FROZEN, OFFSET, SLOW, NOISY)

ALARM = 8.5  # of a sum of innovations, in deviations: 7 gave two false ones in 120 h of a room that jumps
DECIDED_AFTER, DECIDED_BY = 4, 9  # samples from the alarm: where one cause is clear, and at the latest
TOLD_APART = 8.0  # of -2 log likelihood, by which one cause is clear of another, or of none
UNEXPLAINED, UNEXPLAINED_SHARE = 12.0, 0.3  # mean square that is left of an output, and its share
DEAD_SHARE = 0.75  # of its command that a heater lacks, from which it is off, not weak
MOST_Z = 100.0  # deviations that count
FORGETS = 1 / 8  # share a sample of the mean squares by which noise is told
NOISY_SQUARE, NOISY_LAG = 6.0, 0.3  # mean square, and its share at lag one, of a noisy sensor
CHANCE = 1e-9  # that a sensor repeats itself so often
REPEATS_LEAST = 5
SETTLED_DEGC = 5.0  # from the target: where inputs are such as can be held
HELD_SHARE = 1 / 30  # share a sample of the mean of inputs that hold
HEAT = 0.06  # share of the strongest input's range: heat that a zone gains or loses, and no input explains
SLOWLY = 1 / 100  # share a sample of the mean drift, from which such heat is counted
SURELY = 8.0  # deviations of the observer's drift at rest, and
LEFT_OPEN = 2.0  # of what the spread leaves open of it
APPLIED = 0.01  # share of an input's range by which it may differ from the command


class Supervision(NamedTuple):
    """Thresholds and declared safe modes, the arrays by kind (k,), input (m,) or output (p,).

    `mode` (k,) the number in MODES, `back_s` (k,) seconds without the cause after which the law takes over
    again, inf: a person acknowledges it. low, high (p,) in degC between which a reading is one. peak (p, m)
    in degC per percent: how fast each input moves each output. `hysteresis_degC`, `gain_degC`, `check_s` and
    `error_degC_s` are verify_heater's. `early`, `late`, `jump` are shares of the sample time: less than
    `early` or more than `jump` is no time between two samples, more than `late` is a deadline missed.
    `reach_degC`: a target that far from its reference is out of reach. `heat` (p,) in degC a sample: how far
    the observer's drift may be from its mean.
    """

    watch: innovations.Watch
    bank: innovations.Bank
    mode: np.ndarray
    back_s: np.ndarray
    low: np.ndarray
    high: np.ndarray
    noise_degC: np.ndarray
    peak: np.ndarray
    hysteresis_degC: np.ndarray
    gain_degC: np.ndarray
    check_s: np.ndarray
    error_degC_s: np.ndarray
    sample_time_s: float
    early: float
    late: float
    jump: float
    reach_degC: float
    heat: np.ndarray


def supervision(
    model: Plant,
    family: Sequence[Plant],
    machine: Machine,
    noise_degC: np.ndarray,
    *,
    spread: innovations.PlantDeviations | None = None,
    modes: Mapping[str, str] = SAFE,
    back_s: float | None = None,
) -> Supervision:
    """What a machine is watched by: an identified `model`, the `family` of plants that the machine may be
    instead, and the deviation of its sensors' noise (p,) in degC.

    `spread` by itself follows from the family (`spread_of`). `back_s` by itself is 30 samples, 10 s at least.
    Raises ValueError for an unknown kind or mode, and for noise that is no number above zero.
    """
    noise = np.broadcast_to(np.asarray(noise_degC, float), (model.p,)).copy()
    if not (np.isfinite(noise).all() and (noise > 0).all()):
        raise ValueError(
            f"supervision: expected the sensors' noise in degC above zero, found {noise}; estimate it from "
            "a hold of the record"
        )
    if set(modes) != set(KINDS) or not set(modes.values()) <= set(MODES[1:]):
        raise ValueError(
            f"supervision: expected one of {', '.join(MODES[1:])} for each of {', '.join(KINDS)}, found "
            f"{dict(modes)}; declare the safe mode of every kind"
        )
    T = machine.sample_time_s
    waits = max(30 * T, 10.0) if back_s is None else back_s
    limits = np.array([i.low for i in machine.inputs]), np.array([i.high for i in machine.inputs])
    pulses = markov_parameters(strictly_proper(model), innovations.MOST_LATE)
    check = _check_s(model, limits, T)
    watch = innovations.watch(model, limits, noise, spread or spread_of(model, family))
    peak = np.abs(pulses).max(axis=0)
    return Supervision(
        watch=watch,
        bank=innovations.bank(model),
        mode=np.array([MODES.index(modes[kind]) for kind in KINDS]),
        back_s=np.array([np.inf if kind in LATCHED else waits for kind in KINDS]),
        low=np.array([o.low for o in machine.outputs]),
        high=np.array([o.high for o in machine.outputs]),
        noise_degC=noise,
        peak=peak,
        hysteresis_degC=np.maximum(5.0, 6 * noise),
        gain_degC=np.maximum(2.0, 6 * noise),
        check_s=check,
        error_degC_s=6.0 * check,
        sample_time_s=T,
        early=0.5,
        late=1.5,
        jump=10.0,
        reach_degC=max(0.5, 3 * float(noise.max())),
        heat=np.maximum(
            HEAT * (peak * (limits[1] - limits[0])).max(axis=1), SURELY * innovations.drift_sd(watch, noise)
        ),
    )


def _check_s(model: Plant, limits: tuple[np.ndarray, np.ndarray], sample_time_s: float) -> np.ndarray:
    """Seconds (p,) in which an output must gain its degrees: ten times what a quarter of the inputs' range
    takes to warm it by 2 degC; 20 s at least, as in Klipper."""
    rise = np.cumsum(np.abs(markov_parameters(strictly_proper(model), 200)).max(axis=2), axis=0)
    takes = (rise * 0.25 * (limits[1] - limits[0]).max() < 2.0).sum(axis=0) + 1
    return np.maximum(10 * takes * sample_time_s, 20.0)


def spread_of(model: Plant, family: Sequence[Plant]) -> innovations.PlantDeviations:
    """How far the plants of a family are from the model, a deviation each: gain by the rise over MOST_LATE
    samples of each output's strongest input; no less than what records leave open anyway."""
    lags = innovations.MOST_LATE
    rise = np.abs(markov_parameters(strictly_proper(model), lags).sum(axis=0))
    i = rise.argmax(axis=1)
    j = np.arange(model.p)
    ratios = [
        np.abs(markov_parameters(strictly_proper(one), lags).sum(axis=0))[j, i] / rise[j, i] - 1
        for one in family
    ]
    gain = float(np.sqrt(np.mean(np.square(ratios)))) if ratios else 0.0
    return innovations.PlantDeviations(gain=max(gain, 0.15), pace=0.15, loss=0.003, late=0.7)


class Cause(NamedTuple):
    """What is wrong: its kind (KINDS), the signal's name or "machine", the reason in one sentence, and the
    time since when."""

    kind: str
    signal: str
    sentence: str
    since_s: float


class Decision(NamedTuple):
    """Inputs u (m,) to apply in percent, the mode (MODES), and its causes, the one that explains most
    first."""

    u: np.ndarray
    mode: str
    causes: tuple[Cause, ...]


# ---- what is remembered


class Kept(NamedTuple):
    """All that the supervisor remembers beside innovations.Memory, arrays that are changed in place.

    By kind and signal (k, w): since, last in s of the supervisor's own time, -1 where not so; amount; other,
    the number of the kind that would show the same, -1 for none, ALL_INPUTS where it is of every input.

    By output (p,): y the last reading; repeats of it, and quantum the smallest move seen; square and lag,
    means of z(t)^2 and z(t) z(t-1), z the last; trusted 1 or 0; absurd 1 where it left its range by itself;
    expected and e the last forecast and innovation; error, goal and waited of verify_heater in degC s, degC
    and s.

    drift (p, m + 4) the mean of innovations.drift.

    By input (m,): held the inputs that hold; asked the last command; lacks the share that a weak heater
    lacks; stuck 1 where it is on.

    counters (8,): samples since the start or an acknowledgement; samples since the alarm, -1 for none; mode;
    1 once the clock was read; samples in all; causes that are there; 1 where a heater is stuck or weak; 1
    where a zone is colder than it should be. clock_s (2,): the clock at the last sample, and the supervisor's
    own time, which never falls.
    """

    since: np.ndarray
    last: np.ndarray
    amount: np.ndarray
    other: np.ndarray
    y: np.ndarray
    repeats: np.ndarray
    quantum: np.ndarray
    square: np.ndarray
    lag: np.ndarray
    z: np.ndarray
    trusted: np.ndarray
    absurd: np.ndarray
    expected: np.ndarray
    e: np.ndarray
    error: np.ndarray
    goal: np.ndarray
    waited: np.ndarray
    drift: np.ndarray
    held: np.ndarray
    asked: np.ndarray
    lacks: np.ndarray
    stuck: np.ndarray
    counters: np.ndarray
    clock_s: np.ndarray


SAMPLES, ALARMED, MODE, CLOCKED, STEPS, ACTIVE, CHANGED, COLDER = range(8)


def kept(s: Supervision) -> Kept:
    """What a supervisor knows before its first sample."""
    (p, m), k = s.peak.shape, len(KINDS)
    w = max(m, p)
    return Kept(
        since=np.full((k, w), -1.0),
        last=np.full((k, w), -1.0),
        amount=np.zeros((k, w)),
        other=np.full((k, w), -1),
        y=np.full(p, np.nan),
        repeats=np.zeros(p, int),
        quantum=np.full(p, np.inf),
        square=np.ones(p),
        lag=np.zeros(p),
        z=np.zeros(p),
        trusted=np.ones(p),
        absurd=np.zeros(p),
        expected=np.zeros(p),
        e=np.zeros(p),
        error=np.zeros(p),
        goal=np.full(p, -np.inf),
        waited=np.zeros(p),
        drift=np.zeros((p, m + 4)),
        held=np.zeros(m),
        asked=np.zeros(m),
        lacks=np.zeros(m),
        stuck=np.zeros(m),
        counters=np.array([0, -1, 0, 0, 0, 0, 0, 0]),
        clock_s=np.zeros(2),
    )


# ---- one sample, kind by kind


def said(k: Kept, kind: int, signal: int, amount: float = 0.0, other: int = -1) -> None:
    """The cause is there now; what was said of it first stays."""
    t_s = k.clock_s[1]
    if k.since[kind, signal] < 0:
        k.since[kind, signal], k.amount[kind, signal], k.other[kind, signal] = t_s, amount, other
        k.counters[ACTIVE] += 1
    k.last[kind, signal] = t_s


def timed(s: Supervision, k: Kept, t_s: float) -> int:
    """Whole samples since the last one, by which the supervisor's own time goes on: 1 where the clock tells
    none. Says where clock or deadline are wrong."""
    gap_s = t_s - k.clock_s[0]
    gap = gap_s / s.sample_time_s
    sane = s.early <= gap <= s.jump
    k.clock_s[0] = t_s
    k.clock_s[1] += gap_s if sane else s.sample_time_s
    if not sane:
        said(k, CLOCK, 0, gap_s)
    elif gap > s.late:
        said(k, DEADLINE, 0, gap_s)
    return int(gap + 0.5) if sane and gap > s.late else 1


def acted(s: Supervision, k: Kept, applied: np.ndarray | None) -> np.ndarray:
    """Inputs (m,) that acted since the last sample, as far as is known; says where one was not applied."""
    u = k.asked
    if applied is not None:
        off = np.abs(applied - k.asked) > APPLIED * (s.watch.high - s.watch.low)
        wrong = np.flatnonzero(off | ~np.isfinite(applied))
        if len(wrong) > 1:
            said(k, COMMAND, 0, 0.0, ALL_INPUTS)
        elif len(wrong):
            said(k, COMMAND, int(wrong[0]), float(applied[wrong[0]]))
        u = np.where(np.isfinite(applied), applied, k.asked)
    if k.counters[CHANGED]:
        u = np.where(k.stuck > 0, s.watch.high, u * (1 - k.lacks))
    return u


def read(s: Supervision, k: Kept, y: np.ndarray) -> None:
    """Readings that are none, out of range, or the same for too long."""
    moves = np.abs(y - k.y)
    # one comparison for all, where every reading is one
    if (
        math.isfinite(sum(y.tolist()))
        and min((y - s.low).tolist()) >= 0 <= min((s.high - y).tolist())
        and min(moves.tolist()) > 1e-9
    ):
        k.quantum[:] = np.minimum(k.quantum, moves)
        k.repeats[:] = 0
        k.y[:] = y
        return
    for j in range(len(y)):
        value = y[j]
        if not math.isfinite(value):
            said(k, NAN, j)
            k.repeats[j] = 0
            continue
        if not s.low[j] <= value <= s.high[j]:
            said(k, RANGE, j, value)
        move = abs(value - k.y[j])
        if move == 0:
            k.repeats[j] += 1
            if k.counters[SAMPLES] > 20 and k.repeats[j] >= repeats_at_most(k.quantum[j], s.noise_degC[j]):
                said(k, FROZEN, j, value)
        else:
            if move > 1e-9:
                k.quantum[j] = min(k.quantum[j], move)
            k.repeats[j] = 0
        k.y[j] = value


def repeats_at_most(quantum: float, noise: float) -> float:
    """Repeats that an honest sensor of such steps in degC and such noise shows with probability CHANCE."""
    same = math.erf(min(quantum, 1e9) / (2 * math.sqrt(2) * noise))
    if same >= 1:
        return math.inf
    return max(REPEATS_LEAST, math.log(CHANCE) / math.log(max(same, 1e-12)))


def verified(s: Supervision, k: Kept, y: np.ndarray, y_star: np.ndarray) -> None:
    """verify_heater of Klipper: an output colder than its target must gain `gain_degC` in `check_s`, or the
    time it is colder than its hysteresis adds up."""
    T, colder = s.sample_time_s, y_star - s.hysteresis_degC - y
    if max(colder.tolist()) <= 0:
        if k.counters[COLDER]:
            k.counters[COLDER] = 0
            k.error[:] = k.waited[:] = 0.0
        return
    k.counters[COLDER] = 1
    for j in range(len(y)):
        below = colder[j]
        if not below > 0 or not k.trusted[j]:
            k.error[j] = k.waited[j] = 0.0
            continue
        if k.waited[j] == 0 or y[j] >= k.goal[j]:
            k.goal[j], k.waited[j], k.error[j] = y[j] + s.gain_degC[j], 0.0, 0.0
        k.waited[j] += T
        if k.waited[j] > s.check_s[j]:
            k.error[j] += below * T
            if k.error[j] > s.error_degC_s[j]:
                said(k, RUNAWAY, j, below)


def noted(k: Kept, z: np.ndarray) -> None:
    """Mean squares of the innovation, and at lag one."""
    z, square, lag = np.minimum(np.maximum(z, -MOST_Z), MOST_Z), k.square, k.lag
    square += FORGETS * (z * z - square)
    lag += FORGETS * (z * k.z - lag)
    k.z[:] = z


def diagnosed(s: Supervision, k: Kept, memory: innovations.Memory) -> bool:
    """From the alarm on: whether it is decided what explains the innovation, and says so."""
    since = k.counters[ALARMED]
    if since < DECIDED_AFTER or memory.ahead[0] > 0 or memory.age[0] < 0:
        return False
    verdict = innovations.judged(s.bank, memory)
    best = int(verdict.cost.argmin())
    kinds, signals = _named(s, k, verdict)
    same = (kinds == kinds[best]) & (signals == signals[best])
    rival = int(np.where(same, np.inf, verdict.cost).argmin())
    clear = verdict.cost[rival] - verdict.cost[best]
    explains = verdict.none - verdict.cost[best] > TOLD_APART
    if since < DECIDED_BY and not (clear > TOLD_APART and explains):
        return False
    worst = int(verdict.own.argmax())
    repeated = k.repeats[worst] >= 2 and _chance(k, s, worst) < 1e-4
    spoilt = (verdict.left > UNEXPLAINED) & (verdict.left > UNEXPLAINED_SHARE * verdict.own)
    if repeated:
        said(k, FROZEN, worst, k.y[worst])
    elif (
        k.square[worst] > NOISY_SQUARE
        and k.lag[worst] < NOISY_LAG * k.square[worst]
        and (not explains or spoilt.any())
    ):
        said(k, NOISY, worst, math.sqrt(k.square[worst]))
    elif not explains or spoilt.any():
        said(k, MODEL, 0, math.sqrt(verdict.own[worst]))
    else:
        other = int(kinds[rival]) if clear <= TOLD_APART else -1
        _explained(k, memory, (int(kinds[best]), int(signals[best]), best), verdict.amplitude[best], other)
    return True


def _chance(k: Kept, s: Supervision, j: int) -> float:
    same = math.erf(min(k.quantum[j], 1e9) / (2 * math.sqrt(2) * s.noise_degC[j]))
    return same ** int(k.repeats[j])


def _named(s: Supervision, k: Kept, verdict: innovations.Verdict) -> tuple[np.ndarray, np.ndarray]:
    """Kind and signal (h,) of every hypothesis at its amplitude."""
    form, signal, a = s.bank.form, s.bank.signal, verdict.amplitude
    cooling = s.peak @ k.held
    output = np.minimum(signal, len(cooling) - 1)
    falls = -a > 2 * cooling[output] + 10 * s.noise_degC[output]
    kinds = np.full(len(form), OFFSET)
    kinds[form == innovations.ON] = ON
    kinds[form == innovations.LESS] = WEAK
    kinds[(form == innovations.LESS) & (a > DEAD_SHARE)] = OFF
    kinds[form == innovations.NOT_APPLIED] = COMMAND
    kinds[form == innovations.LAG] = SLOW
    kinds[(form == innovations.RAMP) & falls] = RUNAWAY
    return kinds, signal


def _explained(
    k: Kept, memory: innovations.Memory, named: tuple[int, int, int], amount: float, other: int
) -> None:
    """The cause, and the observer freed of what it did to it."""
    kind, signal, best = named
    memory.Z[:, 0] += amount * memory.Xb[:, best]
    if kind in (OFFSET, RUNAWAY) and k.since[RANGE, signal] >= 0:
        k.absurd[signal] = 1.0  # the reading left its range at once: that is its reason
        return
    if kind == COMMAND:
        other = ALL_INPUTS
    said(k, kind, signal, amount * memory.f[best] if kind == OFFSET else amount, other)
    k.counters[CHANGED] = int(k.counters[CHANGED] or kind in (ON, OFF, WEAK))
    if kind == ON:
        k.stuck[signal] = 1.0
    elif kind in (OFF, WEAK):
        k.lacks[signal] = min(amount, 1.0)


def distrusted(s: Supervision, k: Kept, y: np.ndarray) -> None:
    """Sensors that do not count now; an offset is gone where the reading is nearer to the forecast than half
    of it."""
    if not k.counters[ACTIVE]:  # not even one that gives no number
        k.trusted[:] = 1.0
        return
    for j in range(len(y)):
        bad = k.since[NAN, j] >= 0 or k.since[FROZEN, j] >= 0 or k.since[SLOW, j] >= 0
        bad = bad or k.since[OFFSET, j] >= 0 or k.absurd[j] > 0
        bad = bad or k.since[RUNAWAY, j] >= 0 or k.since[NOISY, j] >= 0 or not math.isfinite(y[j])
        k.trusted[j] = 0.0 if bad else 1.0
        off = abs(y[j] - k.expected[j])
        if k.since[OFFSET, j] >= 0 and not off < 0.5 * abs(k.amount[OFFSET, j]):
            k.last[OFFSET, j] = k.clock_s[1]
        if k.since[NOISY, j] >= 0 and off > 5 * s.noise_degC[j]:
            k.last[NOISY, j] = k.clock_s[1]


def gone(s: Supervision, k: Kept) -> bool:
    """Forgets causes that were not there for their time; whether one of a sensor went."""
    if not k.counters[ACTIVE]:
        return False
    active = k.since >= 0
    k.absurd[:] = np.where(k.since[RANGE, : len(k.absurd)] >= 0, k.absurd, 0.0)
    went = active & (k.clock_s[1] - k.last > s.back_s[:, None])
    k.since[went], k.last[went], k.other[went] = -1.0, -1.0, -1
    k.counters[ACTIVE] -= int(went.sum())
    return bool(went[list(OF_OUTPUT)].any())


def mode_of(s: Supervision, k: Kept) -> int:
    """The most severe of the modes that the causes declare; hold while an alarm is not decided."""
    if not k.counters[ACTIVE]:
        return LAW if k.counters[ALARMED] < 0 else HOLD
    kinds, signals = np.nonzero(k.since >= 0)
    beside = k.other[kinds, signals]
    # a mode that is safe for what would show the same, too
    modes = s.mode[np.r_[kinds, beside[beside >= 0]]]
    worst = int(modes[SEVERITY[modes].argmax()])
    if k.counters[ALARMED] >= 0 and SEVERITY[worst] < SEVERITY[HOLD]:
        return HOLD
    return worst


def followed(
    s: Supervision,
    k: Kept,
    memory: innovations.Memory,
    y: np.ndarray,
    y_star: np.ndarray,
    applied,
    samples: int,
) -> np.ndarray:
    """One sample of outputs y (p,), of which targets were y_star, inputs `applied` since the one before, none
    of `samples` in manual; y (p,) with what is not trusted as forecast."""
    manual, samples = samples == 0, max(samples, 1)
    watch, first = s.watch, k.counters[SAMPLES] == 0
    u = acted(s, k, applied)
    read(s, k, y)
    moved = np.zeros(len(y))
    if first:
        innovations.started(watch, memory, np.where(np.isfinite(y), y, y_star))
        memory.u[:] = u
        k.drift[:] = 0.0
    else:
        for step in range(samples):
            e = k.e if step == 0 else 0.0 * k.e
            moved = innovations.advanced(watch, memory, u, e)
            if manual:
                memory.Z[:, 0] += watch.hurried @ e
                memory.Z[:, 1:] = 0.0
    distrusted(s, k, y)
    now = innovations.seen(watch, memory, y, k.trusted)
    noted(k, now.z)
    innovations.kept(memory, now, moved)
    innovations.suspected(watch, s.bank, memory, now, alarmed=bool(k.counters[ALARMED] >= 0))
    k.expected[:], k.e[:] = now.expected, now.e
    filled = np.where(k.trusted > 0, y, now.expected) if k.counters[ACTIVE] else y
    if manual:
        innovations.rested(memory)
        k.drift[:] = innovations.drift(memory, len(y))
    else:
        alarmed(s, k, memory, now.highest)
        heated(s, k, memory)
    if gone(s, k):
        # a sensor counts again: what it showed meanwhile does not
        innovations.started(watch, memory, filled)
        k.e[:] = 0.0
        k.drift[:] = 0.0
    k.counters[SAMPLES] += 1
    k.counters[STEPS] += 1
    return filled


def _loudest(memory: innovations.Memory) -> int:
    """The output whose sum is largest."""
    return int(np.maximum(memory.sums[0], memory.sums[1]).argmax())


def alarmed(s: Supervision, k: Kept, memory: innovations.Memory, highest: float) -> None:
    """The alarm, and its end where it is decided, or where the sensor that raised it is seen to be wrong."""
    c = k.counters
    if c[ALARMED] < 0:
        if highest > ALARM:
            c[ALARMED] = 0
        return
    c[ALARMED] += 1
    if diagnosed(s, k, memory) or c[ALARMED] > 2 * DECIDED_BY or not k.trusted[_loudest(memory)]:
        c[ALARMED] = -1
        innovations.rested(memory)


def heated(s: Supervision, k: Kept, memory: innovations.Memory) -> None:
    """An output that drifts within seconds by more than the heat that surroundings may take or give, while
    nothing else is odd: the observer has followed it, so that no sum shows it. Of that, what a plant of the
    spread may do does not count."""
    mean = k.drift
    away = innovations.drift(memory, len(mean)) - mean
    quiet = not k.counters[ACTIVE] and k.counters[ALARMED] < 0
    if quiet and max((np.abs(away[:, 0]) - s.heat).tolist()) > 0:
        for j, X in enumerate(away[:, 1:]):
            off = away[j, 0] + X @ memory.theta[j]
            stirred = X * s.watch.prior
            left = math.sqrt(s.watch.unexplained**2 * (stirred @ stirred) + X @ (memory.P[j] @ X))
            if abs(off) > s.heat[j] + LEFT_OPEN * left:
                said(k, OFFSET, j, off / FORGETS)
                innovations.drift(memory, len(mean))[j, 0] -= off
    mean += SLOWLY * away


# ---- in words


def sentence(machine: Machine, kind: int, signal: int, amount: float, other: int) -> str:
    """Why, in one sentence, and what else would show the same."""
    names = machine.inputs if kind in OF_INPUT else machine.outputs
    name = names[signal].name if signal < len(names) else "machine"
    said = {
        ON: f"{name} heats whatever it is told, or goes on with an older command ({100 * amount:.0f} % of "
        "what it could add): only the mains can stop it, switch them off",
        OFF: f"{name} does not heat whatever it is told, or goes on with an older command: its zone cools",
        WEAK: f"{name} does {100 * amount:.0f} % less than it is told: it lacks power, goes on with an older "
        "command, or its zone loses more heat than the model knows",
        RUNAWAY: f"{name} reads ever colder than heat can explain: it is out of place, or its zone is not "
        "heated",
        RANGE: f"{name} reads {amount:.1f} degC, outside its declared limits",
        NAN: f"{name} gives no number",
        FROZEN: f"{name} has read {amount:.2f} degC for longer than chance allows",
        OFFSET: f"{name} is off by {amount:+.1f} degC, or its zone gains or loses heat that no input "
        "explains",
        SLOW: f"{name} follows late, or its zone has become slower",
        NOISY: f"{name} is {amount:.0f} times as noisy as it was",
        COMMAND: f"{name} applied {amount:.1f} percent, not what it was told"
        if other != ALL_INPUTS
        else "the machine goes on with older commands than it was told",
        CLOCK: f"the clock went on by {amount:.3g} s between two samples",
        DEADLINE: f"a sample came {amount:.3g} s after the one before",
        MODEL: f"the readings are {amount:.0f} deviations from what any plant of the spread would show, and "
        "no single fault explains them",
        REACH: f"{name} is asked for {amount:.1f} degC more or less than its limits and the inputs can hold: "
        "the last reference in reach stays",
    }[kind]
    also = f"; {KINDS[other].replace('_', ' ')} would show the same" if 0 <= other != kind else ""
    return said + also + "."


ALL_INPUTS = -2
