"""Episodes of the closed loop through rendered frames: their starts and their disturbances."""

from typing import NamedTuple

import numpy as np

from pipeline.setpoint.agents import trials
from pipeline.setpoint.deployment import pixels

# decisions at the end of an episode during which it must keep the target, to count as settled
DWELL = 10


class PixelRollouts(NamedTuple):
    """Episodes through rendered frames; empty if none were simulated."""

    calm: dict[str, pixels.Episodes]  # undisturbed ones by controller
    disturbed: pixels.Episodes | None  # two episodes of the default controller
    words: tuple[str, ...]  # the disturbances of these two


def spread_starts(count: int, runs: int) -> np.ndarray:
    """Returns flow in percent and temperature in °C (E, 2): `count` of the 21 starts, spread over flows and
    temperatures, `runs` times each."""
    starts = trials.starts(1, accuracy=1.0)
    chosen = np.unique(np.linspace(0, 20, count).round().astype(int))
    return np.repeat(
        np.stack([np.asarray(starts.flow)[chosen], np.asarray(starts.temperature)[chosen]], axis=1),
        runs,
        axis=0,
    ).astype(float)


def disturbed_episodes(decisions: int) -> tuple[np.ndarray, pixels.PixelDisturbances, tuple[str, str]]:
    """Returns starts (2, 2), disturbances and descriptions of the two episodes that the page always shows:
    the hardest start, and a clog with pictures out of focus later."""
    D, never = decisions, np.iinfo(int).max
    disturbances = pixels.calm(2)._replace(
        clog=np.array([1.0, 0.6]),
        clog_at=np.array([never, D // 3]),
        blur_px=np.array([0.0, 5.0]),
        burst_at=np.array([never, 3 * D // 4]),
        burst_for=np.array([0, 5]),
    )
    return (
        np.array([[30.0, 190.0], [120.0, 210.0]]),
        disturbances,
        ("from 30 % and 190 °C", f"clogged to 60 % at decision {D // 3}, out of focus from {3 * D // 4}"),
    )
