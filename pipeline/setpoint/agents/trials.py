"""The starts of Li and Pattinson (2025) from which controllers run, and the score of runs from them."""

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
    """Returns the 21 starts of the paper, `runs` times each (21 runs,), on a machine without disturbances."""
    flow, temperature = (
        a.ravel() for a in np.meshgrid(np.repeat(START_FLOWS, runs), START_TEMPERATURES, indexing="ij")
    )
    return nominal(flow, temperature, accuracy=accuracy)


def good_starts(flows: Sequence[float] | np.ndarray, runs: int) -> EpisodeConditions:
    """Returns starts at each of the flows (percent) and 210 °C, `runs` times each."""
    return nominal(np.repeat(flows, runs), BEST_TEMPERATURE, accuracy=1.0)


def evaluate(
    controller: SetpointController,
    parameters,
    windows: WindowSource,
    conditions: EpisodeConditions,
    key: jax.Array,
) -> RunScore:
    """Simulates independent runs and returns their score."""
    trajectory = rollout(controller, parameters, windows, conditions, key, steps=STEPS)
    return judge(np.asarray(trajectory.flow), np.asarray(trajectory.temperature))
