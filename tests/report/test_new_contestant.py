"""A controller that is new in the table of contestants, on the page of the small project."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from pipeline.store import artifacts
from tests.report import made
from tests.report.test_pages import TEMPERATURE, Page

# a process of its own, because the pages read the table when they are imported
ADDED = """
from pipeline.temperature.workflow import contestants
new = contestants.Contestant(
    "proportional", "Proportional", "P per zone", "The baseline without its integral.", None, "plant"
)
contestants.CONTESTANTS = (*contestants.CONTESTANTS[:-1], new, contestants.CONTESTANTS[-1])
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
    part = text.split(f'<div class="cols c6 {section}">')[1].split("</section>")[0]
    return re.findall(r'<h4><span class="mk ([a-z ]+)"', part)


MARKS = ["mb", "dd", "dd hollow", "bl", "triangle", "mb hollow"]


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
    rows = re.findall(r'<th scope="row"><span class="mk triangle"[^>]*></span>Proportional</th>', text)
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
