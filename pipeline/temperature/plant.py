"""The plant of loop 1: a state-space model from heaters and motor to barrel temperatures, with the constants
of the BAAM study, simulation, rank tests and steady states."""

from collections.abc import Sequence

import numpy as np
import scipy.linalg

from pipeline.temperature.controllers.law import Plant


def plant(A, B, C, D=None, b=None, d=None, K=None, sample_time_s: float = 1.0) -> Plant:
    """Returns a Plant with checked shapes; omitted arrays are zero. Raises ValueError that names the matrix,
    the expected shape and the shape found, or the matrix with a number that is not finite."""
    A, B, C = (np.atleast_2d(np.asarray(M, float)) for M in (A, B, C))
    n, m, p = A.shape[0], B.shape[1], C.shape[0]
    expected = {"A": (n, n), "B": (n, m), "C": (p, n), "D": (p, m), "b": (n,), "d": (p,), "K": (n, p)}
    given = {"A": A, "B": B, "C": C, "D": D, "b": b, "d": d, "K": K}
    arrays = {
        name: np.zeros(shape) if given[name] is None else np.asarray(given[name], float)
        for name, shape in expected.items()
    }
    for name, shape in expected.items():
        if arrays[name].shape != shape:
            raise ValueError(
                f"plant: {name} should have shape {shape} but has {arrays[name].shape}; A is {A.shape}, "
                f"B {B.shape}, C {C.shape}"
            )
        if not np.isfinite(arrays[name]).all():
            raise ValueError(
                f"plant: {name} holds a number that is not finite; identify the plant again on a clean record"
            )
    return Plant(**arrays, sample_time_s=float(sample_time_s))


def baam() -> Plant:
    """Returns the big-area extruder of seed 1, (44) and (45): six heated cells and a motor -> five sensors.
    By convention one step is 1 s and u is in percent."""
    A = np.diag([0.992, 0.9919, 1.0009, 0.9979, 0.9972, 0.9953])
    A[0, 1], A[1, 0], A[1, 2], A[2, 1], A[2, 3], A[3, 2] = 0.0018, 0.0023, 0.0043, -0.0042, 0.0024, 0.0013
    B = np.column_stack(
        [
            np.diag([1.0033, 1.0460, 1.0326, 0.4798, 0.8882, 1.1699]),
            [-0.2175, -0.0788, -0.0020, -0.0669, 0.1273, -0.1792],
        ]
    )
    C = np.array(
        [
            [0.992, 0.00018, 0.0, 0.0, -0.0001, 0.0],
            [0.0023, 1.3, 0.0043, 0.0, 0.0, 0.0],
            [0.0, -0.0042, 1.0109, 0.0024, 0.0, 0.201],
            [0.0, 0.0, 0.0013, 0.989, 0.00031, 0.64],
            [0.0, 0.0, 0.0, 0.0, 0.923, 0.3],
        ]
    )
    return plant(A, B, C)


def simulate(plant: Plant, u: np.ndarray, x0: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Noise-free states x (T+1, n) and outputs y (T, p) of (1) under inputs u (T, m) from x0 (n,)."""
    x = np.empty((len(u) + 1, plant.n))
    x[0] = x0
    drive = u @ plant.B.T + plant.b
    for t in range(len(u)):
        x[t + 1] = plant.A @ x[t] + drive[t]
    return x, x[:-1] @ plant.C.T + u @ plant.D.T + plant.d


def markov_parameters(plant: Plant, lags: int) -> np.ndarray:
    """h (lags, p, m) with h[k-1] = C A^(k-1) B, the response of y at lag k to a unit pulse of u."""
    # columns A^k B in blocks that double: two products per doubling instead of one per lag
    columns, power = plant.B, plant.A
    while columns.shape[1] < lags * plant.m:
        columns, power = np.hstack([columns, power @ columns]), power @ power
    h = (plant.C @ columns[:, : lags * plant.m]).reshape(plant.p, lags, plant.m)
    return h.transpose(1, 0, 2)


def clip_spectral_radius(A: np.ndarray, radius: float) -> np.ndarray:
    """Returns A with every eigenvalue beyond `radius` moved onto it along its ray. Works in the modal basis,
    or in Schur's if there is no modal basis, as for a plant with dead times."""
    eigenvalues, T = np.linalg.eig(A)
    size = np.abs(eigenvalues)
    if size.max() <= radius:
        return A
    clipped = eigenvalues * np.where(size > radius, radius * (1 - 1e-9) / np.maximum(size, 1e-300), 1.0)
    try:
        A_clipped = np.real((T * clipped) @ np.linalg.inv(T))
    except np.linalg.LinAlgError:
        upper, Z = scipy.linalg.schur(A, output="complex")
        diagonal = np.diag(upper)
        shrunk = radius * (1 - 1e-9) / np.maximum(np.abs(diagonal), 1e-300)
        np.fill_diagonal(upper, diagonal * np.minimum(shrunk, 1.0))
        A_clipped = np.real(Z @ upper @ Z.conj().T)
    # a defective A has no exact modal basis, so a pole may still lie outside
    return A_clipped * min(1.0, radius * (1 - 1e-9) / np.abs(np.linalg.eigvals(A_clipped)).max())


def observability_matrix(A: np.ndarray, C: np.ndarray, blocks: int) -> np.ndarray:
    """[C; CA; ...; CA^(blocks-1)] (7)."""
    rows = [C]
    for _ in range(blocks - 1):
        rows.append(rows[-1] @ A)
    return np.vstack(rows)


def _rank_test(matrix: np.ndarray, n: int, name: str, remedy: str) -> tuple[int, str]:
    sv = np.linalg.svd(matrix, compute_uv=False)
    rank = int((sv > sv[0] * max(matrix.shape) * np.finfo(float).eps).sum()) if sv[0] > 0 else 0
    reason = (
        ""
        if rank == n
        else f"the plant is not {name}: rank {rank} of {n}, smallest singular values "
        f"{np.array2string(sv[-2:], precision=2)}; {remedy}"
    )
    return rank, reason


def observability(plant: Plant) -> tuple[int, str]:
    """Returns the rank of (7), and the reason if some state never affects y; the reason is empty if all
    do."""
    return _rank_test(
        observability_matrix(plant.A, plant.C, plant.n),
        plant.n,
        "observable",
        "add a sensor, or lower the order of the model",
    )


def observable_part(plant: Plant) -> Plant:
    """Returns the plant without the states that never affect y, now or later. Inputs and outputs are related
    as before. For example, the delays of an input that no output answers are such states."""
    rank, hidden = observability(plant)
    if not hidden:
        return plant
    V = np.linalg.svd(observability_matrix(plant.A, plant.C, plant.n))[2][:rank]
    return plant._replace(A=V @ plant.A @ V.T, B=V @ plant.B, C=plant.C @ V.T, b=V @ plant.b, K=V @ plant.K)


def controllability(plant: Plant) -> tuple[int, str]:
    """Returns the rank of [B AB ... A^(n-1)B] (10), and the reason if no input moves some state; the reason
    is empty if inputs move every state."""
    return _rank_test(
        observability_matrix(plant.A.T, plant.B.T, plant.n),
        plant.n,
        "controllable",
        "add an input, or lower the order of the model",
    )


def bandwidth_rad_s(plant: Plant) -> float | None:
    """Returns the frequency in rad/s above which the largest singular value of y = G u is below 0.707 of its
    steady value. Returns None if it is not below that up to half the sampling rate, or if the plant never
    comes to rest."""
    import control  # takes a second to load

    T = plant.sample_time_s
    if np.abs(np.linalg.eigvals(plant.A)).max() >= 1:
        return None
    system = control.ss(plant.A, plant.B, plant.C, plant.D, T)
    omega = np.concatenate([[0.0], np.geomspace(1e-5, 1.0, 600) * np.pi / T])
    largest = np.linalg.svd(system(np.exp(1j * omega * T), squeeze=False).transpose(2, 0, 1))[1][:, 0]
    below = np.flatnonzero(largest < np.sqrt(0.5) * largest[0])
    return float(omega[below[0]]) if len(below) else None


def strictly_proper(plant: Plant) -> Plant:
    """Returns the plant as the controller samples it. Each output is sampled just before the input of its
    step is applied, so D u acts on it one sample later, as the state w(t+1) = u(t).

    y(t) = C x(t) + D u(t-1) + d: the effect of the previous input on the output is still there when the next
    input is computed from it. Adds only as many states as D has rank. Returns a plant without D unchanged.
    """
    U, sizes, V = np.linalg.svd(plant.D)
    rank = int((sizes > 1e-12 * max(sizes[0], np.finfo(float).tiny)).sum()) if np.any(plant.D) else 0
    if rank == 0:
        return plant
    n, m, p = plant.n, plant.m, plant.p
    root = np.sqrt(sizes[:rank])
    A = np.zeros((n + rank, n + rank))
    A[:n, :n] = plant.A
    return plant._replace(
        A=A,
        B=np.vstack([plant.B, root[:, None] * V[:rank]]),
        C=np.hstack([plant.C, U[:, :rank] * root]),
        D=np.zeros((p, m)),
        b=np.r_[plant.b, np.zeros(rank)],
        K=np.vstack([plant.K, np.zeros((rank, p))]),
    )


def at_disturbances(plant: Plant, inputs: int, level: np.ndarray) -> Plant:
    """Returns the plant of the first `inputs` columns of u, with the others constant at `level`. This is the
    plant for a controller that does not get the disturbances."""
    return plant._replace(
        B=plant.B[:, :inputs],
        D=plant.D[:, :inputs],
        b=plant.b + plant.B[:, inputs:] @ level,
        d=plant.d + plant.D[:, inputs:] @ level,
    )


def padded(plants: Sequence[Plant]) -> list[Plant]:
    """Returns the plants with equal order. Smaller ones are filled up with states that nothing moves and no
    output shows."""
    most = max(plant.n for plant in plants)
    return [
        plant._replace(
            A=np.pad(plant.A, (0, most - plant.n)),
            B=np.pad(plant.B, ((0, most - plant.n), (0, 0))),
            C=np.pad(plant.C, ((0, 0), (0, most - plant.n))),
            b=np.pad(plant.b, (0, most - plant.n)),
            K=np.pad(plant.K, ((0, most - plant.n), (0, 0))),
        )
        for plant in plants
    ]


def hold_state(plant: Plant, x: np.ndarray) -> np.ndarray:
    """Returns the steady input u (m,) of least norm that holds the plant at state x (n,): (I - A) x = B u +
    b. If none is exact, returns the nearest one."""
    return np.linalg.lstsq(plant.B, (np.eye(plant.n) - plant.A) @ x - plant.b, rcond=None)[0]


def hold_output(plant: Plant, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns a steady state x (n,) and input u (m,) with C x + D u + d as near as possible to y (p,), and x
    = A x + B u + b exactly. Among equally near ones u has the least norm."""
    n = plant.n
    balance = np.hstack([np.eye(n) - plant.A, -plant.B])
    free = scipy.linalg.null_space(balance)
    particular = np.linalg.lstsq(balance, plant.b, rcond=None)[0]
    measured = np.hstack([plant.C, plant.D])
    miss = y - plant.d - measured @ particular
    best = np.linalg.lstsq(measured @ free, miss, rcond=None)[0]
    still = free @ scipy.linalg.null_space(measured @ free)
    point = particular + free @ best
    if still.size:
        point = point - still @ np.linalg.lstsq(still[n:], point[n:], rcond=None)[0]
    return point[:n], point[n:]


def stored(plants: Sequence[Plant]) -> dict[str, tuple[np.ndarray, str, str]]:
    """Returns plants of one order as named arrays with unit and meaning, stacked along the first axis, for an
    artifact; `restored` reads them back."""
    meaning = {
        "A": ("1", "state matrix"),
        "B": ("per percent", "input matrix"),
        "C": ("degC", "output matrix"),
        "D": ("degC per percent", "feed-through"),
        "b": ("1", "offset of the state"),
        "d": ("degC", "offset of the output"),
        "K": ("per degC", "Kalman gain"),
        "sample_time_s": ("s", "one step"),
    }
    return {
        name: (np.stack([np.asarray(getattr(plant, name), float) for plant in plants]), *meaning[name])
        for name in Plant._fields
    }


def restored(arrays: dict[str, np.ndarray]) -> list[Plant]:
    return [plant(*(arrays[name][i] for name in Plant._fields)) for i in range(len(arrays["A"]))]
