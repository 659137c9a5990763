"""What a supervisor knows of an honest machine: an observer of the model, by how much the plants of its
spread may differ from it, and what each fault would look like in the innovation.

The observer has the state x, of the model's state and a drift w (p) in °C a step that it cannot explain:

    e = y - C x - d,   x(t+1) = A x + B u + b + L e

A plant of the spread differs by theta: each input's gain, a sample of delay, its pace, more heat lost. What
that does to e is linear in theta to first order, e = S theta + v with S = C X and X(t+1) = (A - L C) X + V.
theta of each output is learned while the machine runs (recursive least squares, from the spread as its prior
of Gaussian deviations), so that v is what no plant of the spread explains, and its deviation sigma is what is
left open: wide before the machine was seen to move, near the sensors' noise afterwards.

A fault is an input or a sensor that is off by f: its signature s goes through the same observer. All are
followed at once from around the sample at which the innovation first looked odd, each with its amplitude by
least squares: a generalised likelihood ratio (Willsky and Jones 1976) of fixed size.

`Memory` is all that is remembered: arrays of fixed size, which the functions below change in place. Nothing
here allocates what a C99 program could not have declared.
"""

from typing import NamedTuple

import numpy as np
import scipy.linalg

from pipeline.temperature.plant import Plant, markov_parameters, strictly_proper
from pipeline.temperature.tracking import reached_state, riccati

SLOW_SAMPLES = (5.0, 18.0)  # time constants of the slow sensors that the bank holds
MOST_Z = 1e4  # deviations: beyond it an innovation counts as this
DOUBTED = 3.0  # of a sum below: while one is above, nothing is learned
TELLS = 0.5  # share of the variance at rest that a plant of the spread must be able to move
KEPT = 2e-4  # share a sample by which what was learned goes back to the spread
CALM = 1.5  # deviations a sample that a sum of innovations forgets at rest (CUSUM, Page 1954)
STIRRED = 2.2  # and more where the spread leaves all open: what a plant of it does there, it does for long
ODD = 3.0  # deviations, or sum of them, from which the bank is followed
MOST_LATE = 12  # samples: the longest dead time that the bank starts before
EARLIER = (0, 1, 2, 3, 5)  # samples by which a fault may have begun before it was to be seen
RING = MOST_LATE + EARLIER[-1] + 10  # samples kept, so that the bank can start before the first odd one
MOVING, COINCIDENCE = (
    50.0,
    6.0,
)  # what a sensor's lag would show, from which its zone moves; -2 log of the prior
MISFIT = 0.005  # share of what is seen that even the right signature leaves: no model is the machine
SELDOM = 2.0  # -2 log of the prior of a sensor that drifts within seconds, beside a heater's
CATCH_UP = 3  # rows of the ring that the bank takes in a step


class Watch(NamedTuple):
    """Constants of the observer.

    A, F = A - L C (n, n), B (n, m), C (p, n), b (n,), d (p,), L (n, p) of the module's formula; `hurried`
    (n, p) is added to L in manual, where the drift is still to be found. loss (n, n) and warm (n,): more heat
    lost moves x by loss x - warm. x starts at start y + start_0. ones (m + 3,) sum a row.

    prior (m + 3,) deviations of theta; floor (p,) variance in degC^2 of an honest innovation at rest, sd its
    root, `least` the smallest; `unexplained` is the share of what moves an output that no theta explains.
    low, high (m,) in percent; strongest (m,) is the output that each input moves most.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    b: np.ndarray
    d: np.ndarray
    L: np.ndarray
    hurried: np.ndarray
    F: np.ndarray
    loss: np.ndarray
    warm: np.ndarray
    ones: np.ndarray
    start: np.ndarray
    start_0: np.ndarray
    prior: np.ndarray
    floor: np.ndarray
    sd: np.ndarray
    least: float
    unexplained: float
    low: np.ndarray
    high: np.ndarray
    strongest: np.ndarray


class PlantDeviations(NamedTuple):
    """Deviations of an honest plant from the model: of each input's gain, of its pace, of the share of heat
    lost a step, and of a sample of delay (0: the model's; 1: in time or late, nobody knows)."""

    gain: float
    pace: float
    loss: float
    late: float


def watch(
    model: Plant,
    limits: tuple[np.ndarray, np.ndarray],
    noise_degC: np.ndarray,
    spread: PlantDeviations,
    *,
    drift: float = 0.05,
    follows: float = 0.3,
    unexplained: float = 0.25,
) -> Watch:
    """The observer of the stationary Riccati equation: outputs are moved a step by `follows` of the sensors'
    noise (p,), along the state that inputs reach, and the drift wanders by `drift` of it."""
    model = strictly_proper(model)
    n, m, p = model.n, model.m, model.p
    likely, noise = reached_state(model), np.maximum(noise_degC, 1e-3)
    A = np.block([[model.A, likely], [np.zeros((p, n)), LEAK * np.eye(p)]])
    C = np.hstack([model.C, np.zeros((p, p))])
    moved, sensors = likely * follows * noise, np.diag(noise**2)
    P = riccati(A.T, C.T, scipy.linalg.block_diag(moved @ moved.T, np.diag((drift * noise) ** 2)), sensors)
    L = A @ P @ C.T @ np.linalg.inv(C @ P @ C.T + sensors)
    heat = np.vstack([likely, np.zeros((p, p))])
    floor = np.diag(C @ P @ C.T) + noise**2
    return Watch(
        A=A,
        B=np.vstack([model.B, np.zeros((p, m))]),
        C=C,
        b=np.r_[model.b, np.zeros(p)],
        d=model.d,
        L=L,
        hurried=np.vstack([np.zeros((n, p)), HURRIED * np.eye(p) - L[n:]]),
        F=A - L @ C,
        loss=-heat @ C,
        warm=heat @ model.d,
        ones=np.ones(m + 3),
        start=heat.copy(),
        start_0=-heat @ model.d,
        prior=np.r_[np.full(m, spread.gain), spread.late, spread.pace, spread.loss],
        floor=floor,
        sd=np.sqrt(floor),
        least=float(floor.min()),
        unexplained=unexplained,
        low=limits[0],
        high=limits[1],
        strongest=np.abs(markov_parameters(model, MOST_LATE)).max(axis=0).argmax(axis=0),
    )


HURRIED = 0.1  # of an innovation, by which the drift follows in manual
LEAK = 0.9999  # of the drift, kept a step

# ---- the hypotheses

ON, LESS, NOT_APPLIED, STEP, RAMP, LAG = range(6)
# amplitudes that each may have: of what an input could still do, of its command, of the command that was not
# applied, of degC, of degC a sample, of a sensor's lag
LEAST = np.array([0.2, 0.08, 0.4, -1e9, -1e9, 0.3])
MOST = np.array([1.8, 1.5, 1.6, 1e9, 1e9, 3.0])


class Bank(NamedTuple):
    """What each hypothesis is: its form, its input or output, how many samples before the first odd
    innovation it begins, and the share of a lag that a slow sensor keeps a sample, each (h,)."""

    form: np.ndarray
    signal: np.ndarray
    back: np.ndarray
    lag: np.ndarray


def bank(model: Plant) -> Bank:
    """Every input stuck on, or acting less than its command, from as many samples before as its strongest
    output is late, and EARLIER; no command applied; every sensor off by a step or a ramp, or slow."""
    pulses = np.abs(markov_parameters(strictly_proper(model), MOST_LATE))
    strongest = pulses.max(axis=0).argmax(axis=0)
    rows: list[tuple[int, int, int, float]] = []
    for i in range(model.m):
        own = pulses[:, strongest[i], i]
        late = 1 + int(np.argmax(own >= 0.1 * own.max()))
        rows += [(form, i, late + early, 0.0) for form in (ON, LESS) for early in EARLIER]
        rows += [(NOT_APPLIED, 0, late + early, 0.0) for early in EARLIER if i == 0]
    for j in range(model.p):
        rows += [(STEP, j, 0, 0.0), *((RAMP, j, 1 + early, 0.0) for early in EARLIER)]
        rows += [(LAG, j, 1, 1 - 1 / tau) for tau in SLOW_SAMPLES]
    return Bank(*(np.array(column) for column in zip(*rows, strict=True)))


# ---- what is remembered


class Memory(NamedTuple):
    """Z (n, m + 4), the columns x and X of the module's formula; V and Y of the same size are room to compute
    in. theta (p, m + 3) and its covariance P (p, m + 3, m + 3). u (2, m) the inputs of the last two samples,
    newest last; sums (2, p) of innovations upward and downward.

    ring (RING, 2 m + 3 p), past samples, newest last: the inputs of the sample before it and of the one
    before that, the innovation in deviations, the deviation, and what the output should have moved.

    The bank of h hypotheses: Xb (n, h); f (h,) how far a sensor is off, in degC; cross, square (h, p) and own
    (p,) the sums of s z, s s and z z; u0 (m,) the input before, gain (m,) and late the plant's as learned
    until then; age the rows taken, -1 while it rests; ahead the rows of the ring still to take.
    """

    Z: np.ndarray
    V: np.ndarray
    Y: np.ndarray
    theta: np.ndarray
    P: np.ndarray
    u: np.ndarray
    sums: np.ndarray
    ring: np.ndarray
    Xb: np.ndarray
    f: np.ndarray
    cross: np.ndarray
    square: np.ndarray
    own: np.ndarray
    u0: np.ndarray
    gain: np.ndarray
    late: np.ndarray
    age: np.ndarray
    ahead: np.ndarray


def remembered(watch: Watch, bank: Bank) -> Memory:
    """A memory that has seen nothing."""
    n, (m, p, h) = len(watch.A), (watch.B.shape[1], len(watch.d), len(bank.form))
    M = m + 3
    return Memory(
        Z=np.zeros((n, 1 + M)),
        V=np.zeros((n, 1 + M)),
        Y=np.zeros((n, 1 + M)),
        theta=np.zeros((p, M)),
        P=np.tile(np.diag(watch.prior**2), (p, 1, 1)),
        u=np.zeros((2, m)),
        sums=np.zeros((2, p)),
        ring=np.tile(np.r_[np.zeros(2 * m + p), np.ones(p), np.zeros(p)], (RING, 1)),
        Xb=np.zeros((n, h)),
        f=np.zeros(h),
        cross=np.zeros((h, p)),
        square=np.zeros((h, p)),
        own=np.zeros(p),
        u0=np.zeros(m),
        gain=np.ones(m),
        late=np.zeros(1),
        age=np.full(1, -1),
        ahead=np.zeros(1, int),
    )


def started(watch: Watch, memory: Memory, y: np.ndarray) -> None:
    """The observer at outputs y (p,) measured, with nothing learned lost."""
    memory.Z[:] = 0.0
    memory.Z[:, 0] = watch.start @ y + watch.start_0
    rested(memory)


def drift(memory: Memory, p: int) -> np.ndarray:
    """The rows (p, m + 4) of Z that are the drift in degC a step: as followed, and as each theta moves it."""
    return memory.Z[-p:]


def drift_sd(watch: Watch, noise_degC: np.ndarray) -> np.ndarray:
    """Deviation (p,) in degC a step of the observer's drift, of which the sensors' noise (p,) is all that
    there is: X = F X F' + L R L'."""
    F, X = watch.F, watch.L @ np.diag(noise_degC**2) @ watch.L.T
    for _ in range(14):  # each step doubles the samples that count: 16,384
        F, X = F @ F, X + F @ X @ F.T
    return np.sqrt(np.diag(X)[-len(noise_degC) :])


def rested(memory: Memory) -> None:
    """No suspicion: sums and bank begin anew."""
    memory.sums[:] = 0.0
    memory.age[0], memory.ahead[0] = -1, 0


# ---- a sample


def advanced(watch: Watch, memory: Memory, u: np.ndarray, e: np.ndarray) -> np.ndarray:
    """x and X a sample on: inputs u (m,) acted since the sample whose innovation was e (p,), in degC; how far
    (p,) the outputs should have moved."""
    m, Z = len(u), memory.Z
    V = memory.V
    x = Z[:, 0].copy()
    on = watch.A @ x + watch.B @ u + watch.b
    V[:, 0] = on + watch.L @ e
    V[:, 1 : m + 1] = watch.B * u
    V[:, m + 1] = watch.B @ (memory.u[1] - u)
    V[:, m + 2] = x - on
    V[:, m + 3] = watch.loss @ x - watch.warm
    Z[:, 0] = 0.0
    np.matmul(watch.F, Z, out=memory.Y)
    np.add(memory.Y, V, out=Z)
    memory.u[0] = memory.u[1]
    memory.u[1] = u
    return watch.C @ (on - x)


class Seen(NamedTuple):
    """e (p,) the innovation in degC, 0 where the output is not trusted; z (p,) what no plant of the spread
    explains, in deviations; sd (p,) the deviation in degC; expected (p,) the output as forecast, in degC; the
    largest of all sums."""

    e: np.ndarray
    z: np.ndarray
    sd: np.ndarray
    expected: np.ndarray
    highest: float


def seen(watch: Watch, memory: Memory, y: np.ndarray, trusted: np.ndarray) -> Seen:
    """The innovation of outputs y (p,), which tells only where `trusted` (p,) is 1; learns theta from it
    where nothing is odd, and follows its sums."""
    forecast = watch.C @ memory.Z
    expected, S = forecast[:, 0] + watch.d, forecast[:, 1:]
    e = np.where(trusted > 0, y - expected, 0.0)
    told = (S * memory.theta) @ watch.ones
    v, sd, variance, forgets = e - trusted * told, watch.sd, watch.floor, CALM
    moved = S * watch.prior
    stirred = (moved * moved) @ watch.ones
    # what moves no output leaves nothing open, and teaches nothing about the plant
    telling = max(stirred.tolist()) > TELLS * watch.least
    if telling:
        PS = (memory.P @ S[:, :, None])[:, :, 0]
        variance = watch.floor + watch.unexplained**2 * stirred + (S * PS) @ watch.ones
        sd, forgets = np.sqrt(variance), CALM + STIRRED * (1 - watch.floor / variance)
    z, sums = v / sd, memory.sums
    sums[0] += np.minimum(z, MOST_Z) - forgets
    sums[1] -= np.maximum(z, -MOST_Z) + forgets
    np.maximum(sums, 0.0, out=sums)
    highest = max(sums.ravel().tolist())
    if telling and highest < DOUBTED:
        _learned(watch, memory, PS, v, variance)
    return Seen(e, z, sd, expected + told, highest)


def _learned(watch: Watch, memory: Memory, PS, v, variance) -> None:
    """theta and P after innovations v (p,) of a variance (p,): recursive least squares, which forgets."""
    theta, P = memory.theta, memory.P
    theta += PS * (v / variance)[:, None]
    theta *= 1 - KEPT
    P -= PS[:, :, None] * (PS / variance[:, None])[:, None, :]
    P *= (1 - KEPT) ** 2
    diagonal = np.arange(len(watch.prior))
    P[:, diagonal, diagonal] += (1 - (1 - KEPT) ** 2) * watch.prior**2


def kept(memory: Memory, now: Seen, moved: np.ndarray) -> None:
    """The ring with the newest sample; `moved` (p,) in degC is what each output should have moved."""
    ring = memory.ring
    ring[:-1] = ring[1:]
    np.concatenate((memory.u[1], memory.u[0], now.z, now.sd, moved), out=ring[-1])


# ---- the bank


def suspected(watch: Watch, bank: Bank, memory: Memory, now: Seen, *, alarmed: bool) -> None:
    """Starts the bank where the newest innovation or a sum is odd, ends it where no sum is left and nothing
    is `alarmed`, and takes the newest rows of the ring."""
    age, ahead = memory.age, memory.ahead
    if age[0] < 0:
        if now.highest > 0 and max(now.highest, *map(abs, now.z.tolist())) > ODD:
            _begun(watch, bank, memory)
    elif not alarmed and now.highest <= 0:
        age[0], ahead[0] = -1, 0
    else:
        ahead[0] += 1
    for _ in range(min(CATCH_UP, int(ahead[0]))):
        _taken(watch, bank, memory)


def _begun(watch: Watch, bank: Bank, memory: Memory) -> None:
    m, longest = memory.u.shape[1], int(bank.back.max())
    memory.age[0], memory.ahead[0] = 0, longest + 1
    memory.u0[:] = memory.ring[-1 - longest, :m]
    for part in (memory.Xb, memory.f, memory.cross, memory.square, memory.own):
        part[:] = 0.0
    certainty = 1 / memory.P[:, m, m]
    memory.late[0] = min(max(float(memory.theta[:, m] @ certainty / certainty.sum()), 0.0), 1.0)
    memory.gain[:] = 1 + memory.theta[watch.strongest, np.arange(m)]


def _taken(watch: Watch, bank: Bank, memory: Memory) -> None:
    """One row of the ring: Xb of every hypothesis a sample on, and its sums."""
    p, m, row = len(watch.d), memory.u.shape[1], RING - int(memory.ahead[0])
    since = int(memory.age[0]) - int(bank.back.max())  # samples since the first odd innovation
    acts, shows = since - 1 >= -bank.back, since >= -bank.back
    form, signal, late = bank.form, bank.signal, memory.late[0]
    past = memory.ring[row]
    u = (1 - late) * past[:m] + late * past[m : 2 * m]
    z, sd, moved = past[2 * m :].reshape(3, p)
    moved = (1 - late) * moved + late * memory.ring[row - 1, 2 * m + 2 * p :]
    # how far each input is off, as a share of each hypothesis' amplitude
    off = np.zeros((m, len(form)))
    inputs = np.flatnonzero(form <= LESS)
    i = signal[inputs]
    on = form[inputs] == ON
    off[i, inputs] = np.where(on, watch.high[i] - u[i], -(u[i] - watch.low[i])) * memory.gain[i]
    off[:, form == NOT_APPLIED] = (memory.gain * (memory.u0 - u))[:, None]
    sensors = form >= STEP
    j = signal[sensors]
    direct = np.zeros((p, len(form)))
    direct[j, np.flatnonzero(sensors)] = memory.f[sensors]
    memory.Xb[:] = watch.F @ memory.Xb + acts * (watch.B @ off - watch.L @ direct)
    after = np.where(form == RAMP, since + bank.back, 1.0)
    after = np.where(form == LAG, bank.lag * (memory.f - moved[signal % p]), after)
    memory.f[:] = np.where(sensors & shows, after, 0.0)
    s = watch.C @ memory.Xb
    s[j, np.flatnonzero(sensors)] += memory.f[sensors]
    s = (s / sd[:, None]).T
    z = np.minimum(np.maximum(z, -MOST_Z), MOST_Z)
    memory.cross[:] += s * z
    memory.square[:] += s * s
    memory.own[:] += z * z
    memory.age[0] += 1
    memory.ahead[0] -= 1


class Verdict(NamedTuple):
    """What the bank says: cost and amplitude (h,) of every hypothesis and of none; `left` (p,) the mean
    square of what the best one leaves, and `own` (p,) of what was there, in deviations."""

    cost: np.ndarray
    amplitude: np.ndarray
    none: float
    left: np.ndarray
    own: np.ndarray


def judged(bank: Bank, memory: Memory) -> Verdict:
    """-2 log likelihood of each hypothesis at its best amplitude, the deviations of the outputs not known but
    no smaller than an honest one's: n log of the mean square that is left, summed over outputs."""
    n = max(int(memory.age[0]), 1)
    amplitude = memory.cross.sum(axis=1) / np.maximum(memory.square.sum(axis=1), 1e-9)
    amplitude = np.minimum(np.maximum(amplitude, LEAST[bank.form]), MOST[bank.form])
    a = amplitude[:, None]
    left = np.maximum((memory.own - 2 * a * memory.cross + a * a * memory.square) / n, 0.0)
    own = memory.own / n
    cost = n * np.log(np.maximum(left, 1 + MISFIT * own)).sum(axis=1)
    # an offset seldom begins just where its zone moves; a slow sensor is seen nowhere else
    lagging = (bank.form == LAG) & (memory.square.sum(axis=1) > MOVING)
    offset = (bank.form == STEP) | (bank.form == RAMP)
    cost[offset & np.isin(bank.signal, bank.signal[lagging])] += COINCIDENCE
    cost[bank.form == RAMP] += SELDOM
    none = n * float(np.log(np.maximum(own, 1 + MISFIT * own)).sum())
    return Verdict(cost, amplitude, none, left[int(cost.argmin())], own)
