"""Tests how far an identified plant can be trusted, on the part of the record that was not used to choose it:
fits beside the reference that they must beat, residual tests, excitation, and step responses and poles with
bands by bootstrap, as figures and as columns. Gives a sentence of advice for each test that failed."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.optimize
import scipy.stats

from pipeline.temperature.identification.drift import simulated_with_drift
from pipeline.temperature.identification.first_order import StepModels, of_step_responses, simc_pid
from pipeline.temperature.identification.model_choice import Identified
from pipeline.temperature.identification.order import LARGEST_RADIUS, fit, shifted, stabilised, with_delays
from pipeline.temperature.identification.refinement import (
    FitSettings,
    drives,
    estimate_state,
    filled,
    linear_recurrence,
    one_step_errors,
    prediction_form,
    simulated,
)
from pipeline.temperature.identification.subspace import Segments, lagged, realise, subspace
from pipeline.temperature.plant import Plant, markov_parameters

# Gauss-Newton steps for a resampled record: from a consistent start one is efficient (Le Cam 1956)
RESAMPLED_STEPS = 1
QUANTILE_99 = 2.5758  # of the standard normal, two-sided
# Measured on 20 simulated machines: with quarters, 90 % bands of gains contained the true gain in 98 % of
# cases in white noise, 88 % with a drift, and 96 % if the drift also hides an input that hardly moved. With
# eighths: 98, 80 and 94 %, too few with a drift. With the bootstrap alone: 81, 54 and 64 %
LEFT_OUT_BLOCKS = 4
# one-step errors below this share of the output's movement are rounding: their correlation comes from the
# processor, and no sensor's record is so exact (float32 resolves 1e-7)
ROUNDING = 1e-8
ADDS = 0.1  # share by which the inputs must lower the error of the free response to explain a fit


class Residuals(NamedTuple):
    """Residual tests at 99 %: autocorrelation (p, lags+1), cross-correlation with each input (p, m, 2 lags+1)
    at lags -lags..lags (positive: input first).

    band and cross_band: limits of the correlations of an ideal residual; whiteness: Ljung and Box's statistic
    for each output.
    """

    autocorrelation: np.ndarray
    cross_correlation: np.ndarray
    band: float
    cross_band: np.ndarray
    whiteness: np.ndarray
    whiteness_passed: np.ndarray
    independence_passed: np.ndarray


class RecordExcitation(NamedTuple):
    """Rank and condition number of the covariance of `past` lags of all inputs (each scaled to unit power),
    and the rank for each input alone. full: the rank required; levels (m,): standard deviation of each
    input."""

    rank: int
    full: int
    condition: float
    per_input_rank: np.ndarray
    levels: np.ndarray


def predicted_ahead(plant: Plant, u: np.ndarray, y: np.ndarray, steps: int) -> np.ndarray:
    """Returns ŷ(t | outputs up to t - steps) (T, p), with inputs known throughout.

    The state, with its disturbances, comes from the Kalman predictor on past outputs only. It starts from the
    state that fits the first max(3 n, 30) one-step predictions; callers leave these rows out of a score. NaN
    in y counts as a missing measurement.
    """
    model, first = prediction_form(plant, []), max(3 * plant.n, 30)
    begun = np.where(np.isfinite(y[:first]), y[:first], np.nanmean(y[:first], axis=0))
    x0 = estimate_state(model, drives("prediction", u[:first], begun), y[:first])
    y_filled = filled(plant, u, y, x0)
    # x(t | y up to t-1)
    x = linear_recurrence(model.F, drives("prediction", u, y_filled) @ model.G.T, x0)[:-1]
    for ahead in range(1, min(steps, len(u))):  # row t then holds x(t | y up to t-1-ahead)
        x[ahead:] = x[ahead - 1 : -1] @ plant.A.T + u[ahead - 1 : -1] @ plant.B.T + plant.b
    return x @ plant.C.T + u @ plant.D.T + plant.d


def _correlation(a: np.ndarray, b: np.ndarray, lag: int) -> float:
    """Returns the mean of a(t) b(t - lag) over the pairs that exist. Both have zero mean and unit power."""
    x, z = (a[lag:], b[: len(b) - lag]) if lag >= 0 else (a[:lag], b[-lag:])
    return float(np.nanmean(x * z))


def residual_tests(
    plant: Plant, u: Segments, y: Segments, *, lags: int = 25, closed: bool = False
) -> Residuals:
    """Tests the whiteness of the one-step errors and their independence of past inputs (Ljung 1999, section
    16.6), both at 99 %.

    Whiteness is Ljung and Box's test. Independence fails if the correlation at a lag of 0 or more leaves the
    band, widened for the number of lags (Bonferroni). Correlation at negative lags only shows that the record
    was taken in closed loop. In closed loop (`closed`) lag 0 shows that too, because u(t) responds to the
    error of y(t), so the test begins at lag 1. Errors below `ROUNDING` of an output's movement count as none.
    Raises ValueError if the record has fewer than 4 lags of samples.
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
        auto, cross, QUANTILE_99 / np.sqrt(N), cross_band, whiteness, whiteness <= limit, independent
    )


def excitation(u: Segments, past: int) -> RecordExcitation:
    """Returns rank and condition number of the lagged inputs together, and the rank of each alone, about
    their mean; levels (m,): standard deviation of each input. Raises ValueError if no segment has past + 1
    complete samples."""
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
    return RecordExcitation(rank, stacked.shape[1] * past, condition, np.array([r for r, _ in alone]), levels)


def bootstrap_spread(
    u: Segments,
    y: Segments,
    identified,
    *,
    count: int = 20,
    order: int | None = None,
    rng: np.random.Generator,
) -> list[Plant]:
    """Returns `count` plants identified on records rebuilt from block-resampled one-step errors (Kuensch
    1989). Every pole is finite and inside the unit circle.

    The record is rebuilt under the recorded inputs by

    x(t+1) = A x + B u + b + K e*
    y* = C x + D u + d + e*

    Blocks are two windows long, so that correlation that the model missed is kept. `order` (without delays)
    may differ from the identified one, to give plants on which no controller was designed. Raises ValueError
    if u has NaN.
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
            starts = rng.integers(0, len(errors) - block + 1, size=-(-len(a) // block))
            e = np.concatenate([errors[s : s + block] for s in starts])[: len(a)]
            x = linear_recurrence(plant.A, a @ plant.B.T + plant.b + e @ plant.K.T, x0)[:-1]
            rebuilt.append(x @ plant.C.T + a @ plant.D.T + plant.d + e)
        family.append(_reidentified(u, rebuilt, identified, order or identified.order))
    return family


def left_out_plants(u: Segments, y: Segments, identified, *, blocks: int = LEFT_OUT_BLOCKS) -> list[Plant]:
    """Fits the identified model class `blocks` times, each time without one equal block of the record's
    samples. Returns none if the rest is too short for the window. A block is skipped if some input hardly
    moves on its own without it, because the rest then does not show its effect.

    Their spread shows what a bootstrap under the model cannot: drift, and effects outside any linear model
    (block jackknife, Kuensch 1989).
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
        except ValueError:  # the rest of the record is too short
            return []
    return plants


def _still_moves(left: Segments, u: Segments) -> bool:
    """Returns whether the least independent movement of the remaining inputs is above a thousandth of that of
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
    basis = subspace(data, identified.past)[0][:order]
    start = stabilised(realise(data, basis, identified.plant.sample_time_s, direct), LARGEST_RADIUS)
    settings = FitSettings(direct, identified.offset, LARGEST_RADIUS, RESAMPLED_STEPS)
    refitted = fit(identified.fit, start, us, ys, settings, gain=False)
    return with_delays(stabilised(refitted, LARGEST_RADIUS), identified.delays)


def step_response(plant: Plant, steps: int) -> np.ndarray:
    """Returns the response (steps, p, m) of each output to a unit step of each input from rest, without
    offsets: D, then D + C B + C A B + ..."""
    return plant.D + np.concatenate(
        [np.zeros((1, plant.p, plant.m)), np.cumsum(markov_parameters(plant, steps - 1), axis=0)]
    )


def steady_gain(plant: Plant) -> np.ndarray:
    """Returns D + C (I - A)^-1 B (p, m), the steady change of the outputs after a unit step of each input. A
    must have no pole at 1."""
    return plant.D + plant.C @ np.linalg.solve(np.eye(plant.n) - plant.A, plant.B)


def spread_bands(
    nominal: Plant,
    family: Sequence[Plant],
    steps: int,
    *,
    level: float = 0.99,
    left_out: Sequence[Plant] = (),
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the step responses (steps, p, m) of the nominal plant, and the low and high ends of their bands
    at `level` over a family of plants. If the family is small, the band is its range.

    If there are `left_out` plants (`left_out_plants`), the bands reach at least to Student's quantile of
    their jackknife deviation.
    """
    own, *rest = (step_response(plant, steps) for plant in (nominal, *family, *left_out))
    return own, *banded(own, rest[: len(family)], rest[len(family) :], level)


def banded(
    own: np.ndarray, family: Sequence[np.ndarray], left_out: Sequence[np.ndarray], level: float
) -> tuple[np.ndarray, np.ndarray]:
    """Returns low and high ends (...) of a quantity `own` (...) of the plant, from those of a family and of
    plants without a block, as in `spread_bands`."""
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
    """Returns a sentence for each kind of test that failed: what was found, where it is strongest, and what
    to do. Empty if everything passed.

    `still_percent` (p,): fit with constant inputs. A higher order is a remedy only if the order was given
    (`order_given`); otherwise the rules chose it.
    """
    sentences = _of_colour(tests, outputs, order_given) + _of_inputs_left(tests, outputs, inputs, order_given)
    for o, output in enumerate(outputs):
        if fit_percent[o] < 50:
            sentences.append(
                f"the hold-out fit of {output} is {fit_percent[o]:.0f} %: "
                "the model misses more than half of its movement; "
                "look for an input or disturbance that is not recorded"
            )
        # the recorded inputs lower the error of the free response by less than `ADDS`
        if still_percent is not None and 100.0 - fit_percent[o] > (1.0 - ADDS) * (100.0 - still_percent[o]):
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


def _of_colour(tests: Residuals, outputs: Sequence[str], order_given: bool) -> list[str]:
    """Returns advice on residuals that are not white, with the name of the most coloured output."""
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
    """Returns advice on residuals that depend on inputs, with the strongest pair."""
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


LEVEL = 0.9  # of every band from here on
ENDS = ((1 - LEVEL) / 2, (1 + LEVEL) / 2)


class Holdout(NamedTuple):
    """Results of a plant on held-out segments.

    simulated, ahead: predictions (T, p) of each segment, the second NaN over its start-up. fits: by name of
    the figure, (3, p) in percent: value and the ends of its 90 % band. `fit_holdout`: of the simulation.
    `..._ahead`: of the predictions ahead; NaN if no segment outlasts the start-up. `..._held`: of the last
    measured value so many steps before, over the same rows. `..._free_mean`: of the simulation with the mean
    of each segment's error removed; the difference to `fit_holdout` is the cost of another ambient alone. It
    starts as the simulation does, because a start fitted together with a free mean lets slow modes follow any
    ramp. `..._drift`: of the simulation with a drift tracked up to so many steps before; NaN without a drift.
    """

    simulated: list[np.ndarray]
    ahead: list[np.ndarray]
    fits: dict[str, np.ndarray]


class Steps(NamedTuple):
    """Responses to unit steps with their bands over a family of plants: response, low, high (K, p, m) at
    samples (K,).

    first_order: models of the plant's responses and the family's, (1 + family, p, m). gain, peak,
    time_constant, delay (3, p, m): value and the ends of its band. gain is the steady value, or the last
    value if the plant is an integrator to the record; peak is the largest excursion at samples. Times are in
    samples. They are NaN if `significant` (p, m) is False: the band of the peak includes zero, so that not
    even the sign of the effect is known.
    """

    samples: np.ndarray
    response: np.ndarray
    low: np.ndarray
    high: np.ndarray
    gain: np.ndarray
    peak: np.ndarray
    time_constant: np.ndarray
    delay: np.ndarray
    significant: np.ndarray
    first_order: StepModels


def held(y: np.ndarray, steps: int) -> np.ndarray:
    """Returns the last value of y (T, p) measured at or before t - steps, NaN before the first one. A
    prediction `steps` ahead must beat it."""
    last = np.maximum.accumulate(np.where(np.isfinite(y), np.arange(len(y))[:, None], -1), axis=0)
    late = np.vstack([np.full((steps, y.shape[1]), -1), last])[: len(y)]
    return np.where(late >= 0, np.take_along_axis(y, np.maximum(late, 0), axis=0), np.nan)


def fit_with_band(
    y: Segments, predicted: Segments, *, block: int, rng: np.random.Generator, draws: int = 400
) -> np.ndarray:
    """Returns the NRMSE fit (3, p) in percent over the samples at which both are finite: value, and the ends
    of its 90 % band by resampling blocks of samples (Kuensch 1989).

    Blocks of `block` samples keep the correlation of the errors. They are shortened if fewer than ten fit,
    and joined if more than 200 do.
    """
    y, predicted = np.vstack(y), np.vstack(predicted)
    mask = np.isfinite(y) & np.isfinite(predicted)
    mean = np.where(mask, y, 0.0).sum(axis=0) / np.maximum(mask.sum(axis=0), 1)
    size = max(min(block, len(y) // 10), len(y) // 200, 1)
    parts = [
        np.add.reduceat(np.where(mask, part, 0.0) ** 2, np.arange(0, len(y), size), axis=0)
        for part in (y - predicted, y - mean)
    ]
    drawn = rng.integers(0, len(parts[0]), (draws, len(parts[0])))
    error, spread = (np.vstack([part.sum(axis=0), part[drawn].sum(axis=1)]) for part in parts)
    fit = np.where(
        mask.any(axis=0), 100.0 * (1.0 - np.sqrt(error / np.maximum(spread, np.finfo(float).tiny))), np.nan
    )
    return np.vstack([fit[0], np.quantile(fit[1:], ENDS, axis=0)])


def holdout(
    plant: Plant,
    u: Segments,
    y: Segments,
    steps: int,
    *,
    block: int,
    rng: np.random.Generator,
    drift: float = 0.0,
) -> Holdout:
    """Simulates held-out segments and predicts them `steps` ahead, beside the last measured value. `block` as
    in `fit_with_band`; `drift`: rate of an identified drift, 0 for none."""
    simulations = [simulated(plant, a, b) for a, b in zip(u, y, strict=True)]
    skip, ahead = max(3 * plant.n, 30) + steps, []  # the start-up of `predict_fit`
    for a, b in zip(u, y, strict=True):
        forecast = predicted_ahead(plant, a, b, steps) if len(a) > skip else np.full(b.shape, np.nan)
        forecast[:skip] = np.nan
        ahead.append(forecast)
    last = [
        np.where(np.isfinite(forecast), held(b, steps), np.nan) for b, forecast in zip(y, ahead, strict=True)
    ]
    free = [_mean_removed(b, a) for a, b in zip(simulations, y, strict=True)]
    drifting = [
        simulated_with_drift(plant, a, b, drift, steps) if drift else np.full(b.shape, np.nan)
        for a, b in zip(u, y, strict=True)
    ]
    parts = {
        "fit_holdout": simulations,
        "fit_holdout_ahead": ahead,
        "fit_holdout_held": last,
        "fit_holdout_free_mean": free,
        "fit_holdout_drift": drifting,
    }
    fits = {name: fit_with_band(y, part, block=block, rng=rng) for name, part in parts.items()}
    return Holdout(simulations, ahead, fits)


def fit_of_held_inputs(plant: Plant, u: Segments, y: Segments) -> np.ndarray:
    """Returns the NRMSE fit (p,) in percent of the free response alone: every input constant at its mean in
    each segment, with the initial state fitted as in `simulated`."""
    free = [simulated(plant, np.broadcast_to(a.mean(axis=0), a.shape), b) for a, b in zip(u, y, strict=True)]
    return fit_with_band(y, free, block=1, rng=np.random.default_rng(0), draws=1)[0]


def _mean_removed(y: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """Returns the prediction shifted by the mean of its error, output by output."""
    seen = np.isfinite(y)
    error = np.where(seen, y - predicted, 0.0).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
    return predicted + error


def residual_lags(u: Segments) -> int:
    """Returns the number of lags that `residual_tests` can use, at most 25."""
    return max(min(25, sum(map(len, u)) // 4), 1)


def horizon(plant: Plant, longest: int) -> int:
    """Returns the samples until every step response stays within 5 % of its output's largest one, and a third
    more; at most `longest`.

    For a plant with a pole outside the unit circle, it is at most three of its time constants, because
    nothing else is visible later. A mode whose time constant is longer than `longest`, the record, is an
    integrator to the record, and is followed over a tenth of it. The record contains ten such stretches, but
    only one of its own length, too few to show a sign. Of 35 signs of the study's plant, 22 were certain over
    a tenth, none of them wrong, and 16 over the whole length, 1 of them wrong.
    """
    radius = np.abs(np.linalg.eigvals(plant.A)).max()
    if not _settles(plant, longest):
        longest = max(longest // 10, 20)
    longest = min(longest, int(np.ceil(3 / np.log(radius)))) if radius > 1 + 1e-9 else longest
    r = step_response(plant, longest)
    away = (np.abs(r - r[-1]) > 0.05 * np.abs(r).max(axis=(0, 2))[:, None]).any(axis=(1, 2))
    return int(min(max(np.flatnonzero(away).max(initial=0) * 4 // 3, 20), longest))


def _settles(plant: Plant, longest: int) -> bool:
    """Returns whether every mode decays, or grows, by 63 % within `longest` samples. Other modes are
    integrators to a record of that length."""
    radius = np.abs(np.linalg.eigvals(plant.A)).max()
    return bool(abs(np.log(max(radius, np.finfo(float).tiny))) * longest >= 1)


def two_points(responses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns time constant 1.5 (t63 - t28) and delay t63 - tau (p, m), in samples, of responses (T, p, m)
    (Smith 1972). t28 and t63 are the times at which 28.3 and 63.2 % of the largest excursion are first
    reached, interpolated linearly between samples."""
    peak = np.take_along_axis(responses, np.abs(responses).argmax(axis=0)[None], axis=0)[0]
    share = responses / np.where(peak == 0, 1.0, peak)

    def reached(level):
        after = np.argmax(share >= level, axis=0)
        here, before = (
            np.take_along_axis(share, np.maximum(k, 0)[None], axis=0)[0] for k in (after, after - 1)
        )
        rise = np.where(after > 0, here - before, 1.0)
        return np.where(after > 0, after - (here - level) / np.where(rise > 0, rise, 1.0), 0.0)

    t28, t63 = reached(0.283), reached(0.632)
    tau = 1.5 * (t63 - t28)
    return tau, np.maximum(t63 - tau, 0.0)


def steps(
    nominal: Plant,
    family: Sequence[Plant],
    longest: int,
    *,
    points: int = 120,
    left_out: Sequence[Plant] = (),
) -> Steps:
    """Returns the step responses of a plant over its `horizon`, at most `points` + 1 of each, with gain,
    peak, time constant and delay, and those of the family; `left_out` as in `spread_bands`."""
    samples = horizon(nominal, longest)
    bands = spread_bands(nominal, family, samples + 1, level=LEVEL, left_out=left_out)
    at = np.abs(bands[0]).argmax(axis=0)[None]
    peak = np.concatenate([np.take_along_axis(part, at, axis=0) for part in bands])
    gain = np.stack([part[-1] for part in bands])
    if _settles(nominal, longest) and np.abs(np.linalg.eigvals(nominal.A)).max() < 1:
        own, *rest = (steady_gain(plant) for plant in (nominal, *family, *left_out))
        gain = np.stack([own, *banded(own, rest[: len(family)], rest[len(family) :], LEVEL)])
    significant = peak[1] * peak[2] > 0
    responses = [step_response(plant, samples + 1) for plant in (nominal, *family)]
    shapes = np.stack([two_points(part) for part in responses])  # (1 + family, 2, p, m)
    times = np.where(significant, np.concatenate([shapes[:1], np.quantile(shapes[1:], ENDS, axis=0)]), np.nan)
    grid = np.arange(0, samples + 1, -(-samples // points))
    response, low, high = (part[grid] for part in bands)
    # equal ratios: the start, which matters to a controller, counts as much as a late drift
    ratios = np.unique(np.geomspace(1, samples, points).round().astype(int))
    models = of_step_responses(ratios, np.stack([part[ratios] for part in responses], axis=1))
    return Steps(grid, response, low, high, gain, peak, times[:, 0], times[:, 1], significant, models)


# no heated part survives it: if an input's whole range moves an output by more, the gain is wrong
LARGEST_RISE_DEGC = 2000.0


def forbidden_gains(
    steps: Steps,
    outputs: Sequence[str],
    inputs: Sequence[str],
    heats: Sequence[bool],
    ranges: Sequence[float],
) -> list[dict[str, Any]]:
    """Returns the steady effects that are physically impossible, for inputs marked in `heats`: negative ones,
    and those that are larger than `LARGEST_RISE_DEGC` over the input's range (percent). Each has its `gain`
    in °C per percent with its band, and a reason; `certain`: the whole band is impossible, not only the
    value."""
    flagged = []
    for j, name in enumerate(inputs):
        for o, output in enumerate(outputs if heats[j] else ()):
            gain, low, high = (float(part) for part in steps.gain[:, o, j])
            largest = LARGEST_RISE_DEGC / ranges[j]
            if not (gain < 0 or gain > largest):
                continue
            too_much = f"more than {LARGEST_RISE_DEGC:g} °C over the input's range"
            flagged.append(
                {
                    "output": output,
                    "input": name,
                    "gain": gain,
                    "low": low,
                    "high": high,
                    "certain": high < 0 if gain < 0 else low > largest,
                    "reason": "a heater that cools" if gain < 0 else too_much,
                }
            )
    return flagged


def input_levels(u: Segments, *, bands: int = 8) -> np.ndarray:
    """Returns the r.m.s. level (bands, m) of each input within equal bands from 0 to pi rad a sample, over
    the segments with at least four samples per band."""
    power, samples = np.zeros((bands, u[0].shape[1])), 0
    for a in u:
        if len(a) >= 4 * bands:
            lines = 2.0 * np.abs(np.fft.rfft(a, axis=0)[1:]) ** 2 / len(a)
            power, samples = (
                power + np.stack([part.sum(axis=0) for part in np.array_split(lines, bands)]),
                samples + len(a),
            )
    return np.sqrt(power / max(samples, 1))


# ---- as columns


def holdout_rows(
    measured: Segments, predictions: Holdout, outputs: Sequence[str], sample_time_s: float
) -> dict[str, np.ndarray]:
    """Returns measured, simulated and predicted outputs of the held-out segments."""
    columns = {
        "segment": np.repeat(np.arange(len(measured), dtype=np.int32), [len(y) for y in measured]),
        "time_s": np.concatenate([sample_time_s * np.arange(len(y)) for y in measured]),
    }
    kinds = {"measured": measured, "simulated": predictions.simulated, "ahead": predictions.ahead}
    return columns | {
        f"{name}_{kind}": np.concatenate([y[:, channel] for y in part])
        for channel, name in enumerate(outputs)
        for kind, part in kinds.items()
    }


def residual_rows(tests: Residuals, outputs: Sequence[str], inputs: Sequence[str]) -> dict[str, list]:
    """Returns every correlation with its 99 % band: each output's residuals with themselves, then with each
    input."""
    lags, table = tests.autocorrelation.shape[1] - 1, []
    for o, output in enumerate(outputs):
        table += [
            (output, output, k, c, tests.band, tests.whiteness_passed[o])
            for k, c in enumerate(tests.autocorrelation[o])
        ]
        for j, name in enumerate(inputs):
            mine = zip(range(-lags, lags + 1), tests.cross_correlation[o, j], strict=True)
            table += [
                (output, name, k, c, tests.cross_band[o, j], tests.independence_passed[o, j]) for k, c in mine
            ]
    return dict(
        zip(
            ("output", "against", "lag", "correlation", "band", "passed"),
            map(list, zip(*table, strict=True)),
            strict=True,
        )
    )


def step_rows(
    steps: Steps, outputs: Sequence[str], inputs: Sequence[str], sample_time_s: float
) -> dict[str, np.ndarray | list]:
    """Returns the responses of `steps`, output by output, and within an output input by input."""
    pairs, count = [(o, j) for o in range(len(outputs)) for j in range(len(inputs))], len(steps.samples)
    columns = {
        "output": [outputs[o] for o, _ in pairs for _ in range(count)],
        "input": [inputs[j] for _, j in pairs for _ in range(count)],
        "time_s": np.tile(sample_time_s * steps.samples, len(pairs)),
    }
    return columns | {
        name: np.concatenate([getattr(steps, name)[:, o, j] for o, j in pairs])
        for name in ("response", "low", "high")
    }


def dynamics_rows(
    steps: Steps, outputs: Sequence[str], inputs: Sequence[str], sample_time_s: float
) -> dict[str, np.ndarray | list]:
    """Returns gain, peak, time constant and delay of `steps`, in the same order."""
    columns = {
        "output": [name for name in outputs for _ in inputs],
        "input": [*inputs] * len(outputs),
        "seen": steps.significant.ravel().tolist(),
    }
    for name, part in (
        ("gain", steps.gain),
        ("peak", steps.peak),
        ("time_constant_s", sample_time_s * steps.time_constant),
        ("delay_s", sample_time_s * steps.delay),
    ):
        columns |= {name: part[0].ravel(), f"{name}_low": part[1].ravel(), f"{name}_high": part[2].ravel()}
    return columns


def first_order_rows(
    steps: Steps, outputs: Sequence[str], inputs: Sequence[str], sample_time_s: float
) -> dict[str, np.ndarray | list]:
    """Returns a first-order model with delay for every pair, in the order of `step_rows`, with bands over the
    family, and its PID by SIMC. Values are missing if not even the sign of the gain is known."""
    models, columns = steps.first_order, {"output": [o for o in outputs for _ in inputs]}
    columns |= {"input": [*inputs] * len(outputs)}
    banded = [
        np.concatenate([part[:1], np.quantile(part[1:], ENDS, axis=0)]).reshape(3, -1)
        for part in (models.gain, sample_time_s * models.time_constant, sample_time_s * models.delay)
    ]
    seen = (banded[0][1] * banded[0][2] > 0) & (banded[0][0] * banded[0][1] > 0) & steps.significant.ravel()
    columns["seen"] = seen.tolist()
    for name, part in zip(("gain", "time_constant_s", "delay_s"), banded, strict=True):
        shown = part if name == "gain" else np.where(seen, part, np.nan)
        columns |= {name: shown[0], f"{name}_low": shown[1], f"{name}_high": shown[2]}
    columns["fit_percent"] = np.where(seen, models.fit_percent[0].ravel(), np.nan)
    pids = [
        simc_pid(gain, tau, delay, sample_time_s=sample_time_s) if known else (np.nan,) * 3
        for known, gain, tau, delay in zip(seen, *(part[0] for part in banded), strict=True)
    ]
    return columns | dict(zip(("Kp", "Ki", "Kd"), np.array(pids, float).T, strict=True))


def pole_rows(nominal: Plant, family: Sequence[Plant]) -> dict[str, np.ndarray]:
    """Returns the poles of the plant (member 0), largest first, and of a family. `pole` is the number of the
    corresponding pole of the plant, -1 if there is none.

    Poles are matched so that the sum of their distances is smallest (Kuhn 1955).
    """
    mine = np.linalg.eigvals(nominal.A)
    mine = mine[np.lexsort((-mine.imag, -np.abs(mine).round(12)))]
    table = [(0, k, pole.real, pole.imag) for k, pole in enumerate(mine)]
    for i, plant in enumerate(family, 1):
        poles = np.linalg.eigvals(plant.A)
        of_mine, of_theirs = scipy.optimize.linear_sum_assignment(np.abs(mine[:, None] - poles))
        number = np.full(len(poles), -1)
        number[of_theirs] = of_mine
        table += [(i, int(k), pole.real, pole.imag) for k, pole in zip(number, poles, strict=True)]
    member, pole, real, imag = zip(*table, strict=True)
    return {
        "member": np.array(member, np.int32),
        "pole": np.array(pole, np.int32),
        "real": np.array(real),
        "imag": np.array(imag),
    }


def level_rows(levels: np.ndarray, inputs: Sequence[str]) -> dict[str, np.ndarray | list]:
    """Returns the levels of `input_levels`, input by input, and within an input band by band."""
    edges = np.linspace(0, np.pi, len(levels) + 1)
    return {
        "input": [name for name in inputs for _ in levels],
        "low_rad": np.tile(edges[:-1], len(inputs)),
        "high_rad": np.tile(edges[1:], len(inputs)),
        "level": levels.T.ravel(),
    }


# ---- as figures by name; None where there is none


def fit_figures(judged: Holdout, outputs: Sequence[str]) -> dict[str, dict | None]:
    """Returns the fits on the hold-out by output, with their bands and the references that they must beat.
    Those ahead are None if no segment was long enough, those with drift if there is no drift."""
    banded = [f"fit_holdout{end}" for end in ("", "_free_mean", "_drift", "_ahead")]
    figures = {key: dict(zip(outputs, judged.fits[key][0].tolist(), strict=True)) for key in banded}
    figures |= {
        f"{key}_band": dict(zip(outputs, judged.fits[key][1:].T.tolist(), strict=True)) for key in banded
    }
    figures["fit_holdout_held"] = dict(zip(outputs, judged.fits["fit_holdout_held"][0].tolist(), strict=True))
    return {key: part if np.isfinite(list(part.values())).all() else None for key, part in figures.items()}


def outcome_figures(
    tests: Residuals, excited: RecordExcitation, outputs: Sequence[str], inputs: Sequence[str]
) -> dict[str, dict]:
    """Returns which tests passed, and how far the inputs excite."""
    lags = excited.full // len(inputs)
    alone = {
        name: {"rank": int(rank), "level": float(level)}
        for name, rank, level in zip(inputs, excited.per_input_rank, excited.levels, strict=True)
    }
    return {
        "whiteness_passed": dict(zip(outputs, tests.whiteness_passed.tolist(), strict=True)),
        "independence_passed": {
            name: dict(zip(inputs, row, strict=True))
            for name, row in zip(outputs, tests.independence_passed.tolist(), strict=True)
        },
        "excitation": {
            "rank": excited.rank,
            "full": excited.full,
            "condition": excited.condition if np.isfinite(excited.condition) else None,
            "lags": lags,
            "inputs": alone,
        },
    }


def judge(
    chosen: Identified,
    first: tuple[Segments, Segments],
    last: tuple[Segments, Segments],
    *,
    ahead_steps: int,
    rng: np.random.Generator,
) -> tuple[Holdout, Residuals, RecordExcitation, np.ndarray]:
    """Judges the model that was chosen on (u, y) of `first`, on (u, y) of `last`. Returns the hold-out
    results, the residual tests, the excitation of the first part, and the fit (p,) with constant inputs."""
    closed = chosen.feedback is not None and chosen.feedback.closed
    return (
        holdout(chosen.plant, *last, ahead_steps, block=2 * chosen.past, rng=rng, drift=chosen.drift),
        residual_tests(chosen.plant, *last, lags=residual_lags(last[0]), closed=closed),
        excitation(first[0], chosen.past),
        fit_of_held_inputs(chosen.plant, *last),
    )
