"""Identifies the whole chain of the extruder from every learning trial. The trials that are left out decide
its structure and give its error. The members are chains that the trials cannot tell from it."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.signal

from pipeline.deposition.extruder import DAMPING, Extruder, backlash, lagged
from pipeline.deposition.parts.library import TooFewTrials, Training


class IdentifiedExtruder(NamedTuple):
    """An extruder with the fields of `extruder.Extruder`, in the same order, and further effects that the
    trials may show.

    Flow falls with fall_ratio times the time constant of its rise. A further lag second_lag_s follows the
    second-order lag. flow = K level (p / level)^exponent, with p the pressed mm and `level` the steady
    command of the fastest routine. The defaults give the plain `Extruder`.
    """

    gain: float
    time_constant_s: float
    delay_s: float = 0.0
    lag_hz: float = math.inf
    play: float = 0.0
    yield_: float = 0.0
    creep_share: float = 0.0
    creep_time_s: float = 20.0
    fall_ratio: float = 1.0
    second_lag_s: float = 0.0
    exponent: float = 1.0
    level: float = 1.0


# the order of the unknowns: ln K, ln tau, delay, ln lag, play, yield, creep share, ln creep time, ln fall
# ratio, second lag, ln exponent; play and yield in shares of the steady command and flow
LOW = np.array([math.log(1e-3), math.log(0.05), 0.0, 0.0, 0.0, 0.0, 0.0, math.log(5.0), -1.0, 0.0, -1.0])
HIGH = np.array([math.log(1e3), math.log(100.0), 1.0, 3.0, 0.3, 0.5, 0.5, math.log(200.0), 1.0, 0.8, 1.0])
# steps of the Jacobian, small against the resolution of a trial and large against rounding
STEP = np.array([1e-3, 1e-3, 1e-3, 1e-2, 1e-3, 1e-3, 2e-3, 1e-2, 1e-3, 2e-3, 1e-3])
# the unknowns of every chain, and the extras, each of which is kept only if left-out trials prefer it
ALWAYS = (0, 1, 2, 4, 5)
EXTRAS = {"creep": (6, 7), "fall": (8,), "second_lag": (9,), "exponent": (10,)}
# the second-order lag, which is removed unless left-out rows prefer it
LAG, LAG_AT = "lag", 3
AVERAGE_S = 0.2
# a measured flow wanders from trial to trial: changes slower than this
# are trusted less than white noise would be
DRIFT_S = 4.0
# number of chains that the trials cannot tell from the identified one: a power of two
MEMBERS = 32
# for fewer rows a loop over plain numbers is faster than one over arrays
FEW_ROWS = 48
# an extra is kept if the squared innovations of left-out routines fall by this share, some fifty times the
# effect of a useless extra on white noise, and fall in this share of the routines
MARGIN, AGREE = 0.002, 0.75
# steps of a fit that starts from the fit to all rows
REFITS = 3
# a chain with more than this many times the least squared innovations can be told from the best by the trials
UNLIKELY = 1.05


class Chain(NamedTuple):
    """The identified extruder, and how far to trust it.

    `residual_percent`: r.m.s. of measured minus simulated flow over all trials; `held_out_percent`: r.m.s.
    error on learned trials of routines that the fit did not see, of means over AVERAGE_S; both in % of the
    steady flow. `structure`: the effects that were kept in addition to gain, time constant, delay, play and
    yield. `left_out`: the fits without one routine each (without one row each if there is only one routine),
    in their order; `members`: the fits that the trials cannot tell from the best. `trials`: number of trials
    used; `rows`: number of rows (`records`).
    """

    extruder: IdentifiedExtruder
    residual_percent: float
    held_out_percent: float
    structure: tuple[str, ...]
    left_out: tuple[IdentifiedExtruder, ...]
    members: tuple[IdentifiedExtruder, ...]
    trials: int
    rows: int


class Records(NamedTuple):
    """Rows (N, T) of commands u and measured flows y; `routine` (N,): the routine of each row; `weight` (N,
    T): root of the number of trials behind a row, 0 where y is unknown or beyond the end."""

    u: np.ndarray
    y: np.ndarray
    weight: np.ndarray
    routine: np.ndarray


def records(trainings: Sequence[Training], *, early: int = 3) -> Records:
    """Returns all trials as rows. The first `early` trials of each routine are a row each, because u still
    changes there. The later ones, whose commands hardly differ, are one row with their mean."""
    rows = []
    for index, training in enumerate(trainings):
        u, y = np.asarray(training.u, float), np.asarray(training.y, float)
        alone = min(early, len(u) - 1)
        for part in (*(slice(j, j + 1) for j in range(alone)), slice(alone, len(u))):
            observable = np.isfinite(y[part])
            count = observable.sum(axis=0)
            mean = np.where(observable, y[part], 0.0).sum(axis=0) / np.maximum(count, 1)
            rows.append((u[part].mean(axis=0), mean, np.sqrt(count), index))
    longest = max(len(row[0]) for row in rows)
    padded = [np.stack([np.pad(row[k], (0, longest - len(row[k]))) for row in rows]) for k in range(3)]
    return Records(*padded, np.array([row[3] for row in rows]))


def first_order(x: np.ndarray, time_constant_s: float, sample_time_s: float) -> np.ndarray:
    """Returns x after 1 / (tau s + 1) along the last axis; x is constant between samples."""
    a = math.exp(-sample_time_s / time_constant_s)
    return scipy.signal.lfilter([0.0, 1 - a], [1.0, -a], x)


def asymmetric(x: np.ndarray, rise: np.ndarray, fall: np.ndarray) -> np.ndarray:
    """Returns p(t+1) = x(t) + a (p(t) - x(t)) from p(0) = 0 along the last axis of x (R, T), with a = rise
    (R,) if p is below x and a = fall (R,) if it is above."""
    out = np.empty_like(x)
    if len(x) < FEW_ROWS:
        for row, up, down, values in zip(out, rise.tolist(), fall.tolist(), x.tolist(), strict=True):
            p, walked = 0.0, []
            for v in values:
                walked.append(p)
                above = p - v
                p = v + above * (down if above > 0 else up)
            row[:] = walked
        return out
    p, steps = np.zeros(len(x)), np.ascontiguousarray(x.T)
    walked = np.empty_like(steps)
    for v, row in zip(steps, walked, strict=True):
        row[:] = p
        above = p - v
        p = v + above * np.where(above > 0, fall, rise)
    return walked.T


def fronts(extruders: Sequence[IdentifiedExtruder], u: np.ndarray, sample_time_s: float) -> np.ndarray:
    """Returns u (N, T) after the delay and the lags of each extruder: (P, N, T)."""
    made: dict[tuple[float, ...], np.ndarray] = {}
    for e in extruders:
        key = (e.delay_s, e.lag_hz, e.second_lag_s)
        if key not in made:
            x = lagged(u, e.delay_s, e.lag_hz, sample_time_s)
            if e.second_lag_s > 0:
                a = math.exp(-sample_time_s / e.second_lag_s)
                x = scipy.signal.lfilter([1 - a], [1.0, -a], x)
            made[key] = x
    return np.stack([made[e.delay_s, e.lag_hz, e.second_lag_s] for e in extruders])


def simulate(
    extruders: Sequence[Extruder | IdentifiedExtruder], u: np.ndarray, *, sample_time_s: float
) -> np.ndarray:
    """Returns the flow (P, N, T) of each of P extruders for the rows u (N, T), each from rest. It equals
    extruder.flow for extruders of that structure, but computes many at once."""
    those = [IdentifiedExtruder(*e) for e in extruders]
    x = fronts(those, u, sample_time_s)
    x = backlash(x, np.array([e.play for e in those])[:, None])
    rise = np.exp([-sample_time_s / e.time_constant_s for e in those])
    fall = np.exp([-sample_time_s / (e.time_constant_s * e.fall_ratio) for e in those])
    if np.any(rise != fall):
        rows = u.shape[0]
        p = asymmetric(x.reshape(-1, x.shape[-1]), np.repeat(rise, rows), np.repeat(fall, rows))
        p = p.reshape(x.shape)
    else:
        each = zip(x, those, strict=True)
        p = np.stack([first_order(v, e.time_constant_s, sample_time_s) for v, e in each])
    for k, e in enumerate(those):
        if e.creep_share > 0:
            slow = first_order(x[k], e.creep_time_s, sample_time_s)
            p[k] = (1 - e.creep_share) * p[k] + e.creep_share * slow
        p[k] = np.maximum(flow_of(e, p[k]) - e.yield_, 0.0)
    return p


def flow_of(extruder: IdentifiedExtruder, p: np.ndarray) -> np.ndarray:
    """Returns K level (p / level)^exponent in mm^3/s for the pressed p in mm, odd in p: the flow before the
    yield is subtracted."""
    if extruder.exponent == 1.0:
        return extruder.gain * p
    share = p / extruder.level
    return extruder.gain * extruder.level * np.sign(share) * np.abs(share) ** extruder.exponent


def forecast(extruder: Extruder | IdentifiedExtruder, u: np.ndarray, *, sample_time_s: float) -> np.ndarray:
    """Returns the predicted flow (T,) of one command (T,) from rest."""
    return simulate([extruder], u[None], sample_time_s=sample_time_s)[0, 0]


def _extruder(z: np.ndarray, steady_flow: float) -> IdentifiedExtruder:
    gain = math.exp(z[0])
    level = steady_flow / gain
    return IdentifiedExtruder(
        gain,
        math.exp(z[1]),
        float(z[2]),
        math.exp(z[3]),
        float(z[4] * level),
        float(z[5] * steady_flow),
        float(z[6]),
        math.exp(z[7]),
        math.exp(z[8]),
        float(z[9]),
        math.exp(z[10]),
        level,
    )


def innovations(error: np.ndarray, weight: np.ndarray, sample_time_s: float) -> np.ndarray:
    """Returns the part of the weighted errors (P, N, T) that cannot be predicted if they are white noise plus
    a random walk: the errors filtered by (1 - q^-1) / (1 - theta q^-1), theta = exp(-Ts / DRIFT_S).

    That is the whitening filter of such a measurement (Muth 1960). Where nothing was measured (weight (N, T)
    0), the last measured error is kept, and the innovation is 0.
    """
    last = np.maximum.accumulate(np.where(weight > 0, np.arange(weight.shape[1]), 0), axis=1)
    held = np.take_along_axis(error * weight, np.broadcast_to(last, error.shape), axis=-1)
    white = scipy.signal.lfilter([1.0, -1.0], [1.0, -math.exp(-sample_time_s / DRIFT_S)], held)
    return np.where(weight > 0, white, 0.0)


class ChainProblem(NamedTuple):
    """The problem to fit: the rows, the steady flow (mm^3/s) by which errors are divided, and the sample
    time."""

    rows: Records
    steady_flow: float
    sample_time_s: float

    def flows(self, z: Sequence[np.ndarray]) -> np.ndarray:
        """Returns the simulated flow (P, N, T) for each vector of unknowns."""
        extruders = [_extruder(one, self.steady_flow) for one in z]
        return simulate(extruders, self.rows.u, sample_time_s=self.sample_time_s)

    def white(self, difference: np.ndarray) -> np.ndarray:
        return innovations(difference, self.rows.weight, self.sample_time_s) / self.steady_flow


class ChainFit(NamedTuple):
    """The unknowns z, and the indices `free` of those that were fitted. At z, for each row: Gauss-Newton's
    matrix H (N, p, p), its gradient g (N, p), the sum of squared innovations cost (N,)."""

    z: np.ndarray
    free: np.ndarray
    H: np.ndarray
    g: np.ndarray
    cost: np.ndarray

    def without(self, out: np.ndarray) -> np.ndarray:
        """Returns the unknowns fitted to all rows except those in `out` (N,), by one step of Gauss-Newton
        from z."""
        return _stepped(self.z, self.free, self.H[~out].sum(axis=0), self.g[~out].sum(axis=0))


def _normal(problem: ChainProblem, z: np.ndarray, free: np.ndarray) -> ChainFit:
    """Computes Gauss-Newton's equations at z by one batch of simulations."""
    sides = np.where(z + STEP < HIGH, STEP, -STEP)[free]
    shifted = np.repeat(z[None], len(free) + 1, axis=0)
    shifted[np.arange(1, len(free) + 1), free] += sides
    flows = problem.flows(list(shifted))
    e = problem.white(flows[:1] - problem.rows.y)[0]
    J = (problem.white(flows[1:] - flows[0]) / sides[:, None, None]).transpose(1, 0, 2)
    return ChainFit(z, free, J @ J.transpose(0, 2, 1), (J @ e[..., None])[..., 0], np.sum(e * e, axis=1))


def _stepped(
    z: np.ndarray, free: np.ndarray, H: np.ndarray, g: np.ndarray, damping: float = 1e-9
) -> np.ndarray:
    """Returns z after one damped step of Gauss-Newton. An unknown at its bound is kept if the step would push
    it beyond."""
    out = z.copy()
    pushed = ((z[free] <= LOW[free]) & (g > 0)) | ((z[free] >= HIGH[free]) & (g < 0))
    moves = np.flatnonzero(~pushed)
    A = H[np.ix_(moves, moves)]
    A = A + damping * np.diag(np.diag(A) + 1e-12 * np.trace(A))
    out[free[moves]] -= np.linalg.solve(A, g[moves])
    out[free] = np.clip(out[free], LOW[free], HIGH[free])
    return out


def fit(problem: ChainProblem, z: np.ndarray, free: np.ndarray, *, evaluations: int) -> ChainFit:
    """Fits the unknowns in `free` by the least sum of squared innovations of simulated - measured flow
    (output error; Levenberg 1944 and Marquardt 1963 within bounds). The other unknowns are kept."""
    best, damping = _normal(problem, z, free), 1e-4
    for _ in range(evaluations):
        H, g = best.H.sum(axis=0), best.g.sum(axis=0)
        candidate = _normal(problem, _stepped(best.z, free, H, g, damping), free)
        gain = best.cost.sum() - candidate.cost.sum()
        if gain < 0:
            damping *= 10
            continue
        done, best, damping = gain < 1e-5 * best.cost.sum(), candidate, damping / 5
        if done:
            break
    return best


def _start(problem: ChainProblem) -> np.ndarray:
    """Returns start values: K is the volume out divided by the displacement in; tau and delay are the best of
    a coarse grid. Raises ValueError if the sum of the commands is not positive."""
    rows, steady_flow = problem.rows, problem.steady_flow
    displaced = np.sum(rows.u * (rows.weight > 0))
    if displaced <= 0:
        raise ValueError(
            "identify: expected commands that press but found a sum of u <= 0; "
            "check the sign of the command (mm, positive pushes material out)"
        )
    gain = max(float(np.sum(rows.y * (rows.weight > 0))), 1e-3 * steady_flow) / displaced
    rest = (math.log(4.5), 0.02, 0.05, 0.0, math.log(20.0), 0.0, 0.0, 0.0)
    grid = [
        np.array([math.log(gain), math.log(tau), delay, *rest])
        for tau in (0.7, 1.5, 3.0, 6.0)
        for delay in (0.05, 0.2)
    ]
    flows = problem.flows(grid)
    return grid[int(np.argmin([np.sum(((f - rows.y) * rows.weight) ** 2) for f in flows]))]


def _left_out(
    problem: ChainProblem, fitted: ChainFit, folds: np.ndarray
) -> tuple[list[np.ndarray], np.ndarray]:
    """Returns the unknowns fitted without each fold, and the flow (N, T) of every row by the fit without its
    fold."""
    names, z = np.unique(folds), []
    for fold in names:
        rest = problem._replace(rows=Records(*(part[folds != fold] for part in problem.rows)))
        z.append(fit(rest, fitted.z, fitted.free, evaluations=REFITS).z)
    flows = problem.flows(z)
    return z, flows[np.searchsorted(names, folds), np.arange(len(folds))]


class ChainCandidate(NamedTuple):
    """A structure: its extras, its fit, and the sum of squared innovations (N,) of each row by the fit
    without that row's fold."""

    extras: tuple[str, ...]
    fitted: ChainFit
    unseen: np.ndarray


def _free(extras: Sequence[str]) -> np.ndarray:
    return np.array(sorted({*ALWAYS, *(i for name in extras for i in (EXTRAS | {LAG: (LAG_AT,)})[name])}))


def _candidate(
    problem: ChainProblem, extras: tuple[str, ...], z: np.ndarray, folds: np.ndarray, evaluations: int
) -> ChainCandidate:
    fitted = fit(problem, z, _free(extras), evaluations=evaluations)
    _, flows = _left_out(problem, fitted, folds)
    white = problem.white((flows - problem.rows.y)[None])[0]
    return ChainCandidate(extras, fitted, np.sum(white**2, axis=1))


def _prefers(better: ChainCandidate, than: ChainCandidate, folds: np.ndarray) -> bool:
    """Returns whether the left-out rows prefer the structure `better`: their squared innovations fall by the
    share MARGIN in total, and fall in the share AGREE of the folds."""
    fall = than.unseen - better.unseen
    agree = np.mean(np.bincount(folds, weights=fall)[np.unique(folds)] > 0)
    return bool(agree >= AGREE and fall.sum() > MARGIN * than.unseen.sum())


def choose(problem: ChainProblem, folds: np.ndarray) -> list[ChainCandidate]:
    """Chooses the structure by forward selection. In each round the two extras whose fit promises most are
    tried, and the first that left-out rows prefer is kept. At the end the lag is removed unless they prefer
    it. Returns all structures tried, the chosen one first."""
    kept = _candidate(problem, (LAG,), _start(problem), folds, 40)
    tried = []
    while True:
        promising = []
        for name in EXTRAS:
            if name not in kept.extras:
                z, extras = _with(kept.fitted.z, name), (*kept.extras, name)
                at = _normal(problem, z, _free(extras))
                H, g = at.H.sum(axis=0), at.g.sum(axis=0)
                move = _stepped(z, at.free, H, g)[at.free] - z[at.free]
                promising.append((at.cost.sum() + 2 * g @ move + move @ H @ move, name, z))
        promising.sort(key=lambda one: one[0])
        for promised, name, z in promising[:2]:
            if promised > (1 - MARGIN) * kept.fitted.cost.sum():
                continue
            candidate = _candidate(problem, (*kept.extras, name), z, folds, 12)
            if _prefers(candidate, kept, folds):
                tried.append(kept)
                kept = candidate
                break
            tried.append(candidate)
        else:
            break
    z = kept.fitted.z.copy()
    z[2] += DAMPING / (math.pi * math.exp(z[LAG_AT]))
    z[LAG_AT] = math.inf
    simpler = _candidate(problem, kept.extras[1:], z, folds, 12)
    return [kept, simpler, *tried] if _prefers(kept, simpler, folds) else [simpler, kept, *tried]


def _with(z: np.ndarray, extra: str) -> np.ndarray:
    """Returns the unknowns with an extra added, at a start value where it has an effect. A second lag takes
    over half of the total lateness."""
    out = z.copy()
    if extra == "creep":
        out[6] = 0.05
    if extra == "second_lag":
        late = out[2] + DAMPING / (math.pi * math.exp(out[3]))
        out[2], out[9] = late / 4, late / 2
        out[3] = min(math.log(4 * DAMPING / (math.pi * max(late, 1e-3))), HIGH[3])
    return out


def averaged(error: np.ndarray, observable: np.ndarray, sample_time_s: float) -> float:
    """Returns the r.m.s. of the means of an error over AVERAGE_S, where it was observable. The means keep
    only a fraction of white noise but all of an error of the flow."""
    box = np.ones(round(AVERAGE_S / sample_time_s))
    count = np.convolve(observable, box, "same")
    return float(
        np.sqrt(
            np.mean(
                (np.convolve(np.where(observable, error, 0.0), box, "same")[count > 0] / count[count > 0])
                ** 2
            )
        )
    )


def _within(fitted: ChainFit, away: np.ndarray) -> np.ndarray:
    """Returns the unknowns shifted by `away` (free,), within their bounds."""
    z, free = fitted.z.copy(), fitted.free
    z[free] = np.clip(z[free] + away, LOW[free], HIGH[free])
    return z


def _members(problem: ChainProblem, fitted: ChainFit) -> list[np.ndarray]:
    """Returns MEMBERS vectors of unknowns that the trials cannot tell from the best: z plus or minus the
    changes from leaving out each cluster of rows, with signs balanced over the members (balanced repeated
    replication, McCarthy 1969).

    If a bound or a curvature makes a member worse than UNLIKELY, its distance from z is halved until it is
    not.
    """
    clusters = np.arange(len(fitted.cost)) % (MEMBERS - 1)
    moved = np.zeros((clusters.max() + 1, len(fitted.free)))
    for k in range(len(moved)):
        moved[k] = fitted.without(clusters == k)[fitted.free] - fitted.z[fitted.free]
    away = scipy.linalg.hadamard(MEMBERS)[:, 1 : len(moved) + 1] @ moved
    most, far = UNLIKELY * fitted.cost.sum(), np.ones(MEMBERS, bool)
    while far.any():
        z = [_within(fitted, one) for one in away[far]]
        cost = np.sum(problem.white(problem.flows(z) - problem.rows.y) ** 2, axis=(1, 2))
        far[far] = cost > most
        away[far] /= 2
    return [_within(fitted, one) for one in away]


def identify(trainings: Sequence[Training], *, sample_time_s: float) -> Chain:
    """Identifies the chain of one material and nozzle from all its trials. Its structure is the one that best
    predicts the routines left out.

    If there is only one routine, its rows are left out instead. Two speeds separate gain from yield; one
    speed cannot, because the two are collinear on one plateau. Raises TooFewTrials if there is no routine or
    one has fewer than two trials, and ValueError if the commands do not press.
    """
    if not trainings or any(len(training.u) < 2 for training in trainings):
        raise TooFewTrials(
            "identify: expected routines of at least two trials each but found "
            f"{[len(t.u) for t in trainings]}; run more trials"
        )
    rows = records(trainings)
    problem = ChainProblem(rows, max(float(np.max(training.r)) for training in trainings), sample_time_s)
    folds = rows.routine if len(trainings) > 1 else np.arange(len(rows.routine))
    chosen = choose(problem, folds)[0]
    z = chosen.fitted.z
    apart, unseen = _left_out(problem, chosen.fitted, folds)
    left = problem.flows([z])[0] - rows.y
    residual = math.sqrt(np.sum((left * rows.weight) ** 2) / np.sum(rows.weight**2))
    last = [np.flatnonzero(folds == fold)[-1] for fold in np.unique(folds)]
    held_out = [averaged(unseen[k] - rows.y[k], rows.weight[k] > 0, sample_time_s) ** 2 for k in last]
    return Chain(
        _extruder(z, problem.steady_flow),
        100 * residual / problem.steady_flow,
        100 * math.sqrt(np.mean(held_out)) / problem.steady_flow,
        chosen.extras,
        tuple(_extruder(one, problem.steady_flow) for one in apart),
        tuple(_extruder(one, problem.steady_flow) for one in _members(problem, chosen.fitted)),
        sum(len(t.u) for t in trainings),
        len(rows.routine),
    )
