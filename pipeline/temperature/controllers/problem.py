"""What every controller is designed from, and what a design is."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pipeline.temperature.plant import markov_parameters

if TYPE_CHECKING:
    from pipeline.temperature.controllers.kernel import Regression
    from pipeline.temperature.controllers.law import ActuatorLimits
    from pipeline.temperature.controllers.predictive import Trajectories
    from pipeline.temperature.controllers.printer_pid import HeaterPid
    from pipeline.temperature.controllers.window import WindowModel
    from pipeline.temperature.plant import Plant
    from pipeline.temperature.tracking import Law


class DesignProblem(NamedTuple):
    """What a controller may be designed from.

    `plant` is identified, its feed-through a delay, `family` its spread, and `window` learned from the
    record. `kernel` and `trajectories` are None if the record does not determine them, and `undetermined`
    then says why, by controller. `truth` is None if nobody knows the plant, `printer_pid` empty if no
    recording holds the PID of a printer. `gamma` is the discount, `exact_tau` the paper's observer, `horizon`
    in steps, `noise` (p,) in °C."""

    plant: Plant
    family: list[Plant]
    window: WindowModel
    kernel: Regression | None
    truth: Plant | None
    limits: ActuatorLimits
    gamma: float
    exact_tau: float
    horizon: int
    noise: np.ndarray
    printer_pid: tuple[HeaterPid, ...] = ()
    trajectories: Trajectories | None = None
    undetermined: Mapping[str, str] = {}

    @property
    def effect(self) -> float:
        """°C^2 per percent^2 by which the strongest input of the median output moves it in a step: the scale
        of an effort weight."""
        strongest = np.abs(markov_parameters(self.plant, min(self.horizon, 50))).max(axis=(0, 2))
        return float(max(np.median(strongest), 1e-6)) ** 2


class Design(NamedTuple):
    """A controller's law, and the plant on which its steady inputs are computed. `plain` designs the same
    without integrator at the weights of the yardstick, and is None if weights mean nothing to it.
    `governed`: the governor watches it. `holds`: it does nothing."""

    law: Law
    model: Plant
    plain: Callable[[], Law] | None = None
    governed: bool = True
    holds: bool = False


def weights(problem: DesignProblem, values: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """diag(Q) = 1 and diag(R) = effort_weight: only their ratio acts."""
    return np.ones(problem.plant.p), np.full(problem.plant.m, values["effort_weight"])


def unit_weights(problem: DesignProblem) -> tuple[np.ndarray, np.ndarray, float]:
    """Q = I, R = I and no integrator: the weights of the yardstick."""
    return np.ones(problem.plant.p), np.ones(problem.plant.m), 0.0
