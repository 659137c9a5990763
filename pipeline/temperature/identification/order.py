"""Chooses window, feed-through, dead time, order and fit. Criteria propose candidates. Every candidate is
identified without one block of the record and simulated on it (cross-validation). The simplest good one is
chosen."""

from typing import Literal, NamedTuple

import numpy as np
import scipy.linalg
import scipy.stats

from pipeline.temperature.identification.refinement import (
    Criterion,
    FitSettings,
    drives,
    fit_inputs,
    fitted_state,
    free_response,
    kalman_gain,
    one_step_errors,
    refine,
    respond,
    simulation_form,
)
from pipeline.temperature.identification.subspace import (
    Lagged,
    Segments,
    complete_runs,
    lagged,
    one_step,
    realise,
    subspace,
)
from pipeline.temperature.plant import Plant, clip_spectral_radius, markov_parameters
from pipeline.temperature.plant import plant as make_plant

Fit = Literal["subspace", "prediction", "simulation"]
NOISE_FREE = 1e-10  # share of the outputs' power: a record with smaller one-step errors is noise-free
WIDEST = 360  # columns of the lagged record: the cost of a fit grows with their square
# a refined fit must lower the error by this share, to be worth its computing time and its fit to noise
WORTH_REFINING = 0.05
CHANCE = 0.1  # probability that blocks show a gain although there is none
# a simulation fit must be better than a prediction fit by this share of the error, because it has no model of
# the noise, which a tracker needs
WORTH_THE_NOISE = 0.2
# a state that lowers the error by less than this share is not worth carrying in a controller
WORTH_A_STATE = 0.02
# a refined fit costs about samples x (states (states + inputs))^2 an iteration: as many candidates are
# refined as this allows, but at least the best one
WORK = 3e8
# Gauss-Newton steps for a candidate without one block: from a consistent start the first few gain nearly all
VALIDATED_STEPS = 4
SMALLEST = 1e-9  # share of an output's variation below which an error is rounding
# pole radius of plants of a spread, which run for any time: no record shows a time constant of 10^6 samples
LARGEST_RADIUS = 1.0 - 1e-6


class ModelStructure(NamedTuple):
    """What is fixed before the order: window (samples), which outputs have direct feed-through (p,), offset,
    and the dead time of each input (samples)."""

    past: int
    feedthrough: tuple[bool, ...]
    offset: bool
    delays: tuple[int, ...]


class Validation(NamedTuple):
    """How candidates are judged. `blocks` are left out in turn, or whole recordings if `recordings` labels
    the segments with more than one. They are judged on simulated outputs, and for a record in `closed` loop
    also on predicted ones."""

    blocks: int = 5
    recordings: tuple[int, ...] = ()
    closed: bool = False


class OrderCandidate(NamedTuple):
    """One row of the order table: the model's class and its error on each left-out block, as a share of each
    output's variation about the block mean (1 = no better than the mean). about_mean: the same error with its
    mean removed."""

    order: int
    structure: ModelStructure
    fit: str
    parameters: int
    singular_value: float
    errors: tuple[float, ...]
    about_mean: tuple[float, ...] = ()

    @property
    def error(self) -> float:
        """Geometric mean over the blocks, so that a block that a disturbance spoils for every candidate
        weighs no more than the others."""
        return float(np.exp(np.mean(np.log(self.errors))))


def longest_window(u: Segments, y: Segments) -> int:
    """Returns the most lags that leave four complete windows for each unknown of a VARX model, within WIDEST
    columns; 1 if the record is shorter than that."""
    q, lengths = u[0].shape[1] + y[0].shape[1], np.array([len(w) for w in complete_runs(u, y)])
    supported = [
        past for past in range(2, WIDEST // q + 1) if np.maximum(lengths - past, 0).sum() >= 4 * q * past
    ]
    return max(supported, default=1)


def windows(data: Lagged) -> tuple[tuple[int, ...], bool]:
    """Returns the windows worth trying: twice the lags with the smallest corrected Akaike criterion (Bauer
    2005: a subspace method's window must outgrow it), and Schwarz's lags.

    If a window predicts to rounding, the record is noise-free: returns the shortest such window and True. The
    one factor holds the errors of every lag.
    """
    p, whole, akaike, schwarz = data.p, np.sum(data.R[:, data.now_y] ** 2), (np.inf, 1), (np.inf, 1)
    for past in range(1, data.past + 1):
        k = past * (data.m + p)
        errors = data.R[k:, data.now_y]
        if np.sum(errors**2) < NOISE_FREE * whole:
            return (past,), True
        count, numbers = p * k + p * (p + 1) / 2, data.rows * p
        S = errors.T @ errors / data.rows
        # a noise-free direction counts as rounding
        S = S + np.eye(p) * (1e-15 * np.trace(S) + np.finfo(float).tiny)
        misfit = data.rows * float(np.linalg.slogdet(S)[1])
        schwarz = min(schwarz, (misfit + count * np.log(data.rows), past))
        if numbers > count + 1:
            akaike = min(akaike, (misfit + 2 * count * numbers / (numbers - count - 1), past))
    return tuple(
        sorted({max(schwarz[1], min(2, data.past)), min(2 * akaike[1], data.past)}, reverse=True)
    ), False


def feedthrough_shows(u: Segments, y: Segments, past: int, offset: bool) -> tuple[bool, ...]:
    """Returns for each output (p,) whether Schwarz's criterion of its one-step predictor falls when u(t) is
    added to it. It also falls if a controller responds to y(t) at once, so the blocks decide."""
    q, rows = u[0].shape[1] + y[0].shape[1], sum(max(len(w) - past, 0) for w in complete_runs(u, y))
    if rows < (past + 2) * q + 1:  # u(t) adds a block of unknowns to those of the window
        return (False,) * y[0].shape[1]
    power = []
    for feedthrough in (False, True):
        data = lagged(u, y, past, feedthrough=feedthrough, offset=offset)
        power.append(np.sum(one_step(data, past)[1] ** 2, axis=0))
    gain = data.rows * np.log(np.maximum(power[0], 1e-300) / np.maximum(power[1], 1e-300))
    return tuple((gain > np.log(data.rows) * data.m).tolist())


def dead_time(plant: Plant, longest: int, share: float = 0.05) -> tuple[int, ...]:
    """Returns for each input the samples before any output reaches `share` of its peak impulse response,
    beyond the one sample that every strictly proper plant has; at most `longest`."""
    h = np.abs(markov_parameters(plant, 10 * longest))
    started = (h >= share * h.max(axis=0)).any(axis=1)
    return tuple(min(int(np.argmax(started[:, j])), longest) for j in range(plant.m))


def tested_dead_times(data: Lagged, longest: int) -> tuple[tuple[int, ...], tuple[bool, ...]]:
    """Returns for each input the lags 1..k that together do not differ from zero in the one-step predictor,
    and whether none of its lags does (Wald's test at 99.9 %).

    A delay at an input is a delay in its predictor too: B_1 ... B_delay of the VARX model are zero, in closed
    loop as well.
    """
    m, p, first = data.m, data.p, data.m if data.feedthrough else 0
    coefficients, errors = one_step(data, data.past)
    k = len(coefficients)
    S = errors.T @ errors / max(data.rows - k, 1)
    G = scipy.linalg.solve_triangular(
        data.R[:k, :k] + 1e-12 * np.diag(np.abs(np.diag(data.R))[:k]), np.eye(k)
    )
    whiten = np.linalg.pinv(np.linalg.cholesky(S + np.eye(p) * (1e-12 * np.trace(S) + np.finfo(float).tiny)))
    late, silent = [], []
    for j in range(m):
        at = first + j + (m + p) * np.arange(data.past)
        size = np.maximum(np.linalg.norm(G[at], axis=1, keepdims=True), np.finfo(float).tiny)
        theta, rows = coefficients[at] @ whiten.T / size, G[at] / size

        def silent_up_to(lag, theta=theta, rows=rows):
            covariance = rows[:lag] @ rows[:lag].T
            if not np.isfinite(theta[:lag]).all() or not np.isfinite(covariance).all():
                return False
            statistic = np.sum(theta[:lag] * np.linalg.lstsq(covariance, theta[:lag], rcond=1e-12)[0])
            return statistic <= scipy.stats.chi2.ppf(0.999, lag * p)

        late.append(next((lag for lag in range(longest) if not silent_up_to(lag + 1)), longest))
        silent.append(bool(late[-1] == longest and silent_up_to(data.past)))
    return tuple(late), tuple(silent)


def noise_edge(data: Lagged, past: int) -> float:
    """Returns sqrt(2) (sqrt(past p) + sqrt(past (m+p))). Singular values above it are larger than those from
    coefficient errors alone.

    A matrix of independent unit noise of that shape stays below the bracket. Here each error appears in up to
    `past` rows, which adds about a tenth (measured).
    """
    return float(np.sqrt(2) * (np.sqrt(past * data.p) + np.sqrt(past * (data.m + data.p))))


def shifted(u: Segments, y: Segments, delays: tuple[int, ...]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Returns u_j(t - delay_j) beside y(t), without the first max(delays) samples of each segment."""
    most = max(delays)
    return [np.column_stack([a[most - d : len(a) - d, j] for j, d in enumerate(delays)]) for a in u], [
        b[most:] for b in y
    ]


def with_delays(plant: Plant, delays: tuple[int, ...]) -> Plant:
    """Returns the plant behind a chain of delays: u_j(t-1) ... u_j(t-delay_j) become states, and B_j acts
    through the last of them."""
    if not any(delays):
        return plant
    n, size = plant.n, plant.n + sum(delays)
    A, B, C, D = (
        np.zeros((size, size)),
        np.zeros((size, plant.m)),
        np.zeros((plant.p, size)),
        np.zeros_like(plant.D),
    )
    A[:n, :n], C[:, :n], at = plant.A, plant.C, n
    for j, delay in enumerate(delays):
        if delay == 0:
            B[:n, j], D[:, j] = plant.B[:, j], plant.D[:, j]
            continue
        B[at, j] = 1.0
        A[at + 1 : at + delay, at : at + delay - 1] = np.eye(delay - 1)
        A[:n, at + delay - 1], C[:, at + delay - 1] = plant.B[:, j], plant.D[:, j]
        at += delay
    rest = np.zeros(size - n)
    return make_plant(
        A,
        B,
        C,
        D,
        np.r_[plant.b, rest],
        plant.d,
        np.vstack([plant.K, np.zeros((size - n, plant.p))]),
        plant.sample_time_s,
    )


def stabilised(plant: Plant, radius: float) -> Plant:
    """Returns the plant with every pole beyond `radius` moved onto it along its ray."""
    return plant._replace(A=clip_spectral_radius(plant.A, radius))


def simulation_errors(plant: Plant, u: Segments, y: Segments) -> np.ndarray:
    """Returns for each segment and output the size of the simulation error as a share of the output's
    variation, at most 1: as it is and about its mean, shape (2, segments, p).

    The initial state is fitted to the segment. If the simulation overflows, the plant counts as no better
    than the mean.
    """
    model, shares = simulation_form(plant, []), []
    for a, b in zip(u, y, strict=True):
        with np.errstate(over="ignore", invalid="ignore"):
            error, gamma = (
                b - respond(model, drives("simulation", a, b), np.zeros(plant.n))[1],
                free_response(model, len(b)),
            )
        if (
            not (np.isfinite(error) | np.isnan(b)).all()
            or not np.isfinite(gamma).all()
            or np.abs(gamma).max() > 1e100
        ):
            shares.append(np.ones((2, plant.p)))
            continue
        spread = np.maximum(np.nanstd(b, axis=0), np.finfo(float).tiny)
        whole = np.sqrt(
            np.nanmean((error - gamma @ fitted_state(gamma, error, free_mean=False)) ** 2, axis=0)
        )
        about_mean = np.nanstd(error - gamma @ fitted_state(gamma, error, free_mean=True)[: plant.n], axis=0)
        shares.append(np.minimum(np.stack([whole, about_mean]) / spread, 1.0))
    return np.nan_to_num(np.stack(shares, axis=1), nan=1.0)


def folds(
    u: Segments, y: Segments, count: int, recordings: tuple[int, ...] = ()
) -> list[tuple[list, list, list, list]]:
    """Returns (u, y, u left out, y left out) with one of `count` blocks of each segment left out in turn. The
    parts before and after the block are separate segments.

    If there are several segments, those too short for blocks of 10 samples are left out whole, every count-th
    of them in turn. If there are several `recordings` (a label for each segment), one is left out at a time,
    or every count-th if there are more than `count`.
    """
    out, labels = [], sorted(set(recordings))
    if len(labels) > 1:
        for k in range(min(count, len(labels))):
            left_out = [label in labels[k::count] for label in recordings]
            test, train = (
                [[part[s] for s, out_now in enumerate(left_out) if out_now == wanted] for part in (u, y)]
                for wanted in (True, False)
            )
            if train[0] and any(np.isfinite(b).any() for b in test[1]):
                out.append((*train, *test))
        return out
    for k in range(count):
        fold = ([], [], [], [])
        for s, (a, b) in enumerate(zip(u, y, strict=True)):
            start, stop = len(a) * k // count, len(a) * (k + 1) // count
            if len(a) < 10 * count and len(u) > 1:
                start, stop = (0, len(a)) if s % count == k else (0, 0)
            for part, at in ((slice(0, start), 0), (slice(stop, len(a)), 0), (slice(start, stop), 2)):
                if part.stop > part.start:
                    fold[at].append(a[part])
                    fold[at + 1].append(b[part])
        if fold[0] and fold[2] and any(np.isfinite(b).any() for b in fold[3]):
            out.append(fold)
    return out


def prediction_errors(plant: Plant, u: Segments, y: Segments) -> np.ndarray:
    """Returns for each segment and output the size of the one-step error as a share of the output's
    variation, at most 1; shape (segments, p). The initial state is fitted to the segment."""
    spreads = [np.maximum(np.nanstd(b, axis=0), np.finfo(float).tiny) for b in y]
    with np.errstate(over="ignore", invalid="ignore"):
        errors = zip(one_step_errors(plant, u, y), spreads, strict=True)
        shares = [np.minimum(np.sqrt(np.nanmean(e**2, axis=0)) / spread, 1.0) for e, spread in errors]
    return np.nan_to_num(np.array(shares), nan=1.0)


def fit(
    kind: Fit, start: Plant, u: Segments, y: Segments, settings: FitSettings, *, gain: bool = True
) -> Plant:
    """Returns the plant that this kind of fit makes of the subspace start: the start itself, or the start
    refined on one-step errors or on simulation errors.

    Every pole stays within `settings.max_radius` if it is given, and those of a refined plant within
    `LARGEST_RADIUS`: a pole beyond the circle is noise about an integrator. A refined plant is moved back
    onto that radius and refined again within it. A fit that may never cross it stops at it; this cost up to 6
    points on the hold-out of the study's record (measured). With `gain` False a plant refined on simulation
    errors has no K.
    """
    # a mode may grow 20-fold over the longest segment while a plant is refined, no more
    radius = settings.max_radius or float(np.exp(3.0 / max(map(len, u))))
    if kind == "subspace":
        return with_stable_predictor(stabilised(start, radius) if settings.max_radius else start, u, y)
    start = stabilised(start, radius)
    if kind == "simulation":
        linear = fit_inputs(start.A, start.C, u, y, feedthrough=settings.feedthrough, offset=settings.offset)
        m = start.m
        start = make_plant(
            linear.F,
            linear.G[:, :m],
            linear.C,
            linear.H[:, :m],
            linear.G[:, m],
            linear.H[:, m],
            None,
            start.sample_time_s,
        )
    refined = _refined(kind, start, u, y, settings, radius)
    drawn = stabilised(refined, LARGEST_RADIUS)
    # nearly equal poles may not move back exactly; such a plant is kept as it is
    if drawn.A is not refined.A and np.abs(np.linalg.eigvals(drawn.A)).max() <= LARGEST_RADIUS:
        refined = _refined(kind, drawn, u, y, settings, LARGEST_RADIUS)
    return kalman_gain(refined, u, y) if gain and kind == "simulation" else refined


def _refined(
    kind: Criterion, start: Plant, u: Segments, y: Segments, settings: FitSettings, radius: float
) -> Plant:
    """Runs `refine` with every pole within `radius`, from a start whose predictor may not be stable."""
    if kind == "prediction":
        start = with_stable_predictor(start, u, y)
    return refine(start, u, y, kind, settings._replace(max_radius=radius * (1 + 1e-12)))[0]


def with_stable_predictor(plant: Plant, u: Segments, y: Segments) -> Plant:
    """Returns the plant unchanged if A - K C is stable, otherwise with the Kalman gain of the record, because
    the errors of an unstable predictor grow without limit."""
    if np.abs(np.linalg.eigvals(plant.A - plant.K @ plant.C)).max() < 1:
        return plant
    return kalman_gain(plant, u, y)


def cross_validate(
    u,
    y,
    orders,
    structure: ModelStructure,
    kinds: tuple[Fit, ...],
    *,
    singular_values,
    validation: Validation,
) -> list[OrderCandidate]:
    """Returns the order table's rows for one structure. Each order and fit is identified without one block or
    recording and judged on it, for each of them in turn.

    A structure whose window does not fit into the remaining record has no rows.
    """
    u, y = shifted(u, y, structure.delays)
    settings = FitSettings(structure.feedthrough, structure.offset, max_iterations=VALIDATED_STEPS)
    errors = {}
    for train_u, train_y, test_u, test_y in folds(u, y, validation.blocks, validation.recordings):
        try:
            data = lagged(
                train_u,
                train_y,
                structure.past,
                feedthrough=any(structure.feedthrough),
                offset=structure.offset,
            )
        except ValueError:
            return []
        basis = subspace(data, structure.past)[0]
        for order in orders:
            start = realise(data, basis[:order], 1.0, structure.feedthrough)
            for kind in kinds:
                plant = fit(kind, start, train_u, train_y, settings, gain=False)
                shares = simulation_errors(plant, test_u, test_y)
                if validation.closed:
                    # under feedback a simulation is partly right only because u contains the noise of y. A
                    # one-step prediction is not, but slow modes gain little there
                    shares = np.sqrt(shares * prediction_errors(plant, test_u, test_y))
                whole, about_mean = shares.mean(axis=(1, 2))
                errors.setdefault((order, kind), []).append(
                    (max((whole + about_mean) / 2, SMALLEST), max(about_mean, SMALLEST))
                )
    m, p = u[0].shape[1], y[0].shape[1]
    # a dead time counts as much as a state, so it must be worth one
    more = m * sum(structure.feedthrough) + p * structure.offset + (m + p) * sum(map(bool, structure.delays))
    return [
        OrderCandidate(
            order,
            structure,
            kind,
            order * (m + p) + more,
            float(singular_values[order - 1]),
            *(tuple(map(float, part)) for part in zip(*both, strict=True)),
        )
        for (order, kind), both in errors.items()
    ]


def slow_window(plant: Plant, longest: int) -> int:
    """Returns the window that spans the time constant of a plant's slowest decaying mode, at most
    `longest`."""
    radii = np.abs(np.linalg.eigvals(plant.A))
    slowest = max(radii[radii < 1 - 1e-6], default=0.0)
    return int(min(np.ceil(-1.0 / np.log(max(slowest, 1e-3))), longest))


def simplest(table: list[OrderCandidate], worth: float = WORTH_A_STATE) -> OrderCandidate:
    """Returns the row with the fewest parameters whose error is within `worth` of the best row's.

    One standard error is not used as the tolerance. If one of five blocks holds a disturbance, the standard
    error is so wide that far too small models pass. These cost more on new data than models that are somewhat
    too large (measured on the records of tests/foreign/records.py).
    """
    best = min(row.error for row in table)
    return min(
        (row for row in table if row.error <= (1 + worth) * best), key=lambda row: (row.parameters, row.error)
    )


def worth_refining(start: OrderCandidate, refined: OrderCandidate) -> bool:
    """Returns whether a refined fit lowers the error of its start by more than `WORTH_REFINING`, and the
    error about the mean beyond chance too: Student's t of the blocks' paired gains, one-sided at `CHANCE`.

    A gain in level alone comes from the ambient of those days. Blocks inside a record show it, but new data
    do not: fits chosen by it lost 5 and 31 points on the hold-outs of two two-heater kits.
    """
    if refined.error >= (1 - WORTH_REFINING) * start.error:
        return False
    return beyond_chance(np.log(np.array(start.about_mean) / np.array(refined.about_mean)))


def beyond_chance(gains: np.ndarray) -> bool:
    """Returns whether the mean of paired gains (blocks,) is above zero by Student's t, one-sided at `CHANCE`.
    With one block, its sign decides."""
    if len(gains) < 2:
        return bool(gains.mean() > 0)
    uncertain = np.std(gains, ddof=1) / np.sqrt(len(gains))
    return bool(gains.mean() > scipy.stats.t.ppf(1 - CHANCE, len(gains) - 1) * uncertain)
