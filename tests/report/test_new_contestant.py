"""A controller that is new in the table of contestants, on the page of the small project."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from pipeline.report.shared.page import MARKS as MARK
from pipeline.report.shared.page import SHAPES
from pipeline.store import artifacts
from pipeline.temperature.workflow.contestants import CONTESTANTS
from stages.report import main
from tests.report import made
from tests.report.test_pages import INDEX, TEMPERATURE, Page, change

# a process of its own, because the pages read the table when they are imported
ADDED = """
from pipeline.temperature.workflow import contestants
new = contestants.Contestant(
    "proportional", "Proportional", "P per zone", "The baseline without its integral.", None, "plant"
)
at = [contestant.name for contestant in contestants.CONTESTANTS].index("exact_model")
contestants.CONTESTANTS = (*contestants.CONTESTANTS[:at], new, *contestants.CONTESTANTS[at:])
from stages.report import main
main()
"""


def pages_with_the_new_one() -> None:
    root = Path(__file__).resolve().parents[2]
    subprocess.run(
        [sys.executable, "-c", ADDED], env=os.environ | {"PYTHONPATH": str(root)}, check=True, timeout=120
    )


def columns(text: str, section: str) -> list[str]:
    """Marks of a picture's columns, in their order."""
    part = re.split(rf'<div class="cols c\d {section}">', text)[1].split("</section>")[0]
    return re.findall(r'<h4><span class="mk ([a-z ]+)"', part)


# the shape after those of the table's controllers that stand before it and have no mark of their own
BEFORE = CONTESTANTS[: [contestant.name for contestant in CONTESTANTS].index("exact_model")]
FREE = list(SHAPES)[sum(not contestant.mark for contestant in BEFORE)]
MARKS = ["mb", "dd", "dd hollow", "bl", FREE, "mb hollow"]


def test_no_two_controllers_have_the_same_mark():
    """Where it fails there are fewer free shapes than controllers without a mark: add one to SHAPES of
    pipeline/report/shared/page.py."""
    marks = [(MARK[contestant.name], contestant.hollow) for contestant in CONTESTANTS]
    assert len(set(marks)) == len(marks)


@pytest.fixture
def with_sixth(project, monkeypatch):
    monkeypatch.setattr(made, "CONTROLLERS", (*made.CONTROLLERS, "proportional"))
    made.write(project)


def test_a_line_in_the_table_is_all_that_the_pages_ask_of_a_new_controller(with_sixth):
    pages_with_the_new_one()
    text = TEMPERATURE.read_text()
    heads = re.findall(r'<th scope="col"><span class="mk ([a-z ]+)"[^>]*></span><a class="term"', text)
    assert heads == MARKS
    for section in ("trajectories", "errors", "costs", "inputs", "tradeoff", "plants"):
        assert columns(text, section) == MARKS, section
    shown = Page(TEMPERATURE).text
    assert "Proportional. The baseline without its integral." in shown
    assert 'id="word-proportional"' in text
    # against the data-driven one by its cost; the small project has no tracking error to compare
    rows = re.findall(rf'<th scope="row"><span class="mk {FREE}"[^>]*></span>Proportional</th>', text)
    assert len(rows) == 1


def test_a_refused_controller_keeps_its_column_with_the_reason(project):
    metrics = artifacts.read_json("reports/metrics/evaluate_temperature.json")
    artifacts.write_metrics(
        "evaluate_temperature", metrics | {"refused": {"proportional": "no input moves zone 2"}}
    )
    pages_with_the_new_one()
    text = TEMPERATURE.read_text()
    assert columns(text, "trajectories") == MARKS
    assert text.count("no input moves zone 2") >= 2  # in the pictures, and in the table's titles


def test_a_refused_baseline_is_shown_as_failed_with_its_reason(project, monkeypatch):
    """With fewer inputs than outputs: the stage goes on without it, and no page advises to run it again."""
    monkeypatch.setattr(made, "CONTROLLERS", tuple(name for name in made.CONTROLLERS if name != "baseline"))
    made.write(project)
    why = "PI needs an input for each of the 5 outputs; found 3 inputs"
    change("evaluate_temperature", refused={"baseline": why})
    main()
    for path in (INDEX, TEMPERATURE):
        assert f"Failed. {why}." in Page(path).text, path
    assert f"Baseline could not be designed: {why}." in Page(INDEX).text
    assert columns(TEMPERATURE.read_text(), "trajectories") == ["mb", "dd", "dd hollow", "bl", "mb hollow"]
    assert "dvc repro evaluate_temperature" not in TEMPERATURE.read_text()


@pytest.mark.parametrize(
    ("without", "sentence"),
    [
        ([], ""),
        (["baseline"], "Baseline has no feed-forward of its own and aims at the feasible target {} too."),
        (
            ["baseline", "window"],
            "Data-driven and Baseline have no feed-forward of their own "
            "and aim at the feasible target {} too.",
        ),
    ],
)
def test_who_aims_at_the_feasible_target_unclipped_is_said_below_the_table_and_the_picture(
    project, without, sentence
):
    change("evaluate_temperature", without_feed_forward=without)
    main()
    text = Page(TEMPERATURE).text
    for where in ("there", "here"):
        if without:
            assert text.count(sentence.format(where)) == 1, where
    assert text.count("no feed-forward of") == 2 * bool(without)


@pytest.mark.parametrize(
    ("shares", "shown"),
    [
        ({}, "a step on errors up to"),
        ({"baseline": 0.004}, "a step (Baseline: its own) on errors up to"),
        ({"baseline": 0.004, "kernel": 0.0}, "a step (Kernel: none; Baseline: its own) on errors up to"),
    ],
)
def test_what_was_declared_names_the_laws_whose_integral_action_is_their_own(project, shares, shown):
    change("evaluate_temperature", own_integral=shares)
    main()
    assert shown in Page(TEMPERATURE).text
