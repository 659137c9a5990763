"""Paired tests and intervals: is the challenger better than the champion beyond noise?

Both ran the same cases. Cases that share a plant, a part or a recording are one block, and the blocks are
independent.

d_b = mean over the cases of block b of log(champion's cost / challenger's cost). Under
"no difference" every d_b is as likely with either sign: the sign-flip test (Fisher
1935), exact for up to 14 blocks and by draws beyond.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.special

# up to so many blocks all 2^n signs are tried
EXACT = 14


class Paired(NamedTuple):
    """Improvement of the mean cost in percent with the ends of its 90 % interval (Student's t over blocks).

    `p` is the one-sided probability that chance alone does as well.
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
    """The challenger's improvement over the champion, from costs (cases,) above 0; less is better.

    An infinite cost of the challenger counts as a thousand times the champion's. Raises ValueError for a
    champion's cost that is not finite and above 0, and for a negative one of the challenger.
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
    """The smallest number of blocks with which a sign-flip test can reach `level`: 2^-n <= level."""
    return int(np.ceil(np.log2(1 / level)))


class Share(NamedTuple):
    """A share of runs in percent with its 95 % interval."""

    percent: float
    low: float
    high: float


class PooledShare(NamedTuple):
    """A share of runs in percent with its 95 % interval; n runs that share nothing tell it as well."""

    percent: float
    low: float
    high: float
    n: float


def wilson(happened: np.ndarray) -> Share:
    """The share of True (n,) in percent with its 95 % interval, for n that share nothing (Wilson 1927)."""
    return wilson_interval(float(np.mean(happened)), len(happened))


def wilson_interval(p: float, n: float) -> Share:
    """The interval of a share p of n, n > 0, which need not be whole (an effective number).

    (p + z^2 / 2n +- z sqrt(p (1 - p) / n + z^2 / 4n^2)) / (1 + z^2 / n)
    """
    z = float(scipy.special.ndtri(0.975))
    centre = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2)) / (1 + z**2 / n)
    # of none or all one end is the share itself, which rounding would miss
    low, high = min(float(max(centre - half, 0.0)), p), max(float(min(centre + half, 1.0)), p)
    return Share(100.0 * p, 100.0 * low, 100.0 * high)


class Mean(NamedTuple):
    """A mean with the ends of its interval."""

    value: float
    low: float
    high: float


def effective(happened: np.ndarray) -> float:
    """As how many runs that share nothing do n runs on each of P pools tell a share? happened (P, n).

    n P / max(1, var(p_k) / (p (1 - p) / n)): what the pools' shares p_k differ by, against what runs that
    share nothing differ by (design effect: Kish 1965). One pool says nothing of others: 1.
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
    """The share of True (P, n) in percent, worth `effective` runs, with its 95 % interval: Wilson's, widened
    by Student's t of P - 1 (Korn and Graubard 1998)."""
    pools, n = len(happened), effective(happened)
    student = scipy.special.stdtrit(max(pools - 1, 1), 0.975) / scipy.special.ndtri(0.975)
    return PooledShare(*wilson_interval(float(np.mean(happened)), n / student**2), n)


def mean_of_pools(values: np.ndarray, *, level: float) -> Mean:
    """The mean of values (P,) of pools that share nothing, with the ends of its interval (Student's t)."""
    mean, pools = float(np.mean(values)), len(values)
    half = scipy.special.stdtrit(pools - 1, (1 + level) / 2) * np.std(values, ddof=1) / np.sqrt(pools)
    return Mean(mean, mean - float(half), mean + float(half))
