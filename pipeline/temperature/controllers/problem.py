"""The problem from which every controller is designed, and the result, a design."""

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
    """The information from which a controller may be designed.

    `plant`: identified, with feed-through as a delay; `family`: its spread; `window`: learned from the
    record. `kernel` and `trajectories` are None if the record does not determine them; `undetermined` then
    gives the reason, by controller. `truth` is None if the true plant is unknown. `printer_pid` is empty if
    no recording contains the PID of a printer. `gamma`: discount; `exact_tau`: tau of the paper's observer;
    `horizon`: steps; `noise` (p,): °C.
    """

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
        """°C^2 per percent^2: the square of the largest effect per step of the strongest input on the median
        output. It scales an effort weight."""
        strongest = np.abs(markov_parameters(self.plant, min(self.horizon, 50))).max(axis=(0, 2))
        return float(max(np.median(strongest), 1e-6)) ** 2


class Design(NamedTuple):
    """A controller's law, and the plant on which its steady inputs are computed. `plain` designs the same
    controller without integrator at weights of one; it is None if the controller has no weights. `governed`:
    the governor limits it. `holds`: no control."""

    law: Law
    model: Plant
    plain: Callable[[], Law] | None = None
    governed: bool = True
    holds: bool = False


def weights(problem: DesignProblem, values: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """Returns diag(Q) = 1 and diag(R) = effort_weight; only their ratio matters."""
    return np.ones(problem.plant.p), np.full(problem.plant.m, values["effort_weight"])


def unit_weights(problem: DesignProblem) -> tuple[np.ndarray, np.ndarray, float]:
    """Returns diag(Q) = 1, diag(R) = 1 and integral 0: the weights of the common cost, without integrator."""
    return np.ones(problem.plant.p), np.ones(problem.plant.m), 0.0
