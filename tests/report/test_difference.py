"""This run against the accepted one: equal runs differ in nothing, one change is named where it is, and a
figure moves where its bands part."""

import re
import sys
from pathlib import Path

import pytest

from pipeline import cli
from pipeline.store import artifacts
from tests.report import made
from tests.report.made import main
from tests.report.test_pages import INDEX, RUNS, TEMPERATURE, Page, change

DEPOSITION = Path("reports/deposition.html")
SCORES = {
    "on_off": (100.0, None, 60.0),
    "priority": (12.0, 11.0, 9.0),
    "superposition": (8.0, 7.0, 4.0),
    "basis": (2.0, 2.5, 1.0),
    "ilc": (1.5, None, 0.5),
}


def compose(error):
    """The deposition loop's table and metrics with another error of the composer in use."""
    made.deposition(SCORES | {"basis": (error, 2.5, 1.0)})
    artifacts.write_metrics(
        "compose_parts", {"square": {"A": {"chosen": "basis", "basis": {"rms_percent_of_on_off": error}}}}
    )


@pytest.fixture
def accepted(project, monkeypatch):
    compose(2.0)
    main()
    monkeypatch.setattr(sys, "argv", ["beadline", "accept"])
    cli.main()
    main()
    return project


def test_two_equal_runs_give_an_empty_difference(accepted):
    text = Page(INDEX).text
    assert "Nothing changed; no figure moved." in text
    assert "All parameters are equal." in Page(RUNS).text and "unchanged" in Page(DEPOSITION).text


def test_who_was_chosen_is_accepted_shown_beside_the_others_and_decides_nothing(accepted):
    """The export reads no accepted run: if the pages did, the two would name different controllers."""
    run = artifacts.read_json("reports/accepted.json")
    assert run["winner"] == "subspace_lqg"
    # VARX + Riccati costs 2.1 (1.89 to 2.31), the best 2.0 (1.8 to 2.2)
    artifacts.write_json("reports/accepted.json", run | {"winner": "varx_riccati"})
    main()
    assert "Pass (simulation): subspace + LQG." in Page(TEMPERATURE).text
    assert "It was named before" not in Page(INDEX).text
    # the accepted one stands beside the pair
    assert "VARX + Riccati" in Page(INDEX).text


def test_a_changed_parameter_code_and_artifact_are_counted_and_the_parameter_is_named(accepted):
    Path("params.yaml").write_text(
        Path("params.yaml").read_text().replace(" disk_margin: 0.4", " disk_margin: 0.41", 1)
    )
    Path("stages/code.py").write_text("2\n")
    artifacts.write_json("datasets/tune_weights/weights.json", {"contestants": {"pi": {"cost": 3.0}}})
    main()
    counted = "No figure moved beyond its noise. Changed: one parameter, code, two artifacts."
    assert counted in Page(INDEX).text
    text = Page(RUNS).text
    assert counted in text and "report.disk_margin 0.4 0.41" in text


def test_a_figure_moves_where_its_band_leaves_the_accepted_one_and_only_there(accepted):
    change(
        "evaluate_temperature",
        contestants__subspace_lqg__overshoot=made.figure(0.85, 0.7, 1.0),
        contestants__subspace_lqg__settling=made.figure(9.0, 8.5, 9.5),
    )
    main()
    text = Page(INDEX).text
    # accepted overshoot 0.3 to 0.9: the bands overlap; settling 5 to 8: they do not
    assert re.search(r"1 of \d+ figures moved beyond their noise\.", text)
    assert re.search(r"Temperature: 1 of \w+ figures moved: settling \S+ s · worse", text)


def test_an_accepted_run_of_the_earlier_comparison_is_said_to_have_no_such_figures(accepted):
    run = artifacts.read_json("reports/accepted.json")
    run["figures"] = {"window": {"gap_percent": {"median": 1.0, "low": 0.9, "high": 1.1}}}
    artifacts.write_json("reports/accepted.json", run)
    main()
    text = Page(INDEX).text
    assert "Temperature: nothing to compare with." in text
    assert "Nothing changed" not in text and "figures moved" not in text


@pytest.mark.parametrize(
    ("error", "said", "moved"),
    [(2.3, "within noise", 0), (3.5, "+1.50 points · worse", 1), (1.0, "−1.00 points · better", 1)],
)
def test_a_flow_error_moves_by_more_than_half_a_point_and_stands_on_both_pages(accepted, error, said, moved):
    compose(error)
    main()
    assert said in Page(DEPOSITION).text
    text = Page(INDEX).text
    assert ("Deposition: 1 of one figure moved: flow error, square, A" in text) == bool(moved)


def test_a_run_whose_pages_are_older_than_its_figures_is_not_accepted(accepted, capsys):
    change("evaluate_temperature", contestants__subspace_lqg__settling=made.figure(2.0, 1.0, 3.0))
    with pytest.raises(SystemExit):
        cli.main()
    assert (
        "the pages are of another run than datasets/evaluate_temperature/figures.json; run ./run dvc repro"
        in capsys.readouterr().err
    )


def test_page_one_does_not_say_that_nothing_moved_where_a_figure_of_the_rival_did(accepted):
    change("evaluate_temperature", contestants__learned_kernel__settling=made.figure(9.0, 8.5, 9.5))
    main()
    text = Page(INDEX).text
    assert re.search(r"Temperature: 1 of \w+ figures moved: settling of the learned kernel ", text)
    assert "Nothing changed" not in text
