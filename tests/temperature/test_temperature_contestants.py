"""The table of contestants: names, roles, and who takes part."""

import numpy as np

from pipeline.temperature import window
from pipeline.temperature.kernel import regress, tuples
from pipeline.temperature.plant import baam
from pipeline.temperature.published import GAMMA, TAU
from pipeline.temperature.study import data_sets
from pipeline.temperature.workflow.contestants import CONTESTANTS, Problem, controllers
from pipeline.temperature.workflow.settings import EvaluateTemperature


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
        settings=EvaluateTemperature(seed=0, data_sets=1, report_noise_degC=0.1),
    )


def test_each_name_and_each_role_of_the_verdict_stands_once():
    names = [contestant.name for contestant in CONTESTANTS]
    roles = [contestant.role for contestant in CONTESTANTS if contestant.role]
    assert len(set(names)) == len(names)
    assert sorted(roles) == ["baseline", "data_driven", "model_based", "yardstick"]


def test_controllers_come_in_the_tables_order_by_the_tables_names():
    given = problem()
    assert [made.name for made in controllers(given)] == [contestant.name for contestant in CONTESTANTS]
    renamed = (CONTESTANTS[0]._replace(name="another"),)
    assert [made.name for made in controllers(given, renamed)] == ["another"]


def test_without_a_kernel_or_the_true_plant_the_others_go_on():
    without = problem()._replace(kernel=None, truth=None)
    assert [made.name for made in controllers(without)] == ["model_based", "window", "baseline"]
