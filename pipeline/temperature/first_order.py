"""First-order models with delay, K e^(-theta s) / (tau s + 1), from records and from single steps up and
down; for the extruder and for one heater alike."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.optimize
import scipy.signal


class FirstOrder(NamedTuple):
    """y = K / (tau s + 1) e^(-delay s) u + offset: gain in units of y by units of u, time
    constant and delay in seconds, offset in units of y.

    fit_percent is the NRMSE of the simulation, 100 (1 - |y - ŷ| / |y - mean y|); deviations holds one
    standard deviation of (gain, time constant, delay) for white errors.
    """

    gain: float
    time_constant_s: float
    delay_s: float
    offset: float
    fit_percent: float
    deviations: tuple[float, float, float]


class Pid(NamedTuple):
    """u = Kp e + Ki integral of e + Kd de/dt: Kp in units of u by units of y, Ki by second, Kd seconds."""

    Kp: float
    Ki: float
    Kd: float


def simc_pid(gain: float, time_constant_s: float, delay_s: float, *, sample_time_s: float) -> Pid:
    """PID of a first-order model with delay, SIMC with a third of the delay as derivative time (Grimholt and
    Skogestad 2018, iSIMC), series form rewritten as parallel:

    K_c = tau / (K (tau_c + theta)), tau_I = min(tau, 4 (tau_c + theta)), tau_D = theta / 3, tau_c = theta.
    The delay counts half a sample more, by which a held input is late, and as no less than one sample.
    """
    theta = max(delay_s + sample_time_s / 2, sample_time_s)
    tau = max(time_constant_s, sample_time_s)
    K_c, tau_I, tau_D = tau / (gain * 2 * theta), min(tau, 8 * theta), theta / 3
    return Pid(K_c * (1 + tau_D / tau_I), K_c / tau_I, K_c * tau_D)


class StepModels(NamedTuple):
    """First-order models of step responses, each (...): gain, time constant and delay in samples, and the
    NRMSE in percent of the model beside the response, 100 for a response of one such mode."""

    gain: np.ndarray
    time_constant: np.ndarray
    delay: np.ndarray
    fit_percent: np.ndarray


def of_step_responses(
    t: np.ndarray, responses: np.ndarray, *, taus: int = 90, delays: int = 40
) -> StepModels:
    """K (1 - exp(-(t - theta) / tau)) nearest in least squares to each response (T, ...) at samples t (T,).

    tau and theta are sought on one grid for all: tau from half a sample to three times the horizon, in equal
    ratios of some tenth; theta up to a third of the horizon, closer together where it is short. K is the best
    for each; among equals the model without delay wins.
    """
    horizon = float(t[-1])
    tau = np.geomspace(0.5, 3 * horizon, taus)
    theta = horizon / 3 * np.linspace(0.0, 1.0, delays) ** 2
    grid_theta, grid_tau = (part.ravel() for part in np.meshgrid(theta, tau, indexing="ij"))
    models = 1.0 - np.exp(-np.maximum(t[:, None] - grid_theta, 0.0) / grid_tau)
    power = np.maximum(np.sum(models**2, axis=0), 1e-12)
    flat = responses.reshape(len(t), -1)
    products = models.T @ flat
    best = (products**2 / power[:, None]).argmax(axis=0)
    columns = np.arange(flat.shape[1])
    gain = products[best, columns] / power[best]
    error = np.linalg.norm(flat - models[:, best] * gain, axis=0)
    spread = np.maximum(np.linalg.norm(flat - flat.mean(axis=0), axis=0), np.finfo(float).tiny)
    shape = responses.shape[1:]
    fit = 100.0 * (1.0 - error / spread)
    return StepModels(*(part.reshape(shape) for part in (gain, grid_tau[best], grid_theta[best], fit)))


class StepFit(NamedTuple):
    """The model of one step of the input: the sample at which it came,
    its size in units of u (negative is downward)."""

    start: int
    step: float
    model: FirstOrder


def response(u: np.ndarray, time_constant_s: float, delay_s: float, sample_time_s: float) -> np.ndarray:
    """Unit-gain response (T,) from rest to u (T,) held between samples, u(0) held for ever
    before: exact for any delay, whole samples or not.

    x(t+1) = a x(t) + (1 - c) u(t-k) + (c - a) u(t-k-1), with delay = (k + f)
    samples, a = exp(-Ts/tau), c = exp(-(1-f) Ts/tau).
    """
    whole, fraction = divmod(delay_s / sample_time_s, 1.0)
    k = int(whole)
    a, c = (
        np.exp(-sample_time_s / time_constant_s),
        np.exp(-(1.0 - fraction) * sample_time_s / time_constant_s),
    )
    moved = u - u[0]
    late = np.concatenate([np.zeros(min(k, len(u))), moved[: max(len(u) - k, 0)]])
    return scipy.signal.lfilter([0.0, 1.0 - c, c - a], [1.0, -a], late)


def _linear_part(u, y, time_constant_s, delay_s, sample_time_s):
    """Gain of all segments, offset and initial deviation of each, best for the given time constant and delay;
    returns (gain, offsets, errors)."""
    columns, target = [], []
    for s, (a, b) in enumerate(zip(u, y, strict=True)):
        rows = np.zeros((len(a), 1 + 2 * len(u)))
        rows[:, 0] = response(a, time_constant_s, delay_s, sample_time_s) + a[0]
        rows[:, 1], rows[:, 2 + s] = 1.0, np.exp(-np.arange(len(a)) * sample_time_s / time_constant_s)
        columns.append(rows[np.isfinite(b)])
        target.append(b[np.isfinite(b)])
    J, z = np.vstack(columns), np.concatenate(target)
    J = J[:, np.abs(J).max(axis=0) > 0]
    theta = np.linalg.lstsq(J, z, rcond=1e-12)[0]
    return theta, z - J @ theta, z


def fit_record(
    u: Sequence[np.ndarray],
    y: Sequence[np.ndarray],
    *,
    sample_time_s: float,
    longest_delay_s: float | None = None,
) -> FirstOrder:
    """The first-order model with delay that simulates the segments u (T,), y (T,) best (variable projection:
    only tau and delay are searched; Golub and Pereyra 1973).

    NaN in y is a masked sample. The delay is sought up to `longest_delay_s` (a fifth of the longest segment
    where None). Raises ValueError where u never moves, u holds NaN, or fewer than 10 samples are seen.
    """
    u, y = [np.asarray(a, float).ravel() for a in u], [np.asarray(b, float).ravel() for b in y]
    _check(u, y, sample_time_s)
    length = max(len(a) for a in u) * sample_time_s
    longest = length / 5 if longest_delay_s is None else longest_delay_s
    taus, delays = np.geomspace(sample_time_s / 3, 3 * length, 24), np.linspace(0.0, longest, 16)
    cost = [
        (np.sum(_linear_part(u, y, tau, delay, sample_time_s)[1] ** 2), tau, delay)
        for tau in taus
        for delay in delays
    ]
    _, tau, delay = min(cost)

    def errors(parameters):
        return _linear_part(u, y, np.exp(parameters[0]), parameters[1], sample_time_s)[1]

    bounds = ([np.log(taus[0] / 10), 0.0], [np.log(taus[-1] * 10), max(longest, sample_time_s * 1e-6)])
    start = [np.log(tau), float(np.clip(delay, 0.0, bounds[1][1]))]
    best = scipy.optimize.least_squares(
        errors,
        start,
        bounds=bounds,
        x_scale=[1.0, sample_time_s],
        diff_step=1e-5,
        xtol=1e-12,
        ftol=1e-12,
        gtol=1e-12,
    )
    tau, delay = float(np.exp(best.x[0])), float(best.x[1])
    theta, error, z = _linear_part(u, y, tau, delay, sample_time_s)
    fit = 100.0 * (1.0 - np.linalg.norm(error) / max(np.linalg.norm(z - z.mean()), np.finfo(float).tiny))
    return FirstOrder(
        float(theta[0]),
        tau,
        delay,
        float(theta[1]),
        float(fit),
        _deviations(u, y, theta[0], tau, delay, sample_time_s, error),
    )


def _check(u, y, sample_time_s) -> None:
    if not u or len(u) != len(y) or any(len(a) != len(b) for a, b in zip(u, y, strict=True)):
        raise ValueError(
            f"fit_record: expected segments of equal length in u and y but found {[len(a) for a in u]} and "
            f"{[len(b) for b in y]}"
        )
    if any(not np.isfinite(a).all() for a in u):
        raise ValueError(
            "fit_record: expected an input without gaps but found NaN in u; "
            "split the record into segments at the gaps"
        )
    measured = sum(int(np.isfinite(b).sum()) for b in y)
    if measured < 10:
        raise ValueError(
            f"fit_record: expected at least 10 samples of y but found {measured}; "
            f"record {10 - measured} samples more"
        )
    if all(np.ptp(a) <= 1e-12 * max(np.abs(a).max(), 1e-300) for a in u):
        raise ValueError("fit_record: the input never moves, so its gain is not identified; record a step")
    if sample_time_s <= 0:
        raise ValueError(f"fit_record: expected a positive sample time but found {sample_time_s} s")


def _deviations(u, y, gain, tau, delay, sample_time_s, error) -> tuple[float, float, float]:
    """From the Jacobian by central differences, everything else (offset, initial states) projected out."""

    def predicted(tau, delay):
        return np.concatenate(
            [
                (response(a, tau, delay, sample_time_s) + a[0])[np.isfinite(b)]
                for a, b in zip(u, y, strict=True)
            ]
        )

    h, k = 1e-4 * tau, 1e-3 * sample_time_s
    low = max(delay - k, 0.0)
    J = np.column_stack(
        [
            predicted(tau, delay),
            gain * (predicted(tau + h, delay) - predicted(tau - h, delay)) / (2 * h),
            gain * (predicted(tau, delay + k) - predicted(tau, low)) / (delay + k - low),
        ]
    )
    nuisance = [np.ones(len(J))]
    at = 0
    for b in y:
        mask = np.isfinite(b)
        column = np.zeros(len(J))
        column[at : at + mask.sum()] = np.exp(-np.arange(len(b)) * sample_time_s / tau)[mask]
        nuisance.append(column)
        at += int(mask.sum())
    N = np.column_stack(nuisance)
    J = J - N @ np.linalg.lstsq(N, J, rcond=None)[0]
    variance = np.sum(error**2) / max(len(J) - 3 - N.shape[1], 1)
    return tuple(float(v) for v in np.sqrt(np.maximum(np.diag(np.linalg.pinv(J.T @ J)) * variance, 0.0)))


def fit_steps(
    u: np.ndarray,
    y: np.ndarray,
    *,
    sample_time_s: float,
    shortest_hold: int = 20,
    others: np.ndarray | None = None,
) -> list[StepFit]:
    """A model for each step of u (T,) that is held for at least `shortest_hold`
    samples before and after it, in the order of the steps.

    Where the machine has `others` (T, k), further inputs, a step counts only as long as these stand still:
    their effect is not u's. Up- and downward steps stand apart, so a plant that heats faster than it cools
    shows as two groups. A hold much shorter than the time constant shows as deviations as large as the
    values. Raises ValueError where no step is held that long.
    """
    u, y = np.asarray(u, float), np.asarray(y, float)
    edges = np.r_[0, np.flatnonzero(np.diff(u) != 0) + 1, len(u)]
    fits = []
    moves = (
        np.flatnonzero((np.diff(others, axis=0) != 0).any(axis=1)) + 1
        if others is not None
        else np.zeros(0, int)
    )
    for before, at, after in zip(edges[:-2], edges[1:-1], edges[2:], strict=True):
        before, after = max([before, *moves[moves <= at]]), min([after, *moves[moves > at]])
        if at - before < shortest_hold or after - at < shortest_hold:
            continue
        start = at - min(at - before, shortest_hold)
        model = fit_record([u[start:after]], [y[start:after]], sample_time_s=sample_time_s)
        fits.append(StepFit(int(at), float(u[at] - u[at - 1]), model))
    if not fits:
        raise ValueError(
            f"fit_steps: no step of the input is held for {shortest_hold} samples before and after it; "
            "record longer holds, or use fit_record"
        )
    return fits
