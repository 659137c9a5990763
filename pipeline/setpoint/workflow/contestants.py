"""The table of contestants: every controller of the setpoint comparison, in the order of simplicity: of two
that are alike within noise the first runs by default.

A new controller is its own file in pipeline/setpoint/, its line in CONTESTANTS, and its settings. The stage
builds from this table; the pages take name and kind from the scoreboard, and rank by it.
"""

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax.tree_util import Partial

from pipeline.setpoint.agents import agent, baselines, bayes, belief_agent, judging
from pipeline.setpoint.simulation.recorded import WindowTable
from pipeline.setpoint.simulation.simulator import Controller
from pipeline.setpoint.workflow.agent_files import Agents
from pipeline.setpoint.workflow.settings import Baselines


class Problem(NamedTuple):
    """What a controller may be made from: its settings, the trained agents, and the evidence of recorded
    windows."""

    settings: Baselines
    agents: Agents
    windows: WindowTable


class Contestant(NamedTuple):
    """A controller of the comparison. `kind` is "baseline" for what learns no policy.

    `make` gives the controller with its parameters, a pytree of numbers or arrays. It gives None where there
    is none, such as a phase that was not trained.
    """

    name: str
    kind: Literal["agent", "baseline", "paper"]
    make: Callable[[Problem], tuple[Controller, Any] | None]


class ControllerSpec(NamedTuple):
    """A controller with its parameters; kind is that of its contestant."""

    kind: str
    controller: Controller
    parameters: Any


def _strange(of: bayes.Filter, network: Any, memory: Any) -> jax.Array:
    return bayes.strange(of, memory)


@cache  # one controller for all phases, so that what was compiled for it is found again
def _published(history: int) -> Controller:
    return agent.greedy(agent.paper_encoder(history))


def _after_phase(number: int) -> Callable[[Problem], tuple[Controller, Any] | None]:
    """The agent of Li and Pattinson (2025) after so many of its phases."""

    def made(problem: Problem) -> tuple[Controller, Any] | None:
        if number > len(problem.agents.li_2025):
            return None
        network = problem.agents.li_2025[number - 1]
        return _published(agent.history_of(network)), network

    return made


CONTESTANTS = (
    Contestant(judging.DOES_NOTHING, "baseline", lambda problem: (baselines.nothing(), ())),
    Contestant(
        "proportional",
        "baseline",
        lambda problem: (
            baselines.proportional(),
            baselines.Proportional(**problem.settings.proportional.model_dump()),
        ),
    ),
    Contestant(
        "filtered proportional",
        "baseline",
        lambda problem: (
            baselines.proportional(),
            baselines.Proportional(**problem.settings.filtered_proportional.model_dump()),
        ),
    ),
    Contestant(
        "sequential test",
        "baseline",
        lambda problem: (
            baselines.sequential_test(),
            baselines.SequentialTest(**problem.settings.sequential_test.model_dump()),
        ),
    ),
    Contestant(
        "Bayes, exact model",
        "baseline",
        lambda problem: (bayes.bayes(1), bayes.class_filter(**problem.settings.bayes_exact.model_dump())),
    ),
    Contestant(
        "Bayes with leak",
        "baseline",
        lambda problem: (bayes.bayes(1), bayes.class_filter(**problem.settings.bayes_leak.model_dump())),
    ),
    Contestant(
        "Bayes, robust",
        "baseline",
        lambda problem: (
            bayes.bayes(problem.settings.bayes_robust.hypotheses()),
            bayes.watching_filter(
                problem.windows, bayes.CameraErrorModel(**problem.settings.bayes_robust.model_dump())
            ),
        ),
    ),
    Contestant("paper's agent, 3 phases", "paper", _after_phase(3)),
    Contestant("paper's agent, 4 phases", "paper", _after_phase(4)),
    Contestant(
        "our agent",
        "agent",
        lambda problem: (
            agent.greedy(belief_agent.belief_encoder(problem.agents.belief))._replace(
                strange=Partial(_strange, problem.agents.belief.filter)
            ),
            problem.agents.belief_dqn,
        ),
    ),
)

# the first of them that is not the default runs beside it through pixels
THROUGH_PIXELS = ("our agent", "Bayes, robust")


def controllers(
    problem: Problem, contestants: Sequence[Contestant] = CONTESTANTS
) -> dict[str, ControllerSpec]:
    """The controllers that there are by name, in the table's order; numbers of a baseline are float32."""
    specs = {}
    for contestant in contestants:
        made = contestant.make(problem)
        if made is None:
            continue
        controller, parameters = made
        if contestant.kind == "baseline":
            parameters = jax.tree.map(lambda number: jnp.asarray(number, dtype=jnp.float32), parameters)
        specs[contestant.name] = ControllerSpec(contestant.kind, controller, parameters)
    return specs
