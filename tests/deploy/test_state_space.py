"""The exported linear systems are the law and the plant that run."""

import io
import json

import control
import numpy as np
import pytest
import scipy.io

from pipeline.deploy import state_space
from pipeline.temperature.controllers.law import RunningController
from pipeline.temperature.plant import hold_output, strictly_proper
from pipeline.temperature.test_set.scorecard import closed_loop
from tests.deploy.deployed_machines import exported

KINDS = ("lqg", "window", "pi", "printer_pid", "study")


STEP_DEGC = 1.0


def runs(of, step_degC: float) -> tuple[np.ndarray, np.ndarray]:
    """True outputs and inputs (T, .) of the law that runs, from rest, references higher by a step."""
    free = of.controller._replace(governor=None, integral_limit=1e9)
    model, running = strictly_proper(of.model), RunningController(free, of.model)
    low, high = (np.array([getattr(one, side) for one in of.machine.outputs]) for side in ("low", "high"))
    x, u0 = hold_output(model, low + 0.4 * (high - low))
    y0 = model.C @ x + model.d
    for _ in range(4000):
        running.watch(u0, y0, y0)
    running.hand_over(y0)
    y, u = [], []
    for t in range(200):
        y.append(model.C @ x + model.d)
        u.append(running.step(y[-1], y0 + step_degC * (t >= 20), t))
        x = model.A @ x + model.B @ u[-1] + model.b
    return np.array(y), np.array(u)


@pytest.mark.parametrize("kind", KINDS)
def test_the_loop_answers_a_step_as_what_runs_does(kind):
    of = exported(kind)
    loop = state_space.systems(of)["loop"]
    y, u = (a - b for a, b in zip(runs(of, STEP_DEGC), runs(of, 0.0), strict=True))
    r = np.tile(STEP_DEGC * (np.arange(200) >= 20), (len(of.machine.outputs), 1))
    answer = control.forced_response(loop, inputs=r, squeeze=False).outputs
    p = y.shape[1]
    assert answer[:p].T == pytest.approx(y, abs=1e-3)
    assert answer[p:].T == pytest.approx(u, abs=0.02)  # percent, as near as a target is found


@pytest.mark.parametrize("kind", KINDS)
def test_its_poles_are_those_that_the_certificate_judges(kind):
    of = exported(kind)
    ours = np.abs(state_space.systems(of)["loop"].poles()).max()
    judged = np.abs(np.linalg.eigvals(closed_loop(strictly_proper(of.model), of.controller.law))).max()
    assert ours == pytest.approx(judged, abs=1e-6)


def test_both_files_hold_the_same_and_are_the_same_each_time():
    of = exported()
    files = state_space.files(of)
    told = json.loads(files["systems.json"])
    read = scipy.io.loadmat(io.BytesIO(files["systems.mat"]), simplify_cells=True)
    for name in ("plant", "controller", "loop"):
        for key in "ABCD":
            assert np.array_equal(np.atleast_2d(read[name][key]), np.array(told["systems"][name][key]))
        assert list(read[name]["inputs"]) == told["systems"][name]["inputs"]
    assert told["systems"]["plant"]["outputs"] == ["sensor_1", "sensor_2"]
    assert read["Ts"] == told["sample_time_s"] == 1.0
    assert state_space.files(of) == files and b"Created on" not in files["systems.mat"]


def test_names_with_dots_are_written_with_underscores():
    of = exported()
    inputs = tuple(one._replace(name=f"extruder.pwm{k}") for k, one in enumerate(of.machine.inputs))
    files = state_space.files(of._replace(machine=of.machine._replace(inputs=inputs)))
    plant = json.loads(files["systems.json"])["systems"]["plant"]
    assert plant["inputs"] == ["extruder_pwm0", "extruder_pwm1"]
