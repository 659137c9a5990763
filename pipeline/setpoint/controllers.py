"""The table of controllers of the setpoint loop, in the order of simplicity: of two that are alike within
noise the first is the default. Pages and verdicts read names and kinds here; importing this needs no jax.

A new controller is a file in pipeline/setpoint/agents/ with a function `build`, its row in CONTROLLERS, and a
section of settings in `settings.Baselines` if it has any.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

if TYPE_CHECKING:
    from pipeline.setpoint.agents.files import Agents
    from pipeline.setpoint.settings import Baselines
    from pipeline.setpoint.simulation.recorded import WindowTable
    from pipeline.setpoint.simulation.simulator import SetpointController

Kind = Literal["model-based", "data-driven", "baseline", "reference"]


class ControllerRow(NamedTuple):
    name: str  # as it stands in artifacts and on pages
    kind: Kind
    group: Literal["agent", "baseline", "paper"]  # column `kind` of scoreboard.parquet, as first written
    build: str  # "file.function" of pipeline/setpoint/agents: settings, agents, windows -> what is built
    settings: str = ""  # the section of evaluate_setpoint.baselines that it is built with


class BuiltController(NamedTuple):
    group: str  # of its row
    controller: "SetpointController"
    parameters: Any  # a pytree of numbers or arrays


NO_CONTROL = "do nothing"
BELIEF_DQN = "our agent"
CONTROLLERS = (
    ControllerRow(NO_CONTROL, "baseline", "baseline", "baselines.build_no_control"),
    ControllerRow("proportional", "baseline", "baseline", "baselines.build_proportional", "proportional"),
    ControllerRow(
        "filtered proportional",
        "baseline",
        "baseline",
        "baselines.build_proportional",
        "filtered_proportional",
    ),
    ControllerRow(
        "sequential test", "baseline", "baseline", "baselines.build_sequential_test", "sequential_test"
    ),
    ControllerRow("Bayes, exact model", "reference", "baseline", "bayes.build_class_filter", "bayes_exact"),
    ControllerRow("Bayes with leak", "model-based", "baseline", "bayes.build_class_filter", "bayes_leak"),
    ControllerRow("Bayes, robust", "model-based", "baseline", "bayes.build_robust_filter", "bayes_robust"),
    ControllerRow("paper's agent, 3 phases", "data-driven", "paper", "agent.build_after_phase_3"),
    ControllerRow("paper's agent, 4 phases", "data-driven", "paper", "agent.build_after_phase_4"),
    ControllerRow(BELIEF_DQN, "data-driven", "agent", "belief_agent.build"),
)
KINDS: dict[str, Kind] = {row.name: row.kind for row in CONTROLLERS}

# the first of them that is not the default runs beside it through pixels
THROUGH_PIXELS = (BELIEF_DQN, "Bayes, robust")


def build_controllers(
    settings: "Baselines | None",
    agents: "Agents | None",
    windows: "WindowTable | None",
    rows: Sequence[ControllerRow] = CONTROLLERS,
) -> dict[str, BuiltController]:
    """The controllers of these rows by name, in the table's order, without those that cannot be built, such
    as a phase that was not trained. Numbers of a baseline are float32, so that all of one controller are one
    program."""
    import importlib

    import jax
    import jax.numpy as jnp

    built = {}
    for row in rows:
        file, function = row.build.split(".")
        build = getattr(importlib.import_module(f"pipeline.setpoint.agents.{file}"), function)
        section = getattr(settings, row.settings).model_dump() if row.settings else {}
        made = build(section, agents, windows)
        if made is None:
            continue
        controller, parameters = made
        if row.group == "baseline":
            parameters = jax.tree.map(lambda number: jnp.asarray(number, dtype=jnp.float32), parameters)
        built[row.name] = BuiltController(row.group, controller, parameters)
    return built
