"""The table of contestants: names, roles, and who takes part."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.store import params
from pipeline.temperature import judging, window
from pipeline.temperature.kernel import regress, tuples
from pipeline.temperature.plant import Plant, baam
from pipeline.temperature.published import GAMMA, TAU
from pipeline.temperature.study import data_sets
from pipeline.temperature.tracking import model_based
from pipeline.temperature.workflow import evaluate_temperature
from pipeline.temperature.workflow.contestants import CONTESTANTS, Designed, Problem, controllers
from pipeline.temperature.workflow.settings import EvaluateTemperature, Panel, Tracking
from pipeline.temperature.workflow.settings import Plant as Machine

ROOT = Path(__file__).resolve().parents[2]


def names(several) -> list[str]:
    return [one.name for one in several]


def problem() -> Problem:
    u, y = data_sets(np.random.default_rng(7), 800, 1)
    u, y = [u[:, 0]], [y[:, 0]]
    return Problem(
        plant=baam(),
        window=window.learn(u, y, longest=4),
        kernel=regress(tuples(u, y, 2)),
        truth=baam(),
        limits=(np.zeros(7), np.full(7, 100.0)),
        gamma=GAMMA,
        observer_tau=TAU,
        exact_tau=TAU,
        horizon=300,
        settings=params.load(EvaluateTemperature, "evaluate_temperature", ROOT / "params.yaml"),
    )


def test_each_name_and_each_role_of_the_verdict_stands_once():
    roles = [contestant.role for contestant in CONTESTANTS if contestant.role]
    assert len(set(names(CONTESTANTS))) == len(CONTESTANTS)
    assert sorted(roles) == ["baseline", "data_driven", "model_based", "yardstick"]


def test_controllers_come_in_the_tables_order_by_the_tables_names():
    given = problem()
    # the study's machine is no printer
    assert names(controllers(given).controllers) == [n for n in names(CONTESTANTS) if n != "printer_pid"]
    assert controllers(given).refused == {}
    renamed = (CONTESTANTS[0]._replace(name="another"),)
    assert names(controllers(given, renamed).controllers) == ["another"]


def test_without_a_kernel_or_the_true_plant_the_others_go_on():
    without = controllers(problem()._replace(kernel=None, truth=None))
    assert names(without.controllers) == [
        name for name in names(CONTESTANTS) if name not in ("kernel", "printer_pid", "exact_model")
    ]
    assert without.refused == {}


def test_a_law_that_bears_no_outer_integrator_is_refused_before_it_is_judged():
    def design(q, r, integral):
        if integral:
            raise ValueError("no gain for an integrator")
        return plain.design(q, r, integral)

    plain = model_based(baam(), GAMMA, tau=TAU)
    stubborn = plain._replace(name="stubborn", design=design)
    weights = np.ones(5), np.ones(7)
    assert judging.refusals([plain, stubborn], [(*weights, 0.0)]) == {}
    assert judging.refusals([plain, stubborn], [(*weights, 0.0), (*weights, 0.02)]) == {
        "stubborn": "no gain for an integrator"
    }


# ---- the whole of the judging, on the study's machine with as many inputs as it is asked for


def learned(model: Plant, inputs: int) -> evaluate_temperature.Learned:
    """A record of the first `inputs` inputs alone, and what is learned from it."""
    u, _ = data_sets(np.random.default_rng(7), 800, 1)
    u, x, y = u[:, 0, :inputs], np.zeros(model.n), []
    for applied in u:
        y.append(model.C @ x)
        x = model.A @ x + model.B @ applied
    weights = {"q": np.ones(5), "r": np.ones(inputs), "observer_tau": np.array(TAU)}
    return evaluate_temperature.Learned(
        model, window.learn([u], [np.array(y)], longest=4), None, weights, [model]
    )


def judged(inputs: int) -> evaluate_temperature.Judged:
    file = ROOT / "params.yaml"
    settings, machine, tracking, panel = (
        params.load(section, name, file)
        for section, name in (
            (EvaluateTemperature, "evaluate_temperature"),
            (Machine, "plant"),
            (Tracking, "tracking"),
            (Panel, "panel"),
        )
    )
    half = panel.judging.model_copy(
        update={"starts_degC": [20.0], "reference_offsets_degC": [0.0], "seeds": [1]}
    )
    model = baam()._replace(B=baam().B[:, :inputs], D=baam().D[:, :inputs])
    return evaluate_temperature.judged(
        settings,
        machine.model_copy(update={"inputs": machine.inputs[:inputs]}),
        tracking,
        panel.model_copy(update={"noise_degC": [settings.report_noise_degC], "steps": 60, "judging": half}),
        learned(model, inputs),
        simulated=False,
    )


def test_with_three_inputs_for_five_outputs_the_baseline_is_refused_and_the_others_are_judged():
    few = judged(3)
    assert few.refused["baseline"] == "PI needs an input for each of the 5 outputs; found 3 inputs"
    assert {"model_based", "window"} <= few.summary["controllers"].keys()
    assert few.summary["controllers"].keys() == set(few.scorecard["controller"])
    assert few.summary["controllers"].keys().isdisjoint(few.refused)
    assert "baseline" not in few.without_feed_forward


def test_where_no_controller_can_be_designed_the_stage_says_so_with_each_reason(monkeypatch):
    monkeypatch.setattr(
        evaluate_temperature.contestants, "controllers", lambda _: Designed([], {"window": "too short"})
    )
    with pytest.raises(ValueError, match=r"found none: window: too short; record the machine longer"):
        judged(3)


def test_the_baseline_is_noted_as_without_feed_forward_and_with_integral_action_of_its_own():
    """Derived from the laws themselves, so that no page depends on a second list of them."""
    full = judged(7)
    assert full.refused == {}
    assert "baseline" in full.without_feed_forward
    assert 0 < full.own_integral["baseline"] < 1
    assert full.own_integral.keys().isdisjoint({"model_based", "window"})
    assert not {"model_based", "window"} & set(full.without_feed_forward)
