"""The record of a machine whose flow and target step, and how long it takes to come to rest."""

import numpy as np

from pipeline.setpoint.deployment import pixels
from pipeline.setpoint.deployment.pixels import MachineDynamics


def step_response(
    machine: MachineDynamics,
    *,
    flow: tuple,
    temperature: tuple,
    before_s: float,
    after_s: float,
    tick_s: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Flow and temperature (T,) of a machine at rest whose flow and target step from the first to the second
    value: the record to measure the wait from."""
    state, on = (
        pixels.at_rest(machine, np.array([flow[0]]), np.array([temperature[0]]), tick_s=tick_s),
        np.array([True]),
    )
    flows, temperatures = [], []
    for k in range(round((before_s + after_s) / tick_s)):
        late = int(k * tick_s >= before_s - tick_s / 2)
        state, out = pixels.tick(
            machine, state, np.array([flow[late]]), np.array([temperature[late]]), on, tick_s=tick_s
        )
        flows.append(out[0])
        temperatures.append(state.temperature[0])
    return np.array(flows), np.array(temperatures)


def settling_s(y: np.ndarray, *, at: int, band: float, window: int, sample_time_s: float) -> float:
    """Seconds from the step at sample `at` until the mean of every later window of y (T,) stays within `band`
    (units of y) of where the response ends.

    It is the mean of a window that the classifier sees, so that noise counts as a window averages it. The end
    is the mean of the record's last quarter. Raises ValueError where the record is too short for that: a
    window's mean still leaves the band in the last quarter.
    """
    y, tail = np.asarray(y, float), (len(y) - at) // 4
    if not np.isfinite(y).all() or at < 0 or tail < window:
        raise ValueError(
            f"settling_s: expected at least {4 * window} finite samples after the step, "
            f"found {int(np.isfinite(y[max(at, 0) :]).sum())}; record for longer"
        )
    end = y[-tail:].mean()
    sums = np.concatenate([[0.0], np.cumsum(y[at:] - end)])
    outside = np.flatnonzero(np.abs(sums[window:] - sums[:-window]) > band * window)
    last = outside[-1] if len(outside) else -1
    if last >= len(y) - at - tail:
        raise ValueError(
            f"settling_s: the response has not come to rest within {band:g} in "
            f"{(len(y) - at) * sample_time_s:g} s; record for longer, or widen the band"
        )
    return float((last + 1) * sample_time_s)
