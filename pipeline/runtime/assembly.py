"""A controller of the comparison as it is exported: with its safe mode, its supervisor and the machine it is
for."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.runtime import supervisor
from pipeline.runtime.bands import GainRoute
from pipeline.runtime.machine import Exported, plants_sha256
from pipeline.runtime.signals import Machine
from pipeline.temperature.controllers.problem import Design, DesignProblem
from pipeline.temperature.plant import Plant
from pipeline.temperature.test_set.cases import CaseConditions, deploy


def assemble(
    name: str,
    design: Design,
    fallback: Design | None,
    machine: Machine,
    setting: CaseConditions,
    family: Sequence[Plant],
    *,
    simulated: bool,
) -> Exported:
    """The controller as it was judged. `fallback` is the safe mode "own"; None: the heaters go off. `family`
    is the identified plant, then its spread."""
    return Exported(
        name,
        machine,
        deploy(design, setting),
        design.model,
        deploy(fallback, setting) if fallback else None,
        supervisor.supervision(design.model, machine, setting.rehearsal.noise),
        simulated,
        plants_sha256(family[:1]),
        plants_sha256(family[1:]),
    )


def gain_route(problem: DesignProblem, learned_from: str, values: Mapping[str, Any]) -> GainRoute | None:
    """How the gains of a controller were learned from the record; None if they are those of a model. `values`
    are its tuned parameters."""
    if learned_from != "window" and learned_from != "kernel":
        return None
    learned = problem.window if learned_from == "window" else problem.kernel
    if learned is None:
        return None
    effort = np.full(problem.plant.m, float(values["effort_weight"]))
    return GainRoute(learned_from, learned.N, np.ones(problem.plant.p), effort, problem.gamma)
