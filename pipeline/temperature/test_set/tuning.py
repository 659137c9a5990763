"""Bayesian optimisation of the weights Q = diag(q), R = diag(r) (seed 1,
section 5), generic in the cost that is minimised.

What the paper's tuning finds, in plain words. The fitness (37) weighs errors and inputs with 1: it *is* the
index (3) at Q = R = I, over l steps. The controller designed with Q = R = I is therefore its optimum (but for
the cut at l): 151,820 for the BAAM extruder from 20 °C, which no search can undercut. The "58.5 % better" of
the paper compares indices with different weights, like prices in two currencies: Q = R = 0.4 I gives the very
same gain, hence the same temperatures and inputs, and "improves" the index by 60.0 %. On one yardstick, (37)
itself, the paper's tuned weights are 4.96 % (model-based) and 39.8 % (data-driven) worse than those it
started from. The search is worth having for other costs (settling, overshoot, limits, the worst plant of a
spread); (37) tests it, because there the answer is known.

Two searches. `expected_improvement` works on log-weights, since weights act by their ratios and span
decades: a Gaussian process with a Matern 5/2 kernel and one length per weight, and expected improvement
inside a trust region that grows on success and shrinks on failure (Eriksson et al. 2019, TuRBO). A
prior holds the lengths to a plausible size: 50 points in 12 dimensions do not determine 12 lengths, and
without it the likelihood calls half of the weights irrelevant and the search ends 100 to 3,000 above
the optimum of (37), not 1 to 34. `upper_confidence_bound` is the published search (39)-(43): the
weights as they are, its fixed kernel, the whole box.

A candidate may fail (an unstable loop, a cost that is not finite). It enters the history as NaN with its
reason, and never the model of the cost: a second Gaussian process learns from the marks "worked" and "failed"
how likely a candidate is to work, and the acquisition is multiplied by that probability. The common remedy,
the worst cost seen in the place of a failure, bends the model just where an optimum lies against such a wall:
on two such problems (8 and 12 weights) it ended 3,000 and 40 times further from the optimum.
"""

from collections.abc import Callable
from functools import partial
from typing import Literal, NamedTuple, get_args

import numpy as np
import scipy.linalg
import scipy.optimize
import scipy.special
from scipy.spatial.distance import cdist

from pipeline.temperature.plant import Plant

Acquisition = Literal["expected_improvement", "upper_confidence_bound"]


class History(NamedTuple):
    """In order of evaluation: theta (k, d), cost (k,), NaN if failed, failed: k
    reasons, "" if it worked, incumbent (k,): least so far."""

    theta: np.ndarray
    cost: np.ndarray
    failed: tuple[str, ...]
    incumbent: np.ndarray


class SearchSettings(NamedTuple):
    """The first `initial` of all `evaluations` candidates are a scrambled Sobol set. `exploration` is epsilon
    of (42), which the paper does not give."""

    initial: int
    evaluations: int
    acquisition: Acquisition = "expected_improvement"
    exploration: float = 2.0


class SearchResult(NamedTuple):
    """The weights theta (d,) that the search recommends, their cost as it
    was evaluated, and everything that was evaluated."""

    theta: np.ndarray
    cost: float
    history: History


def fitness(
    plant: Plant,
    K_x: np.ndarray,
    K_r: np.ndarray,
    *,
    reference: np.ndarray,
    gamma: float,
    steps: int,
    x0: np.ndarray,
    k=0.0,
) -> float:
    """F = sum_{t=0..l} gamma^t (|y(t) - r|^2 + |u(t)|^2)

    of u = -K_x x - K_r r - k with the state known and r constant (37).

    K_x (m, n), K_r (m, p), k (m,), reference r (p,) in °C, x0 (n,), steps = l >= 0: l + 1 terms. With
    z = [x; 1] the loop is z(t+1) = M z(t), so that all z come from log2(l) products, Z <- [Z, M^i Z]. Raises
    ValueError where the closed loop is unstable.
    """
    A_cl = plant.A - plant.B @ K_x
    radius = np.abs(np.linalg.eigvals(A_cl)).max()
    if not radius < 1:
        raise ValueError(
            f"fitness: the closed loop is unstable, spectral radius {radius:.6g}, expected below 1; "
            "choose other weights"
        )
    u_r = -K_r @ reference - k
    M = np.block([[A_cl, (plant.B @ u_r + plant.b)[:, None]], [np.zeros((1, plant.n)), np.ones((1, 1))]])
    offset = plant.D @ u_r + plant.d - reference
    stage = np.block([[plant.C - plant.D @ K_x, offset[:, None]], [-K_x, u_r[:, None]]])  # z -> [y - r; u]
    Z = np.append(x0, 1.0)[:, None]
    while Z.shape[1] <= steps:
        Z, M = np.hstack([Z, M @ Z]), M @ M
    terms = ((stage @ Z[:, : steps + 1]) ** 2).sum(axis=0)
    return float(gamma ** np.arange(steps + 1) @ terms)


class _Surrogate(NamedTuple):
    """A Gaussian process and its data; kappa(s) -> kappa, kappa'.

    k(x, x') = variance kappa(s)
    s = sum_j ((x_j - x'_j) / length_j)^2"""

    points: np.ndarray  # (k, d)
    weights: np.ndarray  # (k,)  K^-1 y
    inverse: np.ndarray  # (k, k)  L^-1, K = L L'
    variance: float
    length: np.ndarray  # (d,)
    kappa: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


def _squared_exponential(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    k = np.exp(-0.5 * s)
    return k, -0.5 * k


def _matern(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    r = np.sqrt(5 * s)
    decay = np.exp(-r)
    return (1 + r + r * r / 3) * decay, -5 / 6 * (1 + r) * decay


def _posterior(gp: _Surrogate, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation (41) at x (k, d)."""
    k = gp.variance * gp.kappa(cdist(x / gp.length, gp.points / gp.length, "sqeuclidean"))[0]
    v = k @ gp.inverse.T
    return k @ gp.weights, np.sqrt(np.maximum(gp.variance - (v * v).sum(axis=1), 1e-14 * gp.variance))


def _posterior_slopes(gp: _Surrogate, x: np.ndarray) -> tuple[float, float, np.ndarray, np.ndarray]:
    """Mean and standard deviation (41) at one x (d,), and their gradients (d,)."""
    apart = (x - gp.points) / gp.length
    kappa, slope = gp.kappa((apart * apart).sum(axis=1))
    k, dk = gp.variance * kappa, 2 * gp.variance * slope[:, None] * apart / gp.length
    v = gp.inverse @ k
    std = np.sqrt(max(gp.variance - v @ v, 1e-14 * gp.variance))
    return k @ gp.weights, std, gp.weights @ dk, -(v @ gp.inverse) @ dk / std


def _surrogate(points: np.ndarray, values: np.ndarray, kernel) -> _Surrogate:
    """scikit-learn's process at fixed kernel parameters, kernel = variance * Matern(length) + noise."""
    # here: the import takes seconds, and few callers search
    from sklearn.gaussian_process import GaussianProcessRegressor

    fitted = GaussianProcessRegressor(kernel, alpha=1e-10, optimizer=None).fit(points, values)
    inverse = scipy.linalg.solve_triangular(fitted.L_, np.eye(len(values)), lower=True)
    variance, matern = fitted.kernel_.k1.k1.constant_value, fitted.kernel_.k1.k2
    kappa = _matern if matern.nu == 2.5 else _squared_exponential
    return _Surrogate(points, fitted.alpha_, inverse, variance, matern.length_scale, kappa)


def _kernel(length: np.ndarray, *, nu: float, noise: float, variance: float = 1.0):
    from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel

    return ConstantKernel(variance, (1e-2, 1e3)) * Matern(length, (0.05, 50.0), nu=nu) + WhiteKernel(
        noise, (1e-9, 1e-1)
    )


def _likeliest(kernel, points: np.ndarray, values: np.ndarray, iterations: int):
    """The kernel at the maximum of likelihood times prior, from where it stands.

    Prior of the logarithms: variance N(0, 3^2), lengths N(log sqrt(d), 1) (distances in a cube grow with
    sqrt(d): Hvarfner et al. 2024), noise N(log 1e-6, 3^2).
    """
    from sklearn.gaussian_process import GaussianProcessRegressor

    d = points.shape[1]
    centre = np.concatenate([[0.0], np.full(d, 0.5 * np.log(d)), [np.log(1e-6)]])
    spread = np.concatenate([[3.0], np.ones(d), [3.0]])
    process = GaussianProcessRegressor(kernel, alpha=1e-10, optimizer=None).fit(points, values)

    def objective(parameters):
        likelihood, gradient = process.log_marginal_likelihood(
            parameters, eval_gradient=True, clone_kernel=False
        )
        off = (parameters - centre) / spread
        return 0.5 * off @ off - likelihood, off / spread - gradient

    start = process.kernel_.theta.copy()
    best = scipy.optimize.minimize(
        objective, start, jac=True, method="L-BFGS-B", bounds=kernel.bounds, options={"maxiter": iterations}
    )
    return kernel.clone_with_theta(best.x)


def _log_improvement(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """log h and h'/h of h(z) = phi(z) + z Phi(z); below z = -1, where the sum
    cancels, as phi (1 + z Phi / phi) with 1 / z^2 at last."""
    near, far = np.maximum(z, -1.0), np.clip(z, -1e4, -1.0)
    h = np.exp(-0.5 * near**2) / np.sqrt(2 * np.pi) + near * scipy.special.ndtr(near)
    mills = np.sqrt(np.pi / 2) * scipy.special.erfcx(-far / np.sqrt(2))
    bracket = 1 + far * mills
    log_far = -0.5 * z**2 - 0.5 * np.log(2 * np.pi) + np.log(bracket)
    return np.where(z > -1, np.log(h), log_far), np.where(
        z > -1, scipy.special.ndtr(near) / h, np.where(z > -1e4, mills / bracket, -z)
    )


# an acquisition takes mean and standard deviation to (a, da/dmean, da/dstd); the least a is evaluated next


def _expected_improvement(mean, std, *, best: float):
    """a = -log E[max(best - f, 0)] = -log(std h(z)), z = (best - mean) / std

    The logarithm keeps a slope where the improvement is flat."""
    z = (best - mean) / std
    log_h, ratio = _log_improvement(z)
    return -(np.log(std) + log_h), ratio / std, (ratio * z - 1) / std


def _upper_confidence_bound(mean, std, *, exploration: float):
    """a = mu - epsilon k, k the posterior variance (42)."""
    return mean - exploration * std**2, np.ones_like(mean), -2 * exploration * std


def _success(mean, std):
    """a = -log P(the candidate works): P that the process of the marks (0 worked, -2
    failed) is above -1; far from every mark P = 0.84."""
    z = (1 + mean) / std
    log_P = scipy.special.log_ndtr(z)
    ratio = np.exp(-0.5 * z * z - log_P) / np.sqrt(2 * np.pi)
    return -log_P, -ratio / std, ratio * z / std


Term = tuple[_Surrogate, Callable]


def _least(
    terms: list[Term], candidates: np.ndarray, low: np.ndarray, high: np.ndarray, starts: int = 2
) -> np.ndarray:
    """The point of the box low..high with the least sum of acquisitions: candidates
    (k, d) screened, the best few refined by L-BFGS-B."""

    def objective(x):
        total, gradient = 0.0, np.zeros_like(x)
        for gp, acquisition in terms:
            mean, std, dmean, dstd = _posterior_slopes(gp, x)
            value, by_mean, by_std = acquisition(mean, std)
            total, gradient = total + value, gradient + by_mean * dmean + by_std * dstd
        return total, gradient

    screened = sum(acquisition(*_posterior(gp, candidates))[0] for gp, acquisition in terms)
    best, least, bounds = candidates[np.argmin(screened)], np.inf, np.column_stack([low, high])
    for first in candidates[np.argsort(screened, kind="stable")[:starts]]:
        optimum = scipy.optimize.minimize(
            objective, first, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 30}
        )
        if optimum.fun < least:
            best, least = optimum.x, optimum.fun
    return np.clip(best, low, high)


class _TrustRegion(NamedTuple):
    """The side of the box around the best candidate, as a share of the domain, and the
    run of successes and failures that may change it."""

    side: float = 0.8
    successes: int = 0
    failures: int = 0

    def after(self, better: bool) -> "_TrustRegion":
        """Twice as wide after 3 improvements in a row, half after 4 vain
        candidates; below 1/256 the search starts again wide."""
        successes, failures = (self.successes + 1, 0) if better else (0, self.failures + 1)
        if successes == 3:
            return _TrustRegion(min(2 * self.side, 1.6))
        if failures == 4:
            return _TrustRegion(self.side / 2 if self.side > 2**-8 else 0.8)
        return _TrustRegion(self.side, successes, failures)


class _Search(NamedTuple):
    """Where and how is searched: in the unit cube of log-weights by expected improvement, or among the
    weights themselves as published."""

    lower: np.ndarray
    upper: np.ndarray
    acquisition: Acquisition
    exploration: float

    @property
    def local(self) -> bool:
        return self.acquisition == "expected_improvement"

    @property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        return (
            (np.zeros_like(self.lower), np.ones_like(self.upper)) if self.local else (self.lower, self.upper)
        )

    def points(self, theta: np.ndarray) -> np.ndarray:
        return np.log(theta / self.lower) / np.log(self.upper / self.lower) if self.local else theta

    def theta(self, point: np.ndarray) -> np.ndarray:
        return np.clip(
            self.lower * (self.upper / self.lower) ** point if self.local else point, self.lower, self.upper
        )

    def kernel(self):
        """Where its fit starts; as published (39), exp(-|theta - theta'|^2), and it
        stays so (noise: for the Cholesky factor only)."""
        d = len(self.lower)
        if self.local:
            return _kernel(np.full(d, np.sqrt(d)), nu=2.5, noise=1e-6, variance=10.0)
        return _kernel(np.full(d, np.sqrt(0.5)), nu=np.inf, noise=1e-8)


def _design(search: _Search, rng: np.random.Generator, count: int) -> np.ndarray:
    """The first points (count, d): a scrambled Sobol sequence."""
    from scipy.stats import qmc  # here: the import takes seconds

    low, high = search.box
    return (
        low
        + (high - low)
        * qmc.Sobol(len(low), scramble=True, rng=rng).random_base2(int(np.ceil(np.log2(count))))[:count]
    )


def _terms(search: _Search, points: np.ndarray, costs: np.ndarray, kernel) -> list[Term]:
    """What the next candidate should be good at: the acquisition of the costs
    seen so far, and to work, where some have failed."""
    worked, terms = np.isfinite(costs), []
    if worked.any():
        values = _standardised(costs[worked])
        rule = partial(_expected_improvement, best=values.min())
        if not search.local:
            rule = partial(_upper_confidence_bound, exploration=search.exploration)
        terms.append((_surrogate(points[worked], values, kernel), rule))
    if not worked.all():
        length = np.clip(
            kernel.k1.k2.length_scale / 2, 0.05 * np.sqrt(points.shape[1]), np.sqrt(points.shape[1])
        )
        terms.append(
            (_surrogate(points, np.where(worked, 0.0, -2.0), _kernel(length, nu=2.5, noise=1e-2)), _success)
        )
    return terms


def _standardised(costs: np.ndarray) -> np.ndarray:
    return (costs - costs.mean()) / (costs.std() or 1.0)


def _next(
    search: _Search,
    points: np.ndarray,
    costs: np.ndarray,
    kernel,
    region: _TrustRegion,
    rng: np.random.Generator,
) -> np.ndarray:
    """The next point (d,): in the trust region, longer where the cost changes
    slowly; as published, or while nothing worked, anywhere.

    512 points screen the box, half of them ten times nearer to its centre;
    about 20 coordinates of each differ from the centre's.
    """
    low, high = search.box
    centre = low + (high - low) * rng.random(len(low))
    if np.isfinite(costs).any():
        centre = points[np.nanargmin(costs)]
        if search.local:
            length = kernel.k1.k2.length_scale
            half = region.side / 2 * np.clip(length / np.exp(np.log(length).mean()), 0.25, 4.0)
            low, high = np.maximum(centre - half, low), np.minimum(centre + half, high)
    candidates = low + (high - low) * rng.random((512, len(low)))
    candidates[256:] = centre + 0.1 * (candidates[256:] - centre)
    candidates = np.where(rng.random(candidates.shape) < 20 / len(low), candidates, centre)
    return _least(_terms(search, points, costs, kernel), candidates, low, high)


def _evaluated(cost: Callable[[np.ndarray], float], theta: np.ndarray) -> tuple[float, str]:
    """The cost, or NaN and the reason why there is none."""
    try:
        value = float(cost(theta.copy()))
    except ValueError as failure:
        return np.nan, str(failure) or "the candidate was refused without a reason"
    return (value, "") if np.isfinite(value) else (np.nan, f"the cost is {value}, expected a finite number")


def _extended(history: History, theta: np.ndarray, value: float, reason: str) -> History:
    costs = np.append(history.cost, value)
    return History(
        np.vstack([history.theta, theta]), costs, (*history.failed, reason), np.fmin.accumulate(costs)
    )


def _recommended(search: _Search, history: History, kernel) -> SearchResult:
    """The candidate of least cost; as published the one of least posterior mean (43).

    (43) is taken over the candidates: over the whole box the mean is least where no data hold it up
    (BAAM: F = 155,000-208,000 there, 153,000-154,000 so).
    """
    worked = np.flatnonzero(np.isfinite(history.cost))
    if not worked.size:
        last = history.failed[-1]
        raise ValueError(
            f"minimise: all {len(history.cost)} candidates failed, the last because: {last}; "
            "widen the bounds or correct the cost"
        )
    merit = history.cost[worked]
    if not search.local:
        points = search.points(history.theta[worked])
        merit = _posterior(_surrogate(points, _standardised(merit), kernel), points)[0]
    best = worked[np.argmin(merit)]
    return SearchResult(history.theta[best], float(history.cost[best]), history)


def _checked(
    lower, upper, settings: SearchSettings, start: History | None
) -> tuple[np.ndarray, np.ndarray, History]:
    initial, evaluations, acquisition, _ = settings
    lower, upper = np.asarray(lower, float), np.asarray(upper, float)
    if (
        lower.ndim != 1
        or lower.shape != upper.shape
        or not lower.size
        or not ((lower > 0) & (lower < upper) & np.isfinite(upper)).all()
    ):
        raise ValueError(
            "minimise: expected bounds 0 < lower < upper of one length, "
            f"found lower {lower} and upper {upper}; correct them"
        )
    if not 1 <= initial <= evaluations:
        raise ValueError(
            f"minimise: expected 1 <= initial <= evaluations, found {initial} of {evaluations}; "
            "change one of them"
        )
    if acquisition not in get_args(Acquisition):
        raise ValueError(
            f"minimise: acquisition {acquisition!r} is unknown, expected {' or '.join(get_args(Acquisition))}"
        )
    start = History(np.empty((0, len(lower))), np.empty(0), (), np.empty(0)) if start is None else start
    count = len(start.cost)
    sound = start.theta.shape == (count, len(lower)) and len(start.failed) == count <= evaluations
    if not sound or not ((start.theta >= lower) & (start.theta <= upper)).all():
        raise ValueError(
            f"minimise: the history to go on from has theta {start.theta.shape}, "
            f"{count} costs and {len(start.failed)} reasons, "
            f"expected at most {evaluations} candidates of {len(lower)} weights within the bounds; start anew"
        )
    return lower, upper, start


def minimise(
    cost: Callable[[np.ndarray], float],
    lower: np.ndarray,
    upper: np.ndarray,
    settings: SearchSettings,
    *,
    rng: np.random.Generator,
    on_step: Callable[[History], None] | None = None,
    start: History | None = None,
) -> SearchResult:
    """The weights of least cost among the candidates evaluated between lower (d,) and upper (d,).

    `cost(theta)` takes weights (d,); a ValueError from it, or a number that is not finite, is a failure of
    the candidate. `on_step(history)` is called after every evaluation. With that history as `start` and a
    generator of the same seed, a run that was stopped goes on as if it had not been. The model costs O(k^3)
    after k candidates: meant for hundreds. Raises ValueError where every candidate failed.
    """
    lower, upper, start = _checked(lower, upper, settings, start)
    initial, evaluations, acquisition, exploration = settings
    search = _Search(lower, upper, acquisition, exploration)
    # a generator for each candidate: what is drawn does not depend on where a run was stopped
    first, *later = rng.spawn(1 + evaluations)
    design, kernel, region, fitted = _design(search, first, initial), search.kernel(), _TrustRegion(), False
    history = History(start.theta[:0], start.cost[:0], (), start.cost[:0])
    for index in range(evaluations):
        points, worked = search.points(history.theta), np.isfinite(history.cost)
        if search.local and index >= initial and worked.any() and (not fitted or (index - initial) % 5 == 0):
            kernel, fitted = (
                _likeliest(kernel, points[worked], _standardised(history.cost[worked]), 5 if fitted else 30),
                True,
            )
        if index < len(start.cost):
            theta, value, reason = start.theta[index], float(start.cost[index]), start.failed[index]
        else:
            theta = search.theta(
                design[index]
                if index < initial
                else _next(search, points, history.cost, kernel, region, later[index])
            )
            value, reason = _evaluated(cost, theta)
        if index >= initial:
            region = region.after(bool(value < np.fmin.reduce(history.cost, initial=np.inf)))
        history = _extended(history, theta, value, reason)
        if on_step is not None and index >= len(start.cost):
            on_step(history)
    return _recommended(search, history, kernel)


def polished(
    cost: Callable[[np.ndarray], float],
    found: SearchResult,
    lower: np.ndarray,
    upper: np.ndarray,
    *,
    evaluations: int,
    side: float = 1 / 8,
) -> SearchResult:
    """The best of `found` after a pattern search of so many `evaluations` more (Hooke and Jeeves 1961): one
    log-weight after the other a step up and down, the step first `side` of its range and halved where none of
    them is better.

    It needs neither a slope nor a model of the cost, which knows least at a wall beyond which candidates
    fail, where an optimum often lies.
    """
    span, history, best = np.log(upper / lower), found.history, found.cost
    point = np.log(found.theta / lower) / span
    ways = [sign * way for way in np.eye(len(lower)) for sign in (1.0, -1.0)]
    last, left = len(history.cost) + evaluations, list(ways)
    while len(history.cost) < last:
        if not left:
            side, left = side / 2, list(ways)
        way = left.pop(0)
        there = np.clip(point + side * way, 0.0, 1.0)
        theta = np.clip(lower * (upper / lower) ** there, lower, upper)
        value, reason = _evaluated(cost, theta)
        history = _extended(history, theta, value, reason)
        if value < best:
            point, best = there, value
            left = [way, *(other for other in ways if other is not way)]
    theta = history.theta[np.nanargmin(history.cost)]
    return SearchResult(theta, best, history)
