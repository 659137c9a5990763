"""Which order, dead time and fit: every candidate is identified without one block of the record and simulated on it (cross-validation), and the simplest good one wins."""

from typing import Literal, NamedTuple

import numpy as np

from pipeline.temperature.plant import Plant
from pipeline.temperature.plant import plant as make_plant
from pipeline.temperature.refinement import drives, estimate_state, fit_inputs, refine, respond, simulation_form
from pipeline.temperature.subspace import Segments, lagged, realise, subspace

Fit = Literal["subspace", "prediction", "simulation"]
WORTH_A_STATE = 0.02  # a state that takes less than this share off the error is not worth carrying in a controller
LARGEST_RADIUS = 1.0 - 1e-6  # refined plants are kept stable: no record shows a time constant of a million samples


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
            error = np.where(seen, b - respond(model, v, estimate_state(model, v, b, free_mean=True))[1], np.nan)
            share = np.nanstd(error, axis=0) / np.maximum(np.nanstd(b, axis=0), np.finfo(float).tiny)
        shares.append(np.where(np.isfinite(share), np.minimum(share, 1.0), 1.0))
    return np.array(shares)


def folds(u: Segments, y: Segments, count: int) -> list[tuple[list, list, list, list]]:
    """(u, y, u left out, y left out) with one of `count` blocks of each segment left out in turn; what remains on either side are segments of their own.

    Segments too short to be cut into blocks of 10 samples are left out whole, every count-th of them in turn.
    """
    out = []
    for k in range(count):
        fold = ([], [], [], [])
        for s, (a, b) in enumerate(zip(u, y, strict=True)):
            start, stop = len(a) * k // count, len(a) * (k + 1) // count
            if len(a) < 10 * count:
                start, stop = (0, len(a)) if s % count == k else (0, 0)
            for part, at in ((slice(0, start), 0), (slice(stop, len(a)), 0), (slice(start, stop), 2)):
                if part.stop > part.start:
                    fold[at].append(a[part])
                    fold[at + 1].append(b[part])
        if fold[2] and any(np.isfinite(b).any() for b in fold[3]):
            out.append(fold)
    return out


def fit(kind: Fit, start: Plant, u: Segments, y: Segments, *, feedthrough: bool, offset: bool, max_iterations: int) -> Plant:
    """The plant that the named fit makes of the subspace start: the start itself, refined on one-step errors, or refined on simulation errors."""
    if kind == "subspace":
        return start
    start = stabilised(start, LARGEST_RADIUS)
    if kind == "simulation":
        linear = fit_inputs(start.A, start.C, u, y, feedthrough=feedthrough, offset=offset)
        m = start.m
        start = make_plant(linear.F, linear.G[:, :m], linear.C, linear.H[:, :m], linear.G[:, m], linear.H[:, m], None, start.sample_time_s)
    settings = {"feedthrough": feedthrough, "offset": offset, "max_radius": LARGEST_RADIUS, "max_iterations": max_iterations}
    return refine(start, u, y, criterion=kind, **settings).plant


def cross_validate(u, y, orders, delays, kinds: tuple[Fit, ...], *, past, feedthrough, offset, blocks, singular_values) -> list[Candidate]:
    """The order table's rows for one choice of delays: each order and fit, identified without a block and simulated on it, for each of `blocks` blocks."""
    u, y = shifted(u, y, delays)
    errors = {}
    for train_u, train_y, test_u, test_y in folds(u, y, blocks):
        data = lagged(train_u, train_y, past, feedthrough=feedthrough, offset=offset)
        basis = subspace(data, past).basis
        for order in orders:
            start = realise(data, basis[:order], 1.0)
            for kind in kinds:
                plant = fit(kind, start, train_u, train_y, feedthrough=feedthrough, offset=offset, max_iterations=10)
                errors.setdefault((order, kind), []).append(float(simulation_errors(plant, test_u, test_y).mean()))
    m, p = u[0].shape[1], y[0].shape[1]
    rest = p * m * feedthrough + p * offset + sum(map(bool, delays))
    return [
        Candidate(order, delays, kind, order * (m + p) + rest, float(singular_values[order - 1]), tuple(e))
        for (order, kind), e in errors.items()
    ]


def simplest(table: list[Candidate]) -> Candidate:
    """The row with the fewest parameters whose error is within one standard error, of the differences block by block, or 2 %, of the best row's."""
    best = min(table, key=lambda row: row.error)
    chosen = best
    for row in table:
        difference = np.subtract(row.errors, best.errors)
        if difference.mean() <= max(difference.std(ddof=1) / np.sqrt(len(difference)), WORTH_A_STATE * best.error):
            chosen = min(chosen, row, key=lambda row: (row.parameters, row.error))
    return chosen
