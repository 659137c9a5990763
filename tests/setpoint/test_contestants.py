"""The table of contestants: a line of it is a controller that is built, judged and shown."""

import jax
import jax.numpy as jnp
import numpy as np

from pipeline.setpoint.agents import baselines, judging
from pipeline.setpoint.agents.agent import QNetwork
from pipeline.setpoint.simulation.simulator import paper_windows
from pipeline.setpoint.workflow.agent_files import Agents
from pipeline.setpoint.workflow.contestants import (
    CONTESTANTS,
    THROUGH_PIXELS,
    Contestant,
    Problem,
    controllers,
)
from pipeline.setpoint.workflow.settings import EvaluateSetpoint
from pipeline.store import params

# the table of windows, the agents and the settings are for those contestants that ask for them
NOTHING = Problem(settings=None, agents=None, windows=None)


def settings(root) -> EvaluateSetpoint:
    return params.load(EvaluateSetpoint, "evaluate_setpoint", root / params.FILE)


def test_a_new_controller_is_one_line_of_the_table_and_is_judged_like_the_others(root):
    """The twin of one in the table gets its score."""
    problem = NOTHING._replace(settings=settings(root).baselines)
    gain, time_constant = problem.settings.proportional.gain, problem.settings.proportional.time_constant
    line = Contestant(
        "twin", "baseline", lambda _: (baselines.proportional(), baselines.Proportional(gain, time_constant))
    )
    specs = controllers(problem, (*CONTESTANTS[1:3], line))
    assert list(specs) == ["proportional", "filtered proportional", "twin"]
    windows, conditions, key = paper_windows(), judging.starts(1, accuracy=0.7), jax.random.key(1)
    scores = {
        name: judging.evaluate(spec.controller, spec.parameters, windows, conditions, key)
        for name, spec in specs.items()
    }
    # as text, since a figure that there is none of is not equal to itself
    assert repr(scores["twin"]) == repr(scores["proportional"]) != repr(scores["filtered proportional"])


def test_numbers_of_a_baseline_are_float32_so_that_all_of_one_kind_share_what_is_compiled():
    whole, network = Contestant("whole", "baseline", lambda _: (None, (3, 2.5))), object()
    agent = Contestant("agent", "agent", lambda _: (None, network))
    specs = controllers(NOTHING, (whole, agent))
    assert [number.dtype for number in specs["whole"].parameters] == [jnp.float32, jnp.float32]
    np.testing.assert_array_equal(np.array(specs["whole"].parameters), [3, 2.5])
    assert specs["agent"].parameters is network


NETWORKS = tuple(QNetwork(jax.random.key(k), 12) for k in range(3))


def test_a_phase_that_was_not_trained_is_no_contestant():
    published = tuple(line for line in CONTESTANTS if line.kind == "paper")
    agents = Agents(li_2025=NETWORKS, belief=None, belief_dqn=None)
    specs = controllers(NOTHING._replace(agents=agents), published)
    assert [(name, spec.parameters) for name, spec in specs.items()] == [
        ("paper's agent, 3 phases", NETWORKS[2])
    ]
    # it sees as many former classes as it was trained with
    assert jax.tree.leaves(specs["paper's agent, 3 phases"].controller.start())[0].shape == (12,)


def test_the_names_of_the_table_are_distinct_and_those_shown_through_pixels_are_among_them():
    names = [line.name for line in CONTESTANTS]
    assert len(set(names)) == len(names)
    assert set(THROUGH_PIXELS) <= set(names)
