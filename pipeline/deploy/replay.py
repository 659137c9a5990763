"""Computes what a controller would have requested on a recorded machine, sample by sample.

The law gets what the machine measured and the inputs that were really applied. Its memory, its integrator and
its governor continue from the recorded inputs, as those of `controllers.law.RunningController` do in manual.
So what it requests at a sample is what it would have applied there; on a recording of its own closed loop
these are that loop's commands.

Memory and integrator run through a recording sample by sample. The governor, which is slow and forgets, runs
in parallel chunks, each of which starts early enough.
"""

from typing import NamedTuple

import numpy as np

from pipeline.temperature.controllers.law import (
    Aim,
    Deployed,
    Governor,
    Plant,
    Reference,
    aim,
    batch_step,
    constant,
    corrected,
    governed,
    handed_over,
    predicted,
    rest,
    started,
    watched,
)

MOST_REFERENCES = 500  # each is aimed at by a quadratic programme


class GaplessLog(NamedTuple):
    """A recorded stretch without a gap: inputs u (T, m) in percent that were applied, outputs y (T, p) in °C
    measured before them, references r (T, p) in °C; all finite."""

    u: np.ndarray
    y: np.ndarray
    r: np.ndarray


class Replayed(NamedTuple):
    """Inputs (T, m): `wished` by the law; `limited` by limits and rate; and `asked`, after the governor.
    `target` (T, p) in °C: the reference, or the nearest that the inputs can hold."""

    wished: np.ndarray
    limited: np.ndarray
    asked: np.ndarray
    target: np.ndarray


WHY = ("", "limit", "rate", "governor")


def replayed(
    controller: Deployed, model: Plant, log: GaplessLog, *, hold: int = 30, forward: np.ndarray | float = 0.0
) -> Replayed:
    """Returns what the controller would have requested on a log. It only watches the first `hold` samples,
    and these inputs are as recorded. `forward` (T, m): what is fed forward. The inputs of the log are without
    it, the requested ones include it."""
    T = len(log.u)
    hold = min(max(hold, 1), T)
    feeds, target, here = _aimed(controller, model, log, hold)
    if controller.holds or T == hold:
        still = np.repeat(log.u[max(hold - 1, 0)][None], T, axis=0)
        still[:hold] = log.u[:hold]
        still += forward
        return Replayed(still, still, still, target)
    wished = _wished(controller, log, feeds, target, here, hold)
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
    """Returns, for each sample and input (T, m), the index in WHY of what changed the command that the law
    wished."""
    limits, tiny = controller.limits, 1e-9 * (controller.limits.high - controller.limits.low)
    outside = (run.wished < limits.low - tiny) | (run.wished > limits.high + tiny)
    cut = np.abs(run.limited - run.wished) > tiny
    at_edge = (run.limited <= limits.low + tiny) | (run.limited >= limits.high - tiny)
    reason = np.where(cut & ~(outside & at_edge), 2, np.where(cut, 1, 0))
    return np.where(np.abs(run.asked - run.limited) > tiny, 3, reason)


def _aimed(
    controller: Deployed, model: Plant, log: GaplessLog, hold: int
) -> tuple[np.ndarray, np.ndarray, Aim]:
    """Returns feed (T, m) and target (T, p) of each sample, and the aim for the machine's state at the
    hand-over."""
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
    return feeds[which], targets[which], of(constant(log.y[min(hold, len(log.y) - 1)]))


def _held(r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the different references (k, p), and which of them applies at each sample (T,)."""
    new = np.r_[True, (r[1:] != r[:-1]).any(axis=1)]
    asked, which = np.unique(r[new], axis=0, return_inverse=True)
    return asked, which.ravel()[np.cumsum(new) - 1]


def _wished(
    controller: Deployed, log: GaplessLog, feeds: np.ndarray, target: np.ndarray, here: Aim, hold: int
) -> np.ndarray:
    """Returns what the law wishes (T, m), sample by sample from `hold` on. Its memory continues from the
    recorded inputs, without the governor."""
    bare, wished = controller._replace(governor=None), log.u.copy()
    samples = list(zip(*(part[:, None] for part in log), strict=True))
    state = watched(bare, None, *samples[0])
    for t, (u, y, r) in enumerate(samples[1:], 1):
        if t < hold:
            state = watched(bare, state, u, y, r)
            continue
        if t == hold:
            state = handed_over(bare, state, y, [here])
        wished[t], state = batch_step(bare, state, y, r, feeds[t][None], target[t][None], applied=u)[1:]
    return wished


WARM_UP = 3000  # samples after which the memory of a governor at its usual pace has faded to 3e-7
SIDE_BY_SIDE = 400  # chunks of a long recording


def _governed(
    family: Governor, log: GaplessLog, u: np.ndarray, target: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Returns the commands (T, m) after the governor, whose memory continues from the recorded inputs. Chunks
    start early enough that what they have not seen no longer matters."""
    T, warm = len(u), int(min(WARM_UP * max(0.005 / family.forgets, 1.0), len(u)))
    length = max(-(-T // SIDE_BY_SIDE), min(T, 2 * warm // 3), 1)
    first = np.arange(0, T, length)
    at = np.maximum(first - warm, 0)
    memory, asked = started(family, log.y[at]), u.copy()
    for step in range(warm + length):
        # chunks near the beginning have fewer samples before them, and wait
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
