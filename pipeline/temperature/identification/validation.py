"""How far an identified plant can be trusted: fits on held-out records, residual tests, excitation,
uncertainty by bootstrap, and a sentence of advice for each."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.stats

from pipeline.temperature.identification.order import LARGEST_RADIUS, fit, shifted, stabilised, with_delays
from pipeline.temperature.identification.refinement import (
    FitSettings,
    drives,
    estimate_state,
    filled,
    linear_recurrence,
    prediction_form,
    respond,
    simulation_form,
)
from pipeline.temperature.identification.subspace import Segments, lagged, realise, subspace
from pipeline.temperature.plant import Plant, markov_parameters

RESAMPLED_STEPS = (
    1  # of Gauss-Newton a resampled record: from a consistent start one is efficient (Le Cam 1956)
)
QUANTILE_99 = 2.5758  # of the standard normal, two-sided
# Quarters: of 20 simulated machines, 90 % bands of gains held the truth in 98 % in white noise, 88 % beside a
# drift and 96 % where it also hides an input that hardly moved. Eighths are short beside a drift: 98, 80 and
# 94 %. The bootstrap alone: 81, 54 and 64 %
LEFT_OUT_BLOCKS = 4
# errors of one step below this share of the output's movement are rounding: what colour they have is the
# processor's, and no record of a sensor comes near (float32 resolves 1e-7)
ROUNDING = 1e-8
ADDS = 0.1  # of the error: what the inputs must take off that of the free response for a fit to be theirs


class PlantBootstrap(NamedTuple):
    """Step responses (steps, p, m) of the nominal plant and their bands over a family, at `level`; poles of
    every member, a list of (n,) arrays."""

    nominal: np.ndarray
    low: np.ndarray
    high: np.ndarray
    poles: list[np.ndarray]
    level: float


class Residuals(NamedTuple):
    """Residual tests at 99 %: autocorrelation (p, lags+1), cross-correlation with each input (p, m, 2 lags+1)
    at lags -lags..lags (positive: input first).

    band and cross_band are what an ideal residual stays under; whiteness is Ljung and Box's statistic for
    each output and whiteness_limit its 99 % point.
    """

    autocorrelation: np.ndarray
    cross_correlation: np.ndarray
    band: float
    cross_band: np.ndarray
    whiteness: np.ndarray
    whiteness_limit: float
    whiteness_passed: np.ndarray
    independence_passed: np.ndarray


class RecordExcitation(NamedTuple):
    """Rank and condition of the covariance of `past` lags of all inputs (each scaled to unit power), and of
    each input alone; full is the rank wanted."""

    rank: int
    full: int
    condition: float
    per_input_rank: np.ndarray
    per_input_condition: np.ndarray
    levels: np.ndarray


def simulated(plant: Plant, u: np.ndarray, y: np.ndarray, *, means_removed: bool = False) -> np.ndarray:
    """ŷ (T, p) of the plant under u (T, m) alone, from the initial state that fits all of y (T, p) best (the
    rule of SLICOT's IB01CD and of MATLAB's compare).

    With `means_removed` the initial state is fitted to the error
    without its mean, for a score that removes it.
    """
    model, v = simulation_form(plant, []), drives("simulation", u, y)
    return respond(model, v, estimate_state(model, v, y, free_mean=means_removed))[1]


def predicted_ahead(
    plant: Plant, u: np.ndarray, y: np.ndarray, steps: int, *, x0: np.ndarray | None = None
) -> np.ndarray:
    """ŷ(t | outputs up to t - steps) (T, p), inputs known throughout;
    the first `steps` - 1 rows start from x0.

    The state, disturbances in it included, comes from the Kalman predictor on past outputs only. x0 defaults
    to the state that fits the first max(3 n, 30) one-step predictions; callers leave these rows out of a
    score. NaN in y passes as a missing measurement.
    """
    if steps < 1:
        raise ValueError(
            f"predicted_ahead: expected steps of at least 1 but found {steps}; one step ahead is steps=1"
        )
    model = prediction_form(plant, [])
    if x0 is None:
        first = min(max(3 * plant.n, 30), len(u))
        start = drives(
            "prediction",
            u[:first],
            np.where(np.isfinite(y[:first]), y[:first], np.nanmean(y[:first], axis=0)),
        )
        x0 = estimate_state(model, start, y[:first])
    y_filled = filled(plant, u, y, x0)
    # x(t | y up to t-1)
    x = linear_recurrence(model.F, drives("prediction", u, y_filled) @ model.G.T, x0)[:-1]
    for ahead in range(1, min(steps, len(u))):  # row t then holds x(t | y up to t-1-ahead)
        x[ahead:] = x[ahead - 1 : -1] @ plant.A.T + u[ahead - 1 : -1] @ plant.B.T + plant.b
    return x @ plant.C.T + u @ plant.D.T + plant.d


def one_step_errors(plant: Plant, u: Segments, y: Segments) -> list[np.ndarray]:
    """e(t) = y(t) - ŷ(t | t-1) (T, p) of each segment, the initial
    state fitted to the segment; NaN where y is masked."""
    model, out = prediction_form(plant, []), []
    for a, b in zip(u, y, strict=True):
        v = drives("prediction", a, filled(plant, a, b, np.zeros(plant.n)))
        out.append(b - respond(model, v, estimate_state(model, v, b))[1])
    return out


def _correlation(a: np.ndarray, b: np.ndarray, lag: int) -> float:
    """Mean of a(t) b(t - lag) over the pairs that exist; both about zero mean and of unit power."""
    x, z = (a[lag:], b[: len(b) - lag]) if lag >= 0 else (a[:lag], b[-lag:])
    return float(np.nanmean(x * z))


def residual_tests(
    plant: Plant, u: Segments, y: Segments, *, lags: int = 25, closed: bool = False
) -> Residuals:
    """Whiteness of the one-step errors and their independence of past
    inputs (Ljung 1999, section 16.6), both at 99 %.

    Whiteness is Ljung and Box's test. Independence fails where a correlation at a lag from 0 on leaves the
    band widened for the number of lags (Bonferroni); correlation at negative lags only says that the record
    was taken in closed loop. There (`closed`) lag 0 says so too, as u(t) answers the error of y(t), and the
    test begins at lag 1. Errors below `ROUNDING` of an output's movement count as none. Raises ValueError
    where the record has fewer than 4 lags of samples.
    """
    if sum(len(a) for a in u) < 4 * lags:
        raise ValueError(
            f"residual_tests: {sum(len(a) for a in u)} samples do not carry {lags} lags; "
            f"expected at least {4 * lags}, so record longer or ask for fewer lags"
        )
    e, m, p = np.vstack(one_step_errors(plant, u, y)), plant.m, plant.p
    w = np.vstack(u)
    size = np.nanstd(e, axis=0)
    rounding = size < ROUNDING * np.nanstd(np.vstack(y), axis=0)
    e = np.where(rounding, 0.0 * e, (e - np.nanmean(e, axis=0)) / np.maximum(size, np.finfo(float).tiny))
    w = (w - np.nanmean(w, axis=0)) / np.maximum(np.nanstd(w, axis=0), np.finfo(float).tiny)
    N = int(np.isfinite(e).all(axis=1).sum())
    auto = np.array([[_correlation(e[:, o], e[:, o], k) for k in range(lags + 1)] for o in range(p)])
    cross = np.array(
        [
            [[_correlation(e[:, o], w[:, j], k) for k in range(-lags, lags + 1)] for j in range(m)]
            for o in range(p)
        ]
    )
    input_auto = np.array([[_correlation(w[:, j], w[:, j], k) for k in range(lags + 1)] for j in range(m)])
    power = 1.0 + 2.0 * np.einsum("ok,jk->oj", auto[:, 1:], input_auto[:, 1:])
    cross_band = QUANTILE_99 * np.sqrt(np.maximum(power, 1.0) / N)
    whiteness = N * (N + 2) * (auto[:, 1:] ** 2 / (N - np.arange(1, lags + 1))).sum(axis=1)
    limit = float(scipy.stats.chi2.ppf(0.99, lags))
    widened = scipy.stats.norm.ppf(1 - 0.005 / (lags + 1)) / QUANTILE_99
    independent = np.abs(cross[:, :, lags + closed :]).max(axis=2) <= widened * cross_band
    return Residuals(
        auto, cross, QUANTILE_99 / np.sqrt(N), cross_band, whiteness, limit, whiteness <= limit, independent
    )


def excitation(u: Segments, past: int) -> RecordExcitation:
    """Rank and condition of the lagged inputs, and of each alone, about their mean; levels (m,) is the
    standard deviation of each input."""
    complete = [a for a in u if np.isfinite(a).all() and len(a) > past]
    if not complete:
        raise ValueError(
            f"excitation: no segment holds {past + 1} complete samples of the inputs; record longer, "
            "or look at a shorter window"
        )
    # (N, m, past)
    stacked = np.vstack([np.stack([a[past - k : len(a) - k] for k in range(past)], axis=2) for a in complete])
    stacked = stacked - stacked.mean(axis=0)
    levels = stacked[:, :, 0].std(axis=0)
    stacked = stacked / np.maximum(levels, np.finfo(float).tiny)[:, None]

    def rank_and_condition(columns):
        values = np.linalg.eigvalsh(columns.T @ columns / len(columns))
        return int((values > 1e-9 * values[-1]).sum()), float(values[-1] / values[0]) if values[
            0
        ] > 0 else np.inf

    rank, condition = rank_and_condition(stacked.reshape(len(stacked), -1))
    alone = [rank_and_condition(stacked[:, j]) for j in range(stacked.shape[1])]
    return RecordExcitation(
        rank,
        stacked.shape[1] * past,
        condition,
        np.array([r for r, _ in alone]),
        np.array([c for _, c in alone]),
        levels,
    )


def _block_resampled(errors: np.ndarray, block: int, length: int, rng: np.random.Generator) -> np.ndarray:
    starts = rng.integers(0, len(errors) - block + 1, size=-(-length // block))
    return np.concatenate([errors[s : s + block] for s in starts])[:length]


def bootstrap_spread(
    u: Segments,
    y: Segments,
    identified,
    *,
    count: int = 20,
    order: int | None = None,
    rng: np.random.Generator,
) -> list[Plant]:
    """`count` plants re-identified on records rebuilt from block-resampled one-step errors (Kuensch 1989),
    each with finite poles inside the unit circle.

    The record is rebuilt under the recorded inputs by

    x(t+1) = A x + B u + b + K e*
    y* = C x + D u + d + e*

    Blocks are two windows long, so that colour that the model missed is kept. `order` (without delays) may
    differ from the identified one, to give plants that no controller was designed on.
    """
    plant, past, block_errors = (
        stabilised(identified.plant, LARGEST_RADIUS),
        identified.past,
        one_step_errors(identified.plant, u, y),
    )
    errors = np.vstack(block_errors)
    errors = errors[np.isfinite(errors).all(axis=1)]
    errors = errors - errors.mean(axis=0)
    block, family = min(2 * past, len(errors) // 4), []
    if any(not np.isfinite(a).all() for a in u):
        raise ValueError(
            "bootstrap_spread: expected inputs without gaps but found NaN in u; "
            "split the record into segments at the gaps"
        )
    for _ in range(count):
        rebuilt = []
        for a, x0 in zip(u, identified.x0, strict=True):
            e = _block_resampled(errors, block, len(a), rng)
            x = linear_recurrence(plant.A, a @ plant.B.T + plant.b + e @ plant.K.T, x0)[:-1]
            rebuilt.append(x @ plant.C.T + a @ plant.D.T + plant.d + e)
        family.append(_reidentified(u, rebuilt, identified, order or identified.order))
    return family


def left_out_plants(u: Segments, y: Segments, identified, *, blocks: int = LEFT_OUT_BLOCKS) -> list[Plant]:
    """The identified class of model fitted anew `blocks` times, each without one equal block of the record's
    samples; none where what is left is too short for the window. A block without which some input hardly
    moves on its own is passed over: what is left does not tell its effect.

    Their spread holds what a bootstrap under the model cannot: drift, and what no linear model has (the
    jackknife of a block, Kuensch 1989).
    """
    ends = np.cumsum([len(a) for a in u])
    edges = np.linspace(0, ends[-1], blocks + 1).round().astype(int)
    plants = []
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        left_u, left_y = [], []
        for a, b, end in zip(u, y, ends, strict=True):
            first, last = np.clip([low - end + len(a), high - end + len(a)], 0, len(a))
            for part in (slice(0, first), slice(last, len(a))) if last > first else (slice(0, len(a)),):
                if len(a[part]) > identified.past + 1:
                    left_u.append(a[part])
                    left_y.append(b[part])
        if not left_u:
            return []
        if not _still_moves(left_u, u):
            continue
        try:
            plants.append(_reidentified(left_u, left_y, identified, identified.order))
        except ValueError:  # what is left of the record is too short
            return []
    return plants


def _still_moves(left: Segments, u: Segments) -> bool:
    """Whether the least independent movement of the inputs that are left is above a thousandth of that of
    all of u."""
    whole, part = np.vstack(u), np.vstack(left)
    scale = np.maximum(whole.std(axis=0), np.finfo(float).tiny)
    of_all, of_part = (
        np.linalg.svd((w - w.mean(axis=0)) / scale, compute_uv=False)[-1] / np.sqrt(len(w))
        for w in (whole, part)
    )
    return bool(of_part > 1e-3 * of_all)


def _reidentified(u: Segments, y: Segments, identified, order: int) -> Plant:
    us, ys = shifted(u, y, identified.delays)
    direct = identified.feedthrough
    data = lagged(us, ys, identified.past, feedthrough=any(direct), offset=identified.offset)
    basis = subspace(data, identified.past).basis[:order]
    start = stabilised(realise(data, basis, identified.plant.sample_time_s, direct), LARGEST_RADIUS)
    settings = FitSettings(direct, identified.offset, LARGEST_RADIUS, RESAMPLED_STEPS)
    refitted = fit(identified.fit, start, us, ys, settings, gain=False)
    return with_delays(stabilised(refitted, LARGEST_RADIUS), identified.delays)


def step_response(plant: Plant, steps: int) -> np.ndarray:
    """Response (steps, p, m) of each output to a unit step of each input from
    rest, without offsets: D, then D + C B + C A B + ..."""
    return plant.D + np.concatenate(
        [np.zeros((1, plant.p, plant.m)), np.cumsum(markov_parameters(plant, steps - 1), axis=0)]
    )


def steady_gain(plant: Plant) -> np.ndarray:
    """D + C (I - A)^-1 B (p, m): what the outputs settle at after a unit step of each input. A must have no
    pole at 1."""
    return plant.D + plant.C @ np.linalg.solve(np.eye(plant.n) - plant.A, plant.B)


def spread_bands(
    nominal: Plant,
    family: Sequence[Plant],
    steps: int,
    *,
    level: float = 0.99,
    left_out: Sequence[Plant] = (),
) -> PlantBootstrap:
    """Bands of the step responses and the poles over a family of plants; with few members the band is their
    range.

    They reach at least as far as Student's quantile of the jackknife's deviation over the `left_out` plants
    (`left_out_plants`), where there are any.
    """
    own, *rest = (step_response(plant, steps) for plant in (nominal, *family, *left_out))
    low, high = banded(own, rest[: len(family)], rest[len(family) :], level)
    return PlantBootstrap(own, low, high, [np.linalg.eigvals(plant.A) for plant in family], level)


def banded(
    own: np.ndarray, family: Sequence[np.ndarray], left_out: Sequence[np.ndarray], level: float
) -> tuple[np.ndarray, np.ndarray]:
    """Low and high ends (...) of a quantity `own` (...) of the plant, from those of a family and of plants
    without a block, as `spread_bands` says."""
    low, high = np.quantile(np.stack(family), [(1 - level) / 2, (1 + level) / 2], axis=0)
    blocks = len(left_out)
    if blocks > 1:
        deviation = np.sqrt((blocks - 1) * np.stack(left_out).var(axis=0))
        reach = scipy.stats.t.ppf((1 + level) / 2, blocks - 1) * deviation
        low, high = np.minimum(low, own - reach), np.maximum(high, own + reach)
    return low, high


def advice(
    tests: Residuals,
    excited: RecordExcitation,
    fit_percent: np.ndarray,
    *,
    outputs: Sequence[str],
    inputs: Sequence[str],
    still_percent: np.ndarray | None = None,
    order_given: bool = False,
) -> list[str]:
    """A sentence for each kind of test that failed: what was seen, where most, and what to do about it. Empty
    where everything passed.

    `still_percent` (p,) is the fit with the inputs held. An order that was not given is no remedy: the rules
    chose it.
    """
    sentences = _of_colour(tests, outputs, order_given) + _of_inputs_left(tests, outputs, inputs, order_given)
    for o, output in enumerate(outputs):
        if fit_percent[o] < 50:
            sentences.append(
                f"the hold-out fit of {output} is {fit_percent[o]:.0f} %: "
                "the model misses more than half of its movement; "
                "look for an input or disturbance that is not recorded"
            )
        if still_percent is not None and _inputs_add_nothing(fit_percent[o], still_percent[o]):
            sentences.append(
                f"the fit of {output} on the hold-out, {fit_percent[o]:.0f} %, is that of the free response "
                f"alone: with every input held at its mean in each stretch it is "
                f"{still_percent[o]:.0f} %, so it does not test what the inputs do; record stretches "
                "in which they move"
            )
    lags = excited.full // excited.per_input_rank.size
    poor = [j for j, rank in enumerate(excited.per_input_rank) if rank < lags]
    if poor:
        shares = ", ".join(f"{inputs[j]} {excited.per_input_rank[j]}" for j in poor)
        sentences.append(
            f"of {lags} lags, some inputs excite fewer ({shares}): move them at more frequencies, or "
            "at shorter holds"
        )
    if excited.rank < excited.per_input_rank.sum():
        sentences.append(
            f"the inputs together excite {excited.rank} of {excited.full} directions: they move alike; "
            "move one at a time, or with different sequences"
        )
    return sentences


def _inputs_add_nothing(fit_percent: float, still_percent: float) -> bool:
    """The recorded inputs take less than `ADDS` off the error of the free response."""
    return 100.0 - fit_percent > (1.0 - ADDS) * (100.0 - still_percent)


def _of_colour(tests: Residuals, outputs: Sequence[str], order_given: bool) -> list[str]:
    """What the residuals show that are not white, the most coloured output named."""
    failed = np.flatnonzero(~tests.whiteness_passed)
    if not failed.size:
        return []
    o = int(failed[tests.whiteness[failed].argmax()])
    lag = int(np.abs(tests.autocorrelation[o, 1:]).argmax()) + 1
    near = "record what disturbs it as one of plant.disturbances, or record longer"
    remedy = near if lag <= 3 else "look for a periodic disturbance"
    remedy += ", or raise identify_plant.order" if order_given else ""
    seen = f"(correlation {tests.autocorrelation[o, lag]:+.2f} at lag {lag})"
    if failed.size == 1:
        return [f"the residuals of {outputs[o]} are not white {seen}: {remedy}"]
    return [
        f"the residuals of {failed.size} of {len(outputs)} outputs are not white, most those of {outputs[o]} "
        f"{seen}: {remedy}"
    ]


def _of_inputs_left(
    tests: Residuals, outputs: Sequence[str], inputs: Sequence[str], order_given: bool
) -> list[str]:
    """What inputs leave in the residuals, the strongest pair named."""
    failed, lags = ~tests.independence_passed, tests.autocorrelation.shape[1] - 1
    if not failed.any():
        return []
    later = np.abs(tests.cross_correlation[:, :, lags:])
    excess = np.where(failed, later.max(axis=2) / np.maximum(tests.cross_band, np.finfo(float).tiny), -1.0)
    o, j = (int(k) for k in np.unravel_index(excess.argmax(), excess.shape))
    where = f"{outputs[o]} correlate with {inputs[j]} at lag {int(later[o, j].argmax())}"
    remedy = f"check the dead time of {inputs[j]}, and whether its effect is linear"
    remedy += ", or raise identify_plant.order" if order_given else ""
    if failed.sum() == 1:
        return [f"the residuals of {where}: {remedy}"]
    return [
        f"the residuals follow inputs in {failed.sum()} of {failed.size} pairs of an output and an input; "
        f"most, those of {where}: {remedy}"
    ]
