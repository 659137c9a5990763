"""The pages of a user's machine, taken from recordings: what is of the study is not on them, and what is the
machine's own is."""

import re
import sys
from pathlib import Path

import pytest
import yaml

from pipeline import cli
from pipeline.report.shared.verdict import FAILED, OPEN, PASSED, Verdict
from pipeline.report.temperature.judgement import trust_first
from pipeline.store import artifacts
from stages.report import main
from tests.report.test_pages import IDENTIFICATION, INDEX, TEMPERATURE, Page, change

OF_THE_STUDY = ("As published", "counted once", "better after tuning", "read seconds as steps")


def declare(section, **values):
    """Keys of a section of the small project's parameters."""
    path = Path("params.yaml")
    sections = yaml.safe_load(path.read_text())
    sections[section] |= values
    path.write_text(yaml.safe_dump(sections))


@pytest.fixture
def recorded(project):
    declare("generate_probing", source="recordings")
    return project


def test_text_of_the_study_is_on_the_pages_of_its_machine_alone(project):
    main()
    simulated = Page(TEMPERATURE).text
    declare("generate_probing", source="recordings")
    main()
    own = Page(TEMPERATURE).text
    assert all(text.lower() in simulated.lower() for text in OF_THE_STUDY)
    assert not [text for text in OF_THE_STUDY if text.lower() in own.lower()]


def test_zones_of_a_users_machine_have_its_names(recorded):
    main()
    assert "Worst settled zone error zone_2" in Page(INDEX).text
    assert "zone_1: 101" in Page(TEMPERATURE).text
    assert not re.search(r"zone 1\b", TEMPERATURE.read_text())


def test_the_designed_probing_is_the_next_experiment_and_not_the_record(recorded):
    main()
    text = Page(TEMPERATURE).text
    assert "What the next experiment would excite" in text and "not what was recorded" in text
    assert "what was applied is what is recorded" not in text


def test_the_next_experiment_stands_beside_its_limits_or_says_why_there_is_none(recorded):
    main()
    text = Page(IDENTIFICATION).text
    assert "zone_1 100 88.0 to 118 0 to 140" in text and "stay beside it" in text
    assert "Nothing is written to add to a running controller: PI needs an input" in text
    assert "What the next experiment would excite" in Page(TEMPERATURE).text
    figures = artifacts.read_metrics("generate_probing")
    reason = "without its controller zone_1 may reach 266 degC within 400 s"
    figures["next_experiment"] = {"written": False, "reason": reason}
    artifacts.write_metrics("generate_probing", figures)
    main()
    text = Page(IDENTIFICATION).text
    assert "No experiment is written: without its controller zone_1 may reach 266 °C within 400 s." in text
    assert "stay beside it" not in text
    assert f"Not written: {reason}" in Page(TEMPERATURE).text


def test_pictures_of_a_users_machine_last_one_and_a_half_times_its_slowest_settling(recorded):
    main()  # 1.5 times 6 s are 9 s, of which 10 s is the next readable number
    assert "over the first 10 s as deployed" in Page(TEMPERATURE).text
    assert "true error over 10 s" in Page(INDEX).text
    change("evaluate_temperature", controllers__window__settling_s__median=1000.0)
    main()  # of a run of 60 steps of 1 s
    assert "over the first 60 s as deployed" in Page(TEMPERATURE).text


def test_pictures_of_the_studys_machine_keep_their_length(project):
    change("evaluate_temperature", controllers__window__settling_s__median=1000.0)
    main()
    assert "over the first 40 s as deployed" in Page(TEMPERATURE).text


def test_a_run_is_not_compared_with_the_accepted_run_of_another_machine(recorded, monkeypatch):
    main()
    monkeypatch.setattr(sys, "argv", ["beadline", "accept"])
    cli.main()
    change("evaluate_temperature", controllers__window__overshoot_degC__median=4.0)
    main()
    assert "The accepted run is of another machine" not in Page(INDEX).text
    run = artifacts.read_json("reports/accepted.json")
    run["params"]["plant"]["outputs"][0]["name"] = "bed"
    artifacts.write_json("reports/accepted.json", run)
    main()
    text = Page(INDEX).text
    assert "The accepted run is of another machine: nothing to compare." in text
    assert not re.search(r"figures moved|parameters? changed|· (better|worse)", text)


def test_card_and_table_say_the_same_of_a_kernel_without_figures(recorded):
    change("evaluate_temperature", refused={"kernel": "the kernel has no minimum in u"})
    figures = artifacts.read_metrics("evaluate_temperature")
    del figures["controllers"]["kernel"]
    artifacts.write_metrics("evaluate_temperature", figures)
    main()
    assert "kernel failed: the kernel has no minimum in u" in Page(INDEX).text
    assert "kernel: not measured" not in Page(INDEX).text


def test_a_gap_without_bound_is_a_word_on_every_page(recorded):
    huge = dict.fromkeys(("median", "low", "high"), 637429062676764819456.0)
    change("evaluate_temperature", controllers__window__gap_percent=huge)
    main()
    for path in (INDEX, TEMPERATURE):
        assert "beyond 1,000 %" in Page(path).text and "637,429" not in Page(path).text


def model(decision, state):
    return Verdict(
        "identification", state, decision, "First failed rule: ahead.", "It predicts badly.",
        "Record longer.", "Ahead", None,
    )  # fmt: skip


@pytest.mark.parametrize("state", [PASSED, FAILED, OPEN])
def test_a_model_that_nobody_may_trust_comes_before_the_figures_judged_on_it(state):
    judged = Verdict(
        "temperature", state, "Deploy it.", "Limits.", "632 s to settle.", "Keep.", "", "baseline"
    )
    judged_again = trust_first(judged, model("Do not trust this model.", FAILED))
    assert judged_again.lead == "Do not trust this model." and judged_again.reason.endswith(
        "It predicts badly."
    )
    assert judged_again.remedy.startswith("Record longer.")
    assert judged_again.state == (OPEN if state == PASSED else state)
    assert (judged_again.winner is None) == (
        state == PASSED
    )  # nothing is deployed by figures of such a model


def test_a_model_that_is_good_for_something_leaves_the_verdict_as_it_is():
    judged = Verdict("temperature", FAILED, "No.", "Limits.", "632 s.", "Keep.", "limits", None)
    assert trust_first(judged, model("Trust this model to simulate.", FAILED)) == judged
