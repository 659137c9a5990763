"""A contestant that the pages do not know yet, one that is refused, and marks."""

import re

import pytest

from pipeline.report.shared.page import MARKS
from pipeline.store import artifacts
from pipeline.temperature.controllers.table import CONTROLLERS as CONTESTANTS
from tests.report import made
from tests.report.made import main
from tests.report.test_pages import TEMPERATURE, Page


def test_no_two_contestants_have_the_same_mark():
    """Where it fails there are fewer free shapes than contestants without a mark: add one to SHAPES of
    pipeline/report/shared/page.py."""
    marks = [(MARKS[contestant.name], contestant.hollow) for contestant in CONTESTANTS]
    assert len(set(marks)) == len(marks)


def test_a_contestant_that_the_pages_do_not_know_stands_in_the_scorecard_under_its_own_name(
    project, monkeypatch
):
    monkeypatch.setattr(made, "CONTESTANTS", (*made.CONTESTANTS[:-1], "fuzzy", "exact_model"))
    made.write(project)
    main()
    heads = re.findall(
        r'<th scope="col"><span class="mk [^>]*></span>([^<]+)<small>', TEMPERATURE.read_text()
    )
    assert heads[-2:] == ["fuzzy", "Exact model"] and len(heads) == 9


@pytest.fixture
def refused(project):
    why = "PI needs an input for each of the 5 outputs; found 3 inputs"
    compared = artifacts.read_figures("evaluate_temperature")
    del compared["contestants"]["pi"]
    artifacts.write_metrics("evaluate_temperature", compared | {"refused": {"pi": why}})
    main()
    return why


def test_a_refused_contestant_is_named_with_its_reason(refused):
    text = Page(TEMPERATURE).text
    assert f"PI, tuned is refused: {refused}." in text
    assert "dvc repro evaluate_temperature" not in TEMPERATURE.read_text()
