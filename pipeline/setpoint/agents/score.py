"""Scores a run of a setpoint controller by its true flow and temperature: whether it reaches and keeps the
target, recovers, or disturbs a good print; and how certain a share of runs is."""

from typing import NamedTuple

import numpy as np

from pipeline.setpoint.agents.criteria import (
    BACK_BAND,
    BEYOND,
    CLOG_STEP,
    DWELL_UNTIL,
    FLOW_BAND,
    RECOVERED_UNTIL,
    SETTLED_BY,
    STEPS,
    TEMPERATURE_BAND,
)
from pipeline.setpoint.published import BEST_FLOW, BEST_TEMPERATURE
from pipeline.statistics import PooledShare, pooled_share, wilson

# tolerance: float32 sums of moves may end slightly outside a border that they should lie on
ROUNDING = 1e-3


class Outcomes(NamedTuple):
    """Outcomes of n runs, (n,) unless stated. "Inside" means 90-110 % flow and 210 +- 5 °C. `flow` and
    `temperature`: at the start; `entered`: step from which the run is inside until step 100, 101 if it is
    outside then.

    `settled`: entered by step 90; `stay`: settled, and never outside from 100 to 200; `recovered`: inside
    from some step <= 90 until 120; `recovery`: decisions from CLOG_STEP until inside for good until 200,
    infinite if never; `back`: as recovered, but within +-15 %; `beyond` (n, 3): further than BEYOND from 100
    % at some step; `overshoot`: points of flow past 100 % on the far side of the start, before step 60;
    `flow_error`: mean
    q - 100 %| over steps 100 to 200.
    """

    flow: np.ndarray
    temperature: np.ndarray
    entered: np.ndarray
    settled: np.ndarray
    stay: np.ndarray
    recovered: np.ndarray
    recovery: np.ndarray
    back: np.ndarray
    beyond: np.ndarray
    overshoot: np.ndarray
    flow_error: np.ndarray


class RunScore(NamedTuple):
    """Score of n runs. Shares are of all runs, as in `Outcomes`; `beyond` has one for each of BEYOND.

    `median_steps` and `p90_steps`: decisions of the settled runs until inside for good (NaN if none settled);
    `overshoot_p95`: 95th percentile; `flow_error`: mean; `worst_start`: flow, temperature and percentage
    settled of the start with the fewest settled runs; `recovery_p95`: 95th percentile of all runs (NaN if
    fewer ever recover).
    """

    runs: int
    settled: PooledShare
    stay: PooledShare
    recovered: PooledShare
    median_steps: float
    p90_steps: float
    overshoot_p95: float
    flow_error: float
    worst_start: tuple[float, float, float]
    back: PooledShare
    recovery_p95: float
    beyond: tuple[PooledShare, ...]


def judge(flow: np.ndarray, temperature: np.ndarray) -> RunScore:
    """Returns the score of n independent trajectories, from their true flow (percent) and temperature (°C),
    each (n, 201 or more).

    Raises ValueError for fewer than 200 decisions.
    """
    return summary(outcomes(flow, temperature))


def outcomes(flow: np.ndarray, temperature: np.ndarray) -> Outcomes:
    """Returns the outcomes of n trajectories (n, 201 or more). Raises ValueError for shorter ones."""
    flow, temperature = np.asarray(flow, float), np.asarray(temperature, float)
    if flow.shape[1] <= STEPS:
        raise ValueError(
            f"judge: expected trajectories of {STEPS} decisions, found {flow.shape[1] - 1}; "
            f"roll out with steps={STEPS}"
        )
    off = np.abs(flow - BEST_FLOW)
    warm = np.abs(temperature - BEST_TEMPERATURE) <= TEMPERATURE_BAND + ROUNDING
    inside = (off <= FLOW_BAND + ROUNDING) & warm
    entered, home = _inside_since(inside, DWELL_UNTIL), _inside_since(inside, STEPS)
    settled = entered <= SETTLED_BY
    past = np.sign(BEST_FLOW - flow[:, :1]) * (flow[:, :CLOG_STEP] - BEST_FLOW)
    farthest = off[:, : STEPS + 1].max(axis=1)
    return Outcomes(
        flow=flow[:, 0],
        temperature=temperature[:, 0],
        entered=entered,
        settled=settled,
        stay=settled & inside[:, DWELL_UNTIL : STEPS + 1].all(axis=1),
        recovered=_inside_since(inside, RECOVERED_UNTIL) <= SETTLED_BY,
        recovery=np.where(home <= STEPS, np.maximum(home - CLOG_STEP, 0.0), np.inf),
        back=_inside_since((off <= BACK_BAND + ROUNDING) & warm, RECOVERED_UNTIL) <= SETTLED_BY,
        beyond=farthest[:, None] > np.array(BEYOND) + ROUNDING,
        overshoot=past.max(axis=1).clip(0),
        flow_error=off[:, DWELL_UNTIL : STEPS + 1].mean(axis=1),
    )


def summary(of: Outcomes, *, pools: int | None = None) -> RunScore:
    """Returns the score of runs on `pools` pools of segments, ordered by pool, equally many on each.
    Intervals and effective numbers of runs follow from the differences between pools
    (`statistics.effective`). Without pools the runs are independent, and the intervals are Wilson's."""

    def share(happened: np.ndarray) -> PooledShare:
        if pools is None:
            return PooledShare(*wilson(happened), len(happened))
        return pooled_share(happened.reshape(pools, -1))

    median, p90 = np.percentile(of.entered[of.settled], [50, 90]) if of.settled.any() else (np.nan, np.nan)
    late = float(np.percentile(of.recovery, 95, method="higher"))
    return RunScore(
        runs=len(of.flow),
        settled=share(of.settled),
        stay=share(of.stay),
        recovered=share(of.recovered),
        median_steps=float(median),
        p90_steps=float(p90),
        overshoot_p95=float(np.percentile(of.overshoot, 95)),
        flow_error=float(of.flow_error.mean()),
        worst_start=_worst_start(of.flow, of.temperature, of.settled),
        back=share(of.back),
        recovery_p95=late if np.isfinite(late) else float("nan"),
        beyond=tuple(share(column) for column in of.beyond.T),
    )


def _inside_since(inside: np.ndarray, until: int) -> np.ndarray:
    """Returns the first step (n,) from which each run is inside through step `until`; until + 1 if it is
    outside then."""
    out = ~inside[:, until::-1]
    return np.where(out.any(axis=1), until + 1 - out.argmax(axis=1), 0)


def _worst_start(
    flow: np.ndarray, temperature: np.ndarray, settled: np.ndarray
) -> tuple[float, float, float]:
    pairs, which = np.unique(np.stack([flow, temperature], axis=1), axis=0, return_inverse=True)
    percent = 100.0 * np.bincount(which.ravel(), weights=settled) / np.bincount(which.ravel())
    worst = int(percent.argmin())
    return float(pairs[worst, 0]), float(pairs[worst, 1]), float(percent[worst])
