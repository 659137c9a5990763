"""How fast a machine is: the time constant that explains a record of one output best."""

from collections.abc import Sequence

import numpy as np

from pipeline.temperature.identification.first_order import response

# the constants that are tried, as shares of the sample time and of the record
_GRID = 40
MOST_SAMPLES = 3000


def time_constant(u: Sequence[np.ndarray], y: Sequence[np.ndarray], *, sample_time_s: float) -> float:
    """The tau in seconds for which y = sum_i K_i u_i / (tau s + 1) + y(0) e^(-t/tau) + offset simulates the
    segments u (T, m), y (T,) best.

    NaN in y is a masked sample. Long records are thinned to MOST_SAMPLES. Raises ValueError where no input
    moves or fewer than 20 samples are seen.
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
    """Sum of squares of the best simulation with this time constant."""
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
