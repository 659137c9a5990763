"""Logs and plants from which the support of a controller is made: honest logs are those of the judging half
under this controller; plants drawn anew from the spread forecast."""

from collections.abc import Sequence

import numpy as np

from pipeline.deploy.replay import GaplessLog
from pipeline.deploy.supervise import Exported
from pipeline.temperature.controllers.law import ActuatorLimits, Plant
from pipeline.temperature.plant import padded
from pipeline.temperature.test_set import panel

FORECASTING, HONEST_LOGS = 24, 200  # plants, and logs at most


def forecasting_plants(
    family: Sequence[Plant], spread: panel.PlantSpread, rng: np.random.Generator
) -> list[Plant]:
    return padded(panel.drawn(family, FORECASTING, spread, cells=False, rng=rng))


def honest_logs(made: Exported, half: panel.Cases, limits: ActuatorLimits) -> list[GaplessLog]:
    """Logs of cases of the judging half under the controller as deployed, from the hold on."""
    aims = panel.aims(made.controller.law, panel.rests(made.model, half, limits), half)
    run, held = panel.rolled_out(made.controller, half, aims), panel.held_readings(half)[:-1]
    logs = []
    for case in np.unique(np.linspace(0, len(half.plant) - 1, HONEST_LOGS).astype(int)):
        still = np.ones((half.hold, 1))
        parts = (still * half.u0[case], run.u[:, case]), (held[:, case], run.measured[:, case]), (
            still * run.r[0, case], run.r[:, case],
        )  # fmt: skip
        logs.append(GaplessLog(*(np.concatenate(part) for part in parts)))
    return logs
