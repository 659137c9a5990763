"""A new controller is one file and one row: it is tuned, compared and shown like those of the house."""

import numpy as np
import pytest

import pipeline.temperature.controllers
from pipeline.report.shared.page import MARKS
from pipeline.temperature.controllers import table
from pipeline.temperature.controllers.table import TemperatureController, TuningParameter, in_file
from tests.temperature.test_evaluate_temperature import judged, small, tuning_of

METHOD = '''
"""u = u_target + gain (C B)^+ (r - y): proportional, through the inverse of the first Markov parameter."""

import numpy as np

from pipeline.temperature.controllers.problem import Design
from pipeline.temperature.tracking import still_law


def design(problem, values):
    if len(problem.family) > 9:
        raise ValueError("it needs a family of at most 9 plants")
    plant = problem.plant
    law = still_law(plant.m, plant.p)
    K = values["gain"] * np.linalg.pinv(plant.C @ plant.B)
    return Design(law._replace(D=K, K_r=-K), plant)
'''
ROW = TemperatureController(
    "feedback",
    "Feedback",
    "output feedback",
    "The inverse of the first Markov parameter on the outputs.",
    in_file("feedback"),
    "model-based",
    (TuningParameter("gain", 1e-4, 1e-3, 1e-2),),
)


@pytest.fixture
def added(tmp_path, monkeypatch):
    (tmp_path / "feedback.py").write_text(METHOD)
    package = pipeline.temperature.controllers
    monkeypatch.setattr(package, "__path__", [*package.__path__, str(tmp_path)])
    monkeypatch.setattr(table, "CONTROLLERS", (*table.CONTROLLERS, ROW))
    monkeypatch.setitem(table.BY_NAME, ROW.name, ROW)


def test_one_file_and_one_row_are_tuned_and_compared_on_the_same_cases(added):
    given = small()
    tuned = tuning_of(given)
    assert tuned.weights["feedback"]["evaluations"] == 9
    compared = judged(given, {**given.weights, **tuned.weights})
    figures = compared.summary["contestants"]["feedback"]
    assert figures["tuned"] == {"gain": tuned.weights["feedback"]["gain"]}
    names = np.array(compared.cases["contestant"])
    assert (names == "feedback").sum() == (names == "hold").sum()
    assert compared.summary["order"][-1] == "feedback"


def test_one_that_the_machine_does_not_allow_is_named_with_its_reason(added):
    given = small()
    family = [given.problem.plant] * 10
    refused = judged(given._replace(problem=given.problem._replace(family=family))).summary["refused"]
    assert refused == {"feedback": "it needs a family of at most 9 plants"}


def test_every_row_has_a_kind_and_a_mark():
    kinds = {controller.name: controller.kind for controller in table.CONTROLLERS}
    house = {
        "hold": "baseline",
        "printer_pid": "baseline",
        "pi_simc": "baseline",
        "pi": "baseline",
        "subspace_lqg": "model-based",
        "varx_riccati": "model-based",
        "learned_kernel": "data-driven",
        "predictive_control": "data-driven",
        "exact_model": "reference",
    }
    assert kinds.items() >= house.items()
    assert set(kinds.values()) == {"baseline", "model-based", "data-driven", "reference"}
    assert set(MARKS) >= set(kinds)
