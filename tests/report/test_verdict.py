"""Rules and figures -> verdict: each state, in the words of the design."""

import math

import pytest

from pipeline.report.deposition.verdict import verdict as deposition
from pipeline.report.identification.model import trust
from pipeline.report.setpoint.verdict import verdict as setpoint
from pipeline.report.shared.verdict import (
    FAILED,
    OPEN,
    PASSED,
    UNDECIDED,
    Figure,
    Missing,
    Question,
    ReportRules,
    Rule,
    Verdict,
    deciding,
    overall,
    share,
    state,
)
from pipeline.report.temperature.judgement import judgement
from pipeline.report.temperature.verdict import decide, questions, undecided, winner
from pipeline.store import params
from stages import report

RULES = ReportRules(
    gap_percent=5.0,
    settled_error_degC=0.5,
    settling_s=60.0,
    overshoot_degC=5.0,
    at_limits_percent=10.0,
    disk_margin=0.4,
    delay_margin_s=1.0,
    worst_case_gap_percent=50.0,
    flow_error_percent=6.0,
    line_volume_percent=3.0,
    above_whole_points=1.0,
    learned_percent=20.0,
    settled_percent=97.0,
    stay_percent=90.0,
    image_accuracy=0.78,
    window_accuracy=0.90,
    ece_image=0.025,
    ece_window=0.04,
)
ASKED = questions(RULES, band_degC=1.0)
BY_KEY = {question.key: question for question in ASKED}


def answers(**changed):
    """A controller that passes every rule, with some figures changed."""
    good = {
        "gap_percent": Figure(0.42, 0.31, 0.58),
        "settled_error_degC": Figure(0.31, 0.26, 0.37, note="zone 4"),
        "settling_s": Figure(9.0, 8.0, 10.0),
        "overshoot_degC": Figure(0.9, 0.7, 1.2),
        "at_limits_percent": Figure(6.1, 4.8, 7.9),
        "disk": Figure(0.46, 0.43, 0.49),
        "delay_s": Figure(3.1, 2.8, 3.3),
        "worst_case_gap_percent": Figure(2.8, 2.3, 3.4),
        "data": Figure(1.24, 1.24, 1.24, note="2,000 of 1,610"),
    }
    return good | changed


def roles(data_driven=None, model_based=None, baseline=None):
    return {
        "data_driven": data_driven or answers(),
        "model_based": model_based or answers(),
        "baseline": baseline or answers(),
    }


@pytest.mark.parametrize(
    ("key", "figure", "expected"),
    [
        ("gap_percent", Figure(4.0, 3.0, 5.0), PASSED),
        ("gap_percent", Figure(4.9, 4.0, 5.1), UNDECIDED),
        ("gap_percent", Figure(7.0, 5.1, 9.0), FAILED),
        ("disk", Figure(0.5, 0.4, 0.5), PASSED),
        ("disk", Figure(0.5, 0.39, 0.5), UNDECIDED),
        ("disk", Figure(0.3, 0.2, 0.39), FAILED),
        ("settling_s", Figure(math.inf, math.inf, math.inf), FAILED),
        ("delay_s", Figure(math.inf, math.inf, math.inf), PASSED),
        ("gap_percent", Missing("not measured", "no run"), OPEN),
        ("gap_percent", Missing("failed", "it broke"), FAILED),
    ],
)
def test_a_band_inside_passes_outside_fails_and_one_that_straddles_is_undecided(key, figure, expected):
    assert state(BY_KEY[key], figure) == expected


def rule(name: str, figure: Figure | Missing) -> Rule:
    return Rule(name, Question(0, "", name, "%", 5.0, False, name), figure)


def test_one_engine_for_every_loop_the_first_rule_of_the_gravest_state_decides():
    passed, failed = rule("passed", Figure(1.0, 1.0, 1.0)), rule("failed", Figure(9.0, 8.0, 10.0))
    unsure, unmeasured = (
        rule("unsure", Figure(5.0, 4.0, 6.0)),
        rule("unmeasured", Missing("not measured", "")),
    )
    assert [one.state for one in (passed, failed, unsure, unmeasured)] == [PASSED, FAILED, UNDECIDED, OPEN]
    assert deciding([passed, unmeasured, unsure, failed, rule("later", failed.figure)]).name == "failed"
    assert deciding([passed, unmeasured, unsure]).name == "unsure"
    assert deciding([passed]) is None
    # what is undecided holds a loop up as what was not measured does, and fails it as little
    assert overall([PASSED]) == PASSED
    assert overall([PASSED, UNDECIDED]) == OPEN
    assert overall([OPEN, FAILED]) == FAILED


def test_the_verdict_of_every_loop_has_the_same_fields(project, monkeypatch):
    caught = []
    monkeypatch.setattr(report, "judgement", lambda sources: caught.append(sources) or judgement(sources))
    report.main()
    sources = caught[0]
    verdicts = [judgement(sources).verdict, deposition(sources), setpoint(sources), trust(sources)]
    assert [one.loop for one in verdicts] == ["temperature", "deposition", "setpoint", "identification"]
    assert {type(one) for one in verdicts} == {Verdict}
    for one in verdicts:
        assert one.rules and {type(rule) for line in one.rules for rule in line} == {Rule}
        assert (one.rule == "") == (one.state == PASSED) or one.loop == "identification"
        assert one.rule in {"", *(line[0].name for line in one.rules)}


def test_share_of_the_allowance_is_inverted_where_more_is_better():
    assert share(BY_KEY["gap_percent"], 2.5) == 0.5
    assert share(BY_KEY["disk"], 0.8) == 0.5
    assert share(BY_KEY["disk"], 0.0) == math.inf
    assert share(BY_KEY["delay_s"], math.inf) == 0.0


def test_failed_names_the_first_failed_rule_its_figure_and_what_to_run_instead():
    worse = answers(
        settled_error_degC=Figure(0.72, 0.61, 0.84, note="zone 4"),
        worst_case_gap_percent=Figure(90.0, 80.0, 99.0),
    )
    verdict = decide("temperature", ASKED, roles(data_driven=worse))
    assert verdict.state == FAILED
    assert verdict.decision == "Do not deploy the data\u2011driven temperature controller."
    assert verdict.lead == "First failed rule: settled error."
    assert verdict.reason == "Zone 4 settles 0.72\u202f°C from its reference; the rule allows 0.50\u202f°C."
    assert verdict.remedy == "Keep the model-based controller: it passes every rule measured so far."


def test_passed_says_so_with_what_is_closest_to_its_limit_and_never_counts_drift_as_passed():
    verdict = decide("temperature", ASKED, roles(model_based=answers(gap_percent=Figure(9.0, 8.0, 10.0))))
    assert verdict.state == PASSED
    assert verdict.decision == "Deploy the data\u2011driven temperature controller."
    assert verdict.lead == "It passes every rule measured so far."
    assert verdict.remedy.startswith(
        "Closest to its limit: disk margin, 0.46 of at least 0.40 (model-based: 0.46). "
        "Drift is not measured. The nightly job measures it and has not run."
    )
    assert verdict.reason == "Model-based fails on gap."


def test_open_says_what_is_missing_and_how_much_more_of_it():
    short_record = answers(data=Figure(0.43, 0.43, 0.43, note="700 of 1,610 samples; record 910 more."))
    undecided_data = decide("temperature", ASKED, roles(data_driven=short_record))
    assert (undecided_data.state, undecided_data.lead) == (FAILED, "First failed rule: data sufficiency.")
    assert undecided_data.reason == "700 of 1,610 samples; record 910 more."
    unmeasured = decide(
        "temperature",
        ASKED,
        roles(
            data_driven=answers(gap_percent=Missing("not measured", "The scorecard is not there", "Run it"))
        ),
    )
    assert (unmeasured.state, unmeasured.decision) == (OPEN, "Do not decide yet.")
    assert unmeasured.reason == "The scorecard is not there. Run it."
    assert unmeasured.remedy.startswith("Until then keep the model-based controller")


def test_where_no_controller_passes_it_says_so_and_names_the_first_rule_of_each():
    bad = answers(gap_percent=Figure(9.0, 8.0, 10.0))
    verdict = decide("temperature", ASKED, roles(bad, bad, answers(disk=Figure(0.1, 0.1, 0.1))))
    assert verdict.winner is None
    assert (
        "No controller passes: the model-based one fails on gap, the baseline one fails on limits."
        in verdict.remedy
    )


def test_the_winner_has_the_smallest_settled_error_and_within_noise_the_smallest_gap():
    assert winner(ASKED, roles(baseline=answers(settled_error_degC=Figure(0.1, 0.09, 0.11)))) == "baseline"
    assert winner(ASKED, roles(model_based=answers(gap_percent=Figure(0.1, 0.09, 0.11)))) == "model_based"
    noisier_gap = answers(gap_percent=Figure(0.4, 0.3, 0.5), worst_case_gap_percent=Figure(26.0, 25.0, 27.0))
    assert winner(ASKED, roles(model_based=noisier_gap, baseline=noisier_gap)) == "data_driven"
    assert (
        winner(
            ASKED,
            roles(
                data_driven=answers(gap_percent=Figure(9.0, 8.0, 10.0)),
                model_based=answers(disk=Figure(0.1, 0.1, 0.1)),
            ),
        )
        == "baseline"
    )


def test_where_the_better_controller_is_the_other_one_the_verdict_deploys_that():
    verdict = decide(
        "temperature", ASKED, roles(model_based=answers(settled_error_degC=Figure(0.1, 0.09, 0.11)))
    )
    assert verdict.decision == "Deploy the model\u2011based temperature controller."
    assert (
        verdict.reason
        == "Data-driven passes too; the settled error decides: 0.10\u202f°C against 0.31\u202f°C."
    )


def test_an_undecided_figure_says_how_many_more_runs_would_decide():
    runs = (1.0,) * 21 + (9.0,) * 3
    said = undecided(BY_KEY["gap_percent"], Figure(1.0, 1.0, 9.0, runs))
    # share outside p = 1/8, allowed 1/20: 1.645^2 p (1 - p) / (p - 1/20)^2 = 52.6, so 53 - 24 = 29
    assert said.endswith("3 of 24 runs lie outside; 29 more runs would decide.")
    many = undecided(BY_KEY["gap_percent"], Figure(9.0, 1.0, 9.0, (1.0,) * 10 + (9.0,) * 14))
    assert many.endswith("14 of 24 runs lie outside, and more runs would not change that.")


def test_the_rules_are_read_from_params_with_bounds(tmp_path):
    (tmp_path / "params.yaml").write_text("report: {gap_percent: -1}\n")
    with pytest.raises(ValueError, match=r"report.gap_percent is -1 but must be more than 0"):
        params.load(ReportRules, "report", tmp_path / "params.yaml")
