"""From a record to a plant: window, dead time, feed-through, order and refinement chosen on the identification data by stated rules, then one fit on all of it.

The rules, each with its reason:
  window        Akaike's criterion (corrected for few samples) over the lags of a VARX model: long enough to whiten, not longer than the record supports
  feed-through  Schwarz's criterion with and without u(t), where `feedthrough` is None
  largest order singular values, in units of the noise, above what coefficient errors alone reach: sqrt(2) (sqrt(rows) + sqrt(columns)) of the noise matrix
  dead time     lags at which the largest model's impulse response stays under 5 % of its peak, kept only where the cross-validation below prefers it
  order         the fewest parameters whose error in simulation of left-out blocks is within one standard error (of the paired differences) of the best
"""

from typing import NamedTuple

import numpy as np

from pipeline.temperature.plant import Plant, markov_parameters
from pipeline.temperature.plant import plant as make_plant
from pipeline.temperature.refinement import drives, estimate_state, fit_inputs, refine, respond, simulation_form
from pipeline.temperature.subspace import Lagged, Segments, Varx, lagged, moesp, moesp_singular_values, one_step, realise, subspace, varx

__all__ = ["Candidate", "Identified", "Varx", "moesp", "moesp_singular_values", "varx"]


class Candidate(NamedTuple):
    """One row of the order table: the model's class, and its error on left-out blocks (share of each output's variation about the block mean, 1 = no better)."""

    order: int
    delays: tuple[int, ...]
    fit: str
    parameters: int
    singular_value: float
    errors: tuple[float, ...]

    @property
    def error(self) -> float:
        return float(np.mean(self.errors))


class Identified(NamedTuple):
    """An identified plant and how it was chosen. order: states without those of the delays; past: window; order_table: candidates with their errors."""

    plant: Plant
    order: int
    past: int
    delays: tuple[int, ...]
    feedthrough: bool
    fit: str
    singular_values: np.ndarray
    noise_edge: float
    order_table: list[Candidate]
    x0: list[np.ndarray]
    rows: int
    dropped_rows: int
    notes: list[str]


def check_inputs(u: Segments, *, offset: bool = True) -> None:
    """Raises ValueError where an input is constant or a linear combination of the others: its column of B is then not identified."""
    rows = np.vstack(u)
    rows = rows[np.isfinite(rows).all(axis=1)]
    rows = rows - rows.mean(axis=0) if offset else rows
    size = np.sqrt(np.mean(rows**2, axis=0))
    for j in range(rows.shape[1]):
        if size[j] <= 1e-9 * max(np.abs(np.vstack(u)[:, j]).max(initial=0.0), 1e-300):
            raise ValueError(f"input u{j + 1} is constant, so its column of B is not identified; excite it, or leave it out of the inputs")
    scaled = rows / size
    for j in range(1, rows.shape[1]):
        weights = np.linalg.lstsq(scaled[:, :j], scaled[:, j], rcond=None)[0]
        if np.linalg.norm(scaled[:, j] - scaled[:, :j] @ weights) < 1e-6 * np.linalg.norm(scaled[:, j]):
            others = ", ".join(f"u{k + 1}" for k in range(j) if abs(weights[k]) > 1e-6)
            raise ValueError(f"input u{j + 1} is a linear combination of {others}, so its column of B is not identified; move it independently, or leave it out")


def choose_past(data: Lagged) -> tuple[int, bool]:
    """Window with the least corrected Akaike criterion, and whether it predicts exactly (errors at rounding), in which case the shortest such window is taken."""
    p, y = data.p, data.R[:, data.now_y]
    whole = np.sum(y**2)
    best = (np.inf, 1)
    for past in range(1, data.past + 1):
        coefficients, errors = one_step(data, past)
        if np.sum(errors**2) < 1e-10 * whole:
            return past, True
        count, numbers = p * len(coefficients) + p * (p + 1) / 2, data.rows * p
        if numbers > count + 1:
            criterion = data.rows * np.linalg.slogdet(errors.T @ errors / data.rows)[1] + 2 * count * numbers / (numbers - count - 1)
            best = min(best, (criterion, past))
    return best[1], False


def choose_feedthrough(u: Segments, y: Segments, past: int, offset: bool) -> bool:
    """Whether Schwarz's criterion of the one-step predictor falls when u(t) is added to it."""
    criterion = []
    for feedthrough in (False, True):
        data = lagged(u, y, past, feedthrough=feedthrough, offset=offset)
        coefficients, errors = one_step(data, past)
        criterion.append(data.rows * np.linalg.slogdet(errors.T @ errors / data.rows)[1] + np.log(data.rows) * coefficients.size)
    return bool(criterion[1] < criterion[0])


def dead_time(plant: Plant, longest: int) -> tuple[int, ...]:
    """Samples, for each input, beyond the one that every strictly proper plant has, before any output answers with 5 % of its peak impulse response."""
    h = np.abs(markov_parameters(plant, 10 * longest))
    started = (h >= 0.05 * h.max(axis=0)).any(axis=1)
    return tuple(min(int(np.argmax(started[:, j])), longest) for j in range(plant.m))


def shifted(u: Segments, y: Segments, delays: tuple[int, ...]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """u_j(t - delay_j) beside y(t), the first max(delays) samples of each segment left out."""
    most = max(delays)
    return [np.column_stack([a[most - d : len(a) - d, j] for j, d in enumerate(delays)]) for a in u], [b[most:] for b in y]


def with_delays(plant: Plant, delays: tuple[int, ...]) -> Plant:
    """The plant behind a chain of delays: u_j(t-1) ... u_j(t-delay_j) become states, and B_j acts through the last of them."""
    if not any(delays):
        return plant
    n, size = plant.n, plant.n + sum(delays)
    A, B, C, D = np.zeros((size, size)), np.zeros((size, plant.m)), np.zeros((plant.p, size)), np.zeros_like(plant.D)
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
    return make_plant(A, B, C, D, np.r_[plant.b, rest], plant.d, np.vstack([plant.K, np.zeros((size - n, plant.p))]), plant.sample_time_s)


def stabilised(plant: Plant, radius: float) -> Plant:
    """The plant with every pole beyond `radius` drawn back onto it along its ray, in the modal basis."""
    eigenvalues, T = np.linalg.eig(plant.A)
    size = np.abs(eigenvalues)
    if size.max() <= radius:
        return plant
    drawn = eigenvalues * np.where(size > radius, radius * (1 - 1e-9) / np.maximum(size, 1e-300), 1.0)
    return plant._replace(A=np.real((T * drawn) @ np.linalg.inv(T)))


def simulation_errors(plant: Plant, u: Segments, y: Segments) -> np.ndarray:
    """For each segment and output, the size of the simulation error about its mean as a share of the output's variation, at most 1; shape (segments, p).

    The initial state is fitted to the segment. The mean is left to the ambient, which no order can foretell.
    """
    model, shares = simulation_form(plant, []), []
    for a, b in zip(u, y, strict=True):
        v = drives("simulation", a, b)
        with np.errstate(over="ignore", invalid="ignore"):  # an unstable candidate may overflow; it then counts as no better than the mean
            seen = np.isfinite(b)
            error = np.where(seen, b - respond(model, v, estimate_state(model, v, b))[1], np.nan)
            share = np.nanstd(error, axis=0) / np.maximum(np.nanstd(b, axis=0), np.finfo(float).tiny)
        shares.append(np.where(np.isfinite(share), np.minimum(share, 1.0), 1.0))
    return np.array(shares)


def folds(u: Segments, y: Segments, count: int) -> list[tuple[list, list, list, list]]:
    """(u, y, u left out, y left out) with one of `count` blocks of each segment left out in turn; what remains on either side are segments of their own."""
    out = []
    for k in range(count):
        fold = ([], [], [], [])
        for a, b in zip(u, y, strict=True):
            start, stop = len(a) * k // count, len(a) * (k + 1) // count
            for part in (slice(0, start), slice(stop, len(a))):
                if part.stop > part.start:
                    fold[0].append(a[part])
                    fold[1].append(b[part])
            fold[2].append(a[start:stop])
            fold[3].append(b[start:stop])
        out.append(fold)
    return out


def _fit(kind: str, start: Plant, u: Segments, y: Segments, feedthrough: bool, offset: bool, iterations: int) -> Plant:
    """The plant that the named fit makes of the subspace start: the start itself, refined on one-step errors, or refined on simulation errors."""
    if kind == "subspace":
        return start
    start = stabilised(start, 1.0)
    if kind in ("inputs", "simulation"):
        linear = fit_inputs(start.A, start.C, u, y, feedthrough=feedthrough, offset=offset)
        m = start.m
        start = make_plant(linear.F, linear.G[:, :m], linear.C, linear.H[:, :m], linear.G[:, m], linear.H[:, m], None, start.sample_time_s)
    if kind == "inputs":
        return start
    try:
        return refine(start, u, y, criterion=kind, feedthrough=feedthrough, offset=offset, max_radius=1.0 + 1e-9, max_iterations=iterations).plant
    except np.linalg.LinAlgError:
        return start


def _table(u, y, *, past, future, orders, delays, kinds, feedthrough, offset, count, singular_values) -> list[Candidate]:
    """Cross-validated errors of every order and fit for one choice of delays."""
    u, y = shifted(u, y, delays)
    errors = {}
    for train_u, train_y, test_u, test_y in folds(u, y, count):
        data = lagged(train_u, train_y, past, feedthrough=feedthrough, offset=offset)
        basis = subspace(data, future).basis
        for order in orders:
            start = realise(data, basis[:order], 1.0)
            for kind in kinds:
                plant = _fit(kind, start, train_u, train_y, feedthrough, offset, 10)
                errors.setdefault((order, kind), []).append(simulation_errors(plant, test_u, test_y).mean())
    m, p = u[0].shape[1], y[0].shape[1]
    size = lambda order: order * (m + p) + p * m * feedthrough + p + sum(delays)
    return [Candidate(order, delays, kind, size(order), float(singular_values[order - 1]), tuple(e)) for (order, kind), e in errors.items()]


def choose(table: list[Candidate]) -> Candidate:
    best = min(table, key=lambda row: row.error)
    def within(row):
        difference = np.array(row.errors) - np.array(best.errors)
        return difference.mean() <= difference.std(ddof=1) / np.sqrt(len(difference))
    return min((row for row in table if within(row)), key=lambda row: (row.parameters, row.error))
