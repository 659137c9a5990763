"""A controller of the comparison as it is exported: with its safe mode, its supervisor and the machine it is
for."""

from collections.abc import Mapping, Sequence

import numpy as np

from pipeline.deploy import supervisor
from pipeline.deploy.machine import Exported, plants_sha256
from pipeline.deploy.signals import Machine
from pipeline.temperature.controllers.problem import Design
from pipeline.temperature.plant import Plant
from pipeline.temperature.test_set.panel import CaseConditions, deploy
from pipeline.temperature.test_set.scorecard import closed_loop

# what takes over if the law is left: the control that the machine has, or a PI in its place
OWN_CONTROL = ("printer_pid", "pi", "pi_simc")


def own_control(designs: Mapping[str, Design]) -> Design | None:
    """The first of OWN_CONTROL that holds its model stable; without one the heaters go off."""
    for name in OWN_CONTROL:
        if name in designs:
            loop = closed_loop(designs[name].model, designs[name].law)
            if np.abs(np.linalg.eigvals(loop)).max() < 1:
                return designs[name]
    return None


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
