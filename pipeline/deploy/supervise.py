"""The supervisor around a control law. It detects six faults that a firmware does not see, each with its safe
mode, its reason in one sentence, and the way back.

An observer of the model follows the machine. Every few samples it starts a forecast that no reading corrects
(a window). As long as a window lasts, readings are compared with it:

* A sensor stands still if the forecast moves by three of the sensor's steps, or four deviations of its noise,
  and the reading does not move with it, with its noise on top or without. If readings in steps finer than
  their noise are all equal, the forecast may be less certain.
* The readings' error r against the forecast is explained by one cause that began when one of the windows did,
  by least squares:
      r = -a g              a heater lacks the share a of what it is told
      r = a (high U - g)    it gives a share a of what it could add: 1 if it is stuck on
      r = q U               a fan, a door, filament or the room take or give q percent: no fault
      r = -tau (g - g')     the machine is late by tau samples: no fault
      r = c                 what the sensor sees of air or filament at once: no fault
  with g the response to the input since then, g' that a sample ago, U that to one percent. A heater is
  at fault if that explains the readings clearly better than the causes that are no fault.
* A window has two forecasts, one from the drift as it was when the window began and one from the mean drift.
  Slow masses, such as the walls of a chamber, move the machine between the two. A sensor stands still only if
  both forecasts move the same way. A heater is stuck on only if the readings rise above both.
* The drift follows any slow loss of heat. A sensor that drifts, or sticks with noise just below its
  reference, looks like such a loss. So the drift has a bound that does not adapt: if more heat is missing
  than a fan or filament takes, for longer than a door is open, and the readings do not rise, then the heater
  or its sensor is in doubt.

`Kept` holds all that the supervisor remembers: arrays of fixed size, plain arithmetic.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from pipeline.temperature.controllers.law import (
    INPUTS,
    REFERENCES,
    ActuatorLimits,
    Deployed,
    FeedForward,
    Governor,
    Law,
    Plant,
    Reference,
    RunningController,
    Strength,
    constant,
    numbers,
    rest,
    same,
)

# ---- exported to the letter from here on


# ---- the machine that a controller is wired to

PERCENT, DEGC = "percent", "degC"


class Signal(NamedTuple):
    """An input with the limits of its command, or an output with its declared limits; -inf and inf if not
    declared."""

    name: str
    unit: str
    low: float
    high: float


def signal(about: Mapping[str, Any]) -> Signal:
    """Returns the signal of a JSON object, in which null is a limit that is not declared."""
    low, high = about["low"], about["high"]
    return Signal(
        about["name"], about["unit"], -np.inf if low is None else low, np.inf if high is None else high
    )


class Machine(NamedTuple):
    """The machine that a controller is wired to: its signals in order, the time between two samples, and the
    measured disturbances that the controller gets."""

    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    sample_time_s: float
    disturbances: tuple[Signal, ...] = ()


# ---- what it is watched by

KINDS = (
    "sensor_open",
    "sensor_still",
    "sensor_deaf",
    "heater_stuck_on",
    "heater_weak",
    "reference_out_of_reach",
)
OPEN, STILL, DEAF, ON, WEAK, REACH = range(len(KINDS))
OF_INPUT = (ON, WEAK)
# "own": the machine's own control, or PI
MODES = ("law", "own", "off")
LAW, OWN, OFF = range(3)

WINDOWS, SPACING = 6, 6  # forecasts side by side, and samples from one to the next
STILL_AFTER = 10  # samples for which a forecast must have been away before a sensor stands still
FIT_AFTER = 12  # least samples of a window before a heater is judged by it
STEPS_STILL, NOISE_STILL = 3.0, 4.0  # steps and deviations that a forecast must move
SAME_STEPS, SAME_NOISE = 1.5, 6.0  # steps and deviations within which a reading has not moved
FOLLOWS = (0.7, 1.4)  # share of the forecast's move by which a sensor is cleared
CLEARED_S = 60.0  # for how long it then counts as cleared
# why readings differ from the forecast: a heater lacks a share, or gives a share of what it could add; heat
# of the surroundings as a share of the input's range; samples late; a heater that differs from the model by a
# share; a step of the reading in degC
LACKS, GIVES, HEAT, LATE, DIFFERS, SHIFTS = range(6)
LEAST = np.array([0.35, 0.6, -0.3, -8.0, -0.25, -1e3])
MOST = np.array([1.0, 1.5, 0.3, 8.0, 0.25, 1e3])
CLEARER = 16.0  # of -2 log likelihood, by which a fault must explain better than causes that are no fault
MISFIT = 0.15  # fraction of the readings' error that even the right cause leaves, since no model is exact
DOUBT = 0.25  # fraction of the inputs' recent effect by which a forecast may be wrong
RESTS = 1 / 40  # fraction by which this effect fades in each sample
REPEATED = 3  # successive samples with an invalid reading
SHOWN = 6  # successive samples that must show a fault
SLOWLY = 1 / 60  # fraction by which the mean drift follows in each sample
EARLY, JUMP = 0.5, 10.0  # shortest and longest valid time between two samples, in sample times
MOST_STEP_DEGC = 5.0  # a larger first move may come from power-on
# a sensor's steps until it has moved: one of 2.5 degC moves before its forecast has moved enough to judge it
UNKNOWN_STEP_DEGC = 1.0
# missing heat that counts, as shares of an input's range: in general, and with the heater at its limit
MISSING, AT_LIMIT = 0.4, 0.1
MISSING_FOR, DOOR_S = 60, 110.0  # for how many samples it must be missing; longest time that a door is open
FAR_DEGC = 1e4  # no machine is so hot: its model is unstable, and no reading corrects it
SETTLES = 30  # samples from the first, in which the observer finds the machine and no forecast begins
BACK_S = 30.0  # without a cause, after which the law takes over again
RETURNS = 3  # times an hour that heaters are tried again after they went off


class Supervision(NamedTuple):
    """The parameters of a machine's supervisor.

    `A` (n, n), `B` (n, m), `C` (p, n), `b` (n,), `d` (p,): the model, with a drift w (p) in degC a step as
    its last states. `L`, `M` (n, p): move its state by an innovation, from one sample to the next and at
    once; `hurried` is added to L in manual. `unsure` (WINDOWS SPACING + 1, p) in degC: standard deviation of
    a forecast by its age; `wander`: cumulative sum of four times its squares.

    The state starts at start y + start_0, in which inputs hold y for long. `low`, `high` (m,) in percent;
    `coldest`, `hottest` (p,) in degC: range of valid readings. Pairs (q,) of an output `of_input` and an
    input `input_of`: first, for each input, the output in which it has the largest share; then the remaining
    outputs, with the input that moves them most. `heat` (m, p): share of the inputs' range that a drift of 1
    stands for; `missing_for`: samples for which heat must be missing.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    b: np.ndarray
    d: np.ndarray
    L: np.ndarray
    M: np.ndarray
    hurried: np.ndarray
    unsure: np.ndarray
    wander: np.ndarray
    start: np.ndarray
    start_0: np.ndarray
    low: np.ndarray
    high: np.ndarray
    coldest: np.ndarray
    hottest: np.ndarray
    noise_degC: np.ndarray
    of_input: np.ndarray
    input_of: np.ndarray
    heat: np.ndarray
    missing_for: int
    sample_time_s: float
    reach_degC: float

    def coarser(self, quantum: np.ndarray) -> np.ndarray:
        """Returns the factor (p,), at least 1, by which readings with steps of `quantum` (p,) in degC deviate
        more than the sensors' noise."""
        return np.maximum(1.0, known_steps(quantum) / np.sqrt(12) / self.noise_degC)


def known_steps(quantum: np.ndarray) -> np.ndarray:
    """Returns the steps of sensors (p,) in degC; UNKNOWN_STEP_DEGC as long as they are unknown."""
    return np.where(np.isfinite(quantum), quantum, UNKNOWN_STEP_DEGC)


class Exported(NamedTuple):
    """A controller as exported.

    `controller`: the controller `name` as it was judged, with law, limits, integral limit and governor.
    `model`: for the feasible targets and the supervisor's forecasts. `fallback`: the machine's own PID, or a
    PI under the same limits, as the safe mode "own"; None: the heaters go off instead. `simulated`: the plant
    was drawn at random, not recorded.
    """

    name: str
    machine: Machine
    controller: Deployed
    model: Plant
    fallback: Deployed | None
    supervision: Supervision
    simulated: bool
    plant_sha256: str
    spread_sha256: str


# the fields of records that are records
RECORDS = {
    "controller": Deployed,
    "fallback": Deployed,
    "law": Law,
    "limits": ActuatorLimits,
    "governor": Governor,
    "strength": Strength,
    "forward": FeedForward,
    "model": Plant,
    "supervision": Supervision,
}


def restored(about: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> Exported:
    """Returns the controller from controller.json and its arrays by dotted names. Raises KeyError if one is
    missing."""
    sides = (tuple(map(signal, about[side])) for side in ("inputs", "outputs", "disturbances"))
    inputs, outputs, disturbances = sides
    return Exported(
        machine=Machine(inputs, outputs, about["sample_time_s"], disturbances),
        **{name: _record(name, arrays) for name in ("controller", "model", "fallback", "supervision")},
        **{name: about[name] for name in ("name", "simulated", "plant_sha256", "spread_sha256")},
    )


def _record(place: str, arrays: Mapping[str, np.ndarray]) -> Any:
    """Returns the record, array or number under a dotted name; None if nothing is stored for a record."""
    kind = RECORDS.get(place.rpartition(".")[2])
    if kind is None:
        return arrays[place] if arrays[place].ndim else arrays[place].item()
    if not any(name.startswith(f"{place}.") for name in arrays):
        return None
    return kind(*(_record(f"{place}.{name}", arrays) for name in kind._fields))


class Cause(NamedTuple):
    """What is wrong: its kind (KINDS), the signal's name, the reason in one sentence, and the time at which
    it began."""

    kind: str
    signal: str
    sentence: str
    since_s: float


class Decision(NamedTuple):
    """Inputs u (m,) to apply in percent, the mode (MODES), and its causes."""

    u: np.ndarray
    mode: str
    causes: tuple[Cause, ...]


# ---- what is remembered


class Kept(NamedTuple):
    """All that the supervisor remembers, in arrays that are changed in place.

    By kind and signal (k, w): `since` and `last`, first and last time of a cause, in s of the supervisor's
    own time, -1 if there is none; `amount`.

    The observer: `x` (n,); `e` (p,), the last innovation; `slow` (p,), the mean drift; `expected` (p,), the
    forecast.

    By output (p,): `y`, the last reading, and its `repeats`; `quantum`, the smallest move seen (infinite:
    none; NaN: a large one, perhaps of power-on); `bad`, successive bad readings; `cleared_s`, the time at
    which it last moved as forecast; `returns`, how often it was trusted again, the last time at `returned_s`.

    Windows (K): `states` (2, K, n), from the drift as it was and from its mean; `given` and `unit` (K, n, m),
    the responses to the inputs and to one percent of each; `before` (K, q), the output of `given` a sample
    ago; `age` (K,), in samples, -1 for no window. Readings in a window (K, p): `began` and `first`, the
    forecast and the reading at the start; `least` and `most`, the least and the largest reading; `away`,
    successive samples in which the forecast was away from where it began. Sums over a window: `square` (K,
    q), of r^2; `causes` (K, q, 6), of each cause's signature squared; `cross` (K, K, q, 6), of r of a window
    times the signature of a cause that began with another window; `total` (2, K, p), of the reading minus
    `began`, and of its square.

    By heater (m,): `shown` (2, m), successive samples in which it was stuck on, or weak; `missing`, in which
    its heat was missing; `asked`, the last command; `usual`, its mean; `stirred`, how far it was from its
    mean lately; `forward`, what was added to it for disturbances. This makes up for the disturbances, so
    forecasts run without both.

    `counters` (6,): samples; mode; 1 once the clock was read; present causes; calls of `step`; 1 after an
    invalid time step of the clock. `clock_s` (2,): the clock at the last sample, and the supervisor's own
    time, which never decreases.
    """

    since: np.ndarray
    last: np.ndarray
    amount: np.ndarray
    x: np.ndarray
    e: np.ndarray
    slow: np.ndarray
    expected: np.ndarray
    y: np.ndarray
    quantum: np.ndarray
    repeats: np.ndarray
    bad: np.ndarray
    cleared_s: np.ndarray
    returns: np.ndarray
    returned_s: np.ndarray
    states: np.ndarray
    given: np.ndarray
    unit: np.ndarray
    before: np.ndarray
    began: np.ndarray
    first: np.ndarray
    least: np.ndarray
    most: np.ndarray
    away: np.ndarray
    square: np.ndarray
    causes: np.ndarray
    cross: np.ndarray
    total: np.ndarray
    age: np.ndarray
    shown: np.ndarray
    missing: np.ndarray
    asked: np.ndarray
    usual: np.ndarray
    stirred: np.ndarray
    forward: np.ndarray
    counters: np.ndarray
    clock_s: np.ndarray


SAMPLES, MODE, CLOCKED, ACTIVE, RUNS, INSANE = range(6)


def kept(s: Supervision) -> Kept:
    """Returns a memory that has seen nothing."""
    n, m, p, q, K = len(s.A), len(s.low), len(s.d), len(s.of_input), WINDOWS
    w, k = max(m, p), len(KINDS)
    return Kept(
        since=np.full((k, w), -1.0),
        last=np.full((k, w), -1.0),
        amount=np.zeros((k, w)),
        x=np.zeros(n),
        e=np.zeros(p),
        slow=np.zeros(p),
        expected=np.zeros(p),
        y=np.full(p, np.nan),
        quantum=np.full(p, np.inf),
        repeats=np.zeros(p, int),
        bad=np.zeros(p, int),
        cleared_s=np.full(p, -np.inf),
        returns=np.zeros(p, int),
        returned_s=np.full(p, -np.inf),
        states=np.zeros((2, K, n)),
        given=np.zeros((K, n, m)),
        unit=np.zeros((K, n, m)),
        before=np.zeros((K, q)),
        began=np.zeros((K, p)),
        first=np.zeros((K, p)),
        least=np.zeros((K, p)),
        most=np.zeros((K, p)),
        away=np.zeros((K, p), int),
        square=np.zeros((K, q)),
        causes=np.zeros((K, q, len(LEAST))),
        cross=np.zeros((K, K, q, len(LEAST))),
        total=np.zeros((2, K, p)),
        age=np.full(K, -1),
        shown=np.zeros((2, m), int),
        missing=np.zeros(m, int),
        asked=np.zeros(m),
        usual=np.zeros(m),
        stirred=np.zeros(m),
        forward=np.zeros(m),
        counters=np.zeros(6, int),
        clock_s=np.zeros(2),
    )


# ---- a sample


def say(k: Kept, kind: int, signal: int, amount: float = 0.0) -> None:
    """Records that a cause is present now; its first amount is kept."""
    if k.since[kind, signal] < 0:
        k.since[kind, signal], k.amount[kind, signal] = k.clock_s[1], amount
        k.counters[ACTIVE] += 1
    k.last[kind, signal] = k.clock_s[1]


def pass_time(s: Supervision, k: Kept, t_s: float) -> int:
    """Returns the whole samples since the last one, and advances the supervisor's own time. If the clock's
    time step is too short or too long (EARLY, JUMP), it counts as one sample, and the first such step in a
    row restarts the forecasts."""
    if not k.counters[CLOCKED]:
        k.clock_s[0], k.counters[CLOCKED] = t_s - s.sample_time_s, 1
    gap_s = t_s - k.clock_s[0]
    gap = gap_s / s.sample_time_s
    sane = EARLY <= gap <= JUMP
    k.clock_s[0] = t_s
    k.clock_s[1] += gap_s if sane else s.sample_time_s
    if not sane and not k.counters[INSANE]:
        k.age[:] = -1
    k.counters[INSANE] = 0 if sane else 1
    return int(gap + 0.5) if sane and gap > 1.5 else 1


def read(s: Supervision, k: Kept, y: np.ndarray) -> np.ndarray:
    """Returns whether each output (p,) is valid now; records as causes outputs that give no number, or one
    out of range."""
    counts = np.isfinite(y) & (y >= s.coldest) & (y <= s.hottest)
    k.bad[:] = np.where(counts, 0, k.bad + 1)
    for j in np.flatnonzero(k.bad >= REPEATED):
        say(k, OPEN, j, y[j])
    moves = np.where(counts, np.abs(y - k.y), np.inf)
    first = np.isposinf(k.quantum) & (moves > MOST_STEP_DEGC) & np.isfinite(moves)
    k.quantum[:] = np.where(first, np.nan, np.fmin(k.quantum, np.where(moves > 1e-9, moves, np.inf)))
    k.repeats[:] = np.where(counts & (moves < 1e-12), k.repeats + 1, np.where(counts, 0, k.repeats))
    k.y[:] = np.where(counts, y, k.y)
    return counts & ((k.since[[OPEN, STILL, DEAF], : len(y)] < 0).all(axis=0))


def begin_window(s: Supervision, k: Kept, at: int) -> None:
    """Starts a forecast from the machine's present state."""
    start = k.x + s.M @ k.e
    k.states[:, at] = start
    k.states[1, at, -len(s.d) :] = k.slow
    for part in (k.given, k.unit, k.before, k.away, k.square, k.causes, k.cross):
        part[at] = 0
    k.cross[:, at] = k.total[:, at] = 0.0
    k.began[at] = s.C @ start + s.d
    # a sensor may be far from its forecast, so whether it moves is judged by its own readings
    k.first[at] = k.least[at] = k.most[at] = np.where(np.isfinite(k.y), k.y, k.began[at])
    k.age[at] = 0


def advance(s: Supervision, k: Kept, u: np.ndarray) -> None:
    """Advances observer and windows by one sample, with inputs u (m,) applied."""
    on = s.B @ u + s.b
    k.x[:] = s.A @ k.x + on + s.L @ k.e
    runs = k.age >= 0
    k.states[:] = np.where(runs[:, None], k.states @ s.A.T + on, 0.0)
    k.given[:] = np.where(runs[:, None, None], s.A @ k.given + s.B * (u - s.low), 0.0)
    k.unit[:] = np.where(runs[:, None, None], s.A @ k.unit + s.B, 0.0)
    k.age[:] = np.where(runs, k.age + 1, -1)


def compare(s: Supervision, k: Kept, y: np.ndarray, counts: np.ndarray) -> None:
    """Compares valid readings y (p,) with every window: what moved, and the sums for the fits."""
    k.least[:] = np.where(counts, np.minimum(k.least, y), k.least)
    k.most[:] = np.where(counts, np.maximum(k.most, y), k.most)
    own, inputs = s.of_input, s.input_of
    runs = (k.age >= 0)[:, None]
    missed = np.where(counts & runs, y - k.states[1] @ s.C.T - s.d, 0.0)[:, own]
    given, unit = ((s.C @ part)[:, own, inputs] for part in (k.given, k.unit))
    span = (s.high - s.low)[inputs]
    step = np.where(runs, 1.0, 0.0) * np.ones_like(given)
    signatures = np.stack([-given, span * unit - given, span * unit, k.before - given, -given, step], axis=2)
    moved = np.where(counts, y - k.began, 0.0)
    k.total[...] += moved, moved * moved
    k.before[:] = given
    k.square[...] += missed * missed
    k.causes[...] += signatures * signatures
    k.cross[...] += missed[:, None, :, None] * signatures


def threshold(s: Supervision, k: Kept) -> np.ndarray:
    """Returns by how many degC (K, p) a forecast must move, or differ from the reading, before a sensor or
    heater is judged."""
    least = np.maximum(STEPS_STILL * known_steps(k.quantum), NOISE_STILL * s.noise_degC)
    unsure = s.unsure[np.minimum(np.maximum(k.age, 0), len(s.unsure) - 1)]
    return np.maximum(least, NOISE_STILL * unsure * s.coarser(k.quantum))


def both_ahead(s: Supervision, k: Kept, y: np.ndarray) -> np.ndarray:
    """Returns by how many degC (K, p) both forecasts, from the drift as it was and from its mean, are above y
    (p,) or (K, p), or below it if negative; 0 if y lies between them."""
    first, second = k.states @ s.C.T + s.d - y
    return np.where(first * second > 0, np.where(np.abs(first) < np.abs(second), first, second), 0.0)


def clear_sensors(s: Supervision, k: Kept) -> None:
    """Clears sensors that move as forecast, and counts the samples in which each forecast was away from its
    start."""
    moves, moved = k.states[0] @ s.C.T + s.d - k.began, k.y - k.first
    large = (np.abs(moves) >= threshold(s, k)) & (k.age > 0)[:, None]
    share = moved / np.where(large, moves, 1.0)
    follows = large & (share >= FOLLOWS[0]) & (share <= FOLLOWS[1])
    k.cleared_s[:] = np.where(follows.any(axis=0) & (k.bad == 0), k.clock_s[1], k.cleared_s)
    k.away[:] = np.where(large, k.away + 1, 0)


def judge(s: Supervision, k: Kept, y: np.ndarray, counts: np.ndarray) -> None:
    """Records which sensors stand still while the forecast moves, and which heater heats differently from its
    command, if this explains the readings clearly better than any cause that is no fault."""
    judge_heat(s, k, y, counts)
    clear_sensors(s, k)
    own, age, m = s.of_input, np.maximum(k.age, 1)[:, None], len(s.low)
    old, moves = counts & (age >= FIT_AFTER), both_ahead(s, k, k.began)
    least = np.maximum(threshold(s, k), DOUBT * np.abs(s.C @ k.unit) @ k.stirred)
    tells = old & (np.abs(y - k.states[1] @ s.C.T - s.d) >= least)
    # a healthy sensor repeats itself for long only if its steps are coarser than its noise
    equal = old & (k.repeats >= age) & (known_steps(k.quantum) <= s.noise_degC)
    equal &= np.abs(moves) >= NOISE_STILL * s.noise_degC
    still = (k.away >= STILL_AFTER) & (np.abs(moves) >= least) & counts | equal
    if not (tells.any() or still.any()):
        k.shown[:] = 0
        return
    amount = np.clip(k.cross / np.maximum(k.causes, 1e-12), LEAST, MOST)
    left = k.square[:, None, :, None] - 2 * amount * k.cross + amount**2 * k.causes
    wander = s.wander[np.minimum(np.maximum(k.age, 0), len(s.wander) - 1)]
    noise = (age * (2 * s.noise_degC) ** 2 + wander) * s.coarser(k.quantum) ** 2
    floor = noise[:, own] + MISFIT**2 * k.square + 1e-12
    later = (k.age[None, :] <= k.age[:, None]) & (k.age >= REPEATED)[None, :]
    left = np.where(later[:, :, None, None], np.maximum(left, floor[:, None, :, None]), 1e300)
    honest = np.minimum(left[..., HEAT:].min(axis=(1, 3)), np.maximum(k.square, floor))
    same = k.most - k.least <= same_degC(s, k)
    # a heater that is stuck on must heat, and by more than the drift of either forecast
    heats = (y - k.least > same_degC(s, k)) & (-both_ahead(s, k, y) >= least)
    judge_sensors(s, k, moves, still & same, honest, noise)
    left, honest, floor = left[:, :, :m], honest[:, :m], floor[:, :m]
    explained = left[..., :HEAT].min(axis=1)
    best = explained.min(axis=2)
    gives = explained[..., GIVES] < explained[..., LACKS]
    tells = tells[:, own[:m]] & (heats[:, own[:m]] | ~gives)
    clear = (age * np.log(honest / best) >= CLEARER) & tells & (best <= 2 * floor) & (best < 1e300)
    shows = np.stack([(clear & gives).any(axis=0), (clear & ~gives).any(axis=0)])
    k.shown[:] = np.where(shows, k.shown + 1, 0)
    shown = clear & (k.shown.max(axis=0) >= SHOWN)
    if shown.any():
        window, i = np.unravel_index(np.where(shown, k.square[:, :m], -1.0).argmax(), shown.shape)
        cause = GIVES if gives[window, i] else LACKS
        share = float(amount[window, left[window, :, i, cause].argmin(), i, cause])
        if same[window, own[i]]:
            say_still(k, int(own[i]), moves[window, own[i]])
        elif cause == GIVES:
            say(k, ON, int(i), share)
        else:
            say(k, WEAK, int(i), share)


def judge_heat(s: Supervision, k: Kept, y: np.ndarray, counts: np.ndarray) -> None:
    """Records heaters whose heat is missing for long: more than disturbances take, or a smaller amount while
    the heater is at its limit, as long as the output does not rise."""
    m, p, window = len(s.low), len(s.d), int(k.age.argmax())
    own, span = s.of_input[:m], s.high - s.low
    lost = -s.heat @ k.x[-p:]
    rises = (k.age[window] < (WINDOWS - 1) * SPACING) | (y - k.first[window] > same_degC(s, k))
    least = np.where(k.asked >= s.high, AT_LIMIT, MISSING)
    k.missing[:] = np.where(counts[own] & ~rises[own] & (lost >= least), k.missing + 1, 0)
    for i in np.flatnonzero(k.missing >= s.missing_for):
        say(k, WEAK, int(i), lost[i] / max((k.usual[i] - s.low[i]) / span[i], lost[i]))


def say_still(k: Kept, j: int, moves_degC: float) -> None:
    """Records that an output stands still, or shows only noise, while its forecast moves. The cause is its
    sensor, or its heater."""
    say(k, STILL if k.repeats[j] >= STILL_AFTER // 2 else DEAF, j, moves_degC)


def same_degC(s: Supervision, k: Kept) -> np.ndarray:
    """Returns by how many degC (p,) a reading that stands still may vary."""
    return np.maximum(SAME_STEPS * known_steps(k.quantum), SAME_NOISE * s.noise_degC)


def judge_sensors(
    s: Supervision, k: Kept, moves: np.ndarray, still: np.ndarray, honest: np.ndarray, noise: np.ndarray
) -> None:
    """Records which sensors stand still (K, p), unless a cause that is no fault explains the readings as
    well. `honest` (K, q): the squared error that such causes leave; `noise` (K, p): the part of it that no
    cause explains."""
    age = np.maximum(k.age, 1)[:, None]
    still = still & (np.abs(moves) >= SAME_STEPS * (k.most - k.least))
    for j in np.flatnonzero(still.any(axis=0)):
        heaters = np.flatnonzero(s.of_input == j)
        square = k.square[:, heaters].max(axis=1)
        steady = k.total[1, :, j] - k.total[0, :, j] ** 2 / age[:, 0]
        floor = noise[:, j] + MISFIT**2 * square + 1e-12
        better = age[:, 0] * np.log(honest[:, heaters].min(axis=1) / np.maximum(steady, floor))
        # a heater moves because a reading moved, so a healthy sensor cannot stay equal meanwhile, unless its
        # steps hide what the law compensates
        equal = (k.repeats[j] >= age[:, 0]) & (known_steps(k.quantum)[j] <= s.noise_degC[j])
        clear = still[:, j] & ((better >= CLEARER) | equal)
        if clear.any():
            window = int(np.where(clear, np.abs(moves[:, j]), -1.0).argmax())
            say_still(k, int(j), moves[window, j])


def forget(s: Supervision, k: Kept) -> None:
    """Removes causes that are gone: BACK_S after they were last present; or, if the heaters are off because
    of them, as soon as the output moves as forecast again. A heater is tried again RETURNS times an hour;
    after that a person must acknowledge."""
    if not k.counters[ACTIVE]:
        return
    gone = (k.since >= 0) & (k.clock_s[1] - k.last > BACK_S)
    for kind in (STILL, DEAF, ON, WEAK):
        for signal in np.flatnonzero(k.since[kind] >= 0):
            j = s.of_input[signal] if kind in OF_INPUT else signal
            rested = k.clock_s[1] - k.returned_s[j] > 3600.0
            heated = kind == WEAK and k.amount[WEAK, signal] >= 0  # under the machine's own control
            over = gone[kind, signal] if heated else k.cleared_s[j] > k.last[kind, signal]
            again = gone[kind, signal] = bool(over) and (rested or k.returns[j] < RETURNS)
            if again:
                k.returns[j] = 1 if rested else k.returns[j] + 1
                k.returned_s[j] = k.clock_s[1]
                k.cleared_s[j] = -np.inf  # what cooled as forecast may yet be out of place
    if gone.any():
        k.since[gone] = k.last[gone] = -1.0
        k.counters[ACTIVE] -= int(gone.sum())
        k.age[:] = -1


def follow(s: Supervision, k: Kept, y: np.ndarray, applied: np.ndarray | None, samples: int) -> np.ndarray:
    """Processes one sample of outputs y (p,), with inputs `applied` since the last one; `samples` is 0 in
    manual. Returns y (p,), with the forecast in place of readings that do not count."""
    u = k.asked if applied is None else np.where(np.isfinite(applied), applied, k.asked)
    u = np.minimum(np.maximum(u, s.low), s.high) - k.forward
    silent = np.isnan(k.y)
    counts = read(s, k, y)
    begins = k.counters[SAMPLES] == 0 or (silent & counts).any()
    settles = samples == 0 or k.counters[SAMPLES] < SETTLES
    for step in range(max(samples, 1) if k.counters[SAMPLES] else 0):
        advance(s, k, u)
        if settles and not step:
            k.x[...] += s.hurried @ k.e
        elif step:
            k.e[:] = 0.0
    k.expected[:] = s.C @ k.x + s.d
    if begins or (np.abs(k.expected) > FAR_DEGC).any():
        k.x[:] = s.start @ np.where(np.isfinite(k.y), k.y, s.d) + s.start_0
        k.expected[:], k.slow[:], k.age[:] = s.C @ k.x + s.d, 0.0, -1
    filled = np.where(counts, y, k.expected)
    k.usual[:] = u if samples == 0 and k.counters[SAMPLES] < 2 else k.usual + SLOWLY * (u - k.usual)
    k.stirred[:] = 0.0 if samples == 0 else np.maximum(np.abs(u - k.usual), (1 - RESTS) * k.stirred)
    if settles:
        k.age[:] = -1
        k.slow[:] = k.x[-len(s.d) :]
    else:
        k.slow[...] += SLOWLY * (k.x[-len(s.d) :] - k.slow)
        compare(s, k, filled, counts)
        judge(s, k, filled, counts)
    k.e[:] = np.where(counts, filled - k.expected, 0.0)
    forget(s, k)
    if not settles and k.counters[SAMPLES] % SPACING == 0:
        begin_window(s, k, k.counters[SAMPLES] // SPACING % WINDOWS)
    k.counters[SAMPLES] += 1
    return filled


def choose_mode(s: Supervision, k: Kept) -> int:
    """Returns the safe mode for the present causes. The heaters go off if a sensor is in doubt, or if a
    heater is in doubt and its sensor has not moved as forecast for CLEARED_S. Otherwise the machine's own
    control takes over."""
    if not k.counters[ACTIVE]:
        return LAW
    doubtful = (k.since[[OPEN, STILL, DEAF, ON]] >= 0).any()
    for i in np.flatnonzero(k.since[WEAK] >= 0):
        if k.amount[WEAK, i] >= 0 and k.last[WEAK, i] - k.cleared_s[s.of_input[i]] > CLEARED_S:
            k.amount[WEAK, i] = -k.amount[WEAK, i]
    uncleared = (k.amount[WEAK][k.since[WEAK] >= 0] < 0).any()
    return OFF if doubtful or uncleared else OWN


# ---- in words


def sentence(s: Supervision, machine: Machine, kind: int, signal: int, amount: float) -> str:
    """Returns the reason in one sentence."""
    if kind in OF_INPUT:
        heater, zone = machine.inputs[signal].name, machine.outputs[s.of_input[signal]].name
    else:
        zone = machine.outputs[signal].name
        heater = machine.inputs[s.input_of[(s.of_input == signal).argmax()]].name
    if kind == OPEN and not np.isfinite(amount):
        return f"{zone} gives no number."
    return {
        OPEN: f"{zone} reads {amount:.1f} degC, outside its limits.",
        STILL: f"{zone} stands still while its model moves by {amount:+.1f} degC: {zone}, or {heater}.",
        DEAF: f"{zone} shows noise alone while its model moves by {amount:+.1f} degC: {zone}, or {heater}.",
        ON: f"{heater} gives {100 * amount:.0f} % of what it could add: it is stuck on, and only the "
        "mains can stop it.",
        WEAK: f"{heater} lacks {100 * abs(amount):.0f} % of what it is told"
        + (f", or {zone} is out of place." if amount < 0 else "."),
        REACH: f"{zone} is asked for {amount:.1f} degC more or less than its limits and the inputs can hold: "
        "the last reference in reach stays.",
    }[kind]


# ---- the object that runs


class Supervised:
    """A controller on one machine with its supervisor, one sample at a time.

    Use it as law.RunningController: in manual, `watch` each sample; then `hand_over` once, then `step` each
    sample. If a cause requires a safe mode, the law only watches. It takes over again without a bump when the
    cause has been gone for its declared time, or after `acknowledge`.
    """

    def __init__(self, exported: Exported, *, rehearsal: bool = False):
        if exported.simulated and not rehearsal:
            raise ValueError(
                f"controller {exported.name}: it was made for a simulated plant and runs only with "
                "rehearsal=True; learn it from recordings of the machine, or rehearse"
            )
        self.exported, self.supervision = exported, exported.supervision
        self.law = RunningController(exported.controller, exported.model)
        self.own = None if exported.fallback is None else RunningController(exported.fallback, exported.model)
        self.kept = kept(self.supervision)
        self._reference: Reference | None = None
        self._w, self._beyond = np.zeros(1), np.zeros(0)
        self._in_reach = np.full(len(exported.machine.outputs), np.nan)

    def tell(self, disturbances: np.ndarray) -> None:
        """Sets the measured disturbances (q,) from this sample on, in the machine's order, NaN if one gives
        no number. Raises ValueError for another number of them."""
        told = numbers(disturbances, (len(self.exported.machine.disturbances),), "disturbances")
        self.law.tell(told)

    def watch(self, u: np.ndarray, y: np.ndarray, r: np.ndarray) -> None:
        """Processes one sample in manual, as RunningController; faults are reported by the first `step`.
        Raises ValueError as `step` does, or if inputs u (m,) are not finite, and then remembers nothing."""
        k = self.kept
        y = self._accepted(y, r)
        u = numbers(u, k.asked.shape, INPUTS, finite=True)
        r_now = self._target(r)
        filled = follow(self.supervision, k, y, None, 0)
        k.asked[:] = u
        k.clock_s[1] += self.supervision.sample_time_s
        k.forward[:] = self.law.forward
        self.law.watch(u, filled, r_now)

    def hand_over(self, y: np.ndarray) -> None:
        """Switches from manual to the law without a bump, at outputs y (p,) measured now."""
        self.law.hand_over(np.where(np.isfinite(y), y, self.kept.expected))

    def acknowledge(self) -> None:
        """Forgets every cause, after a person has repaired the fault."""
        k = self.kept
        k.since[:] = k.last[:] = -1.0
        k.counters[ACTIVE] = 0
        for part in (k.amount, k.returns, k.shown, k.missing):
            part[:] = 0
        k.age[:] = -1

    def step(
        self, y: np.ndarray, r: np.ndarray | Reference, t_s: float, applied: np.ndarray | None = None
    ) -> Decision:
        """Returns the inputs to apply for outputs y (p,) measured at t_s on the machine's clock, NaN if a
        sensor gives none, under reference r. `applied` (m,): inputs that acted since the last sample, if the
        machine reads them back. Raises ValueError for another number of them, before any `watch`, or if r or
        t_s is not finite, and then remembers nothing."""
        s, k = self.supervision, self.kept
        y = self._accepted(y, r)
        numbers(t_s, (), "time in s", finite=True)
        applied = None if applied is None else numbers(applied, k.asked.shape, INPUTS)
        if not k.counters[SAMPLES]:
            raise ValueError("the supervisor has seen no sample; call watch with each sample in manual first")
        samples = pass_time(s, k, t_s)
        r_now = self._target(r)
        filled = follow(s, k, y, applied, samples)
        if self._out():
            j = int(self._beyond.argmax())
            say(k, REACH, j, self._beyond[j])
            if not np.isfinite(self._in_reach).all():
                self._in_reach = filled
            r = r_now = self._in_reach
        u, mode = self._drive(filled, r, r_now)
        return Decision(u.copy(), MODES[mode], self._causes(t_s) if mode != LAW else ())

    def _accepted(self, y: np.ndarray, r: np.ndarray | Reference) -> np.ndarray:
        """Returns outputs y (p,), NaN if a sensor gives none. Raises ValueError for another number of them,
        or if the reference r is not p finite numbers."""
        p = self.kept.y.shape
        numbers(r.H @ r.w0 if isinstance(r, Reference) else r, p, REFERENCES, finite=True)
        return numbers(y, p, "temperatures in °C")

    def _drive(self, y: np.ndarray, r: np.ndarray | Reference, r_now: np.ndarray) -> tuple[np.ndarray, int]:
        """Returns the inputs of the mode, and the mode; in a safe mode the law only watches."""
        k, mode = self.kept, choose_mode(self.supervision, self.kept)
        before, n, forward = k.counters[MODE], int(k.counters[RUNS]), self.law.forward
        if mode == LAW:
            if before != LAW:
                self.law.hand_over(y)
            u = self.law.step(y, r, n)
        else:
            u = self._safe(mode, before, y, r_now, n)
            self.law.watch(u, y, r_now)
        k.asked[:], k.forward[:], k.counters[MODE] = u, forward, mode
        k.counters[RUNS] += 1
        return u, mode

    def _safe(self, mode: int, before: int, y: np.ndarray, r: np.ndarray, n: int) -> np.ndarray:
        """Returns the inputs of a safe mode. They are off, too, if the machine has no control of its own."""
        if mode == OFF or self.own is None:
            return self.exported.controller.limits.low.copy()
        if before != OWN:
            self.own = RunningController(self.own.controller, self.own.model)
            self.own.forward = self.law.forward
            self.own.watch(self.kept.asked, y, r)
            self.own.hand_over(y)
        self.own.forward = self.law.forward
        return self.own.step(y, r, n)

    def _target(self, r: np.ndarray | Reference) -> np.ndarray:
        """Returns the reference r (p,) now. For a new reference, also works out whether the inputs can hold
        it."""
        mine = self._reference
        r = r if isinstance(r, Reference) else np.asarray(r, float)
        if mine is None or not same(mine, r):
            mine = self._reference = r if isinstance(r, Reference) else constant(r)
            self._w, r0 = np.array(mine.w0, float), mine.H @ mine.w0
            miss = rest(self.exported.model, mine, self.exported.controller.limits).miss
            outside = np.maximum(r0 - self.supervision.hottest, self.supervision.coldest - r0)
            self._beyond = np.maximum(np.abs(miss), outside)
            if not self._out():
                self._in_reach = r0
        elif len(self._w) > 1:
            self._w = mine.F @ self._w
        return mine.H @ self._w

    def _out(self) -> bool:
        """Returns whether an output's reference is out of reach."""
        return bool((self._beyond > self.supervision.reach_degC).any())

    def _causes(self, t_s: float) -> tuple[Cause, ...]:
        """Returns every present cause, in the order of KINDS."""
        k, machine, causes = self.kept, self.exported.machine, []
        for kind, signal in zip(*np.nonzero(k.since >= 0), strict=True):
            names = machine.inputs if kind in OF_INPUT else machine.outputs
            words = sentence(self.supervision, machine, int(kind), int(signal), float(k.amount[kind, signal]))
            since = t_s - (k.clock_s[1] - k.since[kind, signal])
            causes.append(Cause(KINDS[kind], names[signal].name, words, float(since)))
        return tuple(causes)

    def saved(self) -> dict[str, np.ndarray]:
        """Returns all that it remembers, as arrays. Raises ValueError before the first watch."""
        arrays = {f"law.{name}": part for name, part in self.law.saved().items()}
        if self.own is not None and self.kept.counters[MODE] == OWN:
            arrays |= {f"own.{name}": part for name, part in self.own.saved().items()}
        arrays |= {name: np.array(part) for name, part in self.kept._asdict().items()}
        aimed = {"beyond": self._beyond, "in_reach": self._in_reach, "w": self._w}
        aimed |= {} if self._reference is None else self._reference._asdict()
        return arrays | {f"aim.{name}": np.array(part) for name, part in aimed.items()}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Continues from what another supervisor of the same controller `saved`. Raises ValueError if the
        arrays belong to another controller, and then changes nothing."""
        memory = self.kept._asdict()
        for name, part in memory.items():
            if name not in arrays or np.shape(arrays[name]) != part.shape:
                given = np.shape(arrays[name]) if name in arrays else "none"
                raise ValueError(
                    f"the supervisor expects to be restored from {name} of shape {part.shape} but was given "
                    f"{given}; restore what a supervisor of the same controller saved"
                )
        parts: dict[str, dict[str, np.ndarray]] = {"law": {}, "own": {}, "aim": {}}
        for name, part in arrays.items():
            if "." in name:
                parts[name.partition(".")[0]][name.partition(".")[2]] = np.array(part)
        aim = parts["aim"]
        if lost := {*Reference._fields, "w", "beyond", "in_reach"} - set(aim):
            raise ValueError(
                f"the supervisor expects to be restored from aim.{', aim.'.join(sorted(lost))}; "
                "restore what a supervisor of the same controller saved"
            )
        law, own = RunningController(self.law.controller, self.law.model), self.own
        law.restore(parts["law"])
        if own is not None and arrays["counters"][MODE] == OWN:
            own = RunningController(own.controller, own.model)
            own.restore(parts["own"])
        self.law, self.own = law, own
        for name, part in memory.items():
            part[...] = arrays[name]
        self._reference = Reference(*(aim[name] for name in Reference._fields))
        self._w, self._beyond, self._in_reach = (aim[name] for name in ("w", "beyond", "in_reach"))
