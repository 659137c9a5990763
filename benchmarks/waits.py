"""The wait after an action and the frames of a window, as records of a
machine and errors of a classifier ask for them."""

import numpy as np

from pipeline.setpoint import pixels
from pipeline.setpoint.actuation import Waits
from pipeline.setpoint.pixels import Machine


def step_response(
    machine: Machine, *, flow: tuple, temperature: tuple, before_s: float, after_s: float, tick_s: float
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


def derived_waits(flow_settling_s: float, target_settling_s: float, *, transport_s: float) -> Waits:
    """The waits from measured settling after a step of the flow and of the target; transport_s
    is how long the nozzle takes along the key area (0 where unknown): only then does all of it
    show line that was laid after the change. After no move another look waits as after a move of
    the flow: at once it would show the same segment."""
    return Waits(
        flow_settling_s + transport_s, target_settling_s + transport_s, flow_settling_s + transport_s
    )


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


def autocorrelation(errors: np.ndarray, *, longest: int) -> np.ndarray:
    """rho (longest,) of the classifier's errors (S, T), a row a segment in the order of its frames, about the
    mean of all rows; NaN is a frame that was rejected.

    rho_k = mean of e_t e_{t+k} within rows / mean of e_t^2, rho_0 = 1: a segment
    that is wrong throughout keeps rho high at every lag.
    """
    e = np.asarray(errors, float)
    if e.ndim != 2 or e.shape[1] < longest or np.nanstd(e) == 0 or np.isnan(e).all():
        raise ValueError(
            f"autocorrelation: expected errors (segments, frames) of {longest} frames or more that are not "
            f"all alike, found {e.shape}; "
            "take longer segments, and flows near the class borders"
        )
    mask = np.isfinite(e)
    e = np.where(mask, e - e[mask].mean(), 0.0)
    pairs = [
        (e[:, : e.shape[1] - k] * e[:, k:]).sum() / max((mask[:, : e.shape[1] - k] & mask[:, k:]).sum(), 1)
        for k in range(longest)
    ]
    return np.array(pairs) / pairs[0]


def effective_frames(rho: np.ndarray) -> np.ndarray:
    """Independent frames that windows of 1 ... K frames are worth: n_eff(n) = n / (1 + 2 sum_{k<n} (1 - k/n)
    rho_k), rho (K,) from lag 0 (Bayley, Hammersley 1946)."""
    n = np.arange(1, len(rho) + 1)
    tail = np.concatenate([[0.0], rho[1:]])
    sums, weighted = np.cumsum(tail), np.cumsum(tail * np.arange(len(rho)))
    return n / np.maximum(1.0 + 2.0 * (sums - weighted / n), 1.0 / n)


def window_frames(rho: np.ndarray, *, wait_s: float, frame_rate_hz: float) -> int:
    """The window that gathers the most evidence a second, argmax over n of n_eff(n) / (wait + n / rate): what
    a longer one adds no longer pays for its time."""
    n = np.arange(1, len(rho) + 1)
    return int(n[np.argmax(effective_frames(rho) / (wait_s + n / frame_rate_hz))])
