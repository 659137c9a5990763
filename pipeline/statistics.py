"""Paired tests and intervals: is one controller (challenger) better than another (champion) beyond chance?

Both ran the same cases. Cases that share a plant, a part or a recording form one block, and the blocks are
independent.

d_b = mean over the cases of block b of log(champion's cost / challenger's cost)

Without a difference, every d_b is equally likely with either sign. The sign-flip test uses this (Fisher
1935). It is exact for up to 14 blocks, and uses random samples of signs beyond.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.special

# the largest number of blocks for which all 2^n signs are tried
EXACT = 14


class Paired(NamedTuple):
    """Improvement of the mean cost in percent, with the ends of its 90 % interval (Student's t over blocks).

    `p` is the one-sided probability of at least this improvement by chance alone.
    """

    improvement_percent: float
    low_percent: float
    high_percent: float
    p: float
    cases: int
    blocks: int


def paired(
    champion: np.ndarray,
    challenger: np.ndarray,
    block: Sequence[str],
    *,
    rng: np.random.Generator,
    draws: int = 20_000,
) -> Paired:
    """Returns the improvement of the challenger over the champion, from costs (cases,) above 0; lower is
    better. `block`: the block of each case; `draws`: random sign vectors beyond EXACT blocks.

    If the challenger's cost is infinite, it counts as a thousand times the champion's. Raises ValueError if
    there is no case, if a cost of the champion is not finite and above 0, or if one of the challenger is
    negative.
    """
    champion, challenger = np.asarray(champion, float), np.asarray(challenger, float)
    if len(champion) == 0 or not (
        np.isfinite(champion).all() and (champion > 0).all() and (challenger >= 0).all()
    ):
        raise ValueError(
            "paired: expected costs above 0 of at least one case that both ran, found none, "
            "or one that is no cost; judge both on the same cases"
        )
    ratio = np.clip(challenger / champion, 1e-3, 1e3)
    names = np.asarray(block, object)
    d = np.array([-np.log(ratio[names == name]).mean() for name in dict.fromkeys(block)])
    n, mean = len(d), float(d.mean())
    if n <= EXACT:
        signs = 1 - 2 * ((np.arange(2**n)[:, None] >> np.arange(n)) & 1)
        p = float((signs @ d >= d.sum() - 1e-12).mean())
    else:
        flipped = rng.choice([-1.0, 1.0], (draws, n)) @ d
        p = float((1 + (flipped >= d.sum() - 1e-12).sum()) / (1 + draws))
    half = scipy.special.stdtrit(n - 1, 0.95) * d.std(ddof=1) / np.sqrt(n) if n > 1 else np.inf
    low, middle, high = (100.0 * (1.0 - np.exp(-value)) for value in (mean - half, mean, mean + half))
    return Paired(float(middle), float(max(low, -1e6)), float(high), p, len(champion), n)


def blocks_needed(level: float) -> int:
    """Returns the smallest number of blocks with which a sign-flip test can reach `level`: 2^-n <= level."""
    return int(np.ceil(np.log2(1 / level)))


class Share(NamedTuple):
    """A share of runs in percent with its 95 % interval."""

    percent: float
    low: float
    high: float


class PooledShare(NamedTuple):
    """A share of runs in percent with its 95 % interval. It is as precise as the share of n independent
    runs."""

    percent: float
    low: float
    high: float
    n: float


def wilson(happened: np.ndarray) -> Share:
    """Returns the share of True (n,) in percent with its 95 % interval, for n independent runs (Wilson
    1927)."""
    return wilson_interval(float(np.mean(happened)), len(happened))


def wilson_interval(p: float, n: float) -> Share:
    """Returns the interval of a share p of n, n > 0. n may be an effective number, not whole.

    (p + z^2 / 2n +- z sqrt(p (1 - p) / n + z^2 / 4n^2)) / (1 + z^2 / n)
    """
    z = float(scipy.special.ndtri(0.975))
    centre = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2)) / (1 + z**2 / n)
    # if p is 0 or 1, one end is p itself, which rounding would miss
    low, high = min(float(max(centre - half, 0.0)), p), max(float(min(centre + half, 1.0)), p)
    return Share(100.0 * p, 100.0 * low, 100.0 * high)


class Mean(NamedTuple):
    """A mean with the ends of its interval."""

    value: float
    low: float
    high: float


def effective(happened: np.ndarray) -> float:
    """Returns how many independent runs give a share as precisely as n runs on each of P pools do. happened
    (P, n).

    n P / max(1, var(p_k) / (p (1 - p) / n))

    The ratio compares the variance of the pools' shares p_k with that of independent runs (design effect:
    Kish 1965). One pool counts as 1, because it says nothing about other pools.
    """
    happened = np.asarray(happened, float)
    pools, n = happened.shape
    p = float(happened.mean())
    if pools < 2:
        return 1.0
    if p in (0.0, 1.0):
        return float(happened.size)
    between = float(happened.mean(axis=1).var(ddof=1))
    return happened.size / max(1.0, between * n / (p * (1.0 - p)))


def pooled_share(happened: np.ndarray) -> PooledShare:
    """Returns the share of True (P, n) in percent, its 95 % interval, and n, the `effective` number of
    runs. The interval is Wilson's, widened by Student's t with P - 1 degrees of freedom (Korn and Graubard
    1998)."""
    pools, n = len(happened), effective(happened)
    student = scipy.special.stdtrit(max(pools - 1, 1), 0.975) / scipy.special.ndtri(0.975)
    return PooledShare(*wilson_interval(float(np.mean(happened)), n / student**2), n)


def mean_of_pools(values: np.ndarray, *, level: float) -> Mean:
    """Returns the mean of values (P,) of independent pools, with the ends of its interval at `level`
    (Student's t)."""
    mean, pools = float(np.mean(values)), len(values)
    half = scipy.special.stdtrit(pools - 1, (1 + level) / 2) * np.std(values, ddof=1) / np.sqrt(pools)
    return Mean(mean, mean - float(half), mean + float(half))
