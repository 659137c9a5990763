"""Algorithm 2 in its published form, vectorised: Kronecker products z (x) z with every entry twice, and every
iteration through all samples. Nothing is whitened, nothing is projected; it shares no line with
pipeline/temperature/controllers/kernel.py, which is held against it."""

import numpy as np
import scipy.linalg


def value_iteration(
    s, u, e, s_next, Q, R, gamma: float, *, mu: float, iterations: int
) -> tuple[np.ndarray, np.ndarray]:
    """H (k+m, k+m) and K (m, k) of u = -K s after H <- argmin sum (e'Qe + u'Ru + gamma z+'H z+ - z'H z)^2 +
    mu |H|^2 (34)-(36), from H = the fit of the stage cost.

    s (samples, k), u (samples, m), e (samples, p), s_next (samples, k); z = [s; u], z+ = [s_next; -K s_next].
    """
    k, z = s.shape[1], np.hstack([s, u])
    d = z.shape[1]
    Phi = (z[:, :, None] * z[:, None, :]).reshape(len(z), d * d)
    factor = scipy.linalg.cho_factor(Phi.T @ Phi + mu * np.eye(d * d))
    stage = ((e @ Q) * e).sum(axis=1) + ((u @ R) * u).sum(axis=1)
    H = scipy.linalg.cho_solve(factor, Phi.T @ stage).reshape(d, d)
    for _ in range(iterations):
        z_next = np.hstack([s_next, -s_next @ np.linalg.solve(H[k:, k:], H[k:, :k]).T])
        value = ((z_next @ H) * z_next).sum(axis=1)
        H = scipy.linalg.cho_solve(factor, Phi.T @ (stage + gamma * value)).reshape(d, d)
    return H, np.linalg.solve(H[k:, k:], H[k:, :k])
