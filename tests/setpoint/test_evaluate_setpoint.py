"""The contest of the setpoint loop: chosen on some segments, told on others, with harm beside settling."""

import collections

import numpy as np
import pytest

from pipeline.setpoint.agents import baselines, trials
from pipeline.setpoint.agents.score import Outcomes
from pipeline.setpoint.controllers import CONTROLLERS, BuiltController, build_controllers
from pipeline.setpoint.evaluation import contest as contests
from pipeline.setpoint.evaluation import judging, scoreboard
from pipeline.setpoint.evaluation.contest import Contest
from pipeline.setpoint.evaluation.judging import DefaultChoice
from pipeline.setpoint.evaluation.pixel_rollouts import PixelRollouts
from pipeline.setpoint.settings import EvaluateSetpoint
from pipeline.setpoint.tables import SCOREBOARD
from pipeline.store import artifacts, params
from stages import evaluate_setpoint
from tests.setpoint.synthetic import synthetic_table

NO_PIXELS = PixelRollouts({}, None, ())
CLOGGED = "recorded, sticky, half clog"
SIMPLE = ("do nothing", "filtered proportional", "sequential test")
ROWS = [row for row in CONTROLLERS if row.name in SIMPLE]


@pytest.fixture(scope="module")
def settings(root) -> EvaluateSetpoint:
    declared = params.load(EvaluateSetpoint, "evaluate_setpoint", root / params.FILE)
    return declared.model_copy(update={"runs": 1, "redraws": 3, "rounds": 2})


def limits_of(settings: EvaluateSetpoint) -> dict[str, float]:
    harmed = settings.most_harmed
    return contests.harm_limits(perfect=harmed.perfect_percent, in_band=harmed.in_band_percent)


def test_harm_is_barred_from_good_starts_with_the_camera_right_stuck_or_blind(settings):
    limits = limits_of(settings)
    assert limits == {"perfect": 1.0, "in band": 2.0, "in band, stuck 30": 2.0, "in band, blind 30": 2.0}


def test_what_is_told_is_of_other_segments_and_the_default_s_harm_stands_by_case(settings, tmp_path):
    specs = build_controllers(settings.baselines, None, None, ROWS)
    groups = dict.fromkeys(SIMPLE, "baseline")
    choose, judge = (synthetic_table(np.random.default_rng(k), segments=6, windows=2) for k in (1, 2))
    choice = evaluate_setpoint.choose_default(specs, choose, settings)
    contest = evaluate_setpoint.simulate_contest(specs, judge, settings, choice.name)
    assert contest.redraws == {name: 6 if name == choice.name else 3 for name in SIMPLE}
    told = contests.with_figures(choice, contest)
    check_margin(told, contest)
    board = scoreboard.scoreboard(groups, contest, NO_PIXELS)
    artifacts.write_table(tmp_path / "scoreboard.parquet", SCOREBOARD, board)
    figures = scoreboard.metrics(groups, contest, told, NO_PIXELS)
    assert figures["default"] == choice.name
    assert set(figures["cases"]) == {case for case in contest.scores[choice.name] if judging.counts(case)}
    for case, shares in figures["cases"].items():
        assert 0 <= shares["low"] <= shares["stay"] <= shares["high"] <= 100, case
    assert figures["worst"] == min(shares["stay"] for shares in figures["cases"].values())
    assert {"recovered", "recovery_steps", "back_within_15"} <= set(
        figures["cases"]["recorded, sticky, half clog"]
    )
    assert len(figures["harm"]) == 12
    for case, shares in figures["harm"].items():
        assert shares["beyond_10"] >= shares["beyond_15"] >= shares["beyond_25"] >= 0, case
        assert shares["beyond_25_low"] <= shares["beyond_25"] <= shares["beyond_25_high"]
    idle = figures["do nothing"]["harm"]
    assert {share for case in idle.values() for share in case.values()} == {0.0}
    # another camera misleads whoever follows it, and nobody else
    followed = figures["filtered proportional"]["harm"]["in band, another camera"]
    assert followed["beyond_10"] > 20


def test_where_nothing_else_may_run_the_choice_is_written_without_a_margin(tmp_path):
    alone = judging.DefaultChoice(
        "do nothing", 0.0, "accuracy 1", *3 * (float("nan"),), {"ours": "harms"}, "Alone."
    )
    artifacts.write_json(tmp_path / "choice.json", scoreboard.choice_record(alone))
    read = artifacts.read_json(tmp_path / "choice.json")
    assert [read[name] for name in ("margin", "margin_low", "margin_high")] == [None] * 3
    assert (read["name"], read["worst"], read["refused"]) == ("do nothing", 0.0, {"ours": "harms"})


def check_margin(told, contest):
    """By hand, of the redraws that both ran on: value and interval are of the same segments."""
    worst = {
        name: min(((runs.mean(), case) for case, runs in of.kept.items()), key=lambda one: one[0])
        for name, of in contest.judged.items()
        if name not in told.refused
    }
    rival = max((name for name in worst if name != told.name), key=lambda name: worst[name][0])
    ours, theirs = (contest.judged[name].kept[worst[name][1]][:3] for name in (told.name, rival))
    assert told.case == worst[told.name][1]
    assert told.margin == pytest.approx(100 * (ours.mean() - theirs.mean()))
    assert told.margin_low <= told.margin <= told.margin_high


def test_the_number_of_cores_changes_nothing_and_the_runs_drawn_are_among_those_judged(settings, monkeypatch):
    specs = build_controllers(settings.baselines, None, None, ROWS)
    groups = dict.fromkeys(SIMPLE, "baseline")
    table = synthetic_table(np.random.default_rng(2), segments=6, windows=2)
    several = settings.model_copy(update={"runs": 2, "redraws": 2, "rounds": 1})
    both = []
    for cores in (1, 3):
        monkeypatch.setattr(evaluate_setpoint.os, "cpu_count", lambda cores=cores: cores)
        both.append(evaluate_setpoint.simulate_contest(specs, table, several, "do nothing"))
    one, three = both
    assert list(one.scores) == list(three.scores) == list(specs)
    rows = [scoreboard.scoreboard(groups, contest, NO_PIXELS) for contest in both]
    np.testing.assert_equal(*rows)
    choice = judging.DefaultChoice("sequential test", 0.0, CLOGGED, *3 * (0.0,), {}, "")
    columns = scoreboard.paths(groups, one, choice, NO_PIXELS)
    np.testing.assert_equal(columns, scoreboard.paths(groups, three, choice, NO_PIXELS))
    check_the_case_that_decides(columns, one)
    for name in SIMPLE:
        drawn = one.paths[name]["accuracy 0.7"]
        assert set(drawn.flow[:, 0]) == set(trials.START_FLOWS)
        starts = trials.starts(1, accuracy=0.7)
        np.testing.assert_array_equal(drawn.flow[:, 0], starts.flow)
        np.testing.assert_array_equal(drawn.temperature[:, 0], starts.temperature)
    assert (np.ptp(one.paths["do nothing"]["recorded, fresh"].flow, axis=1) < 1e-3).all()
    assert np.ptp(one.paths["sequential test"]["recorded, fresh"].flow, axis=1).max() > 50


def check_the_case_that_decides(columns, contest):
    """Beside 100 decisions of two cases, all 200 of the choice's: what is left alone shows when it clogs, and
    how much gets through."""
    rows = {name: np.asarray(column) for name, column in columns.items()}
    decides = rows["case"] == CLOGGED
    assert (~decides).sum() == len(SIMPLE) * 2 * 21 * 101
    assert set(rows["case"][~decides]) == {"accuracy 0.7", "recorded, fresh"}
    assert (rows["step"][~decides].max(), rows["step"][decides].max()) == (100, 200)
    assert set(rows["simulator"][decides]) == {"recorded"}
    assert list(dict.fromkeys(rows["controller"][decides])) == list(SIMPLE)
    for name in SIMPLE:
        drawn = rows["flow_percent"][decides & (rows["controller"] == name)].reshape(21, 201)
        np.testing.assert_array_equal(drawn, contest.paths[name][CLOGGED].flow.astype(float))
        if name == "do nothing":
            np.testing.assert_allclose(drawn[:, :60], np.repeat(drawn[:, :1], 60, axis=1), rtol=1e-5)
            np.testing.assert_allclose(drawn[:, 60:], np.repeat(0.75 * drawn[:, :1], 141, axis=1), rtol=1e-5)
        else:
            assert (np.ptp(drawn[:, 60:], axis=1) > 5).any()


def test_a_case_that_decides_and_is_kept_of_everybody_is_kept_once_and_to_the_end(settings):
    """Runs are made up: every controller rests at 100 %."""
    groups = dict.fromkeys(SIMPLE, "baseline")
    rest = judging.Runs(np.full((21, 201), 100.0), np.full((21, 201), 210.0))
    kept = {name: dict.fromkeys(("accuracy 0.7", "recorded, fresh"), rest) for name in SIMPLE}
    contest = Contest({}, {name: judged(0.5) for name in SIMPLE}, {}, kept)
    choice = judging.DefaultChoice("do nothing", 0.0, "recorded, fresh", *3 * (0.0,), {}, "")
    columns = scoreboard.paths(groups, contest, choice, NO_PIXELS)
    assert len(columns["step"]) == len(SIMPLE) * 21 * (101 + 201)


def judged(share, worst="clog"):
    """So much of the runs is kept in the worst case, and all in another."""
    runs = np.arange(20) < 20 * share
    return judging.JudgedRuns({"other": np.ones((1, 20), bool), worst: runs[None]}, {})


def test_beside_the_default_stand_doing_nothing_the_strongest_rule_and_our_strongest_agent():
    kinds = {
        "do nothing": "baseline", "slow": "baseline", "quick": "baseline", "harmful": "baseline",
        "default": "baseline", "paper": "paper", "weak agent": "agent", "agent": "agent",
    }  # fmt: skip
    shares = dict(zip(kinds, (0.1, 0.4, 0.6, 0.9, 0.8, 0.7, 0.5, 0.6), strict=True))
    contest = Contest({}, {name: judged(share) for name, share in shares.items()}, {}, {})
    choice = judging.DefaultChoice("default", 80.0, "clog", *3 * (0.0,), {"harmful": "harms"}, "")
    who = scoreboard.compared(kinds, contest, choice)
    assert who == ["do nothing", "quick", "default", "agent"]
    # where no other rule may run, the strongest of those stands there
    choice = choice._replace(refused={"harmful": "harms", "quick": "harms", "slow": "harms"})
    assert scoreboard.compared(kinds, contest, choice) == ["do nothing", "harmful", "default", "agent"]


def test_who_cannot_win_any_more_runs_in_one_round_only(settings, monkeypatch):
    """Runs are made up: of 21 from wrong starts, so many are kept; "nearly" loses one run of a round."""
    kept = {"do nothing": 0, "slow": 5, "good": 20, "better": 21, "nearly": 21}
    specs = {name: BuiltController("baseline", baselines.nothing(), name) for name in kept}
    asked = collections.Counter()

    def runs(controller, name, case, part, keys):
        asked[name] += 1
        n = 21 * len(keys)
        stay = np.tile(np.arange(21) < kept[name], len(keys))
        stay[0] &= name != "nearly"
        empty = dict.fromkeys(Outcomes._fields, np.zeros(n))
        return Outcomes(**empty | {"stay": stay, "beyond": np.zeros((n, 3), bool)})

    monkeypatch.setattr(judging, "runs", runs)
    for made_of_runs in ("become", "first_of_each"):
        monkeypatch.setattr(judging, made_of_runs, lambda of: of)
    table = synthetic_table(np.random.default_rng(1), segments=2, windows=1)
    longer = settings.model_copy(update={"redraws": 8, "rounds": 3})
    choice = evaluate_setpoint.choose_default(specs, table, longer)
    cases = 13 + len(limits_of(longer))
    # the runs are paired: one lost in each of eight redraws is told at once, one in one of them never
    once = dict.fromkeys(("do nothing", "slow", "good"), cases)
    assert asked == once | dict.fromkeys(("better", "nearly"), 3 * cases)
    assert isinstance(choice, DefaultChoice)
    assert choice.name == "better"


def test_the_table_is_in_the_order_of_simplicity():
    names = [row.name for row in CONTROLLERS]
    order = ("do nothing", "filtered proportional", "sequential test", "Bayes, robust", "our agent")
    assert [name for name in names if name in order] == list(order)
