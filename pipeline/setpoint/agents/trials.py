"""The starts of Li and Pattinson (2025) from which controllers run, and what runs from them are worth."""

from collections.abc import Sequence

import jax
import numpy as np

from pipeline.setpoint.agents.criteria import STEPS
from pipeline.setpoint.agents.score import RunScore, judge
from pipeline.setpoint.published import BEST_TEMPERATURE
from pipeline.setpoint.simulation.simulator import (
    EpisodeConditions,
    SetpointController,
    WindowSource,
    nominal,
    rollout,
)

START_FLOWS, START_TEMPERATURES = (
    (30.0, 60.0, 80.0, 120.0, 150.0, 200.0, 300.0),
    (190.0, 210.0, 230.0),
)  # section 3.4
STARTS = len(START_FLOWS) * len(START_TEMPERATURES)


def starts(runs: int, *, accuracy: float) -> EpisodeConditions:
    """The 21 starts of the paper, `runs` times each (21 runs,), on a machine that does as it is told."""
    flow, temperature = (
        a.ravel() for a in np.meshgrid(np.repeat(START_FLOWS, runs), START_TEMPERATURES, indexing="ij")
    )
    return nominal(flow, temperature, accuracy=accuracy)


def good_starts(flows: Sequence[float] | np.ndarray, runs: int) -> EpisodeConditions:
    """From each of the flows (percent) at 210 °C, `runs` times."""
    return nominal(np.repeat(flows, runs), BEST_TEMPERATURE, accuracy=1.0)


def evaluate(
    controller: SetpointController,
    parameters,
    windows: WindowSource,
    conditions: EpisodeConditions,
    key: jax.Array,
) -> RunScore:
    """Roll out and judge runs that share nothing."""
    trajectory = rollout(controller, parameters, windows, conditions, key, steps=STEPS)
    return judge(np.asarray(trajectory.flow), np.asarray(trajectory.temperature))
