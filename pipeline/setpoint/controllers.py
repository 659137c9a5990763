"""The table of controllers of the setpoint loop, simplest first. If two are equally good within noise, the
first becomes the default. Pages and verdicts read names and kinds here; importing this needs no jax.

To add a controller, write a file in pipeline/setpoint/agents/ with a function `build`, add its row to
CONTROLLERS, and a section of settings to `settings.Baselines` if it has any.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

if TYPE_CHECKING:
    from pipeline.setpoint.agents.agent import PublishedAgent
    from pipeline.setpoint.settings import Baselines
    from pipeline.setpoint.simulation.recorded import WindowTable
    from pipeline.setpoint.simulation.simulator import SetpointController

Kind = Literal["model-based", "data-driven", "baseline"]


class ControllerRow(NamedTuple):
    name: str  # as it stands in artifacts and on pages
    kind: Kind
    build: str  # "file.function" of pipeline/setpoint/agents: settings, agents, windows -> what is built
    settings: str = ""  # the section of evaluate_setpoint.baselines that it is built with


class BuiltController(NamedTuple):
    controller: "SetpointController"
    parameters: Any  # a pytree of numbers or arrays


NO_CONTROL = "do nothing"
CONTROLLERS = (
    ControllerRow(NO_CONTROL, "baseline", "baselines.build_no_control"),
    ControllerRow("sequential test", "baseline", "baselines.build_sequential_test", "sequential_test"),
    ControllerRow("Bayes filter", "model-based", "flow_filter.build", "flow_filter"),
    ControllerRow("paper's agent", "data-driven", "agent.build"),
)
KINDS: dict[str, Kind] = {row.name: row.kind for row in CONTROLLERS}


def of_kind(kind: Kind) -> str:
    """Returns the name of the first controller of a kind. The comparison "model-based or data-driven?" uses
    one of each."""
    return next(row.name for row in CONTROLLERS if row.kind == kind)


def build_controllers(
    settings: "Baselines | None",
    agents: "PublishedAgent | None",
    windows: "WindowTable | None",
    rows: Sequence[ControllerRow] = CONTROLLERS,
) -> dict[str, BuiltController]:
    """Returns the controllers of these rows by name, in the table's order. Numbers are float32, so that all
    controllers of one kind share one compiled program."""
    import importlib

    import jax
    import jax.numpy as jnp

    built = {}
    for row in rows:
        file, function = row.build.split(".")
        build = getattr(importlib.import_module(f"pipeline.setpoint.agents.{file}"), function)
        section = getattr(settings, row.settings).model_dump() if row.settings else {}
        controller, parameters = build(section, agents, windows)
        parameters = jax.tree.map(lambda number: jnp.asarray(number, dtype=jnp.float32), parameters)
        built[row.name] = BuiltController(controller, parameters)
    return built
