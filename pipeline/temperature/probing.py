"""Probing signals: the study's (48)-(52), and practical ones within amplitude and rate limits. Also their
excitation, which is checked before anything is learned from them."""

from typing import NamedTuple

import numpy as np

from pipeline.temperature.plant import Plant


def multisine(rng: np.random.Generator, samples: int, inputs: int, *, amplitude: float) -> np.ndarray:
    """Returns a signal (samples, inputs) within +-amplitude, with equal power at every frequency of the
    record and random phases. No two inputs share a frequency."""
    lines = np.arange(1, (samples + 1) // 2)
    spectrum = np.zeros((samples // 2 + 1, inputs), complex)
    for channel in range(inputs):
        own = lines[channel::inputs]
        spectrum[own, channel] = np.exp(2j * np.pi * rng.random(len(own)))
    signal = np.fft.irfft(spectrum, samples, axis=0)
    return amplitude * signal / np.abs(signal).max(axis=0)


def prbs(
    rng: np.random.Generator, samples: int, inputs: int, *, amplitude: float, shortest: int
) -> np.ndarray:
    """Returns a random binary sequence (samples, inputs) of +-amplitude that may switch every `shortest`
    samples, independently for each input."""
    bits = rng.integers(0, 2, (-(-samples // shortest), inputs))
    return amplitude * (2.0 * np.repeat(bits, shortest, axis=0)[:samples] - 1.0)


class Probe(NamedTuple):
    """u (samples, m) as applied, y (samples, p) as measured, and the share of (sample, input) at a limit of
    amplitude, rate or machine."""

    u: np.ndarray
    y: np.ndarray
    limited: float


def probe(
    plant: Plant,
    signal: np.ndarray,
    point: tuple[np.ndarray, np.ndarray, np.ndarray],
    limits: tuple[np.ndarray, np.ndarray, float],
    *,
    feedback: np.ndarray,
    noise: np.ndarray,
) -> Probe:
    """Plays u = u_centre + feedback (y_centre - y measured) + signal on the plant, within the limits. Outputs
    stay near y_centre, with feedback from measurements only.

    point: state x (n,) at the start, u_centre (m,) and y_centre (p,); limits: low (m,) <= u <= high (m,), and
    the largest change in percent per step; feedback (m, p) in percent per °C; noise (samples, p) in °C. The
    applied inputs are recorded, so limits cause no bias.
    """
    (x, u_centre, y_centre), (low, high, rate) = point, limits
    last = u_centre
    u, y, limited = np.empty_like(signal), np.empty((len(signal), plant.p)), 0
    for t in range(len(signal)):
        y[t] = plant.C @ x + plant.d + noise[t]
        wanted = u_centre + feedback @ (y_centre - y[t]) + signal[t]
        u[t] = np.clip(np.clip(wanted, last - rate, last + rate), low, high)
        limited += int((u[t] != wanted).sum())
        last, x = u[t], plant.A @ x + plant.B @ u[t] + plant.b
    return Probe(u, y, limited / signal.size)


class Excitation(NamedTuple):
    """Excitation of u over windows of `order` samples: rank and condition number of its second moment
    (`full`: the largest possible rank), and its r.m.s. level (bands, m) in percent within equal bands from 0
    to pi rad a step."""

    order: int
    rank: int
    full: int
    condition: float
    level: np.ndarray


def excitation(u: np.ndarray, order: int, *, bands: int = 8) -> Excitation:
    """Returns the excitation of u (samples, m). u is persistently exciting of order `order` if the rank is m
    x order. Raises ValueError if there are fewer than (m + 1) order samples."""
    samples, m = u.shape
    if samples < (m + 1) * order:
        raise ValueError(
            f"excitation of order {order} with {m} inputs expects at least {(m + 1) * order} samples, "
            f"found {samples}; record {(m + 1) * order - samples} more"
        )
    centred = u - u.mean(axis=0)
    hankel = np.hstack([centred[lag : samples - order + 1 + lag] for lag in range(order)])
    sv = np.linalg.svd(np.linalg.qr(hankel, mode="r"), compute_uv=False)
    rank = int((sv > 1e-9 * sv[0]).sum()) if sv[0] > 0 else 0
    power = np.abs(np.fft.rfft(centred, axis=0)[1:]) ** 2 * 2 / samples**2
    level = np.sqrt(np.stack([part.sum(axis=0) for part in np.array_split(power, bands)]))
    return Excitation(
        order, rank, m * order, float(sv[0] / sv[-1]) ** 2 if rank == m * order else float("inf"), level
    )
