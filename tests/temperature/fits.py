"""How well a plant simulates or predicts a record, and a maker's record on a clock of its own."""

from pathlib import Path

import numpy as np

from pipeline.temperature.identification.refinement import simulated
from pipeline.temperature.identification.subspace import Segments
from pipeline.temperature.identification.validation import predicted_ahead
from pipeline.temperature.plant import Plant


def nrmse(y: np.ndarray, predicted: np.ndarray, *, means_removed: bool = False) -> np.ndarray:
    """Fit of each output in percent, 100 (1 - |y - ŷ| / |y - mean y|); NaN in y is left out. With
    `means_removed` the mean of the error is taken off first."""
    mask = np.isfinite(y)
    error = np.where(mask, y - predicted, np.nan)
    error = error - np.nanmean(error, axis=0) if means_removed else error
    spread = np.where(mask, y, np.nan) - np.nanmean(np.where(mask, y, np.nan), axis=0)
    return 100.0 * (
        1.0
        - np.sqrt(
            np.nansum(error**2, axis=0) / np.maximum(np.nansum(spread**2, axis=0), np.finfo(float).tiny)
        )
    )


def simulate_fit(plant: Plant, u: Segments, y: Segments, *, means_removed: bool = False) -> np.ndarray:
    """NRMSE (p,) in percent of free simulation over the segments, the
    initial state of each fitted as in `simulated`."""
    predicted = [simulated(plant, a, b, means_removed=means_removed) for a, b in zip(u, y, strict=True)]
    return nrmse(np.vstack(y), np.vstack(predicted), means_removed=means_removed)


def predict_fit(plant: Plant, u: Segments, y: Segments, steps: int) -> np.ndarray:
    """NRMSE (p,) in percent `steps` samples ahead, over the samples
    after the start-up of `predicted_ahead`."""
    skip = max(3 * plant.n, 30) + steps
    if all(len(a) <= skip for a in u):
        raise ValueError(
            f"predict_fit: expected a segment longer than {skip} samples for {steps} steps ahead; "
            "hold out a longer part, or fewer steps"
        )
    pairs = [
        (b[skip:], predicted_ahead(plant, a, b, steps)[skip:])
        for a, b in zip(u, y, strict=True)
        if len(a) > skip
    ]
    return nrmse(np.vstack([b for b, _ in pairs]), np.vstack([e for _, e in pairs]))


def resampled(
    path: Path, sample_time_s: float, columns: tuple[list[int], list[int]]
) -> tuple[np.ndarray, np.ndarray]:
    """Inputs held and outputs interpolated on a clock of `sample_time_s`: the makers' stamps are jittered."""
    record = np.genfromtxt(path, delimiter=",", skip_header=1)
    t = np.arange(0.0, record[-1, 0], sample_time_s)
    held = np.maximum(np.searchsorted(record[:, 0], t, side="right") - 1, 0)
    return record[held][:, columns[0]], np.column_stack(
        [np.interp(t, record[:, 0], record[:, k]) for k in columns[1]]
    )
