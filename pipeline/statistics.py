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
    return Share(100.0 * p, float(100.0 * max(centre - half, 0.0)), float(100.0 * min(centre + half, 1.0)))


class Mean(NamedTuple):
    """A mean with the ends of its 95 % interval."""

    value: float
    low: float
    high: float


def variance_of_mean(values: np.ndarray) -> float:
    """The variance of the mean of values (B, n): B redraws of what runs share (segments, plants), n runs on
    each, drawn from the redraw alone.

    The redraws' means differ by what is shared and by their own runs: max(var_b(mean_b) - s^2 / n, 0) is
    the first alone (variance components, Searle 1971), to which the mean of all adds s^2 / (B n), where s^2 is
    the variance within a redraw. Raises ValueError for fewer than two redraws.
    """
    values = np.asarray(values, float)
    if values.ndim != 2 or values.shape[0] < 2 or values.shape[1] < 1:
        raise ValueError(
            f"variance_of_mean: expected values (B, n) of at least 2 redraws, found shape {values.shape}; "
            "redraw more often"
        )
    n = values.shape[1]
    within = float(values.var(axis=1, ddof=1).mean()) if n > 1 else 0.0
    between = max(float(values.mean(axis=1).var(ddof=1)) - within / n, 0.0)
    return between + within / values.size


def redrawn_mean(values: np.ndarray) -> Mean:
    """The mean of values (B, n) of B redraws with its 95 % interval, Student's t of B - 1."""
    mean, B = float(np.mean(values)), len(values)
    half = float(scipy.special.stdtrit(B - 1, 0.975) * np.sqrt(variance_of_mean(values)))
    return Mean(mean, mean - half, mean + half)


def redrawn_share(happened: np.ndarray) -> Share:
    """The share of True in happened (B, n) of B redraws, in percent, with its 95 % interval: Wilson's, of as
    many runs as would tell as much if they shared nothing.

    n_eff = p (1 - p) / V (z / t)^2, at most B n, with V of `variance_of_mean` and t of B - 1 (Korn and
    Graubard 1998); where all or none happened, nothing tells V, and n_eff is B n.
    """
    happened = np.asarray(happened, bool)
    p, V, B = float(happened.mean()), variance_of_mean(happened), len(happened)
    n = min(p * (1.0 - p) / V, happened.size) if V > 0 and 0 < p < 1 else float(happened.size)
    student = float(scipy.special.ndtri(0.975) / scipy.special.stdtrit(B - 1, 0.975))
    return wilson_interval(p, n * student**2)
