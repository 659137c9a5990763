"""Widths of many frames -> cross-section along the line -> flow Q(t) by regularised inversion, with its
uncertainty and the times that the frames do not show.

A width belongs to a place, not to a moment. The nozzle at x(t) lays Q(t) dt over its footprint f, so A(s) =
integral of Q(t) f(s - x(t)) dt, and many frames show each place. Q is computed from A by least squares with a
smoothness prior, and the data choose the strength of the prior.
"""

import math
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.optimize
import scipy.sparse

from pipeline.deposition.camera.bead import BLOCK, area

# instants per sample at which the nozzle is placed: at 8 mm/s and 50 Hz every 20 um, a third of a place
INSTANTS = 8
# a bead lower than this is not seen, px: its section is the least that a place without a bead may hide
BLIND_PX = 8.0
# below this share of the highest speed the flow at a moment is not
# observable, only the volume of the whole pause
SLOW = 0.05
# readings of one place this many deviations from their median are specks, not scatter
GATE = 5.0
# residuals of A(s) beyond this many deviations get less weight (Huber 1964: 95 % efficient for normal errors)
HUBER = 1.345
# weights and scatter settle within this many rounds
ROUNDS = 3
# widths within this share of the median are those of a steady line
NEAR_USUAL = 0.15
# log of the strengths that are tried: from no smoothing at all to a straight line
STRENGTHS = (-8.0, 24.0)
# prior weight of the amplitudes, far below that of any data: an amplitude that no frame shows is 0
RIDGE = 1e-6


class View(NamedTuple):
    """The part of the stage that the camera shows: a column shows s = x + (column - nozzle_column) mm_per_px,
    with x the gantry's position.

    mm_per_px is negative if the line trails towards higher columns.
    """

    mm_per_px: float
    nozzle_column: float


class Sections(NamedTuple):
    """Cross-section along the stage. `s` (n,): centres in mm of places 8 px long; `area` (n,) in mm^2;
    `deviation` (n,): its standard deviation from the scatter of the frames; `frames` (n,): number of readings
    of each place; `length` of a place in mm."""

    s: np.ndarray
    area: np.ndarray
    deviation: np.ndarray
    frames: np.ndarray
    length: float


class Flow(NamedTuple):
    """Q (T,) in mm^3/s at the gantry's samples and its standard deviation, for the smoothness that the data
    chose.

    observable (T,) is False if the gantry stood or the camera never saw what was laid. There only the volume
    of the whole pause is measured, and Q is its most likely distribution over time. `outliers`: number of
    places with less than half their weight.
    """

    flow: np.ndarray
    deviation: np.ndarray
    observable: np.ndarray
    outliers: int


def deposit_share(distance: np.ndarray, radius: float) -> np.ndarray:
    """Returns the share of the material from a round nozzle that falls behind a point `distance` ahead of its
    middle:

        1/2 + (z sqrt(1 - z^2) + arcsin z) / pi,   z = distance / radius in -1..1

    Its derivative is the footprint f: the chord of the nozzle at that distance, divided by its area.
    """
    z = np.clip(distance / radius, -1.0, 1.0)
    return 0.5 + (z * np.sqrt(1 - z * z) + np.arcsin(z)) / np.pi


def sections(
    position: np.ndarray,
    columns: np.ndarray,
    widths: np.ndarray,
    *,
    view: View,
    nozzle_radius_mm: float,
    contact_angle_deg: float,
) -> Sections:
    """Returns A(s) from widths (F, m) in mm at the `columns` (m,) of F frames taken with the gantry at
    `position` (F,). In widths NaN is unread and 0 is bare substrate.

    Readings are collected by place. Readings closer to the nozzle than its radius, where the bead still
    grows, are left out, and so are readings beyond five robust deviations from the median of their place.
    Raises ValueError if no reading remains, or if the gantry does not move away from what the camera sees.
    """
    s, w = _readings(position, columns, widths, view, nozzle_radius_mm)
    px = abs(view.mm_per_px)
    length = BLOCK * px
    place = np.floor((s - s.min()) / length).astype(int)
    order = np.lexsort((w, place))
    place, s, w = place[order], s[order], w[order]
    of, keep, scatter = _without_specks(place, w, px)
    count = np.bincount(of, keep)
    A, where = np.bincount(of, area(w, contact_angle_deg) * keep) / count, np.bincount(of, s * keep) / count
    slope, blind = np.sqrt(4 * area(1.0, contact_angle_deg) * A), area(BLIND_PX * px, contact_angle_deg)
    # a place averages over its length: if A bends within it, the mean is not the value in the middle
    bend = np.convolve(np.pad(A, 1, "edge"), [1.0, -2.0, 1.0], "valid") / 12
    deviation = np.sqrt(slope**2 * scatter**2 / count + blind**2 / 12 + bend**2)
    return Sections(where, A, deviation, count.astype(int), length)


def column_trend(position: np.ndarray, columns: np.ndarray, widths: np.ndarray, view: View) -> float:
    """Returns the share by which one place of the line looks wider at the last of the `columns` (m,) than at
    the first, from widths (F, m) as in `sections`: least squares over readings of the same place, with widths
    near the median. 0 if no place was read twice. For a camera square to the stage it is 0."""
    behind = (columns - view.nozzle_column) * view.mm_per_px
    usual = float(np.median(widths[widths > 0])) if (widths > 0).any() else math.nan
    used = np.abs(widths - usual) < NEAR_USUAL * usual
    if not used.any():
        return 0.0
    u = np.broadcast_to((columns - columns[0]) / np.ptp(columns), widths.shape)[used]
    s = (position[:, None] + behind)[used]
    place = np.floor((s - s.min()) / (BLOCK * abs(view.mm_per_px))).astype(int)
    count = np.maximum(np.bincount(place), 1)
    u, w = (part - (np.bincount(place, part) / count)[place] for part in (u, widths[used] / usual))
    return float(u @ w / max(u @ u, 1e-9))


def _readings(
    position: np.ndarray, columns: np.ndarray, widths: np.ndarray, view: View, nozzle_radius_mm: float
) -> tuple[np.ndarray, np.ndarray]:
    """Returns places (N,) in mm and widths (N,) in mm of the readings that count. Raises ValueError if there
    is none, or if the gantry goes back."""
    behind = (columns - view.nozzle_column) * view.mm_per_px
    used = np.isfinite(widths) & (np.abs(behind) >= nozzle_radius_mm) & np.isfinite(position)[:, None]
    if not used.any():
        raise ValueError(
            f"sections: none of {widths.size} readings is usable; look at why the frames were rejected, "
            "and at the nozzle's column in the view"
        )
    travel = -np.sign(np.median(behind)) * position[np.isfinite(position)]
    retreat = float(np.max(np.maximum.accumulate(travel) - travel))
    if retreat > nozzle_radius_mm:
        raise ValueError(
            f"sections: the gantry goes back by {retreat:.3g} mm, towards where the camera looks, "
            "so a place is seen before it is printed; "
            "cut the record to one pass along the line, or turn the sign of the view's mm per px"
        )
    return (position[:, None] + behind)[used], widths[used]


def _without_specks(place: np.ndarray, w: np.ndarray, px: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Returns, for readings w (N,) sorted by place and width: the index of their place (N,), whether they
    count (N,), and the robust scatter of one reading in mm."""
    first = np.flatnonzero(np.diff(place, prepend=-1))
    count = np.diff(np.append(first, len(place)))
    of = np.repeat(np.arange(len(first)), count)
    median = w[first + (count - 1) // 2]
    miss = np.abs(w - median[of])
    # one scatter for all places, because a dozen readings of one place are too few; the width may also change
    # along a place
    scatter = max(1.4826 * float(np.median(miss[w > 0])) if (w > 0).any() else 0.0, 0.02 * px)
    keep = miss <= (GATE * scatter + np.abs(np.gradient(np.pad(median, 1, "edge"))[1:-1]))[of]
    return of, keep, scatter


def estimate(
    time_s: np.ndarray,
    position: np.ndarray,
    sections: Sections,
    *,
    nozzle_radius_mm: float,
    shapes: np.ndarray,
    contact_angle_deg: float,
    width_deviation_mm: float,
) -> Flow:
    """Estimates Q(t) = z + shapes' a at the evenly spaced samples time_s (T,) of the gantry's position (T,),
    from

        min |W (A - K Q)|^2 + strength |D2 z|^2
        K[i, k] = mean over place i of integral of hat_k(t) f(s - x(t)) dt

    D2 is the second difference, so z is an integrated random walk. The shapes (k, T) are the times when the
    flow may turn sharply, each with an amplitude that the data choose: the wanted flow r as one row, a
    model's answer to the command, or none, as zeros (0, T). The strength maximises the likelihood of A with
    all Q integrated out (generalised maximum likelihood, Wahba 1985). W has the deviations of A, scaled to
    its scatter about the fit, and Huber's weights. `width_deviation_mm` is the error that remains after
    calibration. It is common to all widths and adds Q 2 dw / w to the uncertainty of Q. Raises ValueError if
    the nozzle reaches no place.
    """
    dt = float(np.mean(np.diff(time_s)))
    K = _laid(position, dt, sections, nozzle_radius_mm)
    reached = np.asarray(K.sum(axis=1)).ravel() > 0
    if not reached.any():
        raise ValueError(
            "estimate: the nozzle reached no place of A(s) in this record; "
            "do frames and gantry overlap in time, and has the view the right direction?"
        )
    K, A = K[reached], sections.area[reached]
    bead = A > 0
    Q, deviation, outliers = _robust_fit(K, A, sections.deviation[reached], bead, shapes.T)
    share = (
        2 * width_deviation_mm / np.sqrt(np.median(A[bead]) / area(1.0, contact_angle_deg))
        if bead.any()
        else 0.0
    )
    deviation = np.hypot(deviation, share * Q)
    speed = np.abs(np.gradient(position, dt))
    moving = speed > SLOW * speed.max()
    lit = np.asarray(K.sum(axis=0)).ravel() * sections.length > 0.4 * dt
    return Flow(Q, deviation, moving & lit, outliers)


def _robust_fit(
    K: scipy.sparse.csr_matrix, A: np.ndarray, expected: np.ndarray, bead: np.ndarray, shapes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, int]:
    """Returns the flow Q (T,), its deviation (T,), and the number of outlier places. Least squares with
    Huber's weights, reweighted ROUNDS times, each time with the most likely strength."""
    steps = K.shape[1]
    P, robust = _penalty(steps), np.ones(len(A))
    deviation = np.where(bead, _roughness(A, expected, bead) * expected, expected)
    for _ in range(ROUNDS):
        weight = np.sqrt(robust) / deviation
        H = scipy.sparse.diags(weight) @ K
        M, C = _banded((H.T @ H).tocoo(), steps), H.T @ (H @ shapes)
        data = (M, P, C, shapes, H.T @ (weight * A), float(np.sum((weight * A) ** 2)))
        best = scipy.optimize.minimize_scalar(
            lambda log_strength, data=data: _solve(log_strength, data).unlikely,
            bounds=STRENGTHS,
            method="bounded",
            options={"xatol": 0.1},
        )
        fit = _solve(best.x, data)
        Q = fit.z + shapes @ fit.a
        robust = np.minimum(1.0, HUBER * deviation / np.maximum(np.abs(A - K @ Q), 1e-12))
    U = shapes - scipy.linalg.cho_solve_banded((fit.factor, True), C)
    spread = U @ np.linalg.inv(np.linalg.cholesky(fit.S)).T
    deviation = np.sqrt(_inverse_diagonal(_sum(M, P, np.exp(best.x))) + np.sum(spread**2, axis=1))
    return Q, deviation, int(np.sum(robust < 0.5))


def _roughness(A: np.ndarray, expected: np.ndarray, bead: np.ndarray) -> float:
    """Returns the scatter of A along the stage divided by the one expected from the frames' scatter, at least
    1. It is the robust deviation of the second differences of means over three places, which flow hardly
    changes. Things on the stage cause the same error in every frame, so only this shows them. Means are used
    because neighbours share readings."""
    n = len(A) // 3
    mean, variance = (
        A[: 3 * n].reshape(n, 3).mean(axis=1),
        np.square(expected[: 3 * n]).reshape(n, 3).sum(axis=1) / 9,
    )
    covered = bead[: 3 * n].reshape(n, 3).all(axis=1)
    inside = covered[:-2] & covered[1:-1] & covered[2:]
    if not inside.any():
        return 1.0
    spread = np.sqrt(variance[:-2] + 4 * variance[1:-1] + variance[2:])
    return max(1.4826 * float(np.median(np.abs(np.diff(mean, 2) / spread)[inside])), 1.0)


def _laid(position: np.ndarray, dt: float, sections: Sections, radius: float) -> scipy.sparse.csr_matrix:
    """Returns K (n, T) in s/mm: the section at place i from unit flow at sample k. Positions and flow are
    linear between samples."""
    share = (np.arange(INSTANTS) + 0.5) / INSTANTS
    x = (position[:-1, None] + np.diff(position)[:, None] * share).ravel()
    begin = np.searchsorted(sections.s, x - radius - sections.length / 2)
    many = int(2 * radius / sections.length) + 3
    place = begin[:, None] + np.arange(many)
    s = sections.s[np.minimum(place, len(sections.s) - 1)] - x[:, None]
    half = sections.length / 2
    f = (
        (deposit_share(s + half, radius) - deposit_share(s - half, radius))
        * (place < len(sections.s))
        / sections.length
    )
    f *= dt / INSTANTS
    late = np.tile(share, len(position) - 1)[:, None]
    sample = np.repeat(np.arange(len(position) - 1), INSTANTS)[:, None]
    on = f > 0
    rows = np.concatenate([place[on]] * 2)
    columns = np.concatenate([np.broadcast_to(sample, f.shape)[on], np.broadcast_to(sample + 1, f.shape)[on]])
    values = np.concatenate([(f * (1 - late))[on], (f * late)[on]])
    return scipy.sparse.coo_matrix((values, (rows, columns)), shape=(len(sections.s), len(position))).tocsr()


def _penalty(steps: int) -> np.ndarray:
    """D2'D2 in lower banded form (3, T)."""
    D = scipy.sparse.diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(steps - 2, steps))
    return _banded((D.T @ D).tocoo(), steps)


def _banded(M: scipy.sparse.coo_matrix, steps: int) -> np.ndarray:
    below = M.row - M.col
    band = np.zeros((max(int(below.max()), 2) + 1, steps))
    low = below >= 0
    band[below[low], M.col[low]] = M.data[low]
    return band


def _sum(M: np.ndarray, P: np.ndarray, strength: float) -> np.ndarray:
    total = M.copy()
    total[:3] += strength * P
    return total


# normal equations: M = H'H banded, P = D2'D2 banded, C = H'H shapes, shapes (T, k), right side H'y, energy
# y'y
_Data = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]


class _Fit(NamedTuple):
    """Cholesky factor of M + strength P; Schur complement S (k, k) of the amplitudes; z (T,); a (k,); and -2
    log likelihood up to a constant."""

    factor: np.ndarray
    S: np.ndarray
    z: np.ndarray
    a: np.ndarray
    unlikely: float


def _solve(log_strength: float, data: _Data) -> _Fit:
    """Minimises over z and a by elimination of z:

    -2 log likelihood = minimum + log det (M + strength P) + log det S - (T - 2) log strength
    """
    M, P, C, shapes, right, energy = data
    factor = scipy.linalg.cholesky_banded(_sum(M, P, np.exp(log_strength)), lower=True)
    solved = scipy.linalg.cho_solve_banded((factor, True), np.column_stack([right, C]))
    S = shapes.T @ C - C.T @ solved[:, 1:] + RIDGE * np.eye(C.shape[1])
    a = np.linalg.solve(S, shapes.T @ right - C.T @ solved[:, 0])
    z = solved[:, 0] - solved[:, 1:] @ a
    minimum = energy - right @ z - a @ (shapes.T @ right)
    unlikely = (
        minimum + 2 * np.log(factor[0]).sum() + np.linalg.slogdet(S)[1] - (M.shape[1] - 2) * log_strength
    )
    return _Fit(factor, S, z, a, float(unlikely))


def _inverse_diagonal(band: np.ndarray) -> np.ndarray:
    """Returns the diagonal of the inverse of a symmetric banded matrix. Blocks as wide as the band make it
    block tridiagonal; Schur complements are computed downward, inverses upward (Takahashi 1973)."""
    b, steps = len(band) - 1, band.shape[1]
    blocks = -(-steps // b)
    full = np.zeros((b + 1, blocks * b + b))
    full[:, :steps] = band
    full[0, steps:] = 1.0
    i = np.arange(b)
    down = i[:, None] - i
    inverses, lower = [], []
    for k in range(blocks):
        column = k * b + i
        D = np.where(down >= 0, full[np.abs(down), column[None, :]], 0.0)
        D = D + np.tril(D, -1).T
        if k:
            D = D - lower[-1] @ inverses[-1] @ lower[-1].T
        inverses.append(np.linalg.inv(D))
        reach = down + b
        lower.append(np.where(reach <= b, full[np.minimum(reach, b), column[None, :]], 0.0))
    G = inverses[-1]
    out = [np.diag(G)]
    for S, E in zip(inverses[-2::-1], lower[-2::-1], strict=True):
        G = S + S @ E.T @ G @ E @ S
        out.append(np.diag(G))
    return np.concatenate(out[::-1])[:steps]
