"""First-order models with delay, K e^(-theta s) / (tau s + 1), from records and from step responses, for the
extruder and for one heater."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.optimize
import scipy.signal


def simc_pid(
    gain: float, time_constant_s: float, delay_s: float, *, sample_time_s: float
) -> tuple[float, float, float]:
    """Returns Kp (units of u per unit of y), Ki (per second) and Kd (seconds) of u = Kp e + Ki integral of e
    + Kd de/dt, by SIMC for a first-order model with delay. A third of the delay is the derivative time
    (Grimholt and Skogestad 2018, iSIMC); the series form is rewritten as parallel:

    K_c = tau / (K (tau_c + theta))
    tau_I = min(tau, 4 (tau_c + theta))
    tau_D = theta / 3
    tau_c = theta

    theta is the delay plus half a sample, because a held input is late by that, and at least one sample.
    """
    theta = max(delay_s + sample_time_s / 2, sample_time_s)
    tau = max(time_constant_s, sample_time_s)
    K_c, tau_I, tau_D = tau / (gain * 2 * theta), min(tau, 8 * theta), theta / 3
    return K_c * (1 + tau_D / tau_I), K_c / tau_I, K_c * tau_D


class StepModels(NamedTuple):
    """First-order models of step responses, each (...): gain, time constant and delay in samples, and the
    NRMSE fit in percent of the model to the response, 100 for an exact first-order response."""

    gain: np.ndarray
    time_constant: np.ndarray
    delay: np.ndarray
    fit_percent: np.ndarray


def of_step_responses(
    t: np.ndarray, responses: np.ndarray, *, taus: int = 90, delays: int = 40
) -> StepModels:
    """Fits K (1 - exp(-(t - theta) / tau)) by least squares to each response (T, ...) at samples t (T,).

    tau and theta are searched on one grid for all responses: tau from half a sample to three times the
    horizon, in equal ratios of about a tenth; theta up to a third of the horizon, with smaller steps at small
    values. K is the best for each. Among equals the model without delay wins.
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


def response(u: np.ndarray, time_constant_s: float, delay_s: float, sample_time_s: float) -> np.ndarray:
    """Returns the unit-gain response (T,) from rest to u (T,) held between samples. Before the start the
    input was always u(0). Exact for any delay, whole samples or not:

    x(t+1) = a x(t) + (1 - c) u(t-k) + (c - a) u(t-k-1)

    with delay = (k + f) samples, a = exp(-Ts/tau), c = exp(-(1-f) Ts/tau).
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


# number of time constants tried, from one sample time to twice the longest segment
_GRID = 40
MOST_SAMPLES = 3000


def time_constant(u: Sequence[np.ndarray], y: Sequence[np.ndarray], *, sample_time_s: float) -> float:
    """Returns the tau in seconds for which y = sum_i K_i u_i / (tau s + 1) + y(0) e^(-t/tau) + offset
    simulates the segments u (T, m), y (T,) best.

    NaN in y is a masked sample. Long records are thinned to MOST_SAMPLES. Raises ValueError if no input moves
    or fewer than 20 samples are measured.
    """
    thin = max(1, sum(map(len, y)) // MOST_SAMPLES)
    u, y = [np.asarray(a, float)[::thin] for a in u], [np.asarray(b, float)[::thin] for b in y]
    sample_time_s *= thin
    pairs = [(a, b) for a, b in zip(u, y, strict=True) if len(b) > 2]
    samples = sum(int(np.isfinite(b).sum()) for _, b in pairs)
    if samples < 20 or not any(np.ptp(a, axis=0).any() for a, _ in pairs):
        raise ValueError(
            f"the record has {samples} samples with a moving input, of which a time constant needs 20; "
            "record longer, with a step of the input"
        )
    longest = max(len(b) for _, b in pairs) * sample_time_s
    taus = np.geomspace(sample_time_s, 2 * longest, _GRID)
    return float(taus[int(np.argmin([_error(pairs, tau, sample_time_s) for tau in taus]))])


def _error(pairs: Sequence[tuple[np.ndarray, np.ndarray]], tau: float, sample_time_s: float) -> float:
    """Returns the sum of squared errors of the best simulation with this time constant."""
    m, rows, target = pairs[0][0].shape[1], [], []
    for s, (a, b) in enumerate(pairs):
        block = np.zeros((len(b), m + 1 + len(pairs)))
        for i in range(m):
            block[:, i] = response(a[:, i], tau, 0.0, sample_time_s) + a[0, i]
        block[:, m], block[:, m + 1 + s] = 1.0, np.exp(-np.arange(len(b)) * sample_time_s / tau)
        rows.append(block[np.isfinite(b)])
        target.append(b[np.isfinite(b)])
    J, z = np.vstack(rows), np.concatenate(target)
    J = J / np.maximum(np.abs(J).max(axis=0), np.finfo(float).tiny)
    theta = np.linalg.lstsq(J, z, rcond=1e-10)[0]
    return float(np.sum((z - J @ theta) ** 2))
