"""Plants that a record does not exclude: window models and gains, learned again from resampled blocks of its
samples, and how a controller performs on those plants.

The regression of a window model (temperature/window.py) needs second moments only. Those of each block of
consecutive samples are summed once; a resample (Kuensch 1989) is then a sum of blocks and one solve, and each
is a plant that the record does not contradict. Blocks preserve errors that are not white: drift, and effects
that no linear model has.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import scipy.linalg
import scipy.stats

from pipeline.temperature.controllers.kernel import Tuples, regress, value_iteration, window_shift, windows
from pipeline.temperature.controllers.law import (
    Deployed,
    Plant,
    aim,
    batch_step,
    constant,
    handed_over,
    rest,
    watched,
)
from pipeline.temperature.controllers.problem import DesignProblem
from pipeline.temperature.controllers.window import WindowModel, observer_form, predictor
from pipeline.temperature.plant import hold_output, observability_matrix, padded
from pipeline.temperature.tracking import gains

Segments = Sequence[np.ndarray]
LEAST_BLOCKS = 20  # with fewer blocks the scatter of resamples is not reliable
DIVERGED = 1e6  # °C
CHUNK = 50  # resamples whose moments are held at once


class Rows(NamedTuple):
    """The complete windows of a record, one a row: `w` (samples, N (m+p)); inputs `u` (samples, m) and
    outputs `y` (samples, p) of the same instant."""

    w: np.ndarray
    u: np.ndarray
    y: np.ndarray
    N: int


class Moments(NamedTuple):
    """Second moments (blocks, k, k) of the columns [1, (w - centre) / scale, y - base] over each block of
    `block` rows; `starts` (blocks,): their first rows."""

    blocks: np.ndarray
    starts: np.ndarray
    block: int
    centre: np.ndarray
    scale: np.ndarray
    base: np.ndarray


class Predictors(NamedTuple):
    """Window models, one for each resample: `Theta` (count, p, N (m+p)); `theta_0` (count, p); `covariance`
    of the innovation (count, p, p)."""

    Theta: np.ndarray
    theta_0: np.ndarray
    covariance: np.ndarray
    N: int

    def window(self, index: int) -> WindowModel:
        return WindowModel(
            self.Theta[index], self.theta_0[index], self.covariance[index], self.N, 0, np.zeros((0, 3))
        )


class GainRoute(NamedTuple):
    """How the gains were learned: `route`; windows of `N` samples; weights diag(q) (p,) and diag(r) (m,);
    `gamma`, the discount; `gain_spread`, the spread of input gains that window.learn allows for."""

    route: Literal["window", "kernel"]
    N: int
    q: np.ndarray
    r: np.ndarray
    gamma: float
    gain_spread: float = 0.0


def gain_route(problem: DesignProblem, learned_from: str, values: Mapping[str, Any]) -> GainRoute | None:
    """Returns how the gains of a controller were learned from the record; None if they come from a model.
    `values`: its tuned parameters."""
    if learned_from != "window" and learned_from != "kernel":
        return None
    learned = problem.window if learned_from == "window" else problem.kernel
    if learned is None:
        return None
    effort = np.full(problem.plant.m, float(values["effort_weight"]))
    return GainRoute(learned_from, learned.N, np.ones(problem.plant.p), effort, problem.gamma)


class Bands(NamedTuple):
    """Gains u = -K w - K_r r of the record, and the ends of their bands at `level`: each (m, N (m+p) + p),
    the columns of K before those of K_r, in percent per percent and percent per °C. `resamples`: how many
    gave a gain."""

    gain: np.ndarray
    low: np.ndarray
    high: np.ndarray
    level: float
    resamples: int


# ---- predictors


def rows(u: Segments, y: Segments, N: int) -> Rows:
    """Returns the complete windows. Raises ValueError if no segment is longer than N samples."""
    return Rows(*windows(u, y, N), N)


def moments(data: Rows, block: int) -> Moments:
    """Returns the moments of blocks of `block` rows; the blocks are shorter if the record has fewer than
    LEAST_BLOCKS."""
    samples = len(data.w)
    block = max(min(block, samples // LEAST_BLOCKS), 1)
    starts = np.arange(0, samples, block)
    centre, base = data.w.mean(axis=0), data.y.mean(axis=0)
    scale = np.maximum(data.w.std(axis=0), 1e-12 * np.maximum(np.abs(centre), 1.0))
    columns = np.hstack([np.ones((samples, 1)), (data.w - centre) / scale, data.y - base])
    parts = np.stack([columns[a : a + block].T @ columns[a : a + block] for a in starts])
    return Moments(parts, starts, block, centre, scale, base)


def drawn(of: Moments, count: int, rng: np.random.Generator) -> np.ndarray:
    """Returns how often each block is drawn (count, blocks); each resample has as many blocks as the
    record."""
    blocks = len(of.starts)
    return rng.multinomial(blocks, np.full(blocks, 1 / blocks), size=count).astype(float)


def predictors(of: Moments, taken: np.ndarray, data: Rows, *, gain_spread: float = 0.0) -> Predictors:
    """Returns one window model for each row of `taken` (count, blocks), by least squares with a constant."""
    m, p = data.u.shape[1], data.y.shape[1]
    k = 1 + data.w.shape[1]
    Theta, theta_0 = np.empty((len(taken), p, k - 1)), np.empty((len(taken), p))
    covariance = np.empty((len(taken), p, p))
    for i, S in enumerate(_summed(of, taken)):
        normal, right = S[:k, :k].copy(), S[:k, k:]
        if gain_spread:
            normal += gain_spread**2 * _own_moments(S, of, m, p, data.N)
        normal[np.diag_indices(k)] *= 1 + 1e-10  # in case a signal is constant in these blocks
        solution = scipy.linalg.cho_solve(scipy.linalg.cho_factor(normal, lower=True), right)
        residual = S[k:, k:] - solution.T @ right - right.T @ solution + solution.T @ S[:k, :k] @ solution
        covariance[i] = residual / max(S[0, 0] - k, 1.0)
        Theta[i] = solution[1:].T / of.scale
        theta_0[i] = of.base + solution[0] - Theta[i] @ of.centre
    return Predictors(Theta, theta_0, covariance, data.N)


def _summed(of: Moments, taken: np.ndarray) -> Iterator[np.ndarray]:
    """Yields the moments (k, k) of each resample, CHUNK resamples in one product."""
    flat, shape = of.blocks.reshape(len(of.blocks), -1), of.blocks.shape[1:]
    for first in range(0, len(taken), CHUNK):
        yield from (taken[first : first + CHUNK] @ flat).reshape(-1, *shape)


def _own_moments(S: np.ndarray, of: Moments, m: int, p: int, N: int) -> np.ndarray:
    """Returns the second moments of each input's own lags about zero, in the scaled columns, without those
    between inputs; zero for all other columns."""
    k = 1 + N * (m + p)
    own = np.zeros((k, k))
    ratio = of.centre / of.scale
    for channel in range(m):
        lags = np.arange(channel, N * m, m)
        at, c = 1 + lags, ratio[lags]
        first = np.outer(c, S[0, at])
        own[np.ix_(at, at)] = S[np.ix_(at, at)] + first + first.T + S[0, 0] * np.outer(c, c)
    return own


# ---- gains


def bands(
    u: Segments,
    y: Segments,
    learning: GainRoute,
    *,
    resamples: int = 200,
    level: float = 0.9,
    block: int | None = None,
    rng: np.random.Generator,
) -> Bands:
    """Returns bands of the learned gains, by resampling blocks of the record. `block`: rows in a block, by
    default two windows.

    They are 2 K - mean +- z s of the resamples: bias-corrected, since the regression's bias appears in them
    once more (Efron and Tibshirani 1993, 10.6), and with their standard deviation s. With quantiles of the
    resamples, bands of 90 % contained some gains in only 54 % of records; these do in 82 %. Resamples without
    a gain are left out. Raises ValueError if fewer than half of them give one.
    """
    data = rows(u, y, learning.N)
    of = moments(data, block or max(2 * learning.N, 10))
    taken = np.vstack([np.ones((1, len(of.starts))), drawn(of, resamples, rng)])
    learned = predictors(of, taken, data, gain_spread=learning.gain_spread)
    here, found = _gain(data, of, taken[0], learned.window(0), learning), []
    for k in range(1, resamples + 1):
        try:
            found.append(_gain(data, of, taken[k], learned.window(k), learning))
        except (ValueError, np.linalg.LinAlgError):
            continue
    if 2 * len(found) < resamples:
        raise ValueError(
            f"bands: only {len(found)} of {resamples} resamples of the record give a gain; record longer, or "
            "lower the window"
        )
    centre = 2 * here - np.mean(found, axis=0)
    reach = scipy.stats.norm.ppf((1 + level) / 2) * np.std(found, axis=0, ddof=1)
    return Bands(here, centre - reach, centre + reach, level, len(found))


def _gain(
    data: Rows, of: Moments, counts: np.ndarray, learned: WindowModel, learning: GainRoute
) -> np.ndarray:
    """Returns [K K_r] (m, N (m+p) + p) of one resample, whose window model is `learned`."""
    Q, R = np.diag(learning.q), np.diag(learning.r)
    if learning.route == "window":
        model, T = observer_form(learned)
        found = gains(model, Q, R, learning.gamma)
        return np.hstack([found.K_x @ T, found.K_r])
    solution = value_iteration(regress(_predicted(learned, data, of, counts)), Q, R, learning.gamma)
    return np.hstack([solution.K, solution.K_r])


def _predicted(learned: WindowModel, data: Rows, of: Moments, counts: np.ndarray) -> Tuples:
    """Returns window.predicted_tuples of resampled rows. The state is what the window predicts of the next
    two outputs, and the moments come from the blocks."""
    m, p, width = data.u.shape[1], data.y.shape[1], data.w.shape[1]
    index = np.concatenate([np.repeat(a, int(c)) for a, c in enumerate(counts)])
    rows = (of.starts[index][:, None] + np.arange(of.block)).ravel()
    rows = rows[rows < len(data.w)]
    S = (counts @ of.blocks.reshape(len(counts), -1)).reshape(of.blocks.shape[1:])
    mean = S[0, 1 : 1 + width] / S[0, 0]
    centre = of.centre + mean * of.scale
    second = (S[1 : 1 + width, 1 : 1 + width] / S[0, 0] - np.outer(mean, mean)) * np.outer(of.scale, of.scale)
    model = predictor(learned)
    free = observability_matrix(model.A, model.C, 2)
    power, axes = np.linalg.eigh(second)
    left, sv, _ = np.linalg.svd(free @ (axes * np.sqrt(np.maximum(power, 0.0))), full_matrices=False)
    noise = np.sqrt(np.diag(learned.covariance).max())
    order = int((sv > np.maximum(2 * noise, 1e-7 * sv[0])).sum())
    if order == 0:
        raise ValueError("the window predicts nothing beyond the noise of the sensors")
    T = left[:, :order].T @ free / sv[:order, None]
    A, B_u, B_y = window_shift(m, p, data.N)
    x = (data.w @ T.T)[rows] - T @ centre
    x_next = (data.w @ (T @ A).T + data.u @ (T @ B_u).T + data.y @ (T @ B_y).T)[rows] - T @ centre
    one = np.ones((len(rows), 1))
    features = np.zeros((order + 1, width + 1))
    features[:order, :-1], features[:order, -1], features[order:, -1] = T, -T @ centre, 1.0
    measured = data.y[rows]
    base = measured.mean(axis=0)
    return Tuples(
        np.hstack([x, one]), data.u[rows], measured - base, np.hstack([x_next, one]), features, data.N, base
    )


# ---- the controller on what the record leaves open


class ReferenceSteps(NamedTuple):
    """Starting at rest at `start` (p,) °C, the references (g, p) °C are applied for `steps` samples each. The
    settled error is the mean error of the last `settled` samples."""

    references: np.ndarray
    start: np.ndarray
    steps: int
    settled: int


class Met(NamedTuple):
    """Results of s plants: `settled_error` (s,) in °C, the largest over references and outputs, DIVERGED if
    it is not finite; `lowest` and `highest` outputs (s, p) in °C."""

    settled_error: np.ndarray
    lowest: np.ndarray
    highest: np.ndarray


class _Plants(NamedTuple):
    """s plants: state x (s, n) and inputs u (s, m) at rest; functions for the outputs of a state, the state
    after inputs and measured outputs, and a random sample of the sensors' noise (s, p)."""

    x: np.ndarray
    u: np.ndarray
    outputs: Callable[[np.ndarray], np.ndarray]
    after: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
    noise: Callable[[], np.ndarray]


def met(
    controller: Deployed, model: Plant, sampled: Predictors, asked: ReferenceSteps, rng: np.random.Generator
) -> Met:
    """Simulates window models with the controller as deployed, all at once, with innovations of their own
    covariance.

    In observer form (window.observer_form)

        x_i(t+1) = x_{i+1} + A_i y + B_i u,

    driven by the measured outputs. Each starts at rest with the input of least norm that holds it there, as
    near as limits allow.
    """
    s, p, width = sampled.Theta.shape
    N = sampled.N
    m = width // N - p
    of_u, of_y = (
        part.reshape(s, p, N, -1).transpose(0, 2, 1, 3)
        for part in (sampled.Theta[:, :, : N * m], sampled.Theta[:, :, N * m :])
    )
    needed = asked.start - of_y.sum(axis=1) @ asked.start - sampled.theta_0
    u = np.matmul(np.linalg.pinv(of_u.sum(axis=1)), needed[:, :, None])[:, :, 0]
    u = np.clip(u, controller.limits.low, controller.limits.high)
    drive = of_y @ asked.start + np.einsum("sipm,sm->sip", of_u, u)
    x = drive[:, ::-1].cumsum(axis=1)[:, ::-1].reshape(s, -1)
    F, G = of_y.reshape(s, N * p, p), of_u.reshape(s, N * p, m)
    values, axes = np.linalg.eigh(sampled.covariance)
    root = (axes * np.sqrt(np.maximum(values, 0.0))[:, None, :]).transpose(0, 2, 1)

    def after(x: np.ndarray, u: np.ndarray, y: np.ndarray) -> np.ndarray:
        moved = np.matmul(F, y[:, :, None])[:, :, 0] + np.matmul(G, u[:, :, None])[:, :, 0]
        moved[:, :-p] += x[:, p:]
        return moved

    plants = _Plants(
        x,
        u,
        lambda x: x[:, :p] + sampled.theta_0,
        after,
        lambda: np.matmul(rng.standard_normal((s, 1, p)), root)[:, 0],
    )
    return _run(controller, model, plants, asked)


def met_spread(
    controller: Deployed,
    model: Plant,
    spread: Sequence[Plant],
    asked: ReferenceSteps,
    noise: np.ndarray,
    rng: np.random.Generator,
) -> Met:
    """Does the same for plants of a spread, with sensors of white noise (p,) °C."""
    held = [hold_output(plant, asked.start) for plant in spread]
    plants = padded(spread)
    A, B, C, b, d = (np.stack([getattr(plant, name) for plant in plants]) for name in "ABCbd")
    x = np.stack([np.pad(one[0], (0, A.shape[1] - len(one[0]))) for one in held])
    u = np.clip(np.stack([one[1] for one in held]), controller.limits.low, controller.limits.high)

    def after(x: np.ndarray, u: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.matmul(A, x[:, :, None])[:, :, 0] + np.matmul(B, u[:, :, None])[:, :, 0] + b

    return _run(
        controller,
        model,
        _Plants(
            x,
            u,
            lambda x: np.matmul(C, x[:, :, None])[:, :, 0] + d,
            after,
            lambda: noise * rng.standard_normal(d.shape),
        ),
        asked,
    )


def _run(controller: Deployed, model: Plant, plants: _Plants, asked: ReferenceSteps) -> Met:
    law, limits = controller.law, controller.limits
    at = [constant(r) for r in (asked.start, *asked.references)]
    here, *aims = [aim(law, rest(model, one, limits), one) for one in at]
    x, u, s = plants.x, plants.u, len(plants.x)
    y = plants.outputs(x)
    state = watched(controller, None, u, y + plants.noise(), np.tile(asked.references[0], (s, 1)))
    state = handed_over(controller, state, y, [here] * s)
    settled, lowest, highest = np.zeros(s), y, y
    for r, one in zip(asked.references, aims, strict=True):
        feed, target = np.tile(one.feed[:, 0], (s, 1)), np.tile(one.Y[:, 0], (s, 1))
        wanted, late = np.tile(r, (s, 1)), np.zeros_like(y)
        for t in range(asked.steps):
            y = plants.outputs(x)
            measured = y + plants.noise()
            u, _, state = batch_step(controller, state, measured, wanted, feed, target)
            x = plants.after(x, u, measured)
            if not np.abs(x).max() < DIVERGED:
                x = np.clip(np.nan_to_num(x), -DIVERGED, DIVERGED)
                state = state._replace(z=np.clip(np.nan_to_num(state.z), -DIVERGED, DIVERGED))
            lowest, highest = np.minimum(lowest, y), np.maximum(highest, y)
            if t >= asked.steps - asked.settled:
                late += (y - r) / asked.settled
        off = np.abs(late).max(axis=1)
        settled = np.maximum(settled, np.where(np.abs(y).max(axis=1) > DIVERGED / 10, DIVERGED, off))
    return Met(settled, lowest, highest)
