"""Runs the learners on the study's machine, whose optimum is known: without noise, and on many noisy data
sets. It is the reference for the paper's figures."""

from collections.abc import Sequence

import numpy as np

from pipeline.papers.published import GAMMA, K_DATA, REFERENCE, TAU
from pipeline.temperature.controllers import window as window_route
from pipeline.temperature.controllers.kernel import Kernel, regress, tuples, value_iteration, window_law
from pipeline.temperature.plant import Plant, baam, hold_output, hold_state, observability_matrix
from pipeline.temperature.probing import Probe
from pipeline.temperature.test_set.scorecard import CommonCost, Scenarios, cost, optimum, simulate
from pipeline.temperature.test_set.tuning import SearchResult
from pipeline.temperature.tracking import Gains, Law, gains, observer_gain, observer_law

OUTPUTS, INPUTS = 5, 7
YARDSTICK = CommonCost(np.ones(OUTPUTS), np.ones(INPUTS), GAMMA)
AMPLITUDES, BANDWIDTH, VARIANCE = np.arange(100.0, 0.0, -10.0), 1.65, 1.5


def study_signal(
    rng: np.random.Generator,
    samples: int,
    inputs: int,
    *,
    amplitudes: np.ndarray,
    bandwidth: float,
    variance: float,
    redrawn: bool = True,
) -> np.ndarray:
    """Returns omega_pr (samples, inputs) of (51), (52): a sinusoid at the bandwidth, one for each further
    amplitude at a random frequency below it, and Gaussian noise.

    `redrawn` draws new frequencies at every step, as the study's script does (nearly white). Without it they
    are fixed, as the text says. bandwidth in rad per step.
    """
    t = np.arange(samples)[:, None]
    signal = np.sqrt(variance) * rng.standard_normal((samples, inputs)) + amplitudes[0] * np.sin(
        bandwidth * t
    )
    for amplitude in amplitudes[1:]:
        omega = rng.uniform(0.0, bandwidth, (samples if redrawn else 1, inputs))
        signal += amplitude * np.sin(omega * t)
    return signal


def study_probe(
    plant: Plant, signal: np.ndarray, K_data: np.ndarray, *, x0: np.ndarray, noise: np.ndarray
) -> Probe:
    """Returns the record of u = -K_data x + omega_pr (50), which reads the true state and has no limits: for
    parity and benchmarks only. signal and noise may have a batch axis: signal (samples, batch, m), noise
    (samples, batch, p) give u and y of the same shapes."""
    closed = (plant.A - plant.B @ K_data).T
    x = np.empty((len(signal), *signal.shape[1:-1], plant.n))
    x[0] = x0
    drive = signal @ plant.B.T
    for t in range(len(signal) - 1):
        x[t + 1] = x[t] @ closed + drive[t]
    return Probe(signal - x @ K_data.T, x @ plant.C.T + noise, 0.0)


def reconstruction(plant: Plant, N: int) -> np.ndarray:
    """Returns M (n, N (m+p)) with x(t) = M [u(t-1); ...; u(t-N); y(t-1); ...; y(t-N)] (23)-(28). It is exact
    if N is at least the observability index (b = d = 0)."""
    n, m, p = plant.n, plant.m, plant.p
    powers = [np.eye(n)]
    for _ in range(N):
        powers.append(plant.A @ powers[-1])
    U_N = np.hstack([powers[lag] @ plant.B for lag in range(N)])
    W_N = observability_matrix(plant.A, plant.C, N).reshape(N, p, n)[::-1].reshape(N * p, n)
    D_N = np.zeros((N * p, N * m))
    for row in range(N):
        for column in range(row + 1, N):
            D_N[row * p : (row + 1) * p, column * m : (column + 1) * m] = (
                plant.C @ powers[column - row - 1] @ plant.B
            )
    back = powers[N] @ np.linalg.pinv(W_N)
    return np.hstack([U_N - back @ D_N, back])


def exact_gains(plant: Plant, gains: Gains, N: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns K (m, N (m+p)) and K_r (m, p) of (32) from the model, which a kernel learned from noise-free
    data should equal."""
    return gains.K_x @ reconstruction(plant, N), gains.K_r


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
    """Returns F (37) of u = -K_x x - K_r r - k with the state known and r constant.

        F = sum_{t=0..l} gamma^t (|y(t) - r|^2 + |u(t)|^2)

    K_x (m, n), K_r (m, p), k (m,), reference r (p,) in °C, x0 (n,), steps = l >= 0: l + 1 terms. With z = [x;
    1] the loop is z(t+1) = M z(t), so that all z come from log2(l) products, Z <- [Z, M^i Z]. Raises
    ValueError if the closed loop is unstable.
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


def panel(
    plants: Sequence[Plant],
    *,
    starts: Sequence[float],
    references: Sequence[Sequence[float]],
    noise: Sequence[float],
    seeds: Sequence[int],
    steps: int,
    hold: int,
    cells: bool,
) -> Scenarios:
    """Returns every combination of plant, start, reference and noise level, once without noise and once per
    seed with noise.

    A start is a temperature in °C at which the plant is kept by its steady input: of every cell if the states
    are `cells`, else of every sensor. Each scenario's noise depends on its own seed only, so every controller
    gets the same noise.
    """
    rows = []
    for index, plant in enumerate(plants):
        for start in starts:
            x0, u0 = (np.full(plant.n, start), None) if cells else hold_output(plant, np.full(plant.p, start))
            u0 = hold_state(plant, x0) if u0 is None else u0
            for reference in references:
                for level in noise:
                    rows += [
                        (index, x0, u0, reference, level, seed)
                        for seed in (seeds if level > 0 else seeds[:1])
                    ]
    index, x0, u0, r, level, seed = (np.array(column) for column in zip(*rows, strict=True))
    shape = hold + steps, len(references[0])
    unit = {int(one): np.random.default_rng(one).standard_normal(shape) for one in np.unique(seed)}
    drawn = np.stack([size * unit[int(one)] for size, one in zip(level, seed, strict=True)], axis=1)
    return Scenarios(list(plants), index, x0, u0, np.asarray(r, float), steps, hold, drawn)


def study_panel(
    references: np.ndarray, *, noise: float = 0.0, seeds: tuple[int, ...] = (0,), hold: int = 0
) -> Scenarios:
    """Returns the study's machine, kept at 20 °C in every cell by its steady input, for each reference (k,
    5); 1,000 steps."""
    return panel(
        [baam()],
        starts=[20.0],
        references=references,
        noise=[noise],
        seeds=seeds,
        steps=1000,
        hold=hold,
        cells=True,
    )


def gap(law: Law, scenarios: Scenarios) -> np.ndarray:
    """Returns J / J* - 1 of each scenario, unclipped, Q = R = I."""
    run = simulate(scenarios, law)
    return cost(scenarios, run, YARDSTICK) / optimum(scenarios, YARDSTICK) - 1


def data_sets(rng: np.random.Generator, samples: int, sets: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns `sets` runs of the study's probing (50) from 50 °C, noise-free: u (samples, sets, 7), y
    (samples, sets, 5)."""
    signal = study_signal(
        rng, samples, 7 * sets, amplitudes=AMPLITUDES, bandwidth=BANDWIDTH, variance=VARIANCE
    ).reshape(samples, sets, 7)
    recorded = study_probe(baam(), signal, K_DATA, x0=np.full(6, 50.0), noise=np.zeros((samples, sets, 5)))
    return recorded.u, recorded.y


def kernel_of(u: np.ndarray, y: np.ndarray, N: int) -> Kernel:
    """Returns the kernel of Algorithm 2 at Q = R = I from one record, mu = 0."""
    return value_iteration(regress(tuples([u], [y], N)), np.eye(y.shape[1]), np.eye(u.shape[1]), GAMMA)


def law_of(kernel: Kernel, N: int) -> Law:
    return window_law(kernel.K, kernel.K_r, kernel.k, N)


def exact() -> dict[str, dict[str, float]]:
    """Returns J over 1,000 (100) steps from 20 °C, Q = R = I, for the optimum, which knows the state, and for
    the observer, which does not. Also returns the cost of a wrong start: the paper's 50 °C estimate, and a
    window filled with u = 0 and y(0)."""
    plant, scenarios = baam(), study_panel(REFERENCE[None])
    best = gains(plant, np.eye(5), np.eye(7), GAMMA)
    short = scenarios._replace(steps=100)
    law = observer_law(plant, best, observer_gain(plant, TAU))
    from_50 = law._replace(start_y=np.zeros_like(law.start_y), start=np.full(plant.n, 50.0))
    K, K_r = exact_gains(plant, best, 2)
    history = window_law(K, K_r, best.k, 2)
    empty = history._replace(start_u=np.zeros_like(history.start_u))
    J = [float(cost(scenarios, simulate(scenarios, run), YARDSTICK)[0]) for run in (law, from_50)]
    return {
        "optimal": {
            "J1000": float(optimum(scenarios, YARDSTICK)[0]),
            "J100": float(optimum(short, YARDSTICK)[0]),
        },
        "observer": dict(zip(("J1000", "J1000_from_50_degC"), J, strict=True)),
        "takeover": {"zero_history_gap": float(gap(empty, scenarios)[0])},
    }


def noise_free(
    u: np.ndarray, y: np.ndarray, rng: np.random.Generator, *, references: int = 20
) -> dict[str, float]:
    """Returns the gaps of Algorithm 2 from the study's own record u (T, 7), y (T, 5) without its first row.
    `gap` and `gap_window_6`: with a window of 2 on 500 and of 6 on 1,610 samples for the study's reference;
    `any_reference_gap`: from 540 samples, the worst of `references` random references from 100 to 220 °C."""
    one, many = study_panel(REFERENCE[None]), study_panel(rng.uniform(100.0, 220.0, (references, 5)))
    gaps = {}
    sets = {"gap": (2, 500, one), "gap_window_6": (6, 1610, one), "any_reference_gap": (2, 540, many)}
    for name, (N, samples, scenarios) in sets.items():
        rows = slice(0, samples + N)
        gaps[name] = float(np.abs(gap(law_of(kernel_of(u[rows], y[rows], N), N), scenarios)).max())
    return gaps


NOISE = (0.1, 0.5)
ROUTES = ("window", "kernel", "kernel_predicted_state")


def under_noise(
    u: np.ndarray, y: np.ndarray, *, noise: float, seed: int, longest: int = 24
) -> dict[str, tuple[float, float]]:
    """Returns (gap, r.m.s. error in °C over steps 500-1000) of each route on one data set with `noise` °C on
    y. The controller gets noise of the same size while it is judged."""
    y = y + noise * np.random.default_rng(seed).standard_normal(y.shape)
    scenarios, identity = (
        study_panel(REFERENCE[None], noise=noise, seeds=(seed,), hold=longest),
        (np.eye(5), np.eye(7)),
    )
    long = window_route.learn([u], [y], longest=longest)
    predicted = value_iteration(regress(window_route.predicted_tuples(long, [u], [y])), *identity, GAMMA)
    laws = (
        window_route.law(long, *identity, GAMMA),
        law_of(kernel_of(u, y, 2), 2),
        law_of(predicted, long.N),
    )
    result = {}
    for name, law in zip(ROUTES, laws, strict=True):
        run = simulate(scenarios, law)
        late = (run[0] - scenarios.r)[500:]
        result[name] = (
            float((cost(scenarios, run, YARDSTICK) / optimum(scenarios, YARDSTICK) - 1)[0]),
            float(np.sqrt((late**2).mean())),
        )
    return result


def rows(
    work: Sequence[tuple[float, int]], results: Sequence[dict[str, tuple[float, float]]]
) -> dict[str, list]:
    """Returns `under_noise` of each (noise, data set) as columns, one row per route."""
    table = [
        (route, noise, index, *result[route])
        for (noise, index), result in zip(work, results, strict=True)
        for route in ROUTES
    ]
    route, noise, index, gaps, errors = (list(column) for column in zip(*table, strict=True))
    finite = [[value if np.isfinite(value) else np.nan for value in column] for column in (gaps, errors)]
    return {"route": route, "noise_degC": noise, "data_set": index, "gap": finite[0], "error_degC": finite[1]}


def tuning_objective(theta: np.ndarray) -> float:
    """Returns (37) of theta = [q (5,); r (7,)] on the study's machine: l = 100, from 20 °C, the state known,
    the gain from the discounted Riccati equation."""
    plant = baam()
    best = gains(plant, np.diag(theta[:5]), np.diag(theta[5:]), GAMMA)
    return fitness(
        plant, best.K_x, best.K_r, reference=REFERENCE, gamma=GAMMA, steps=100, x0=np.full(plant.n, 20.0)
    )


def scaled_weights(scale: float = 0.4) -> dict[str, float]:
    """Returns the change of the index in percent from Q = R = I to Q = R = scale I if each is computed with
    its own weights, and the largest difference of the gains. It shows that indices with different weights
    cannot be compared: scaling all weights changes the index by the same factor, and the controller not at
    all."""
    plant, scenarios = baam(), study_panel(REFERENCE[None])
    one, other = (gains(plant, factor * np.eye(5), factor * np.eye(7), GAMMA) for factor in (1.0, scale))
    law = observer_law(plant, other, observer_gain(plant, TAU))
    run = simulate(scenarios, law)
    J = [
        cost(scenarios, run, CommonCost(np.full(5, factor), np.full(7, factor), GAMMA))[0]
        for factor in (1.0, scale)
    ]
    return {
        "change_percent": float(100 * (J[1] / J[0] - 1)),
        "gain_difference": float(np.abs(one.K_x - other.K_x).max()),
    }


def parity_metrics(result: SearchResult) -> dict:
    """Returns the result of a search for the least (37), its known optimum, Q = R = I, and the weights that
    it recommends."""
    return {
        "best_cost_perfect_state": result.cost,
        "optimum": tuning_objective(np.ones(OUTPUTS + INPUTS)),
        "scaled_weights": scaled_weights(),
        "q": result.theta[:OUTPUTS],
        "r": result.theta[OUTPUTS:],
    }
