"""Has the plant changed since the champion was made? The champion's own observer on the new record, asked in
the words of an engineer: gains, time constants, offsets, noise.

The local approach to change detection (Benveniste, Basseville and Moustakides 1987; Basseville 1998): with e
the one-step errors of the champion's model on the record, and psi = d y-hat / d theta their sensitivity to a
change of one physical parameter, the change that the record asks for is

    theta = (sum psi' S^-1 psi)^-1 sum psi' S^-1 e,     S the errors' variance, output by output,

psi and e taken free of the initial state and of each output's mean, which say nothing of the plant.
Its variance is that of the record's own blocks, so that coloured errors count as what they are.
What the model gets wrong on every record cancels: the estimate on the new record is held against
those on the records that the champion was made of.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.stats

from pipeline.temperature.plant import Plant, clip_spectral_radius
from pipeline.temperature.refinement import Predictor, free_response, linear_recurrence
from pipeline.temperature.tracking import robust_observer_gain

STEP = 0.02  # relative change by which sensitivities are taken: small beside 10 %, large beside rounding
BLOCKS = 24  # into which a record is cut for the variance of an estimate
# the slow observer forgets in an eighth of the record: long enough to tell a gain from a time constant,
# short enough to pass a slow disturbance over
MEMORY = 8
# a gain explains so much more than a time constant, or the other way round, or the record cannot tell
TELLING = 1.3

Segments = Sequence[tuple[np.ndarray, np.ndarray]]


class Cause(NamedTuple):
    """One way in which a plant can change: kind (gain or time constant) of what
    answers to an input, by number; -1 where all do."""

    kind: str
    channel: int


class Estimate(NamedTuple):
    """Of one record: change (causes,) of each parameter as a share, each as if it alone had changed, its
    standard deviation, and the fall of the weighted squared error that it explains; mean (p,) and logarithm
    of the variance (p,) of the errors, each with its standard deviation."""

    change: np.ndarray
    deviation: np.ndarray
    explained: np.ndarray
    mean: np.ndarray
    mean_deviation: np.ndarray
    log_variance: np.ndarray
    log_variance_deviation: np.ndarray


def causes(plant: Plant) -> list[Cause]:
    """The gain from each input and from all, then the time constants in the same order."""
    return [Cause(kind, channel) for kind in ("gain", "time constant") for channel in (*range(plant.m), -1)]


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


def errors(plant: Plant, K: np.ndarray, u: np.ndarray, y: np.ndarray) -> np.ndarray:
    """e (T, p) = y - y-hat of the observer x(t+1) = A x + B u + b + K e with gain K from x = 0; NaN in y is
    passed over by the model's own prediction."""
    e = np.empty_like(y)
    if np.isfinite(y).all():
        drive = u @ (plant.B - K @ plant.D).T + (plant.b - K @ plant.d) + y @ K.T
        x = linear_recurrence(plant.A - K @ plant.C, drive, np.zeros(plant.n))[:-1]
        return y - x @ plant.C.T - u @ plant.D.T - plant.d
    x = np.zeros(plant.n)
    for t in range(len(y)):
        e[t] = y[t] - plant.C @ x - plant.D @ u[t] - plant.d
        x = plant.A @ x + plant.B @ u[t] + plant.b + K @ np.nan_to_num(e[t])
    return e


def observer(plant: Plant, samples: int) -> np.ndarray:
    """The model's own Kalman gain where it has one that is stable, and the slow observer otherwise."""
    own = plant.K
    stable = np.abs(own).max() > 0 and np.abs(np.linalg.eigvals(plant.A - own @ plant.C)).max() < 1
    return own if stable else slow_observer(plant, samples)


def slow_observer(plant: Plant, samples: int) -> np.ndarray:
    """The observer of `tracking.robust_observer_gain` whose slowest
    mode forgets in 1 / MEMORY of the record."""
    wanted = max(1.0 - MEMORY / samples, 0.5)
    taus = np.geomspace(1e-2, 1e7, 19)
    gains = [robust_observer_gain(plant, tau) for tau in taus]
    radii = [np.abs(np.linalg.eigvals(plant.A - K @ plant.C)).max() for K in gains]
    return gains[int(np.abs(np.array(radii) - wanted).argmin())]


def estimate(
    plant: Plant, records: Segments, asked: Sequence[Cause], K: np.ndarray, variance: np.ndarray | None = None
) -> Estimate:
    """What the record's segments (u (T, m), y (T, p)) say of each cause.
    Raises ValueError where they are too short for it."""
    p = plant.p
    parts = [(*_free(plant, K, u, y, asked), len(y)) for u, y in records if len(y) >= 4 * plant.n + 8]
    if sum(part[2] for part in parts) < 4 * BLOCKS:
        raise ValueError(
            f"drift: expected records of at least {4 * BLOCKS} samples to hold against the champion, "
            f"found {sum(part[2] for part in parts)}; record longer"
        )
    e, psi = (
        np.concatenate([part[0] for part in parts]),
        np.concatenate([part[1] for part in parts]),
    )  # (T, p), (T, p, causes)
    mask = np.isfinite(e)
    e, psi = np.where(mask, e, 0.0), np.where(mask[:, :, None], psi, 0.0)
    raw_mean = np.array(
        [np.average(e[:, i], weights=mask[:, i]) if mask[:, i].any() else 0.0 for i in range(p)]
    )
    centred = np.where(mask, e - raw_mean, 0.0)
    counts = np.maximum(mask.sum(axis=0), 2)
    own = np.maximum((centred**2).sum(axis=0) / (counts - 1), 1e-12)
    variance = own if variance is None else variance
    score = np.einsum("tpc,tp->tc", psi, centred / variance)
    information = np.einsum("tpc,p->c", psi**2, 1 / variance)
    alone = np.maximum(information, 1e-12)
    change = score.sum(axis=0) / alone
    # robust to colour: the spread of the blocks' own scores about what the estimate leaves
    residual_score = score - np.einsum("tpc,p->tc", psi**2, 1 / variance) * change
    sums = np.stack([part.sum(axis=0) for part in np.array_split(residual_score, BLOCKS)])
    deviation = np.sqrt(np.maximum((sums**2).sum(axis=0) * BLOCKS / (BLOCKS - 1), information)) / alone
    blocks = [
        (part, on) for part, on in zip(np.array_split(e, BLOCKS), np.array_split(mask, BLOCKS), strict=True)
    ]
    means = np.stack([part.sum(axis=0) / np.maximum(on.sum(axis=0), 1) for part, on in blocks])
    powers = np.stack(
        [
            (np.where(on, part - raw_mean, 0.0) ** 2).sum(axis=0) / np.maximum(on.sum(axis=0), 1)
            for part, on in blocks
        ]
    )
    return Estimate(
        change, deviation, change**2 * information, raw_mean, means.std(axis=0, ddof=1) / np.sqrt(BLOCKS),
        np.log(own),
        powers.std(axis=0, ddof=1) / np.sqrt(BLOCKS) / own,
    )  # fmt: skip


def _free(
    plant: Plant, K: np.ndarray, u: np.ndarray, y: np.ndarray, asked: Sequence[Cause]
) -> tuple[np.ndarray, np.ndarray]:
    """Errors (T, p) and sensitivities (T, p, causes) of one segment, free of the initial
    state; sensitivities also of each output's mean."""
    e = errors(plant, K, u, y)
    quick, slow = faster(plant, STEP), faster(plant, -STEP)
    dA, dB = (quick.A - slow.A) / (2 * STEP), (quick.B - slow.B) / (2 * STEP)
    forgets = plant.A - K @ plant.C
    # what each input alone has done to the state, about its mean; the
    # observer's state would bring its noise along
    moved, A = u - u.mean(axis=0), clip_spectral_radius(plant.A, 1.0 - 1.0 / len(u))
    gains = [
        _passed(plant, K, forgets, np.outer(u[:, j], plant.B[:, j]), np.outer(u[:, j], plant.D[:, j]))
        for j in range(plant.m)
    ]
    times = []
    for j in range(plant.m):
        x = linear_recurrence(A, np.outer(moved[:, j], plant.B[:, j]), np.zeros(plant.n))[:-1]
        times.append(_passed(plant, K, forgets, x @ dA.T + np.outer(moved[:, j], dB[:, j]), None))
    parts = {("gain", -1): np.sum(gains, axis=0), ("time constant", -1): np.sum(times, axis=0)}
    columns = [
        parts.get(tuple(cause), (gains if cause.kind == "gain" else times)[cause.channel]) for cause in asked
    ]
    gamma = free_response_of(plant, K, len(y))
    psi = np.stack(columns, axis=2)
    mask = np.isfinite(e).all(axis=1)
    # the initial state and each output's mean are fitted along, and taken off both
    T, p, n = gamma.shape
    nuisance = np.concatenate([gamma, np.broadcast_to(np.eye(p), (T, p, p))], axis=2)[mask].reshape(-1, n + p)
    both = np.concatenate([np.nan_to_num(e)[:, :, None], np.nan_to_num(psi)], axis=2)[mask].reshape(
        -1, 1 + len(asked)
    )
    fitted = np.linalg.lstsq(nuisance, both, rcond=1e-10)[0]
    start = np.einsum("tpn,nc->tpc", gamma, fitted[:n])
    e = e - start[:, :, 0]
    return e, psi - start[:, :, 1:] - fitted[n:, 1:]


def free_response_of(plant: Plant, K: np.ndarray, T: int) -> np.ndarray:
    """[C; CF; ...] (T, p, n) with F = A - K C."""
    return free_response(
        Predictor(plant.A - K @ plant.C, np.zeros((plant.n, 1)), plant.C, np.zeros((plant.p, 1)), []), T
    )


def _passed(
    plant: Plant, K: np.ndarray, forgets: np.ndarray, drive: np.ndarray, straight: np.ndarray | None
) -> np.ndarray:
    """d y-hat (T, p) of the observer where its state is driven by
    `drive` (T, n) and its output by `straight` (T, p)."""
    through = drive if straight is None else drive - straight @ K.T
    y = linear_recurrence(forgets, through, np.zeros(plant.n))[:-1] @ plant.C.T
    return y if straight is None else y + straight


# ---- the new record against those of the champion


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
) -> Shift:
    """value (k,) against those of the reference nights before (nights, k): their mean, and as noise both
    nights' own and what they scatter beyond it (DerSimonian and Laird 1986).

    A night's own deviation has `freedom`, the scatter of a few nights less: both count with the
    degrees of freedom that they have (Satterthwaite 1946), and the ratio is brought to the sigmas
    that a normal variable would need to be as unlikely.
    """
    nights = len(before)
    inside = (before_deviation**2).mean(axis=0)
    between = np.maximum(before.var(axis=0, ddof=1) - inside, 0.0) if nights > 1 else np.zeros_like(inside)
    own, scatter = np.maximum(deviation**2 + inside / nights, 1e-24), between * (1 + 1 / nights)
    spread = np.sqrt(own + scatter)
    t = (value - before.mean(axis=0)) / spread
    degrees = spread**4 / (own**2 / freedom + scatter**2 / max(nights - 1, 1))
    tail = np.maximum(scipy.stats.t.sf(np.abs(t), degrees), 1e-290)
    return Shift(value, before.mean(axis=0), spread, np.sign(t) * scipy.stats.norm.isf(tail))


def explained(shifted: Shift, estimated: Estimate) -> np.ndarray:
    """(causes,): the weighted squared error that each change explains; causes are rivals for the same error,
    and the largest is the likeliest."""
    information = estimated.explained / np.maximum(estimated.change**2, 1e-30)
    return (shifted.value - shifted.reference) ** 2 * information


def named(fits: np.ndarray, own: np.ndarray, slow: np.ndarray) -> list[int]:
    """The causes that the record names: none where none of them `fits` (causes,), one, or gain and time
    constant of one input where it cannot tell those apart.

    own and slow (causes,) are what each explains under the two observers: the first finds the input, the
    second, which remembers longer, tells steady from slow.
    """
    if not fits.any():
        return []
    half = len(own) // 2
    channel = int(np.where(fits, own, -np.inf).argmax()) % half
    gain, time_constant = slow[channel], slow[channel + half]
    if max(gain, time_constant) < TELLING * min(gain, time_constant):
        return [channel, channel + half]
    return [channel if gain > time_constant else channel + half]


# ---- what is wrong with a record itself


class Mistake(NamedTuple):
    """A mistake that makes the record fit the champion: what it is in words, and how far the errors fall with
    it undone: `error_share` of them is left."""

    words: str
    error_share: float


def mistakes(
    plant: Plant,
    u: np.ndarray,
    y: np.ndarray,
    *,
    inputs: Sequence[str],
    outputs: Sequence[str],
    scale: np.ndarray,
    gross: float,
) -> list[Mistake]:
    """Swapped sensors, swapped inputs and wrong units that explain the record better than taking it at its
    word, the best first; `scale` (p,) is the errors' usual size. The first of the list is the record as it
    is, with its mean squared error; alone where that is below `gross`, for then nothing is wrong.

    `error_share` is the mean squared error with the mistake undone, as a share of that without. The observer
    starts settled, so that a wrong level is an error too.
    """
    K = observer(plant, len(y))

    def misfit(a: np.ndarray, b: np.ndarray) -> float:
        e = errors(plant, K, a, b)
        gamma = free_response_of(plant, K, len(b))
        measured = np.isfinite(e)
        x0 = np.linalg.lstsq(gamma[measured], e[measured], rcond=1e-10)[0]
        rest = (e - gamma @ x0) / scale
        # bounded, so that one wild channel does not drown the others
        return float(np.mean(np.minimum(rest[measured] ** 2, 1e4)))

    as_is, suspects = misfit(u, y), []
    if as_is < gross:
        return [Mistake("", as_is)]
    for names, signals, word, other in ((outputs, y, "sensors", u), (inputs, u, "inputs", y)):
        for i in range(len(names)):
            for j in range(i):
                swapped = signals.copy()
                swapped[:, [i, j]] = swapped[:, [j, i]]
                pair = (other, swapped) if word == "sensors" else (swapped, other)
                suspects.append(
                    Mistake(f"the {word} {names[j]} and {names[i]} are swapped", misfit(*pair) / as_is)
                )
    for name, undo in (("°F", lambda c: (c - 32) / 1.8), ("K", lambda c: c - 273.15)):
        suspects.append(
            Mistake(f"every sensor is in {name} where °C is declared", misfit(u, undo(y)) / as_is)
        )
        for i, output in enumerate(outputs):
            undone = y.copy()
            undone[:, i] = undo(y[:, i])
            suspects.append(Mistake(f"{output} is in {name} where °C is declared", misfit(u, undone) / as_is))
    for factor, words in ((100.0, "shares of 1"), (100.0 / 255.0, "counts of 255")):
        suspects.append(
            Mistake(f"every input is in {words} where percent is declared", misfit(factor * u, y) / as_is)
        )
        for j, name in enumerate(inputs):
            undone = u.copy()
            undone[:, j] *= factor
            suspects.append(
                Mistake(f"{name} is in {words} where percent is declared", misfit(undone, y) / as_is)
            )
    return [Mistake("", as_is), *sorted(suspects, key=lambda mistake: mistake.error_share)]
