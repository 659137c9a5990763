"""What a run of a controller of setpoints is worth, by its true flow and temperature: settled, staying,
recovered, and how sure a share of runs is."""

from typing import NamedTuple

import numpy as np

from pipeline.setpoint.published import BEST_FLOW, BEST_TEMPERATURE
from pipeline.statistics import Share, wilson

FLOW_BAND, TEMPERATURE_BAND = 10.0, 5.0  # about 100 % and 210 °C
SETTLED_BY, DWELL_UNTIL, STEPS = (
    90,
    100,
    200,
)  # inside from some step <= 90 until 100; never out from 100 to 200 is staying
CLOG_STEP, RECOVERED_UNTIL = 60, 120


class Score(NamedTuple):
    """n runs. Shares of all runs: settled (inside 90-110 % and 210 +- 5 °C from some step <= 90 until 100),
    stay (settled, and never out from 100 to 200), recovered (inside from some step <= 90 until 120: the one
    to read where something befalls the machine at step 60).

    median_steps and p90_steps of the settled runs until they are inside for good (NaN where
    none settled); overshoot_p95 of the points of flow past 100 % on the far side of the start,
    before step 60; flow_error the mean of |q - 100 %| over steps 100 to 200; worst_start names
    the start with the fewest settled, with its percent.
    """

    runs: int
    settled: Share
    stay: Share
    recovered: Share
    median_steps: float
    p90_steps: float
    overshoot_p95: float
    flow_error: float
    worst_start: tuple[float, float, float]


def judge(flow: np.ndarray, temperature: np.ndarray) -> Score:
    """The score of n trajectories of at least 200 decisions, by their true flow
    (percent) and temperature (°C), each (n, 201 or more).

    Raises ValueError for shorter ones.
    """
    flow, temperature = np.asarray(flow, float), np.asarray(temperature, float)
    if flow.shape[1] <= STEPS:
        raise ValueError(
            f"judge: expected trajectories of {STEPS} decisions, found {flow.shape[1] - 1}; "
            f"roll out with steps={STEPS}"
        )
    # float32 sums of moves end a hair outside a border that they are on
    inside = (np.abs(flow - BEST_FLOW) <= FLOW_BAND + 1e-3) & (
        np.abs(temperature - BEST_TEMPERATURE) <= TEMPERATURE_BAND + 1e-3
    )
    entered = _inside_since(inside, DWELL_UNTIL)
    settled, stay = (
        entered <= SETTLED_BY,
        (entered <= SETTLED_BY) & inside[:, DWELL_UNTIL : STEPS + 1].all(axis=1),
    )
    recovered = _inside_since(inside, RECOVERED_UNTIL) <= SETTLED_BY
    past = np.sign(BEST_FLOW - flow[:, :1]) * (flow[:, :CLOG_STEP] - BEST_FLOW)
    median, p90 = np.percentile(entered[settled], [50, 90]) if settled.any() else (np.nan, np.nan)
    return Score(
        runs=len(flow),
        settled=wilson(settled),
        stay=wilson(stay),
        recovered=wilson(recovered),
        median_steps=float(median),
        p90_steps=float(p90),
        overshoot_p95=float(np.percentile(past.max(axis=1).clip(0), 95)),
        flow_error=float(np.abs(flow[:, DWELL_UNTIL : STEPS + 1] - BEST_FLOW).mean()),
        worst_start=_worst_start(flow[:, 0], temperature[:, 0], settled),
    )


def _inside_since(inside: np.ndarray, until: int) -> np.ndarray:
    """The first step (n,) from which each run is inside through step
    `until`; until + 1 where it is outside then."""
    out = ~inside[:, until::-1]
    return np.where(out.any(axis=1), until + 1 - out.argmax(axis=1), 0)


def _worst_start(
    flow: np.ndarray, temperature: np.ndarray, settled: np.ndarray
) -> tuple[float, float, float]:
    pairs, which = np.unique(np.stack([flow, temperature], axis=1), axis=0, return_inverse=True)
    percent = 100.0 * np.bincount(which.ravel(), weights=settled) / np.bincount(which.ravel())
    worst = int(percent.argmin())
    return float(pairs[worst, 0]), float(pairs[worst, 1]), float(percent[worst])
