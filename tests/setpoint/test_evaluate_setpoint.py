"""The stage that judges controllers: chosen on some segments, told on others, with harm beside settling."""

import numpy as np
import pytest

from pipeline.setpoint.agents import trials
from pipeline.setpoint.controllers import CONTROLLERS, build_controllers
from pipeline.setpoint.evaluation import judging, scoreboard
from pipeline.setpoint.evaluation.pixel_rollouts import PixelRollouts
from pipeline.setpoint.settings import EvaluateSetpoint
from pipeline.setpoint.tables import SCOREBOARD
from pipeline.store import artifacts, params
from stages import evaluate_setpoint
from tests.setpoint.test_flow_filter import camera

NO_PIXELS = PixelRollouts({}, None, ())
CLOGGED = "recorded, sticky, half clog"
ROWS = [row for row in CONTROLLERS if row.kind != "data-driven"]
NAMES = ["do nothing", "sequential test", "Bayes filter"]


@pytest.fixture(scope="module")
def settings(root) -> EvaluateSetpoint:
    declared = params.load(EvaluateSetpoint, "evaluate_setpoint", root / params.FILE)
    return declared.model_copy(update={"runs": 1})


@pytest.fixture(scope="module")
def controllers(settings):
    return build_controllers(settings.baselines, None, camera(), ROWS)


@pytest.fixture(scope="module")
def segments():
    """Pools to choose on, and others to judge on."""
    return judging.pools([camera(seed=6), camera(seed=7)], 100)


@pytest.fixture(scope="module")
def judged(controllers, segments, settings):
    return evaluate_setpoint.simulate(controllers, segments[1], settings, stream=1)


def test_the_default_is_chosen_on_segments_of_its_own_and_told_on_others(
    controllers, segments, judged, settings, tmp_path
):
    choice = evaluate_setpoint.choose_default(controllers, segments[0], settings)
    assert choice.name == "Bayes filter" and "sequential test" in choice.refused
    outcomes, paths = judged
    contest = scoreboard.Contest(scoreboard.scores(outcomes, 3), paths)
    board = scoreboard.scoreboard(contest, NO_PIXELS)
    artifacts.write_table(tmp_path / "scoreboard.parquet", SCOREBOARD, board)
    assert set(board["kind"]) == {"baseline", "model-based"}
    pair = judging.compare(outcomes, 3, segments=300)
    assert pair == {"a": "Bayes filter", "b": "paper's agent", "cases": 0, "segments": 300}
    figures = scoreboard.metrics(contest, choice, pair, NO_PIXELS)
    assert figures["default"] == choice.name and figures["pair"] == pair
    assert set(figures["cases"]) == {case for case in outcomes[choice.name] if judging.counts(case)}
    for case, shares in figures["cases"].items():
        assert 0 <= shares["low"] <= shares["stay"] <= shares["high"] <= 100, case
        assert 1 <= shares["n_eff"] <= shares["runs"] == 63
    assert {"recovered", "recovery_p95_steps", "back_within_15"} <= set(figures["cases"][CLOGGED])
    assert len(figures["harm"]) == 3
    for case, shares in figures["harm"].items():
        assert shares["beyond_10"] >= shares["beyond_15"] >= shares["beyond_25"] >= 0, case
        assert shares["beyond_25_low"] <= shares["beyond_25"] <= shares["beyond_25_high"]
    idle = figures["do nothing"]["harm"]
    assert {share for case in idle.values() for share in case.values()} == {0.0}
    # another camera misleads whoever follows it, and nobody else
    assert figures["sequential test"]["harm"]["in band, another camera"]["beyond_10"] > 20


def test_the_number_of_cores_changes_nothing(controllers, segments, judged, settings, monkeypatch):
    monkeypatch.setattr(evaluate_setpoint.os, "cpu_count", lambda: 1)
    outcomes, paths = evaluate_setpoint.simulate(controllers, segments[1], settings, stream=1)
    assert list(outcomes) == list(judged[0]) == NAMES
    for name in NAMES:
        np.testing.assert_equal(scoreboard.scores(outcomes, 3)[name], scoreboard.scores(judged[0], 3)[name])
        for case, kept in paths[name].items():
            np.testing.assert_array_equal(kept.flow, judged[1][name][case].flow)


def test_the_runs_drawn_are_the_first_from_each_start_and_whole_where_the_case_decides(judged):
    contest = scoreboard.Contest({}, judged[1])
    choice = judging.DefaultChoice("Bayes filter", 0.0, CLOGGED, {}, "")
    rows = {name: np.asarray(column) for name, column in scoreboard.paths(contest, choice, NO_PIXELS).items()}
    decides = rows["case"] == CLOGGED
    assert (~decides).sum() == len(NAMES) * 2 * 21 * 101
    assert set(rows["case"][~decides]) == {"accuracy 0.7", "recorded, sticky"}
    assert (rows["step"][~decides].max(), rows["step"][decides].max()) == (100, 200)
    assert list(dict.fromkeys(rows["controller"][decides])) == NAMES
    starts = trials.starts(1, accuracy=0.7)
    for name in NAMES:
        drawn = rows["flow_percent"][decides & (rows["controller"] == name)].reshape(21, 201)
        np.testing.assert_array_equal(drawn[:, 0], starts.flow)
        np.testing.assert_array_equal(drawn, judged[1][name][CLOGGED].flow.astype(float))
        if name == "do nothing":
            np.testing.assert_allclose(drawn[:, :60], np.repeat(drawn[:, :1], 60, axis=1), rtol=1e-5)
            np.testing.assert_allclose(drawn[:, 60:], np.repeat(0.75 * drawn[:, :1], 141, axis=1), rtol=1e-5)
        else:
            assert (np.ptp(drawn[:, 60:], axis=1) > 5).any()
    # a case that decides and is kept of everybody is kept once and to the end
    choice = choice._replace(case="recorded, sticky")
    columns = scoreboard.paths(contest, choice, NO_PIXELS)
    assert len(columns["step"]) == len(NAMES) * 21 * (101 + 201)


def test_the_table_is_in_the_order_of_simplicity():
    assert [row.name for row in CONTROLLERS] == [*NAMES, "paper's agent"]
