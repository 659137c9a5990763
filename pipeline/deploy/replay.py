"""What a controller would have asked on a recorded machine, sample by sample.

The law sees what the machine measured and what it was really given: its memory, its integrator and its
governor go on from the recorded inputs, as those of `controllers.law.RunningController` do where
another hand moves the heaters. What it asks at a sample is therefore what it would have applied there; of a
recording of its own closed loop it is that loop's commands.

All that is linear runs through a recording in chunks side by side; what is not (integrator, governor) is a
chain of a few numbers, or forgets, and starts each chunk early enough.
"""

import math
from typing import NamedTuple

import numpy as np

from pipeline.temperature.controllers.law import (
    AS_WISHED,
    Aim,
    Deployed,
    Governor,
    Plant,
    Reference,
    aim,
    constant,
    corrected,
    governed,
    predicted,
    rest,
    started,
)

# ---- in chunks

CHUNK = 500  # samples at most that are walked one by one, for all chunks of a block at once
BLOCK = 1 << 17  # samples whose memories are held at once
MOST_REFERENCES = 500  # each is aimed at by a quadratic programme


def scanned(A: np.ndarray, drive: np.ndarray, first: np.ndarray, shift: int = 0) -> np.ndarray:
    """z (..., T + 1, q) with z(0) = first (..., q) and z(t+1) = A z(t) + drive(t), A (..., q, q), drive
    (..., T, q).

    Every chunk goes from zero; then the chunks' ends are joined one after the other; then every chunk goes
    from where it starts. `shift`: A moves z on by so many entries."""
    *sides, T, q = drive.shape
    length = min(max(math.isqrt(T), 1), CHUNK)
    chunks = -(-T // length)
    padded = np.zeros((*sides, chunks * length, q))
    padded[..., :T, :] = drive
    by_chunk = padded.reshape(*sides, chunks, length, q)
    still = np.zeros((*sides, chunks, q))
    ends = _walked(A, by_chunk, still, shift, keep=False)[..., 0, :]
    far, starts = np.linalg.matrix_power(A, length), np.empty((*sides, chunks, q))
    at = first
    for chunk in range(chunks):
        starts[..., chunk, :] = at
        at = np.matmul(far, at[..., None])[..., 0] + ends[..., chunk, :]
    walked = _walked(A, by_chunk, starts, shift, keep=True).reshape(*sides, chunks * length, q)
    return np.concatenate([first[..., None, :], walked[..., :T, :]], axis=-2)


def _walked(A: np.ndarray, drive: np.ndarray, z: np.ndarray, shift: int, *, keep: bool) -> np.ndarray:
    """z after each sample (..., s, c, q) of chunks with drive (..., s, c, q), from z (..., s, q); the last
    alone unless `keep`."""
    *sides, length, q = drive.shape
    walked = np.empty((*sides, length if keep else 1, q))
    for t in range(length):
        after = drive[..., t, :].copy()
        if shift:
            after[..., :-shift] += z[..., shift:]
        else:
            after += np.matmul(z, A.swapaxes(-1, -2))
        z = after
        if keep:
            walked[..., t, :] = z
    if not keep:
        walked[..., 0, :] = z
    return walked


# ---- what it would have asked


class GaplessLog(NamedTuple):
    """A recorded stretch without a gap: inputs u (T, m) in percent that were applied, outputs y (T, p) in °C
    measured before, references r (T, p) in °C; all finite."""

    u: np.ndarray
    y: np.ndarray
    r: np.ndarray


class Replayed(NamedTuple):
    """(T, .): inputs that the law wished; within limits and rate; and asked for, after the governor; the
    target in °C, which is the reference or the nearest that the inputs can hold."""

    wished: np.ndarray
    limited: np.ndarray
    asked: np.ndarray
    target: np.ndarray


WHY = ("", "limit", "rate", "governor")


def replayed(
    controller: Deployed, model: Plant, log: GaplessLog, *, hold: int = 30, forward: np.ndarray | float = 0.0
) -> Replayed:
    """What the controller would have asked on a log. It watches the first `hold` samples, for which nothing
    is asked: they are as recorded. `forward` (T, m) is what is fed forward: the inputs of the log are without
    it, those that are asked for with it."""
    T = len(log.u)
    hold = min(hold, T)
    feeds, target, bump = _aimed(controller, model, log, hold)
    if controller.holds or T == hold:
        still = np.repeat(log.u[max(hold - 1, 0)][None], T, axis=0)
        still[:hold] = log.u[:hold]
        still += forward
        return Replayed(still, still, still, target)
    base = _without_integral(controller, log, feeds)
    wished = base - _integral(controller, log, base, target, hold, bump) @ controller.law.K_r.T
    given, limits = log.u + forward, controller.limits
    before = np.vstack([given[:1], given[:-1]])
    low = np.maximum(limits.low, np.minimum(before - limits.rate, limits.high)) - forward
    high = np.minimum(limits.high, np.maximum(before + limits.rate, limits.low)) - forward
    limited = np.minimum(np.maximum(wished, low), high)
    asked = limited
    if controller.governor is not None:
        asked = _governed(controller.governor, log, limited, target, low, high)
    parts = [part + forward for part in (wished, limited, asked)]
    for part in parts:
        part[:hold] = given[:hold]
    return Replayed(*parts, target)


def why(controller: Deployed, log: GaplessLog, run: Replayed) -> np.ndarray:
    """Of each sample and input (T, m) the index in WHY of what kept it from what the law wished."""
    limits, tiny = controller.limits, 1e-9 * (controller.limits.high - controller.limits.low)
    outside = (run.wished < limits.low - tiny) | (run.wished > limits.high + tiny)
    cut = np.abs(run.limited - run.wished) > tiny
    at_edge = (run.limited <= limits.low + tiny) | (run.limited >= limits.high - tiny)
    reason = np.where(cut & ~(outside & at_edge), 2, np.where(cut, 1, 0))
    return np.where(np.abs(run.asked - run.limited) > tiny, 3, reason)


def _aimed(
    controller: Deployed, model: Plant, log: GaplessLog, hold: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Feed (T, m) and target (T, p) of each sample, and by how much more the law would feed (m,) at the
    hand-over if it were aimed at where the machine is."""
    law, limits = controller.law, controller.limits

    def of(reference: Reference) -> Aim:
        return aim(law, rest(model, reference, limits), reference)

    asked, which = _held(log.r)
    if len(asked) > MOST_REFERENCES:
        raise ValueError(
            f"the references take {len(asked)} values, expected at most {MOST_REFERENCES} that are held; "
            "give the references as steps"
        )
    aims = [of(constant(r)) for r in asked]
    feeds, targets = (np.array([getattr(one, name)[:, 0] for one in aims]) for name in ("feed", "Y"))
    feeds, targets = feeds[which], targets[which]
    at = min(hold, len(log.y) - 1)
    return feeds, targets, of(constant(log.y[at])).feed[:, 0] - feeds[at]


def _held(r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The references that are asked for (k, p), and which of them at each sample (T,)."""
    new = np.r_[True, (r[1:] != r[:-1]).any(axis=1)]
    asked, which = np.unique(r[new], axis=0, return_inverse=True)
    return asked, which.ravel()[np.cumsum(new) - 1]


def _without_integral(controller: Deployed, log: GaplessLog, feeds: np.ndarray) -> np.ndarray:
    """feed - K z - D y (T, m)."""
    law = controller.law
    base = feeds - log.y @ law.D.T
    if not len(law.A):
        return base
    z = law.start_u @ log.u[0] + law.start_y @ log.y[0] + law.start
    for first in range(0, len(log.u), BLOCK):
        rows = slice(first, first + BLOCK)
        drive = log.u[rows] @ law.B_u.T + log.y[rows] @ law.B_y.T + log.r[rows] @ law.B_r.T + law.c
        memory = scanned(law.A, drive, z, controller.shift)
        base[rows] -= memory[:-1] @ law.K.T
        z = memory[-1]
    return base


def _integral(
    controller: Deployed, log: GaplessLog, base: np.ndarray, target: np.ndarray, hold: int, bump: np.ndarray
) -> np.ndarray:
    """xi (T, p) at each sample, from the hand-over at `hold` on:
    xi(t+1) = xi + integral (clip(y* - y) + clip(beyond(P (u - base + K_r xi))))."""
    law, most, back = controller.law, controller.integral_limit, controller.back
    T, p = log.y.shape
    xi = np.zeros((T, p))
    if not np.any(law.integral):
        return xi
    share, coupled = np.broadcast_to(np.asarray(law.integral, float), (p,)), back @ law.K_r
    before = log.u[max(hold - 1, 0)]
    if law.conditional:
        return _conditional(controller, log, base, target, xi, hold)
    at = np.clip((before - base[hold] - bump) @ back.T, -most, most)
    pull, error = (log.u - base) @ back.T, np.clip(target - log.y, -most, most)
    if np.abs(coupled + np.eye(p)).max() < 1e-9:
        for j in range(p):
            xi[hold:, j] = _chain(pull[hold:, j], error[hold:, j], float(share[j]), most, float(at[j]))
        return xi
    for t in range(hold, T):
        xi[t] = at
        shift = pull[t] + coupled @ at
        beyond = shift - np.minimum(np.maximum(shift, -most), most)
        at = at + share * (error[t] + np.minimum(np.maximum(beyond, -most), most))
    return xi


def _chain(pull: np.ndarray, error: np.ndarray, share: float, most: float, at: float) -> np.ndarray:
    """xi (T,) of one output whose integrator nothing couples to another's.

    Where no command is cut by more than `most`, xi is the sum of errors: it is taken for a stretch at once up
    to the first sample at which one is, and from there sample by sample."""
    states, T, t, stretch = np.empty(len(pull)), len(pull), 0, BY_HAND
    summed = np.empty(MOST_AT_ONCE + 1)
    while t < T:
        ahead = summed[: min(stretch, T - t) + 1]
        ahead[0], ahead[1:] = at, share * error[t : t + len(ahead) - 1]
        np.cumsum(ahead, out=ahead)
        free = np.abs(pull[t : t + len(ahead) - 1] - ahead[:-1]) <= most
        whole = len(free) if free.all() else int(free.argmin())
        states[t : t + whole], at = ahead[:whole], float(ahead[whole])
        t += whole
        if whole == len(free):
            stretch = min(2 * stretch, MOST_AT_ONCE)
            continue
        stretch, rows = BY_HAND, slice(t, t + BY_HAND)
        walked = []
        for away, off in zip(pull[rows].tolist(), error[rows].tolist(), strict=True):
            walked.append(at)
            shift = away - at
            beyond = shift - most if shift > most else shift + most if shift < -most else 0.0
            at += share * (off + (most if beyond > most else -most if beyond < -most else beyond))
        states[rows] = walked
        t += len(walked)
    return states


BY_HAND, MOST_AT_ONCE = 128, 1 << 13


def _conditional(
    controller: Deployed, log: GaplessLog, base: np.ndarray, target: np.ndarray, xi: np.ndarray, hold: int
) -> np.ndarray:
    """xi (T, p) of a law with conditional integration (law.Law): it rests where the command is cut."""
    law, limits, back = controller.law, controller.limits, controller.back
    at, moves = back @ log.u[max(hold - 1, 0)], law.K_r != 0
    for t in range(hold, len(xi)):
        xi[t] = at
        after = at + law.integral * (target[t] - log.y[t])
        inside = np.abs(log.u[t] - base[t] + law.K_r @ at) <= AS_WISHED * (limits.high - limits.low)
        within = back @ np.clip(-law.K_r @ after, limits.low, limits.high)
        at = np.where(inside @ moves, within, at)
    return xi


WARM_UP = 3000  # samples after which what a governor at its own pace remembers has faded to 3e-7
SIDE_BY_SIDE = 400  # chunks of a long recording


def _governed(
    family: Governor, log: GaplessLog, u: np.ndarray, target: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Commands (T, m) after the governor, whose memory goes on from the recorded inputs. Chunks start so much
    earlier that what they have not seen has faded."""
    T, warm = len(u), int(min(WARM_UP * max(0.005 / family.forgets, 1.0), len(u)))
    length = max(-(-T // SIDE_BY_SIDE), min(T, 2 * warm // 3), 1)
    first = np.arange(0, T, length)
    at = np.maximum(first - warm, 0)
    memory, asked = started(family, log.y[at]), u.copy()
    for step in range(warm + length):
        # chunks near the beginning have less before them, and wait
        now = first - warm + step
        mine = np.flatnonzero((now >= 0) & (now < T))
        rows = now[mine]
        if not len(mine):
            continue
        seen = corrected(family, memory[:, mine], log.y[rows])
        if step >= warm:
            asked[rows] = governed(family, seen, u[rows], target[rows], low[rows], high[rows])
        memory[:, mine] = predicted(family, seen, log.u[rows])
    return asked
