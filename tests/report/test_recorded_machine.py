"""The pages of a user's machine, taken from recordings: nothing is of the study, which papers.html
shows, and what is the machine's own is there."""

import re
import sys
from pathlib import Path

import pytest
import yaml

from pipeline import cli
from pipeline.store import artifacts
from pipeline.verdict.decide import trust_first
from pipeline.verdict.verdict import FAILED, OPEN, PASSED, Verdict
from tests.report.made import main
from tests.report.test_pages import IDENTIFICATION, INDEX, TEMPERATURE, Page, change, figures

OF_THE_STUDY = (
    "As published",
    "counted once",
    "better after tuning",
    "random starts",
    "15,000 samples",
    "The study’s objective",
    "read seconds as steps",
)


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


def test_nothing_of_the_study_stands_on_the_page_of_a_users_machine(recorded):
    main()
    text = TEMPERATURE.read_text()
    assert [said for said in OF_THE_STUDY if said.lower() in text.lower()] == []


def test_zones_of_a_users_machine_have_its_names(recorded):
    main()
    assert "zone_1 is off" in TEMPERATURE.read_text()
    assert not re.search(r"zone 1\b", TEMPERATURE.read_text())


def test_words_of_a_recorded_machine_speak_of_a_trial_and_of_a_simulated_one_of_a_simulation(project):
    main()
    assert "Pass (simulation): subspace + LQG." in Page(INDEX).text
    declare("generate_probing", source="recordings")
    main()
    text = Page(TEMPERATURE).text
    assert "(simulation)" not in text
    assert (
        "Not ready for a supervised trial." in text or "Ready for a supervised trial: subspace + LQG." in text
    )


def test_outputs_without_low_and_high_leave_the_rule_open_and_it_does_not_pass(recorded):
    machine = yaml.safe_load(Path("params.yaml").read_text())["plant"]
    for output in machine["outputs"]:
        del output["low"], output["high"]
    declare("plant", **machine)
    main()
    text = Page(TEMPERATURE).text
    assert "First undecided rule: crossings." in text or "Do not trust this model." in text
    assert "low and high of zone_1, zone_2 are not declared" in text or "trust" in text
    assert figures()["verdict"]["winner"] is None


def test_the_next_experiment_stands_beside_its_limits_or_says_why_there_is_none(recorded):
    main()
    text = Page(IDENTIFICATION).text
    assert "zone_1 100 88.0 to 118 0 to 140" in text and "stay beside it" in text
    assert "Nothing is written to add to a running controller: PI needs an input" in text
    figures = artifacts.read_figures("generate_probing")
    reason = "without its controller zone_1 may reach 266 degC within 400 s"
    figures["next_experiment"] = {"written": False, "reason": reason}
    artifacts.write_metrics("generate_probing", figures)
    main()
    text = Page(IDENTIFICATION).text
    assert "No experiment is written: without its controller zone_1 may reach 266 °C within 400 s." in text
    assert "stay beside it" not in text


def test_prints_without_their_gcode_are_the_next_step(recorded):
    machine = yaml.safe_load(Path("params.yaml").read_text())["plant"]
    for output in machine["outputs"]:
        del output["low"], output["high"]
    declare("plant", **machine)
    change("ingest", findings__recording={"printed_file": 2})
    main()
    said = "without them part fan and filament feed of two prints are not recorded. ./run beadline init"
    assert f"{said} klippy.log --copy --force" in Page(INDEX).text
    change("ingest", findings={})
    main()
    assert "Record the next experiment." in Page(INDEX).text


def test_a_run_is_not_compared_with_the_accepted_run_of_another_machine(recorded, monkeypatch):
    main()
    monkeypatch.setattr(sys, "argv", ["beadline", "accept"])
    cli.main()
    change("evaluate_temperature", contestants__subspace_lqg__overshoot__q90=4.0)
    main()
    assert "The accepted run is of another machine" not in Page(INDEX).text
    run = artifacts.read_json("reports/accepted.json")
    run["params"]["plant"]["outputs"][0]["name"] = "bed"
    artifacts.write_json("reports/accepted.json", run)
    main()
    text = Page(INDEX).text
    assert "The accepted run is of another machine: nothing to compare." in text
    assert not re.search(r"figures moved|parameters? changed|· (better|worse)", text)


def test_a_figure_without_bound_is_a_word_on_every_page(recorded):
    huge = dict.fromkeys(("median", "q90", "low", "high", "worst"), 637429062676764819456.0)
    change("evaluate_temperature", contestants__pi__overshoot=huge, contestants__pi__cost=huge)
    compared = artifacts.read_figures("evaluate_temperature")
    compared["contestants"]["pi"]["gap"] |= {"median_percent": 5e24, "q90_percent": 5e24}
    artifacts.write_metrics("evaluate_temperature", compared)
    main()
    assert "off the scale" in Page(TEMPERATURE).text
    for path in (INDEX, TEMPERATURE):
        assert "637,429" not in Page(path).text and "10²⁴" not in Page(path).text


def model(decision, state):
    return Verdict(
        "identification", state, decision, "First failed rule: ahead.", "It predicts badly.",
        "Record longer.", "Ahead", None,
    )  # fmt: skip


@pytest.mark.parametrize("state", [PASSED, FAILED, OPEN])
def test_a_model_that_nobody_may_trust_comes_before_the_figures_judged_on_it(state):
    judged = Verdict("temperature", state, "Ready.", "Limits.", "632 s to settle.", "Keep.", "", "baseline")
    judged_again = trust_first(judged, model("Do not trust this model.", FAILED))
    assert judged_again.lead == "Do not trust this model." and judged_again.reason.endswith(
        "It predicts badly."
    )
    assert judged_again.remedy.startswith("Record longer.")
    assert judged_again.state == (OPEN if state == PASSED else state)
    assert (judged_again.winner is None) == (state == PASSED)  # nothing is ready by figures of such a model


def test_a_model_that_is_good_for_something_leaves_the_verdict_as_it_is():
    judged = Verdict("temperature", FAILED, "No.", "Limits.", "632 s.", "Keep.", "limits", None)
    assert trust_first(judged, model("Trust this model to simulate.", FAILED)) == judged
