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


def shared_variance(figures: Sequence[np.ndarray]) -> float:
    """The share of a run's variance that all runs on one redraw have in common (intraclass correlation),
    pooled over figures (B, n) that are alike: B redraws of what runs share, n runs on each.

    sum (var_b(mean_b) - s^2 / n) / sum (var_b(mean_b) + (1 - 1 / n) s^2), not below 0, with s^2 the variance
    within a redraw (components of variance: Searle 1971). One figure alone tells it badly: what n runs differ
    by exceeds what they share. Raises ValueError for fewer than two redraws.
    """
    between = total = 0.0
    for figure in figures:
        values = np.asarray(figure, float)
        if values.ndim != 2 or values.shape[0] < 2:
            raise ValueError(
                f"shared_variance: expected values (B, n) of at least 2 redraws, found shape {values.shape}; "
                "redraw more often"
            )
        n = values.shape[1]
        within = float(values.var(axis=1, ddof=1).mean()) if n > 1 else 0.0
        common = float(values.mean(axis=1).var(ddof=1)) - within / n
        between, total = between + common, total + common + within
    return min(max(between / total, 0.0), 1.0) if total > 0 else 0.0


def effective_runs(redraws: int, runs: int, shared: float) -> float:
    """As how many runs that share nothing do `runs`, on so many redraws of segments, tell a mean?

    1 / (shared + (1 - shared) / runs): further runs say nothing more of the segments (Kish 1965), times
    (z / t)^2 for Student's t of redraws - 1 (Korn and Graubard 1998).
    """
    student = float(scipy.special.ndtri(0.975) / scipy.special.stdtrit(redraws - 1, 0.975))
    return student**2 / (shared + (1.0 - shared) / runs)


def redrawn_mean(values: np.ndarray, shared: float) -> Mean:
    """The mean of values (B, n) of n runs on each of B redraws with its 95 % interval, for the `shared`
    variance of `shared_variance`."""
    values = np.asarray(values, float)
    mean, n = float(values.mean()), effective_runs(len(values), values.size, shared)
    half = float(scipy.special.ndtri(0.975) * values.std() / np.sqrt(n))
    return Mean(mean, mean - half, mean + half)


def redrawn_share(happened: np.ndarray, shared: float) -> Share:
    """The share of True in happened (B, n) in percent with the 95 % interval of what the same work gives on
    other segments: Wilson's, of an effective number of runs.

    The mean of B redraws and a repetition on one set of segments differ by shared (1 + 1 / B) of a run's
    variance for the segments and by (1 - shared) / (B n) for the runs of either; z / t as in
    `effective_runs`. `shared` is of all figures alike; where this one shows more, its own counts.
    """
    happened = np.asarray(happened, bool)
    B, own = len(happened), max(shared, shared_variance([happened]))
    student = float(scipy.special.ndtri(0.975) / scipy.special.stdtrit(B - 1, 0.975))
    variance = own * (1.0 + 1.0 / B) + 2.0 * (1.0 - own) / happened.size
    return wilson_interval(float(happened.mean()), student**2 / variance)
