"""The case that decides the setpoint loop: which runs are read, what happens to them, and where
they are drawn."""

import html
import re
import urllib.parse
from pathlib import Path

import numpy as np
import pytest

from pipeline.report.setpoint import deciding
from pipeline.setpoint.tables import SCOREBOARD
from pipeline.store import artifacts
from tests.report import made_setpoint
from tests.report.made import main
from tests.report.test_pages import Page, change
from tests.report.test_viewer import manifest

PAGE, INDEX = Path("reports/setpoint.html"), Path("reports/index.html")
HALF = ("recorded", "recorded, sticky, half clog")
CASE = ("paper", "accuracy 0.7, clog")


def table(runs, case=CASE):
    """Columns of paths.parquet of {name: flow (starts, decisions + 1)} at 210 °C."""
    rows = [
        (name, *case, start, step, flow, 210.0)
        for name, flows in runs.items()
        for start, run in enumerate(flows)
        for step, flow in enumerate(run)
    ]
    names = ("controller", "simulator", "case", "start", "step", "flow_percent", "temperature_degC")
    return {name: np.array(column) for name, column in zip(names, zip(*rows, strict=True), strict=True)}


def left_alone(*left, steps=120):
    """Runs from 80 and 120 % of which so much gets through, (decision, share) by (decision, share)."""
    gain = np.ones(steps + 1)
    for step, share in left:
        gain[step:] = share
    return np.outer([80.0, 120.0], gain)


def test_what_happens_is_read_off_the_runs_that_are_left_alone():
    clogged = table({"do nothing": left_alone((60, 0.75))})
    assert deciding.clog(clogged, CASE) == deciding.Clog(60, pytest.approx(75.0))
    assert deciding.clog(table({"do nothing": left_alone()}), CASE) is None
    # what comes and goes, or lets more through, is no one clog
    assert deciding.clog(table({"do nothing": left_alone((60, 0.75), (90, 1.0))}), CASE) is None
    assert deciding.clog(table({"do nothing": left_alone((60, 1.2))}), CASE) is None
    # and a controller's own moves are none
    assert deciding.clog(table({"agent": left_alone((60, 0.75))}), CASE) is None
    assert deciding.clog(clogged, HALF) is None


def test_runs_are_counted_before_the_clog_and_from_decision_90_to_the_end():
    """By hand: of the agent's three one is out before it, one comes back at 90, one at 91."""
    agent = np.full((3, 121), 100.0)
    agent[0, :60], agent[1, 60:90], agent[2, 60:91] = 130.0, 75.0, 75.0
    rows = table({"agent": agent, "do nothing": left_alone((60, 0.75))})
    shuffled = np.random.default_rng(0).permutation(len(rows["step"]))
    found = deciding.traces(
        {name: column[shuffled] for name, column in rows.items()}, CASE, ["agent", "nobody", "do nothing"]
    )
    np.testing.assert_array_equal(found[0]["agent"].flow, agent)
    # 120 % is outside, and 90 % on the border after it
    assert deciding.finding(found).replace("\u202f", " ") == (
        "At decision 60 a clog leaves 75 % of the flow. Of three runs inside just before it, and from "
        "decision 90 to the end: agent 2 and 2; do nothing 0 and 1."
    )
    missing = deciding.traces(rows, CASE, ["nobody", "agent"])
    assert "no run of the case that decides was kept" in missing.sentence()


def test_a_line_without_its_inner_points_is_the_same_line():
    y = np.repeat([100.0, 100.0, 75.0, 80.0, 80.0, 80.0, np.nan, 60.0], [3, 4, 1, 1, 2, 5, 2, 3])
    step, drawn = deciding.corners(y)
    assert len(step) < len(y) - 8
    known = np.isfinite(y)
    np.testing.assert_array_equal(np.interp(np.flatnonzero(known), step, drawn, left=0)[:16], y[known][:16])
    low, high = np.array([1.0, 1, 1, 1, 1]), np.array([1.0, 1, 1, 2, 2])
    np.testing.assert_array_equal(deciding.corners(low, high)[0], [0, 2, 3, 4])


def harder(case, stay):
    """The default keeps so few percent in this case."""
    path = "datasets/evaluate_setpoint/scoreboard.parquet"
    rows = {name: list(column) for name, column in artifacts.read_table(path, SCOREBOARD).items()}
    mine = list(zip(rows["controller"], rows["simulator"], rows["case"], strict=True)).index(
        (made_setpoint.DEFAULT, *case)
    )
    for end, away in (("", 0.0), ("low_", -1.0), ("high_", 1.0)):
        rows[f"stay_{end}percent"][mine] = stay + away
    artifacts.write_table(path, SCOREBOARD, rows)


def test_the_last_case_stands_first_where_it_decides_and_is_drawn_on_both_pages(project):
    harder(HALF, 40.0)
    made_setpoint.paths(decides=HALF)
    change("train_classifier", ece_window=0.05)  # page one shows the loop that failed
    main()
    text = PAGE.read_text()
    answers = re.search(r"answers setpoint.*?</table>", text, re.DOTALL)[0]
    _, first, *others = answers.split('<tr role="row"')[1:]
    assert len(others) == 4
    assert "sticky, half clog" in first and "decides" in first and "decides" not in "".join(others)
    drawn = re.search(r'<section aria-labelledby="deciding">.*?</section>', text, re.DOTALL)[0]
    # the strongest of those that may run beside the default, and doing nothing
    told = Page(PAGE).text.replace("\u202f", " ")
    assert "At decision 60 a clog leaves 60 % of the flow. Of 21 runs inside just before it" in told
    assert re.search(
        r"to the end: Bayes filter \d+ and \d+; paper's agent \d+ and \d+; do nothing 0 and 1\.", told
    )
    assert drawn.count("clog to 60") == 2
    link = urllib.parse.parse_qs(html.unescape(re.search(r'viewer.html#([^"]+)"', drawn)[1]))
    assert link["case"] == [HALF[1]]
    assert link["controller"] == ["Bayes filter", "paper's agent", "do nothing"]
    one = INDEX.read_text()
    assert one.count("clog to 60") == 1
    assert re.search(
        r"settle and stay in classified windows, sticky, half clog: [^.]*[\d.]+\s%, Bayes filter 40\.0", one
    )
    clogs = [run for run in manifest(Path("reports").absolute())["tables"] if run["name"] == "paths"][0][
        "events"
    ]
    assert len(clogs) == len(made_setpoint.KINDS) * 21
    assert all(happened == [[60, 60, "a clog leaves 60 % of the flow", "flow"]] for _, happened in clogs)


def test_runs_of_before_without_the_deciding_case_are_said_in_its_place_on_both_pages(project):
    made_setpoint.paths(decides=None)
    change("train_classifier", ece_window=0.05)
    main()
    assert (
        "no run of the case that decides was kept. Run ./run dvc repro evaluate_setpoint." in Page(PAGE).text
    )
    assert "no run of the case that decides was kept" in INDEX.read_text()
