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

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg
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


class MachineChanges(NamedTuple):
    """Of a machine against the model: share of each gain (m,), of each rate (m,), delay in samples (m,), the
    most that acts of each input (m,), then offset in °C (p,) and lateness in samples (p,) of each output."""

    gain: np.ndarray
    rate: np.ndarray
    delay: np.ndarray
    cap: np.ndarray
    offset: np.ndarray
    late: np.ndarray

    @classmethod
    def none(cls, m: int, p: int) -> "MachineChanges":
        zeros = np.zeros(m)
        return cls(zeros, zeros, zeros, np.full(m, np.inf), np.zeros(p), np.zeros(p))


FIELD = {
    "gain": "gain",
    "time constant": "rate",
    "delay": "delay",
    "saturation": "cap",
    "offset": "offset",
    "late sensor": "late",
}


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


def with_change(changes: MachineChanges, cause: DriftCause, value: float) -> MachineChanges:
    """`changes` with that of one cause moved by `value`; a saturation is set to it."""
    name = FIELD[cause.kind]
    moved = getattr(changes, name).copy()
    at = slice(None) if cause.channel < 0 else cause.channel
    if cause.kind == "gain":
        moved[at] = (1 + moved[at]) * (1 + value) - 1
    elif cause.kind == "saturation":
        moved[at] = value
    else:
        moved[at] = moved[at] + value
    return changes._replace(**{name: moved})


def faster(plant: Plant, share: float) -> Plant:
    """The plant with every rate 1 + share as high, its time constants 1 / (1 + share) as long, its steady
    gains the same: expm((1 + share) log [A B b; 0 I]).

    A plant whose logarithm is not real (dead times, poles on the negative axis) has
    its slow modes quickened, I - (1 + share) (I - A).
    """
    n, m = plant.n, plant.m
    rate = 1.0 + share
    augmented = np.block([[plant.A, plant.B, plant.b[:, None]], [np.zeros((m + 1, n)), np.eye(m + 1)]])
    eigenvalues = np.linalg.eigvals(plant.A)
    if (
        np.abs(eigenvalues).min() > 0.05
        and not ((eigenvalues.real < 0) & (np.abs(eigenvalues.imag) < 1e-9)).any()
    ):
        with np.errstate(all="ignore"):
            power = scipy.linalg.expm(scipy.linalg.logm(augmented) * rate)
        if np.isfinite(power).all() and np.abs(power.imag).max() < 1e-6:
            power = power.real
            return plant._replace(A=power[:n, :n], B=power[:n, n : n + m], b=power[:n, -1])
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
    at = np.clip(np.arange(len(values)) - samples, 0, len(values) - 1)
    low = np.floor(at).astype(int)
    high, share = np.minimum(low + 1, len(values) - 1), at - low
    share = share.reshape(-1, *[1] * (values.ndim - 1))
    return (1 - share) * values[low] + share * values[high]


class ProductionModel:
    """The champion's model, ready to be asked: a plant that is stable over the record, its observer's
    gain K (n, p), and what it has already worked out."""

    def __init__(self, plant: Plant, samples: int):
        self.plant = plant._replace(A=clip_spectral_radius(plant.A, 1.0 - 1.0 / max(samples, 10)))
        own = plant.K
        stable = np.abs(np.linalg.eigvals(self.plant.A - own @ plant.C)).max() < 1
        self.K = own if stable else np.zeros_like(own)
        self._faster: dict[float, Plant] = {0.0: self.plant}
        self._gains: dict[float, np.ndarray] = {0.0: self.K}

    def gain(self, draught: float, variance: np.ndarray) -> np.ndarray:
        """Kalman's gain (n, p) where draughts take so many percent from each input, sample by sample."""
        if draught not in self._gains:
            A, C, B = self.plant.A, self.plant.C, self.plant.B
            Q = draught**2 * B @ B.T + self.K @ np.diag(variance) @ self.K.T + 1e-9 * np.eye(len(A))
            try:
                P = scipy.linalg.solve_discrete_are(A.T, C.T, Q, np.diag(variance))
            except (
                np.linalg.LinAlgError
            ):  # a mode on the unit circle that no output shows: draughts are not asked
                P = None
            forgets = None if P is None else A @ P @ C.T @ np.linalg.inv(C @ P @ C.T + np.diag(variance))
            self._gains[draught] = self.K if forgets is None else forgets
        return self._gains[draught]

    def faster(self, share: float) -> Plant:
        if share not in self._faster:
            self._faster[share] = faster(self.plant, share)
        return self._faster[share]

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
    """Segments held against a machine at a scale, in a room, by an observer of gain K; `basis` is that of the
    outputs' levels, which all segments share, and `common` (N, p) those levels before they were made
    orthonormal."""

    machine: ProductionModel
    scale: Scatter
    room: RoomAir
    K: np.ndarray
    segments: list[RecordSegment]
    basis: np.ndarray
    common: np.ndarray


def record(
    machine: ProductionModel, segments: Segments, scale: Scatter, room: RoomAir = RESTLESS
) -> DriftRecord:
    """A record ready to be asked. Raises ValueError where it is too short."""
    plant = machine.plant
    long = [(u, y) for u, y in segments if len(y) >= 4 * plant.n + 8]
    if sum(len(y) for _, y in long) < SHORTEST:
        raise ValueError(
            f"drift: expected records of at least {SHORTEST} samples to hold against the champion, "
            f"found {sum(len(y) for _, y in long)}; record longer"
        )
    scale = _in(scale, room)
    K, none = machine.gain(room.draught, scale.variance), np.zeros((0, 0))
    made, bare = [], DriftRecord(machine, scale, room, K, [], none, none)
    for u, y in long:
        measured = np.isfinite(y)
        nuisance = _weighted(bare, _own_nuisances(machine, len(y), scale, room.course), measured)
        columns = _held(nuisance, plant.n)
        made.append(RecordSegment(u, y, measured, {}, columns, np.linalg.qr(columns)[0]))
    bare, level = bare._replace(segments=made), np.diag(scale.level)
    parts = [
        _weighted(bare, np.broadcast_to(level, (len(one.y), *level.shape)), one.measured) for one in made
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


def _freed(record: DriftRecord, parts: Sequence[np.ndarray]) -> np.ndarray:
    """parts (T p, k) of each segment free of its own nuisances, one below the other."""
    freed = []
    for one, part in zip(record.segments, parts, strict=True):
        Q = one.basis
        padded = np.vstack([part, np.zeros((len(Q) - len(part), part.shape[1]))])
        freed.append(padded - Q @ (Q.T @ padded))
    return np.concatenate(freed)


def predicted(machine: ProductionModel, one: RecordSegment, changes: MachineChanges) -> np.ndarray:
    """y-hat (T, p) of a segment with these changes."""
    plant = machine.plant
    y = np.tile(plant.C @ np.linalg.solve(np.eye(plant.n) - plant.A, plant.b) + plant.d, (len(one.u), 1))
    for j in range(plant.m):
        cap = float(changes.cap[j]) if changes.cap[j] < one.u[:, j].max() else np.inf
        key = (j, float(changes.rate[j]), cap)
        if key not in one.answers:
            if len(one.answers) > 60:
                one.answers.clear()
            one.answers[key] = respond(machine.faster(key[1]), j, np.minimum(one.u[:, j], cap))
        answer = one.answers[key]
        y += (1 + changes.gain[j]) * (shifted(answer, changes.delay[j]) if changes.delay[j] else answer)
    for i in np.flatnonzero(changes.late):
        y[:, i] = shifted(y[:, i], changes.late[i])
    return y + changes.offset


def left(record: DriftRecord, changes: MachineChanges) -> np.ndarray:
    """The one-step errors (N,) under these changes, in their own standard deviation and free of every
    nuisance, with what those cost."""
    freed = _freed(record, _errors(record, changes))[:, 0]
    Q = record.basis
    padded = np.concatenate([freed, np.zeros(len(Q) - len(freed))])
    return padded - Q @ (Q.T @ padded)


def _errors(record: DriftRecord, changes: MachineChanges) -> list[np.ndarray]:
    """(T p, 1) of each segment before any nuisance is taken off."""
    parts = []
    for one in record.segments:
        error = one.y - predicted(record.machine, one, changes) - record.scale.mean_level
        error = _bridged(error, one.measured)
        parts.append(_weighted(record, error[:, :, None], one.measured))
    return parts


def _bridged(error: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """What was not measured by a straight line between its neighbours."""
    if measured.all():
        return error
    error, at = error.copy(), np.arange(len(error))
    for i in range(error.shape[1]):
        there = measured[:, i]
        error[:, i] = np.interp(at, at[there], error[there, i]) if there.any() else 0.0
    return error


def by_output(record: DriftRecord, rest: np.ndarray) -> np.ndarray:
    """(samples, p) in °C of errors (N,) that `left` gave; NaN where nothing was measured."""
    parts, at, p = [], 0, record.machine.plant.p
    for one in record.segments:
        part = rest[at : at + one.y.size].reshape(-1, p) * np.sqrt(record.scale.variance)
        parts.append(np.where(one.measured, part, np.nan))
        at += len(one.basis)
    return np.concatenate(parts)


def room_of(
    machine: ProductionModel, segments: Segments, scale: Scatter, changes: MachineChanges
) -> tuple[Scatter, RoomAir]:
    """The surroundings under which what is left of the record is likeliest, and the scale there: of draughts
    the one-step errors are larger than the champion's own, and the record itself says by how much."""
    likeliest = (np.inf, scale, RESTLESS)
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
        cost += DRAUGHTY if room.draught else 0.0
        likeliest = min(likeliest, (cost, there, room), key=lambda found: found[0])
    return likeliest[1], likeliest[2]


def _log_determinant(record: DriftRecord) -> float:
    """log det of the errors' covariance by what the nuisances add to it."""
    R = [np.linalg.qr(one.columns, mode="r") for one in record.segments]
    R.append(np.linalg.qr(_held(record.common, 0), mode="r"))
    return float(sum(2 * np.log(np.abs(np.diag(one))).sum() for one in R))


def levels(record: DriftRecord, changes: MachineChanges) -> tuple[float, np.ndarray]:
    """°C by which the air around differs from what the model knows, and each output's own level (p,)."""
    errors, k = _errors(record, changes), record.common.shape[1]
    freed = _freed(record, errors)[:, 0]
    rows = np.vstack([record.common, np.eye(k)])
    share = np.linalg.lstsq(rows, np.concatenate([freed, np.zeros(k)]), rcond=None)[0]
    n, airs, weights = record.machine.plant.n, [], []
    for one, error in zip(record.segments, errors, strict=True):
        level = np.broadcast_to(np.diag(record.scale.level), (len(one.y), k, k))
        own = error[:, 0] - _weighted(record, level, one.measured) @ share
        airs.append(np.linalg.solve(one.columns.T @ one.columns, one.columns.T @ _padded(own, one))[n])
        weights.append(len(one.y))
    return float(np.average(airs, weights=weights)) * record.scale.ambient, share * record.scale.level


def air_deviation(record: DriftRecord) -> float:
    """Standard deviation in °C of the air's level that `levels` gives."""
    n, longest = record.machine.plant.n, max(record.segments, key=lambda one: len(one.y))
    known = np.linalg.inv(longest.columns.T @ longest.columns)[n, n]
    return float(np.sqrt(known)) * record.scale.ambient


def _padded(values: np.ndarray, one: RecordSegment) -> np.ndarray:
    return np.concatenate([values, np.zeros(len(one.columns) - len(values))])


# ---- one cause


def fitted(
    record: DriftRecord, changes: MachineChanges, cause: DriftCause, start: np.ndarray | None = None
) -> CauseFit:
    """The change of one cause that explains most beside `changes` (Gauss and Newton's steps); `start` (N,)
    are the errors left without it."""
    before = left(record, changes) if start is None else start
    if cause.kind == "saturation":
        return _capped(record, changes, cause, before)
    (step, low, high), value, J = RANGES[cause.kind], 0.0, float(before @ before)
    e, whole = before, J
    if cause.kind in ("delay", "late sensor"):
        for guess in (6.0, 20.0, 40.0):
            there = left(record, with_change(changes, cause, guess))
            if (cost := float(there @ there)) < J:
                e, value, J = there, guess, cost
    psi = e - left(record, with_change(changes, cause, value + step))
    for _ in range(6):
        move = step * float(psi @ e) / max(float(psi @ psi), 1e-30)
        tried = float(np.clip(value + move, low, high))
        there = left(record, with_change(changes, cause, tried))
        if (cost := float(there @ there)) >= J:
            break
        done = J - cost < 0.01
        e, value, J = there, tried, cost
        psi = e - left(record, with_change(changes, cause, value + step))
        if done:
            break
    return CauseFit(cause, value, _deviation(psi / step, e), whole - J)


def _deviation(psi: np.ndarray, e: np.ndarray) -> float:
    """Standard deviation of an estimate with sensitivity psi (N,) and errors e (N,): no less than white ones
    give, and robust to colour by the blocks' own scores."""
    information = max(float(psi @ psi), 1e-30)
    scores = np.array([float(a @ b) for a, b in zip(_blocks(psi), _blocks(e), strict=True)])
    return float(np.sqrt(max((scores**2).sum() * BLOCKS / (BLOCKS - 1), information)) / information)


def _blocks(values: np.ndarray) -> list[np.ndarray]:
    return np.array_split(values, BLOCKS)


def _capped(record: DriftRecord, changes: MachineChanges, cause: DriftCause, before: np.ndarray) -> CauseFit:
    """The level above which an input has no effect: the best of a fine grid, then Newton's steps."""
    j = cause.channel
    u = np.concatenate([one.u[:, j] for one in record.segments])
    low, high = float(u.min()), float(u.max())
    whole = float(before @ before)
    if high - low < 1e-6:
        return CauseFit(cause, high, 1.0, 0.0)
    grid = np.linspace(high, low - 0.5 * (high - low), 25)[1:]

    def cost(level: float) -> float:
        e = left(record, with_change(changes, cause, level))
        return float(e @ e)

    costs = [cost(level) for level in grid]
    best, width = int(np.argmin(costs)), float(grid[0] - grid[1])
    level, J = float(grid[best]), costs[best]
    for _ in range(6):
        width /= 2
        J, level = min((J, level), *((cost(level + side), level + side) for side in (-width, width)))
    e = left(record, with_change(changes, cause, level))
    step = 0.05 * (high - low)
    psi = (left(record, with_change(changes, cause, level - step)) - e) / step
    return CauseFit(cause, level, _deviation(psi, e), max(whole - J, 0.0))


def above(segments: Segments, j: int, level: float) -> float:
    """Percent of the samples in which so much more than `level` is asked of input j that it matters."""
    return 100 * float(np.mean(np.concatenate([u[:, j] for u, _ in segments]) > (1 + LOST) * level))


def moved(record: DriftRecord, changes: MachineChanges, now: MachineChanges) -> np.ndarray:
    """°C (p,) by which the outputs' level differs between two states of the machine under the record's
    inputs."""
    parts = [
        predicted(record.machine, one, now) - predicted(record.machine, one, changes)
        for one in record.segments
    ]
    return np.abs(np.concatenate(parts).mean(axis=0))


def alone(record: DriftRecord, changes: MachineChanges) -> list[CauseFit]:
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
    changes: MachineChanges
    left: np.ndarray


def explain(record: DriftRecord, changes: MachineChanges, usual: Mapping[DriftCause, float]) -> Explanation:
    """Names what changed beside `changes`, one cause after the other; `usual` is what each cause explains of
    the champion's own records at most, which is no change of the machine."""
    now, fits, found = changes, alone(record, changes), []
    for _ in range(MOST):
        least = np.array([max(SURE**2, 2 * usual.get(fit.cause, 0.0)) for fit in fits])
        worth = np.array([fit.explained for fit in fits])
        if found:
            least = np.maximum(least, REMAINDER * found[0].fit.explained)
        surely = np.array([abs(_from_none(fit)) >= SURE for fit in fits])
        worth = np.where((worth > least) & surely, worth, -np.inf)
        best = int(worth.argmax())
        if not np.isfinite(worth[best]):
            break
        if fits[best].cause.kind == "late sensor":
            best = _rather_transport(fits, worth, best)
        rivals = [
            fit
            for k, fit in enumerate(fits)
            if k != best and worth[best] - worth[k] < RIVALS * _colour(fits[best])
        ]
        found.append(NamedCause(fits[best], rivals))
        now = with_change(now, fits[best].cause, fits[best].value)
        before = left(record, now)
        taken = {named.fit.cause for named in found}
        fits = [fitted(record, now, fit.cause, before) for fit in fits if fit.cause not in taken]
    if len(found) > 1:
        found, now = _polished(record, changes, found)
    return Explanation(found, fits, now, left(record, now))


def explain_segments(
    machine: ProductionModel,
    segments: Segments,
    scale: Scatter,
    changes: MachineChanges,
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
    within = explain(same, changes, usual)
    return min((same, within), (asked, explained), key=_cost)


def _cost(told: tuple[DriftRecord, Explanation]) -> float:
    record, explained = told
    unlikely = float(explained.left @ explained.left) + _log_determinant(record)
    return unlikely + CAUSE * len(explained.named)


def _rather_transport(fits: Sequence[CauseFit], worth: np.ndarray, best: int) -> int:
    """The delay of an input where a late sensor explains no more: transport is the commoner cause."""
    for k, fit in enumerate(fits):
        if fit.cause.kind == "delay" and worth[best] - worth[k] < RIVALS * _colour(fits[best]):
            return k
    return best


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
    record: DriftRecord, changes: MachineChanges, found: list[NamedCause]
) -> tuple[list[NamedCause], MachineChanges]:
    """Several causes fitted beside each other, in turns."""
    fits = [named.fit for named in found]
    for _ in range(3):
        for k, fit in enumerate(fits):
            others = changes
            for other in fits[:k] + fits[k + 1 :]:
                others = with_change(others, other.cause, other.value)
            fits[k] = fitted(record, others, fit.cause)
    together = changes
    for fit in fits:
        together = with_change(together, fit.cause, fit.value)
    return [named._replace(fit=fit) for named, fit in zip(found, fits, strict=True)], together


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
