"""Has the machine changed since the champion was made? Rival changes of one recording, each fitted by itself,
and the one named that explains most: a gain, a time constant, a delay, a heater's cap, a sensor's offset.

The generalised likelihood ratio (Willsky and Jones 1976; Basseville and Nikiforov 1993, ch. 4). The
champion's model predicts the outputs of the recording under a change theta of one cause c; what is left goes
through the observer's filter S(q) = I - C (qI - A + K C)^-1 K, which makes it the one-step errors, and

    J_c = min over theta, z of |S (y - y-hat(theta)) - Z z|^2 / variance + |z / spread|^2

counts it. z is what says nothing of the machine: each segment's initial state, the air around (a
level and a slow course, which warm every output alike), and the level by which honest nights differ, output
by output. Their spreads are those of the champion's own recordings (a mixed model; Robinson 1991).
J_0 - J_c is what the cause explains. The largest is named, made part of the prediction, and the rest asked
again, so that one change hides no other.

A level thus counts in °C of the steady output whatever the observer, and a gain by its dynamics and
its level together.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.optimize
import scipy.stats

from pipeline.temperature.identification.refinement import Predictor, free_response, linear_recurrence
from pipeline.temperature.plant import Plant, clip_spectral_radius

BLOCKS = 12  # into which a record is cut for the variance of an estimate
SHORTEST = 96  # samples of a record that is asked
COURSE = 8  # degree of the polynomial that the air around may follow within a segment
# by kind of cause: the step of a derivative, and the ends between which it is looked for; a delay that is
# longer is a mistake of the record
RANGES = {
    "gain": (0.02, -0.98, 1.0), "time constant": (0.02, -0.6, 1.5), "offset": (0.1, -60.0, 60.0),
    "delay": (1.0, -16.0, 64.0), "late sensor": (1.0, -16.0, 64.0),
}  # fmt: skip
GUESSES = dict.fromkeys(("delay", "late sensor"), (6.0, 20.0, 40.0))  # where the search may begin, beside 0
ENOUGH = 0.01  # of the squared error: steps that win less are not taken
SURE = 5.0  # a cause is named from so many sigmas on, squared: what it explains beyond the noise
# of what the first cause explains, a second one must explain so much: less is what the model gets wrong of it
REMAINDER = 0.004
RIVALS = 4.0  # a rival that explains less by up to this (two sigmas squared) is named too
# by so much more than the champion's own errors must draughts explain a record: they also cover what changed
DRAUGHTY = 30.0
CALM = 0.2  # °C of the course of the air in a closed room
SEASON = 20.0  # °C by which another season's air may differ
UNLIKE = 0.1  # share of the air's course by which one output may follow it otherwise than the others
CAUSE = 10.0  # by so much more must a cause explain than another season's air
MOST = 3  # causes of one record
LOST = 0.04  # share of what is asked of a heater: if its cap takes less, nobody needs to know

Segments = Sequence[tuple[np.ndarray, np.ndarray]]


class DriftCause(NamedTuple):
    """One way in which a machine can change: kind, and the number of the input (gain, time
    constant, delay, saturation) or output (offset, late sensor); -1 for all."""

    kind: str
    channel: int


# of a machine against the model, one after the other: a share of a gain or of a rate (the inverse of a time
# constant), samples of a delay or of a late sensor, the most that acts of an input, °C of an offset
Changes = tuple[tuple[DriftCause, float], ...]


def sizes(changes: Changes, kind: str, channel: int) -> list[float]:
    """The changes of one kind that concern a channel."""
    return [value for cause, value in changes if cause.kind == kind and cause.channel in (channel, -1)]


class Scatter(NamedTuple):
    """What honest records scatter by: variance (p,) of the one-step errors, standard deviation of the air
    around between nights, and (p,) of each output's level between nights; mean level of each output in °C
    (p,)."""

    variance: np.ndarray
    ambient: float
    level: np.ndarray
    mean_level: np.ndarray


class RoomAir(NamedTuple):
    """How restless a record is: standard deviation in °C of the course of the air within it, and of what
    draughts take from one sample to the next, in percent of each input; then whether the air may be farther
    from the champion's nights than those are from each other."""

    course: float
    draught: float
    another_season: bool = True


# from a closed room to an open door; the record itself says which (empirical Bayes)
RESTLESS = RoomAir(5.0, 0.0)
ROOMS = (
    RoomAir(CALM, 0.0), RoomAir(1.0, 0.0), RESTLESS,
    RoomAir(1.0, 0.5), RoomAir(1.0, 2.0),
)  # fmt: skip


class CauseFit(NamedTuple):
    """Of one cause, as if it alone had changed: `value` in the unit of `Changes`, its standard deviation, and
    the fall of the weighted squared error that it explains."""

    cause: DriftCause
    value: float
    deviation: float
    explained: float


def causes(plant: Plant) -> list[DriftCause]:
    """Every cause that a record is asked for: those of inputs with all together last, those of outputs."""
    inputs = [
        DriftCause(kind, j)
        for kind in ("gain", "time constant", "delay")
        for j in (*range(plant.m), *([-1] if plant.m > 1 else []))
    ]
    return [
        *inputs,
        *(DriftCause("saturation", j) for j in range(plant.m)),
        *(DriftCause("offset", i) for i in range(plant.p)),
        *(DriftCause("late sensor", i) for i in range(plant.p) if plant.p > 1),
    ]


def faster(plant: Plant, share: float) -> Plant:
    """The plant with every rate 1 + share as high, its time constants 1 / (1 + share) as long, its steady
    gains the same: expm((1 + share) log [A B b; 0 I]).

    A plant whose logarithm is not real (dead times, poles on the negative axis) has
    its slow modes quickened, I - (1 + share) (I - A).
    """
    n, m, rate = plant.n, plant.m, 1.0 + share
    augmented = np.block([[plant.A, plant.B, plant.b[:, None]], [np.zeros((m + 1, n)), np.eye(m + 1)]])
    eigenvalues = np.linalg.eigvals(plant.A)
    negative = (eigenvalues.real < 0) & (np.abs(eigenvalues.imag) < 1e-9)
    if np.abs(eigenvalues).min() > 0.05 and not negative.any():
        with np.errstate(all="ignore"):
            power = scipy.linalg.expm(scipy.linalg.logm(augmented) * rate)
        if np.isfinite(power).all() and np.abs(power.imag).max() < 1e-6:
            A, B, b = np.split(power.real[:n], [n, n + m], axis=1)
            return plant._replace(A=A, B=B, b=b[:, 0])
    eye = np.eye(n)
    return plant._replace(A=eye - (eye - plant.A) * rate, B=plant.B * rate, b=plant.b * rate)


# ---- what the model predicts


def respond(plant: Plant, j: int, u: np.ndarray) -> np.ndarray:
    """y (T, p) of input j alone, u (T,), from the equilibrium under u(0)."""
    x0 = np.linalg.solve(np.eye(plant.n) - plant.A, plant.B[:, j] * u[0])
    x = linear_recurrence(plant.A, np.outer(u, plant.B[:, j]), x0)[:-1]
    return x @ plant.C.T + np.outer(u, plant.D[:, j])


def shifted(values: np.ndarray, samples: float) -> np.ndarray:
    """values (T, ...) so many samples later, between samples by a straight line; the ends are held."""
    if not samples:
        return values
    at = np.clip(np.arange(len(values)) - samples, 0, len(values) - 1)
    low = np.floor(at).astype(int)
    share = (at - low).reshape(-1, *[1] * (values.ndim - 1))
    return (1 - share) * values[low] + share * values[np.minimum(low + 1, len(values) - 1)]


class ProductionModel:
    """The champion's model, ready to be asked: a plant that is stable over the record, its observer's
    gain K (n, p), and `faster`, the plant with its rates so much higher, worked out once."""

    def __init__(self, plant: Plant, samples: int):
        self.plant = plant._replace(A=clip_spectral_radius(plant.A, 1.0 - 1.0 / max(samples, 10)))
        stable = np.abs(np.linalg.eigvals(self.plant.A - plant.K @ plant.C)).max() < 1
        self.K = plant.K if stable else np.zeros_like(plant.K)
        self.faster = functools.cache(lambda share: faster(self.plant, share) if share else self.plant)

    def gain(self, draught: float, variance: np.ndarray) -> np.ndarray:
        """Kalman's gain (n, p) where draughts take so many percent from each input, sample by sample."""
        A, B, C = self.plant.A, self.plant.B, self.plant.C
        if not draught:
            return self.K
        Q = draught**2 * B @ B.T + self.K @ np.diag(variance) @ self.K.T + 1e-9 * np.eye(len(A))
        try:
            P = scipy.linalg.solve_discrete_are(A.T, C.T, Q, np.diag(variance))
        except np.linalg.LinAlgError:  # a mode on the unit circle that no output shows
            return self.K
        return A @ P @ C.T @ np.linalg.inv(C @ P @ C.T + np.diag(variance))

    def innovation(self, values: np.ndarray, K: np.ndarray) -> np.ndarray:
        """S(q) values (T, p): what the observer of gain K does not foresee of an error of the output."""
        if not K.any():
            return values
        x = linear_recurrence(self.plant.A - K @ self.plant.C, values @ K.T, np.zeros(self.plant.n))[:-1]
        return values - x @ self.plant.C.T


class RecordSegment(NamedTuple):
    """Of a record: u (T, m), y (T, p), where y was measured (T, p), the answers of inputs worked out so
    far, its own nuisances with the rows that hold them to their spread, and their orthonormal basis."""

    u: np.ndarray
    y: np.ndarray
    measured: np.ndarray
    answers: dict[tuple, np.ndarray]
    columns: np.ndarray
    basis: np.ndarray


class DriftRecord(NamedTuple):
    """Segments held against a machine at a scale by an observer of gain K; `basis` is that of the outputs'
    levels, which all segments share, and `common` (N, p) those levels before they were made orthonormal."""

    machine: ProductionModel
    scale: Scatter
    K: np.ndarray
    segments: list[RecordSegment]
    basis: np.ndarray
    common: np.ndarray


def record(
    machine: ProductionModel, segments: Segments, scale: Scatter, room: RoomAir = RESTLESS
) -> DriftRecord:
    """A record ready to be asked. Raises ValueError if it is too short."""
    n, p = machine.plant.n, machine.plant.p
    long = [(u, y) for u, y in segments if len(y) >= 4 * n + 8]
    measured = sum(int(np.isfinite(y).any(axis=1).sum()) for _, y in long)
    if measured < SHORTEST:
        raise ValueError(
            f"drift: expected records of at least {SHORTEST} samples to hold against the champion, with "
            f"readings that are not masked, found {measured}; record longer"
        )
    scale, none = _in(scale, room), np.zeros((0, 0))
    bare = DriftRecord(machine, scale, machine.gain(room.draught, scale.variance), [], none, none)
    for u, y in long:
        measured = np.isfinite(y)
        nuisances = _weighted(bare, _own_nuisances(machine, len(y), scale, room.course), measured)
        columns = _held(nuisances, n)
        bare.segments.append(RecordSegment(u, y, measured, {}, columns, np.linalg.qr(columns)[0]))
    levels = [np.broadcast_to(np.diag(scale.level), (len(one.y), p, p)) for one in bare.segments]
    parts = [
        _weighted(bare, *each) for each in zip(levels, (one.measured for one in bare.segments), strict=True)
    ]
    common = _freed(bare, parts)
    return bare._replace(basis=np.linalg.qr(_held(common, 0))[0], common=common)


def _in(scale: Scatter, room: RoomAir) -> Scatter:
    """The scale where the air is restless, or of another season: outputs follow it alike, but not exactly."""
    ambient = max(scale.ambient, SEASON) if room.another_season else scale.ambient
    apart = np.hypot(UNLIKE * room.course, 0.5 * UNLIKE * SEASON if room.another_season else 0.0)
    return scale._replace(ambient=ambient, level=np.hypot(scale.level, apart))


def _own_nuisances(machine: ProductionModel, T: int, scale: Scatter, course: float) -> np.ndarray:
    """(T, p, n + 1 + COURSE): what the state at the start does, then level and courses of the air around,
    which warms like inputs that would raise every steady output by 1 °C."""
    plant = machine.plant
    A = plant.A
    start = free_response(Predictor(A, np.zeros((plant.n, 1)), plant.C, np.zeros((plant.p, 1)), []), T)
    size = np.maximum(np.sqrt((start**2).mean(axis=(0, 1))), 1e-12)
    steady = plant.C @ np.linalg.solve(np.eye(plant.n) - A, plant.B) + plant.D
    heat = np.linalg.lstsq(steady, np.ones(plant.p), rcond=None)[0]
    air = plant._replace(B=(plant.B @ heat)[:, None], D=(plant.D @ heat)[:, None])
    at = np.linspace(-1.0, 1.0, T)
    courses = [
        course * respond(air, 0, np.polynomial.legendre.Legendre.basis(degree)(at))
        for degree in range(1, COURSE + 1)
    ]
    level = np.full((T, plant.p), scale.ambient)
    return np.concatenate([start / size, np.stack([level, *courses], axis=2)], axis=2)


def _weighted(record: DriftRecord, values: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """values (T, p, k) in °C as one-step errors in their own standard deviation, (T p, k); what was not
    measured counts nothing."""
    T, p, k = values.shape
    made = np.stack([record.machine.innovation(values[:, :, c], record.K) for c in range(k)], axis=2)
    made = made / np.sqrt(record.scale.variance)[:, None] * measured[:, :, None]
    return made.reshape(T * p, k)


def _held(columns: np.ndarray, free: int) -> np.ndarray:
    """Columns (N, k) with k rows below that hold all but the first `free` to unit variance."""
    k = columns.shape[1]
    return np.vstack([columns, np.diag(np.concatenate([np.full(free, 1e-6), np.ones(k - free)]))])


def _padded(values: np.ndarray, rows: int) -> np.ndarray:
    return np.concatenate([values, np.zeros((rows - len(values), *values.shape[1:]))])


def _freed(record: DriftRecord, parts: Sequence[np.ndarray]) -> np.ndarray:
    """parts (T p, k) of each segment free of its own nuisances, one below the other."""
    padded = [_padded(part, len(one.basis)) for one, part in zip(record.segments, parts, strict=True)]
    pairs = zip(record.segments, padded, strict=True)
    return np.concatenate([part - one.basis @ (one.basis.T @ part) for one, part in pairs])


def predicted(machine: ProductionModel, one: RecordSegment, changes: Changes) -> np.ndarray:
    """y-hat (T, p) of a segment with these changes."""
    plant = machine.plant
    y = np.tile(plant.C @ np.linalg.solve(np.eye(plant.n) - plant.A, plant.b) + plant.d, (len(one.u), 1))
    for j in range(plant.m):
        rate, delay = (sum(sizes(changes, kind, j)) for kind in ("time constant", "delay"))
        cap = min(sizes(changes, "saturation", j), default=np.inf)
        key = (j, rate, cap if cap < one.u[:, j].max() else np.inf)
        if key not in one.answers:
            if len(one.answers) > 60:
                one.answers.clear()
            one.answers[key] = respond(machine.faster(rate), j, np.minimum(one.u[:, j], cap))
        gain = np.prod([1 + share for share in sizes(changes, "gain", j)])
        y += gain * shifted(one.answers[key], delay)
    for i in range(plant.p):
        late, offset = (sum(sizes(changes, kind, i)) for kind in ("late sensor", "offset"))
        y[:, i] = shifted(y[:, i], late) + offset
    return y


def left(record: DriftRecord, changes: Changes) -> np.ndarray:
    """The one-step errors (N,) under these changes, in their own standard deviation and free of every
    nuisance, with what those cost."""
    Q = record.basis
    padded = _padded(_freed(record, _errors(record, changes))[:, 0], len(Q))
    return padded - Q @ (Q.T @ padded)


def _errors(record: DriftRecord, changes: Changes) -> list[np.ndarray]:
    """(T p, 1) of each segment before any nuisance is taken off; what was not measured by a straight line
    between its neighbours."""
    parts = []
    for one in record.segments:
        error = one.y - predicted(record.machine, one, changes) - record.scale.mean_level
        at = np.arange(len(error))
        for i in np.flatnonzero(~one.measured.all(axis=0)):
            known = one.measured[:, i]
            error[:, i] = np.interp(at, at[known], error[known, i]) if known.any() else 0.0
        parts.append(_weighted(record, error[:, :, None], one.measured))
    return parts


def by_output(record: DriftRecord, rest: np.ndarray) -> np.ndarray:
    """(samples, p) in °C of errors (N,) that `left` gave; NaN where nothing was measured."""
    parts, at, p = [], 0, record.machine.plant.p
    for one in record.segments:
        part = rest[at : at + one.y.size].reshape(-1, p) * np.sqrt(record.scale.variance)
        parts.append(np.where(one.measured, part, np.nan))
        at += len(one.basis)
    return np.concatenate(parts)


def room_of(
    machine: ProductionModel, segments: Segments, scale: Scatter, changes: Changes
) -> tuple[Scatter, RoomAir]:
    """The surroundings under which what is left of the record is likeliest, and the scale there: of draughts
    the one-step errors are larger than the champion's own, and the record itself says by how much."""
    rooms = []
    for room in ROOMS:
        there = scale
        if room.draught:
            asked = record(machine, segments, scale, room)
            errors = by_output(asked, left(asked, changes))
            there = scale._replace(variance=np.nanmean(errors**2, axis=0) + 1e-9)
        asked = record(machine, segments, there, room)
        e = left(asked, changes)
        samples = sum(one.measured.sum(axis=0) for one in asked.segments)
        cost = float(e @ e + samples @ np.log(there.variance)) + _log_determinant(asked)
        rooms.append((cost + DRAUGHTY * (room.draught > 0), there, room))
    return min(rooms, key=lambda one: one[0])[1:]


def _log_determinant(record: DriftRecord) -> float:
    """log det of the errors' covariance by what the nuisances add to it."""
    columns = [*(one.columns for one in record.segments), _held(record.common, 0)]
    return float(sum(2 * np.log(np.abs(np.diag(np.linalg.qr(one, mode="r")))).sum() for one in columns))


def levels(record: DriftRecord, changes: Changes) -> tuple[float, np.ndarray]:
    """°C by which the air around differs from what the model knows, and each output's own level (p,)."""
    rows, n = _held(record.common, 0), record.machine.plant.n
    errors = _padded(_freed(record, _errors(record, changes))[:, 0], len(rows))
    own = np.linalg.lstsq(rows, errors, rcond=None)[0] * record.scale.level
    offsets = tuple((DriftCause("offset", i), float(level)) for i, level in enumerate(own))
    pairs = zip(record.segments, _errors(record, (*changes, *offsets)), strict=True)
    airs = [
        np.linalg.lstsq(one.columns, _padded(error[:, 0], len(one.columns)), rcond=None)[0][n]
        for one, error in pairs
    ]
    air = np.average(airs, weights=[len(one.y) for one in record.segments])
    return float(air * record.scale.ambient), own


# ---- one cause


def fitted(
    record: DriftRecord, changes: Changes, cause: DriftCause, start: np.ndarray | None = None
) -> CauseFit:
    """The change of one cause that explains most beside `changes` (Gauss and Newton's steps); `start` (N,)
    are the errors left without it."""

    def errors(value: float) -> np.ndarray:
        return left(record, (*changes, (cause, value)))

    before = left(record, changes) if start is None else start
    if cause.kind == "saturation":
        return _capped(record, cause, before, errors)
    (step, low, high), value, e = RANGES[cause.kind], 0.0, before
    for guess in GUESSES.get(cause.kind, ()):
        tried = errors(guess)
        if tried @ tried < e @ e:
            e, value = tried, guess
    psi = e - errors(value + step)
    for _ in range(6):
        move = step * float(psi @ e) / max(float(psi @ psi), 1e-30)
        there = float(np.clip(value + move, low, high))
        tried = errors(there)
        if tried @ tried > e @ e - ENOUGH:
            break
        e, value = tried, there
        psi = e - errors(value + step)
    return CauseFit(cause, value, _deviation(psi / step, e), float(before @ before - e @ e))


def _deviation(psi: np.ndarray, e: np.ndarray) -> float:
    """Standard deviation of an estimate with sensitivity psi (N,) and errors e (N,): no less than white ones
    give, and robust to colour by the blocks' own scores."""
    information = max(float(psi @ psi), 1e-30)
    scores = np.array([block.sum() for block in np.array_split(psi * e, BLOCKS)])
    return float(np.sqrt(max((scores**2).sum() * BLOCKS / (BLOCKS - 1), information)) / information)


def _capped(
    record: DriftRecord, cause: DriftCause, before: np.ndarray, errors: Callable[[float], np.ndarray]
) -> CauseFit:
    """The level above which an input has no effect: the best of a fine grid, then between its neighbours
    (Brent's method)."""
    u = np.concatenate([one.u[:, cause.channel] for one in record.segments])
    low, high = float(u.min()), float(u.max())
    if high - low < 1e-6:
        return CauseFit(cause, high, 1.0, 0.0)

    def cost(level: float) -> float:
        e = errors(float(level))
        return float(e @ e)

    grid, width = np.linspace(high, low - 0.5 * (high - low), 25, retstep=True)
    best = min(grid[1:], key=cost)
    within = (best + width, best - width)
    nearer = scipy.optimize.minimize_scalar(cost, bounds=within, method="bounded", options={"maxiter": 12}).x
    level, step = float(min(best, nearer, key=cost)), 0.05 * (high - low)
    e = errors(level)
    psi = (errors(level - step) - e) / step
    return CauseFit(cause, level, _deviation(psi, e), max(float(before @ before - e @ e), 0.0))


def above(segments: Segments, j: int, level: float) -> float:
    """Percent of the samples in which so much more than `level` is asked of input j that it matters."""
    return 100 * float(np.mean(np.concatenate([u[:, j] for u, _ in segments]) > (1 + LOST) * level))


def moved(record: DriftRecord, changes: Changes, now: Changes) -> np.ndarray:
    """°C (p,) by which the outputs' level differs between two states of the machine under the record's
    inputs."""
    outputs = (
        np.concatenate([predicted(record.machine, one, state) for one in record.segments])
        for state in (now, changes)
    )
    return np.abs(np.subtract(*outputs).mean(axis=0))


def alone(record: DriftRecord, changes: Changes) -> list[CauseFit]:
    """Every cause, each as if it alone had changed."""
    before = left(record, changes)
    return [fitted(record, changes, cause, before) for cause in causes(record.machine.plant)]


# ---- the causes that explain the record


class NamedCause(NamedTuple):
    """A change that explains the record, with the rivals that it cannot be told from."""

    fit: CauseFit
    rivals: list[CauseFit]


class Explanation(NamedTuple):
    """Of a record: the causes that are named, the largest first, what the others seem beside them, all
    changes together, and the errors (N,) left."""

    named: list[NamedCause]
    others: list[CauseFit]
    changes: Changes
    left: np.ndarray


def explain(record: DriftRecord, changes: Changes, usual: Mapping[DriftCause, float]) -> Explanation:
    """Names what changed beside `changes`, one cause after the other; `usual` is what each cause explains of
    the champion's own records at most, which is no change of the machine."""
    now, fits, found = changes, alone(record, changes), []
    while len(found) < MOST:
        remainder = REMAINDER * found[0].fit.explained if found else 0.0
        worth = np.array([
            fit.explained
            if abs(_from_none(fit)) >= SURE
            and fit.explained > max(SURE**2, 2 * usual.get(fit.cause, 0.0), remainder)
            else -np.inf
            for fit in fits
        ])  # fmt: skip
        # transport is commoner than a late sensor, which is named if it explains more
        behind = [RIVALS * _colour(fit) if fit.cause.kind == "late sensor" else 0.0 for fit in fits]
        best = int((worth - behind).argmax())
        if not np.isfinite(worth[best]):
            break
        close = worth > worth[best] - RIVALS * _colour(fits[best])
        found.append(NamedCause(fits[best], [fits[k] for k in np.flatnonzero(close) if k != best]))
        now = (*now, fits[best][:2])
        before = left(record, now)
        fits = [fitted(record, now, fit.cause, before) for k, fit in enumerate(fits) if k != best]
    if len(found) > 1:
        found, now = _polished(record, changes, found)
    return Explanation(found, fits, now, left(record, now))


def explain_segments(
    machine: ProductionModel,
    segments: Segments,
    scale: Scatter,
    changes: Changes,
    usual: Mapping[DriftCause, float],
) -> tuple[DriftRecord, Explanation]:
    """A record explained in the surroundings that it was made in: asked first in restless ones, which
    cost the least to take for calm. What only another season's air tells from a change of the machine is
    decided by what explains more."""
    asked = record(machine, segments, scale)
    explained = explain(asked, changes, usual)
    there, room = room_of(machine, segments, scale, explained.changes)
    if room != RESTLESS:
        asked = record(machine, segments, there, room)
        explained = explain(asked, changes, usual)
    same = record(machine, segments, there, room._replace(another_season=False))
    rest = left(same, explained.changes)
    if not explained.named and float(rest @ rest - explained.left @ explained.left) < SURE**2:
        return same, Explanation([], alone(same, changes), changes, rest)
    return min((same, explain(same, changes, usual)), (asked, explained), key=_cost)


def _cost(candidate: tuple[DriftRecord, Explanation]) -> float:
    record, explained = candidate
    unlikely = float(explained.left @ explained.left) + _log_determinant(record)
    return unlikely + CAUSE * len(explained.named)


def _from_none(fit: CauseFit) -> float:
    """Sigmas of a change from none; a cap has none to be measured from."""
    if fit.cause.kind == "saturation":
        return np.sqrt(fit.explained)
    return fit.value / fit.deviation


def _colour(fit: CauseFit) -> float:
    """Variance of the estimate in that of white errors, from 1 on."""
    if fit.cause.kind == "saturation":
        return 1.0
    return max(1.0, fit.explained * (fit.deviation / max(abs(fit.value), 1e-12)) ** 2)


def _polished(
    record: DriftRecord, changes: Changes, found: list[NamedCause]
) -> tuple[list[NamedCause], Changes]:
    """Several causes fitted beside each other, in turns."""
    for _ in range(3):
        for k, named in enumerate(found):
            others = [other.fit[:2] for other in found if other is not named]
            found[k] = named._replace(fit=fitted(record, (*changes, *others), named.fit.cause))
    return found, (*changes, *(named.fit[:2] for named in found))


# ---- a figure against those of the champion's nights


class Shift(NamedTuple):
    """How far a figure has moved from its reference: value and reference, the standard deviation of their
    difference, and the ratio `sigmas`."""

    value: np.ndarray
    reference: np.ndarray
    deviation: np.ndarray
    sigmas: np.ndarray


def shift(
    value: np.ndarray,
    deviation: np.ndarray,
    before: np.ndarray,
    before_deviation: np.ndarray,
    *,
    freedom: int = BLOCKS - 1,
    nights: int = 0,
) -> Shift:
    """value (k,) against those of the reference nights before (rows, k): their mean, and as noise both
    nights' own and what they scatter beyond it (DerSimonian and Laird 1986). `nights` is how many of the rows
    are independent, 0 if all are.

    A night's own deviation has `freedom`, the scatter of a few nights less: both count with the
    degrees of freedom that they have (Satterthwaite 1946), and the ratio is brought to the sigmas
    that a normal variable would need to be as unlikely.
    """
    nights = nights or len(before)
    inside = (before_deviation**2).mean(axis=0)
    scattered = before.var(axis=0) * nights / max(nights - 1, 1)
    between = np.maximum(scattered - inside, 0.0) if nights > 1 else np.zeros_like(inside)
    own, scatter = np.maximum(deviation**2 + inside / nights, 1e-24), between * (1 + 1 / nights)
    spread = np.sqrt(own + scatter)
    t = (value - before.mean(axis=0)) / spread
    degrees = spread**4 / (own**2 / freedom + scatter**2 / max(nights - 1, 1))
    tail = np.maximum(scipy.stats.t.sf(np.abs(t), degrees), 1e-290)
    return Shift(value, before.mean(axis=0), spread, np.sign(t) * scipy.stats.norm.isf(tail))
