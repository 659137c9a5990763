"""A controller under its supervisor on healthy machines of the test set, and on one whose heater is weak."""

import numpy as np
import pytest

from pipeline.deploy import assembly
from pipeline.temperature.controllers.problem import Design
from pipeline.temperature.plant import Plant
from pipeline.temperature.test_set import panel
from pipeline.temperature.tracking import still_law
from tests.deploy.test_supervisor import MODEL, R, exported


def asked(*plants: Plant) -> panel.Cases:
    """Set-point changes of 5 °C, and a door, a fan and another room at the reference."""
    questions = panel.Questions(np.array([R - 60, R - 5]), R[None], None, None, np.array([R - 5, R, R - 3]))
    late = [panel.delayed(one, late=False) for one in plants]
    return panel.asked(late, questions, noise=np.full(2, 0.1), seed=3, steps=600, hold=30, cells=False)


def test_what_runs_on_healthy_machines_is_the_law():
    """One of each structure: a slow wall, radiation, a sensor and a duty in steps."""
    cases = asked(MODEL, MODEL, MODEL, MODEL)
    found = assembly.play(exported(), cases)
    assert found == {"cases": 8, "left": 0, "percent": 0.0, "why": "", "plant": None}


def test_a_machine_that_lacks_half_of_a_heater_is_left_and_the_reason_said():
    weak = MODEL._replace(B=MODEL.B * [0.3, 1.0])
    found = assembly.play(exported(), asked(MODEL, weak))
    assert found["left"] > 0 and found["percent"] > 0
    assert found["plant"] == 1 and "heater_1" in found["why"]


def test_what_takes_over_is_the_first_control_that_holds_its_model():
    made = exported()
    stable = Design(made.controller.law, MODEL)
    unstable = Design(made.controller.law, MODEL._replace(B=-MODEL.B))
    assert assembly.own_control({"pi_simc": stable}) is stable
    assert assembly.own_control({"pi_simc": stable, "pi": unstable}) is stable
    assert assembly.own_control({"printer_pid": unstable, "pi": stable, "pi_simc": unstable}) is stable
    assert assembly.own_control({"pi": unstable, "hold": Design(still_law(2, 2), MODEL)}) is None


@pytest.mark.parametrize("kinds", [("disturbed",), assembly.KINDS])
def test_some_cases_of_some_plants_are_those_cases(kinds):
    cases = asked(MODEL, MODEL, MODEL)
    few = panel.some(cases, kinds, 2)
    assert (few.each, len(few.plants), len(few.plant)) == (len(kinds), 2, 2 * len(kinds))
    keep = np.isin(cases.kind, kinds) & (cases.plant < 2)
    np.testing.assert_array_equal(few.x0, cases.x0[keep])
    np.testing.assert_array_equal(few.outside, cases.outside[:, keep])
