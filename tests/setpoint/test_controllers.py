"""The table of controllers: a row of it is a controller that is built, judged and shown."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np

from pipeline.setpoint.agents import baselines, trials
from pipeline.setpoint.agents.agent import QNetwork
from pipeline.setpoint.agents.files import Agents
from pipeline.setpoint.controllers import CONTROLLERS, KINDS, THROUGH_PIXELS, ControllerRow, build_controllers
from pipeline.setpoint.settings import Baselines, EvaluateSetpoint
from pipeline.setpoint.simulation.simulator import paper_windows
from pipeline.store import params


def settings(root) -> Baselines:
    return params.load(EvaluateSetpoint, "evaluate_setpoint", root / params.FILE).baselines


def test_a_new_controller_is_one_row_of_the_table_and_is_judged_like_the_others(root):
    """The twin of one in the table gets its score."""
    row = ControllerRow("twin", "baseline", "baseline", "baselines.build_proportional", "proportional")
    built = build_controllers(settings(root), None, None, (*CONTROLLERS[1:3], row))
    assert list(built) == ["proportional", "filtered proportional", "twin"]
    windows, conditions, key = paper_windows(), trials.starts(1, accuracy=0.7), jax.random.key(1)
    scores = {
        name: trials.evaluate(one.controller, one.parameters, windows, conditions, key)
        for name, one in built.items()
    }
    # as text, since a figure that there is none of is not equal to itself
    assert repr(scores["twin"]) == repr(scores["proportional"]) != repr(scores["filtered proportional"])


def test_numbers_of_a_baseline_are_float32_so_that_all_of_one_kind_share_what_is_compiled(monkeypatch):
    whole = ControllerRow("whole", "baseline", "baseline", "baselines.build_no_control")
    agent = ControllerRow("agent", "data-driven", "agent", "belief_agent.build")
    network = object()
    monkeypatch.setattr(baselines, "build_no_control", lambda *_: (None, (3, 2.5)))
    monkeypatch.setattr("pipeline.setpoint.agents.belief_agent.build", lambda *_: (None, network))
    built = build_controllers(None, None, None, (whole, agent))
    assert [number.dtype for number in built["whole"].parameters] == [jnp.float32, jnp.float32]
    np.testing.assert_array_equal(np.array(built["whole"].parameters), [3, 2.5])
    assert built["agent"].parameters is network


NETWORKS = tuple(QNetwork(jax.random.key(k), 12) for k in range(3))


def test_a_phase_that_was_not_trained_is_no_controller():
    published = tuple(row for row in CONTROLLERS if row.group == "paper")
    agents = Agents(li_2025=NETWORKS, belief=None, belief_dqn=None)
    built = build_controllers(None, agents, None, published)
    assert [(name, one.parameters) for name, one in built.items()] == [
        ("paper's agent, 3 phases", NETWORKS[2])
    ]
    # it sees as many former classes as it was trained with
    assert jax.tree.leaves(built["paper's agent, 3 phases"].controller.start())[0].shape == (12,)


def test_the_names_of_the_table_are_distinct_and_those_shown_through_pixels_are_among_them():
    assert len(KINDS) == len(CONTROLLERS)
    assert set(THROUGH_PIXELS) <= set(KINDS)
    assert set(KINDS.values()) == {"model-based", "data-driven", "baseline", "reference"}


def test_names_and_kinds_are_read_without_numerics(root):
    code = (
        "import sys; import pipeline.setpoint.controllers, pipeline.setpoint.published, "
        "pipeline.setpoint.agents.criteria; print(*{'jax', 'numpy', 'pydantic'} & {*sys.modules})"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""
