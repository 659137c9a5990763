"""Half-vectors of symmetric matrices: the coordinates in which a quadratic function of a sample is linear,
with half the columns of the Kronecker product."""

import numpy as np
import scipy.linalg.blas

ROOT2 = np.sqrt(2.0)


def svec(S: np.ndarray) -> np.ndarray:
    """Half-vector of a symmetric S (d, d): upper triangle by rows, sqrt 2 off the
    diagonal, so that svec(S) . svec(T) = trace(S T)."""
    i, j = np.triu_indices(len(S))
    return S[i, j] * np.where(i == j, 1.0, ROOT2)


def smat(h: np.ndarray, d: int) -> np.ndarray:
    """The symmetric (d, d) matrix whose half-vector is h."""
    i, j = np.triu_indices(d)
    S = np.empty((d, d))
    S[i, j] = S[j, i] = h / np.where(i == j, 1.0, ROOT2)
    return S


def skron(X: np.ndarray) -> np.ndarray:
    """The matrix with svec((X z)(X z)') = skron(X) svec(z z'), for X (a, d): shape (a (a+1)/2, d (d+1)/2)."""
    (p, q), (k, j) = np.triu_indices(X.shape[0]), np.triu_indices(X.shape[1])
    product = X[p][:, k] * X[q][:, j]
    off = k != j
    product[:, off] = (product[:, off] + X[p][:, j[off]] * X[q][:, k[off]]) / ROOT2
    return product * np.where(p == q, 1.0, ROOT2)[:, None]


def quadratic_gram(Z: np.ndarray, *, block: int = 1024) -> np.ndarray:
    """Sum over samples of svec(z z') svec(z z')' for Z (d, samples), accumulated in blocks: memory does not
    grow with the number of samples."""
    d, samples = Z.shape
    i, j = np.triu_indices(d)
    gram, features = np.zeros((len(i), len(i)), order="F"), np.empty((len(i), block))
    starts = np.concatenate([[0], np.cumsum(np.arange(d, 0, -1))])
    for first in range(0, samples, block):
        z = np.ascontiguousarray(Z[:, first : first + block])
        phi = features[:, : z.shape[1]]
        for row in range(d):
            np.multiply(z[row], z[row:], out=phi[starts[row] : starts[row + 1]])
        gram = scipy.linalg.blas.dsyrk(1.0, phi.T, beta=1.0, c=gram, trans=1, lower=1, overwrite_c=1)
    weight = np.where(i == j, 1.0, ROOT2)
    gram += np.tril(gram, -1).T
    return gram * weight * weight[:, None]
