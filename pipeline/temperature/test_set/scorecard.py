"""Compares control laws on the same scenarios with the same reference. The laws run unclipped and without
integrator, so that the discrete Riccati equation gives the optimum (regret J / J* - 1). All costs use the
same weights and the true outputs. Also computes the margins of a law on a plant; which controller is best;
what separates model-based from data-driven, and which plant decides; and what a record is sufficient for.
Controllers as deployed are simulated in panel.py.

The cases of one plant depend on each other, so plants are the blocks of every test and of every band.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse

from pipeline.statistics import Paired, paired
from pipeline.temperature.controllers import kernel
from pipeline.temperature.controllers import window as window_route
from pipeline.temperature.plant import Plant
from pipeline.temperature.tracking import Law, gains

Run = tuple[np.ndarray, np.ndarray]  # true outputs and inputs (steps, scenarios, p or m)


class Scenarios(NamedTuple):
    """Scenarios, one per row: plant[i] of `plants` (all of one order), held at x0 by u0, reference r, sensor
    noise (hold + steps, s, p) in °C.

    The controller watches the machine for `hold` samples before it takes over, so that its memory holds what
    a machine would have put there. It then runs for `steps` samples.
    """

    plants: list[Plant]
    plant: np.ndarray
    x0: np.ndarray
    u0: np.ndarray
    r: np.ndarray
    steps: int
    hold: int
    noise: np.ndarray | float = 0.0


class CommonCost(NamedTuple):
    """The weights diag(q), diag(r) and the discount gamma of every J in one comparison."""

    q: np.ndarray
    r: np.ndarray
    gamma: float


def simulate(panel: Scenarios, law: Law) -> Run:
    """Runs every scenario at once under one law with its own feed-forward. Inputs are not limited, and xi
    stays zero. Returns true outputs and inputs (steps, s, p or m)."""
    A, B, C, b, d = (
        np.stack([getattr(panel.plants[i], name) for i in panel.plant]) for name in ("A", "B", "C", "b", "d")
    )
    steps, (scenarios, p) = panel.steps, panel.r.shape
    y, u = np.empty((steps, scenarios, p)), np.empty((steps, scenarios, law.K.shape[0]))
    x, noise = panel.x0.copy(), np.broadcast_to(panel.noise, (panel.hold + steps, scenarios, p))
    held = np.einsum("sij,sj->si", C, x) + d
    z = panel.u0 @ law.start_u.T + (held + noise[0]) @ law.start_y.T + law.start
    # the memory of a window is a shift; as a sparse matrix it costs only a copy, not a product
    memory = scipy.sparse.csr_array(law.A.T) if np.count_nonzero(law.A) < 0.05 * law.A.size else law.A.T
    for t in range(panel.hold):
        z = z @ memory + panel.u0 @ law.B_u.T + (held + noise[t]) @ law.B_y.T + panel.r @ law.B_r.T + law.c
    noise = noise[panel.hold :]
    for t in range(steps):
        y[t] = np.einsum("sij,sj->si", C, x) + d
        measured = y[t] + noise[t]
        u[t] = -(z @ law.K.T + measured @ law.D.T + panel.r @ law.K_r.T + law.k)
        z = z @ memory + u[t] @ law.B_u.T + measured @ law.B_y.T + panel.r @ law.B_r.T + law.c
        x = np.einsum("sij,sj->si", A, x) + np.einsum("sij,sj->si", B, u[t]) + b
        if not np.abs(x).max() < 1e9:
            x = np.clip(np.nan_to_num(x), -1e9, 1e9)
            z = np.clip(np.nan_to_num(z), -1e9, 1e9)
    return y, u


def cost(panel: Scenarios, run: Run, yardstick: CommonCost) -> np.ndarray:
    """Returns (3) for every scenario (s,): discounted, on true outputs and applied inputs."""
    y, u = run
    stage = (y - panel.r) ** 2 @ yardstick.q + u**2 @ yardstick.r
    return yardstick.gamma ** np.arange(len(stage)) @ stage


def optimum(panel: Scenarios, yardstick: CommonCost) -> np.ndarray:
    """Returns J* of every scenario (s,): the cost of the Riccati law of its own plant, with known state,
    unclipped."""
    best = [
        gains(plant, np.diag(yardstick.q), np.diag(yardstick.r), yardstick.gamma) for plant in panel.plants
    ]
    plants = [panel.plants[i] for i in panel.plant]
    A, B, C, b, d = (
        np.stack([getattr(plant, name) for plant in plants]) for name in ("A", "B", "C", "b", "d")
    )
    K_x = np.stack([best[i].K_x for i in panel.plant])
    feed = np.stack([best[i].K_r @ r + best[i].k for i, r in zip(panel.plant, panel.r, strict=True)])
    x, y, u = panel.x0.copy(), np.empty((panel.steps, *panel.r.shape)), np.empty((panel.steps, *feed.shape))
    for t in range(panel.steps):
        y[t] = np.einsum("sij,sj->si", C, x) + d
        u[t] = -np.einsum("sij,sj->si", K_x, x) - feed
        x = np.einsum("sij,sj->si", A, x) + np.einsum("sij,sj->si", B, u[t]) + b
    return cost(panel, (y, u), yardstick)


# ---- margins


class Margins(NamedTuple):
    """The margins of a law on one plant. `disk`: the smaller of the disk margins at the plant's inputs and at
    its outputs, with all channels changing independently at the same time (a lower bound, by scaling).
    `delay_s`: extra delay in all sensors at once, in seconds. `stable`: every eigenvalue of the closed loop
    lies inside the unit circle."""

    disk: float
    delay_s: float
    stable: bool


DOUBLINGS = 14  # of the power of A by which `is_stable` shows that a loop decays
AT_ONCE = 16  # plants whose loops are in memory together


def margins(plants: Sequence[Plant], law: Law, *, grid: int = 240) -> list[Margins]:
    """Returns the margins of the law on each plant; both are 0 if the loop is unstable. Disk margin: 1 / max
    |S - I/2| (Seiler, Packard, Gahinet 2020, skew 0). Delay margin: min (pi + arg lambda(L)) / omega over
    |lambda(L)| = 1. `grid`: number of frequencies."""
    # rad a step: logarithmic in the range where loops of heaters cross, then linear up to pi
    slow = np.geomspace(1e-4, 0.3, grid // 2, endpoint=False)
    omega = np.concatenate([slow, np.linspace(0.3, np.pi, grid - grid // 2)])
    z = np.exp(1j * omega)
    K = law_response(law, z)
    return [
        found
        for k in range(0, len(plants), AT_ONCE)
        for found in _margins(plants[k : k + AT_ONCE], law, omega, z, K)
    ]


def _structured(M: np.ndarray, *, sweeps: int = 12) -> np.ndarray:
    """Returns an upper bound of the structured singular value of M (grid, k, k) for independent channels: |D
    M D^-1| with D by Osborne's balancing, never above |M|."""
    k = M.shape[1]
    off, d, squares = np.abs(M) ** 2 * (1 - np.eye(k)), np.ones(M.shape[:2]), np.ones(M.shape[:2])
    for _ in range(sweeps):
        for i in range(k):
            row = (off[:, i] / squares).sum(axis=1)
            column = (off[:, :, i] * squares).sum(axis=1)
            d[:, i] = np.where(
                (row > 0) & (column > 0),
                (np.maximum(column, 1e-300) / np.maximum(row, 1e-300)) ** 0.25,
                d[:, i],
            )
            squares[:, i] = d[:, i] ** 2
    scaled = d[:, :, None] * M / d[:, None, :]
    return np.minimum(np.linalg.norm(scaled, ord=2, axis=(1, 2)), np.linalg.norm(M, ord=2, axis=(1, 2)))


def _margins(
    plants: Sequence[Plant], law: Law, omega: np.ndarray, z: np.ndarray, K: np.ndarray
) -> list[Margins]:
    answers = [is_stable(closed_loop(plant, law)) for plant in plants]
    stable = [plant for plant, answer in zip(plants, answers, strict=True) if answer]
    if not stable:
        return [Margins(0.0, 0.0, False) for _ in plants]
    G = np.stack([_response(plant, z) for plant in stable])
    loops, disks = (G @ K, K @ G), []
    for L in loops:
        identity = np.eye(L.shape[-1])
        balanced = (np.linalg.inv(identity + L) - identity / 2).reshape(-1, *identity.shape)
        disks.append(1 / _structured(balanced).reshape(len(stable), -1).max(axis=1))
    delays = [
        _delay_margin(omega, values) * plant.sample_time_s
        for plant, values in zip(stable, np.linalg.eigvals(loops[0]), strict=True)
    ]
    found = zip(np.min(disks, axis=0), delays, strict=True)
    return [
        Margins(*map(float, next(found)), True) if answer else Margins(0.0, 0.0, False) for answer in answers
    ]


def is_stable(A: np.ndarray) -> bool:
    """Returns whether every eigenvalue of A (n, n) lies inside the unit circle. A power of A with norm below
    1 proves it, at a quarter of the cost of the eigenvalues of a long memory. If no such power is found, the
    eigenvalues decide."""
    power = A
    for _ in range(DOUBLINGS):
        norm = np.abs(power).sum(axis=1).max(initial=0.0)
        if norm < 1 or norm > 1e100:
            break
        power = power @ power
    return bool(norm < 1 or np.abs(np.linalg.eigvals(A)).max() < 1)


def _response(plant: Plant, z: np.ndarray) -> np.ndarray:
    """Returns the frequency response (grid, p, m) of a plant whose feed-through is a delay."""
    B = np.broadcast_to(plant.B, (len(z), plant.n, plant.m))
    return plant.C @ np.linalg.solve(z[:, None, None] * np.eye(plant.n) - plant.A, B)


def closed_loop(plant: Plant, law: Law) -> np.ndarray:
    """Returns the state matrix of plant, memory and integrator together, [x; z; xi], unclipped.

    With fewer inputs than outputs, K_r xi (m,) replaces xi. The rest of xi moves no input and would count as
    a mode that never decays.
    """
    integrates = np.any(law.integral)
    C, D, Kz, Kr = plant.C, law.D, law.K, law.K_r if integrates else np.zeros_like(law.K_r)
    q, few = len(law.A), plant.m < plant.p
    held, into, to_u = (plant.m, Kr @ C, np.eye(plant.m)) if few else (plant.p, C, Kr)
    u = np.hstack([-D @ C, -Kz, -to_u])
    rows = [
        np.hstack([plant.A, np.zeros((plant.n, q + held))]) + plant.B @ u,
        np.hstack([law.B_y @ C, law.A, np.zeros((q, held))]) + law.B_u @ u,
        np.hstack([-np.reshape(law.integral, (-1, 1)) * into, np.zeros((held, q)), np.eye(held)]),
    ]
    whole = np.vstack(rows)
    return whole if integrates else whole[: plant.n + q, : plant.n + q]


def law_response(law: Law, z: np.ndarray) -> np.ndarray:
    """Returns the frequency response K (grid, m, p) of the law, u = -K(z) y, with its memory fed its own
    command. If the memory is a plain shift (law.compact), K is computed from polynomials in 1 / z; otherwise
    from one Schur form, which is triangular at every frequency."""
    m, q = law.K.shape
    if q and q % m == 0 and np.array_equal(law.A, np.eye(q, k=m)) and np.array_equal(law.K, np.eye(m, q)):
        back = z[:, None] ** -np.arange(1, q // m + 1)
        of_u, of_y = (np.einsum("gl,lij->gij", back, B.reshape(q // m, m, -1)) for B in (law.B_u, law.B_y))
        of_xi = (-np.asarray(law.integral) / (z[:, None] - 1))[:, None, :] * law.K_r
        return np.linalg.solve(np.eye(m) + of_u, of_y + law.D + of_xi)
    T, V = scipy.linalg.schur(law.A - law.B_u @ law.K, output="complex")
    from_y, from_xi = V.conj().T @ (law.B_y - law.B_u @ law.D), V.conj().T @ law.B_u @ law.K_r
    K, identity = law.K @ V, np.eye(len(T))
    response = np.empty((len(z), *law.D.shape), complex)
    for i, point in enumerate(z):
        xi = -law.integral / (point - 1) if np.any(law.integral) else 0.0
        response[i] = (
            K @ scipy.linalg.solve_triangular(point * identity - T, from_y - xi * from_xi, check_finite=False)
            + law.D
            + xi * law.K_r
        )
    return response


def _delay_margin(omega: np.ndarray, loci: np.ndarray) -> float:
    """Returns the smallest delay in samples that takes an eigenvalue of the loop to -1. Both sides of each
    unit crossing are tried, and the smaller value counts."""
    size = np.abs(loci)
    crossing = (size[:-1] - 1) * (size[1:] - 1) < 0
    lag = np.minimum(
        (np.angle(loci[:-1]) + np.pi) / omega[:-1, None], (np.angle(loci[1:]) + np.pi) / omega[1:, None]
    )
    # a delay of whole samples turns the locus at pi by pi a sample. If the locus is larger than one there, it
    # meets -1 without crossing the circle
    last = (np.angle(loci[-1]) + np.pi) / omega[-1]
    lags = np.concatenate([lag[crossing], last[size[-1] > 1]])
    return float(lags.min()) if lags.size else float("inf")


LEVEL = 0.05


def chosen(
    costs: Mapping[str, np.ndarray], plant: np.ndarray, passes: Mapping[str, bool], *, seed: int
) -> tuple[str | None, str | None, Paired | None]:
    """Returns the best controller that passes, the cheapest other one that passes, and the test of the best
    against that one. `costs` (s,) by controller are ordered from simple to complex. The choice starts with
    the first that passes. A more complex one replaces it if its costs are lower beyond chance: paired by
    plant, one-sided at LEVEL. Each is None if no controller passes; the last two are None if only one
    passes."""
    able = [name for name in costs if passes[name]]
    if not able:
        return None, None, None
    best = able[0]
    for name in able[1:]:
        if between(costs[best], costs[name], plant, seed=seed).p < LEVEL:
            best = name
    others = [name for name in able if name != best]
    if not others:
        return best, None, None
    nearest = min(others, key=lambda name: float(costs[name].mean()))
    return best, nearest, between(costs[nearest], costs[best], plant, seed=seed)


def between(champion: np.ndarray, challenger: np.ndarray, plant: np.ndarray, *, seed: int) -> Paired:
    """Returns the improvement of the second controller over the first on the same cases, paired by plant."""
    return paired(
        np.maximum(champion, 1e-9),
        np.maximum(challenger, 1e-9),
        [str(index) for index in plant],
        rng=np.random.default_rng(seed),
    )


def pair(
    a: str, b: str, costs: Mapping[str, np.ndarray], plant: np.ndarray, structure: np.ndarray, *, seed: int
) -> dict[str, Any]:
    """Compares two controllers a and b by their costs (s,). `difference`: by how many percent of the other's
    cost the cheaper one is lower; `low`, `high`: the ends of its 90 % interval; `p`: two-sided.
    `by_structure`: the same difference on the plants of each machine structure, from `structure` (s,).
    `winner`: the cheaper controller if the difference is beyond chance and `kept`, otherwise None.

    `kept`: the difference is larger than the standard deviation over the structures. By Student's t, one more
    structure then keeps the sign with at least 79 % probability: for five structures, P(t_4 < 1 / sqrt(1 + 1
    / 5)).
    """
    forward = between(costs[b], costs[a], plant, seed=seed)
    backward = between(costs[a], costs[b], plant, seed=seed)
    cheaper, result = (a, forward) if forward.improvement_percent >= 0 else (b, backward)
    p, dearer = min(1.0, 2 * result.p), b if cheaper == a else a
    own = [structure == kind for kind in np.unique(structure)]
    by_structure = [
        between(costs[dearer][rows], costs[cheaper][rows], plant[rows], seed=seed).improvement_percent
        for rows in own
    ]
    spread = np.std(by_structure, ddof=1) if len(by_structure) > 1 else 0.0
    kept = result.improvement_percent > spread
    return {
        "a": a,
        "b": b,
        "winner": cheaper if p < LEVEL and kept else None,
        "difference": result.improvement_percent,
        "low": result.low_percent,
        "high": result.high_percent,
        "p": p,
        "by_structure": by_structure,
        "kept": bool(kept),
    }


def deciding_plant(a: np.ndarray, b: np.ndarray, plant: np.ndarray) -> int:
    """Returns the plant that contributes most to the overall difference between the costs (s,) of two
    controllers. The verdict without this plant is reported too."""
    ratio = np.log(np.maximum(a, 1e-9) / np.maximum(b, 1e-9))
    by_plant = np.array([ratio[plant == index].mean() for index in np.unique(plant)])
    return int(np.unique(plant)[(np.sign(by_plant.sum() or 1.0) * by_plant).argmax()])


def banded(
    values: np.ndarray, plant: np.ndarray, *, seed: int, resamples: int = 200
) -> tuple[dict[str, float], int]:
    """Returns a summary of a figure (s,) for which lower is better, and the case with the worst value. The
    summary has the `median` and 90 % quantile `q90` over all cases, the ends `low` and `high` of the 90 %
    band of that quantile, with plants resampled as blocks, and the `worst`, inf if a run never settles.
    Values are NaN if the figure does not apply; if it applies nowhere, the whole summary is NaN."""
    applies = np.flatnonzero(~np.isnan(values))
    if not len(applies):
        return dict.fromkeys(("median", "q90", "low", "high", "worst"), np.nan), 0
    values, plant = values[applies], plant[applies]
    median, q90 = np.quantile(values, [0.5, 0.9], method="nearest")
    blocks = [values[plant == index] for index in np.unique(plant)]
    drawn = np.random.default_rng(seed).integers(0, len(blocks), (resamples, len(blocks)))
    quantiles = [
        np.quantile(np.concatenate([blocks[k] for k in row]), 0.9, method="nearest") for row in drawn
    ]
    low, high = np.quantile(quantiles, [0.05, 0.95], method="nearest")
    worst = int(np.argmax(values))
    band = {"median": median, "q90": q90, "low": low, "high": high, "worst": values[worst]}
    return {name: float(value) for name, value in band.items()}, int(applies[worst])


def mean_and_worst(costs: np.ndarray, plant: np.ndarray, *, weight: float) -> float:
    """Returns one number for a search: the geometric mean of the plants' costs, as in the paired test,
    combined with that of the costliest quarter at `weight`. The quarter changes smoothly, while the single
    worst plant would jump. One plant that no controller can hold then cannot set the gains for all."""
    by_plant = np.sort([np.log(max(costs[plant == index].mean(), 1e-9)) for index in np.unique(plant)])
    tail = by_plant[-max(1, len(by_plant) // 4) :].mean()
    return float(np.exp((by_plant.mean() + weight * tail) / (1 + weight)))


def sufficiency(
    u: Sequence[np.ndarray],
    y: Sequence[np.ndarray],
    learn: Callable[[Sequence[np.ndarray], Sequence[np.ndarray]], Law],
    yardstick: CommonCost,
    scenarios: Scenarios,
    *,
    whole: float,
    samples: int,
    least: int,
    allowed: float,
) -> tuple[float, int]:
    """Tests from the record alone whether it is long enough for its noise. `learn` makes a controller from
    each half of the record. Returns their mean extra cost, relative to the cost `whole` of the controller
    from all `samples`, on `scenarios` of the model learned from all of them. Also returns the number of
    samples, at least `least`, at which this excess would fall to `allowed`, if it falls as one over the
    samples."""
    gaps = []
    for part in (0, 1):
        half_u, half_y = (
            [rows[part * len(rows) // 2 : (part + 1) * len(rows) // 2] for rows in signal]
            for signal in (u, y)
        )
        run = simulate(scenarios, learn(half_u, half_y))
        gaps.append(cost(scenarios, run, yardstick)[0] / whole - 1)
    half_gap = float(np.mean(gaps))
    return half_gap, max(int(np.ceil(samples * min(half_gap / 2 / allowed, 1e3))), least)


class KernelCandidate(NamedTuple):
    """One state on which Algorithm 2 was tried: the regression, the gap in cost of its gain on the window's
    model, and the reason if it was refused. The gap of a refused candidate is infinite."""

    state: str
    learned: kernel.Regression | None
    gap: float
    refusal: str


def kernel_candidates(
    u: Sequence[np.ndarray],
    y: Sequence[np.ndarray],
    long: window_route.WindowModel,
    yardstick: CommonCost,
    scenarios: Scenarios,
    *,
    largest: int,
    offset: bool,
) -> list[KernelCandidate]:
    """Tries Algorithm 2 on windows of 1 to `largest` samples and on the predicted state, all from one record.
    Each is judged on `scenarios` of the long window's model.

    Without noise, the shortest window that holds the plant's state is exact. With noise, longer windows are
    biased, but the predicted state is not.
    """
    best = optimum(scenarios, yardstick)
    tried = [
        (f"window of {N}", lambda N=N: kernel.tuples(u, y, N, offset=offset)) for N in range(1, largest + 1)
    ]
    tried.append(("predicted state", lambda: window_route.predicted_tuples(long, u, y, offset=offset)))
    candidates = []
    for state, features in tried:
        try:
            learned = kernel.regress(features())
            law = kernel.law(learned, np.diag(yardstick.q), np.diag(yardstick.r), yardstick.gamma)
        except ValueError as refusal:
            candidates.append(KernelCandidate(state, None, float("inf"), str(refusal)))
            continue
        run = simulate(scenarios, law)
        gap = float((cost(scenarios, run, yardstick) / best - 1)[0])
        candidates.append(KernelCandidate(state, learned, gap if np.isfinite(gap) else float("inf"), ""))
    return candidates
