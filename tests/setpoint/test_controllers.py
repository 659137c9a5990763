"""The table of controllers: a row of it is a controller that is built, judged and shown."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np

from pipeline.setpoint.agents import baselines, trials
from pipeline.setpoint.agents.agent import PublishedAgent, QNetwork
from pipeline.setpoint.controllers import CONTROLLERS, KINDS, ControllerRow, build_controllers, of_kind
from pipeline.setpoint.settings import Baselines, EvaluateSetpoint
from pipeline.setpoint.simulation.simulator import paper_windows
from pipeline.store import params


def settings(root) -> Baselines:
    return params.load(EvaluateSetpoint, "evaluate_setpoint", root / params.FILE).baselines


def test_a_new_controller_is_one_row_of_the_table_and_is_judged_like_the_others(root):
    """The twin of one in the table gets its score."""
    row = ControllerRow("twin", "baseline", "baselines.build_sequential_test", "sequential_test")
    built = build_controllers(settings(root), None, None, (*CONTROLLERS[:2], row))
    assert list(built) == ["do nothing", "sequential test", "twin"]
    windows, conditions, key = paper_windows(), trials.starts(1, accuracy=0.7), jax.random.key(1)
    scores = {
        name: trials.evaluate(one.controller, one.parameters, windows, conditions, key)
        for name, one in built.items()
    }
    # as text, since a figure that there is none of is not equal to itself
    assert repr(scores["twin"]) == repr(scores["sequential test"]) != repr(scores["do nothing"])


def test_numbers_are_float32_so_that_all_of_one_kind_share_what_is_compiled(monkeypatch):
    whole = ControllerRow("whole", "baseline", "baselines.build_no_control")
    monkeypatch.setattr(baselines, "build_no_control", lambda *_: (None, (3, 2.5)))
    built = build_controllers(None, None, None, (whole,))
    assert [number.dtype for number in built["whole"].parameters] == [jnp.float32, jnp.float32]
    np.testing.assert_array_equal(np.array(built["whole"].parameters), [3, 2.5])


def test_the_paper_s_agent_is_that_of_its_last_phase_and_sees_as_many_classes_as_it_was_trained_with():
    networks = tuple(QNetwork(jax.random.key(k), 12) for k in range(3))
    rows = tuple(row for row in CONTROLLERS if row.kind == "data-driven")
    (built,) = build_controllers(None, PublishedAgent(networks, ()), None, rows).values()
    np.testing.assert_array_equal(built.parameters.heads.weight, networks[2].heads.weight)
    assert jax.tree.leaves(built.controller.start())[0].shape == (12,)


def test_the_names_of_the_table_are_distinct_and_the_pair_is_one_of_each_kind():
    assert len(KINDS) == len(CONTROLLERS)
    assert set(KINDS.values()) == {"model-based", "data-driven", "baseline"}
    assert [KINDS[of_kind(kind)] for kind in ("model-based", "data-driven")] == ["model-based", "data-driven"]


def test_names_and_kinds_are_read_without_numerics(root):
    code = (
        "import sys; import pipeline.setpoint.controllers, pipeline.setpoint.published, "
        "pipeline.setpoint.agents.criteria; print(*{'jax', 'numpy', 'pydantic'} & {*sys.modules})"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""
