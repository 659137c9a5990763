"""The history from a git of many runs: every figure of every revision, old formats, hostile subjects, time,
and what it says where there is none."""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pipeline import cli
from pipeline.report.runs import history
from pipeline.store import artifacts
from tests.report import made
from tests.report.conftest import MACHINE
from tests.report.test_pages import Page

PAGE = Path("reports/history.html")


def report(gap):
    figures = {
        name: {
            "gap_percent": {"median": k * gap, "low": 0.9 * k * gap, "high": 1.1 * k * gap},
            "settling_s": made.figure(6.0, 5.0, None),
            "disk": {"median": 0.66, "low": 0.62, "high": 0.66},
        }
        for k, name in enumerate(("window", "model_based", "baseline"), 1)
    }
    return {"verdict": {"decision": f"Deploy, gap {gap:g}."}, "figures": figures}


def of_today(settling):
    """The pages' figures of a run of the comparison as deployed."""
    ends = {"median": settling, "low": 0.9 * settling, "high": 1.1 * settling}
    names = ("subspace_lqg", "learned_kernel", "pi")
    return {
        "verdict": {"decision": "Rehearsal passed: subspace + LQG.", "winner": "subspace_lqg"},
        "figures": {name: {"settling": ends} for name in names},
    }


def commits(runs):
    """A git whose revisions are (subject, {file of reports/metrics:
    JSON or text}), oldest first, by one fast-import."""
    stream = []
    for k, (subject, files) in enumerate(runs):
        message = subject.encode()
        stream.append(
            b"commit refs/heads/main\ncommitter A <a@b> %d +0000\ndata %d\n%s\n"
            % (1_700_000_000 + 86400 * k, len(message), message)
        )
        for name, data in files.items():
            text = data.encode() if isinstance(data, str) else json.dumps(data).encode()
            stream.append(
                b"M 100644 inline reports/metrics/%s\ndata %d\n%s\n" % (name.encode(), len(text), text)
            )
    subprocess.run(["git", "init", "-q", "-b", "main"], check=True)
    subprocess.run(["git", "fast-import", "--quiet"], input=b"".join(stream), check=True)
    subprocess.run(["git", "checkout", "-q", "-f", "main"], check=True)


def command(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["beadline", "history", *arguments])
    cli.main()


@pytest.fixture
def empty(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    made.declared(tmp_path)
    return tmp_path


def test_two_hundred_revisions_are_drawn_with_their_own_figures_by_a_few_processes(
    empty, monkeypatch, capsys, started
):
    commits([(f"run {k}", {"report.json": report(1 + k / 100)}) for k in range(200)])
    started.clear()
    command(monkeypatch)
    # no git for each revision
    assert 0 < len(started) < 20
    runs = list(history.revisions(500))
    np.testing.assert_allclose(
        [run.figures["window"]["gap_percent"].value for run in runs],
        [1 + k / 100 for k in range(200)],
        rtol=1e-15,
    )
    assert [run.subject for run in runs] == [f"run {k}" for k in range(200)]
    text = PAGE.read_text()
    assert (
        text.count('<svg class="plot') == 9 + 2 + 3 + 4
        and len(re.findall(r"<tr><th scope=\"row\"><code>[0-9a-f]{8}</code>", text)) == 200
    )
    assert "data-driven from 1 % to 2.99 %" in text.replace("\u202f", " ")
    assert len(text) <= 1_500_000
    assert "200" in capsys.readouterr().err


def test_the_newest_are_taken_where_there_are_more_and_they_stay_in_their_order(empty, monkeypatch):
    commits([(f"run {k}", {"report.json": report(1 + k)}) for k in range(5)])
    assert [run.subject for run in history.revisions(2)] == ["run 3", "run 4"]


def test_figures_that_are_not_committed_come_last_and_equal_ones_do_not_come_twice(empty):
    commits([("one", {"report.json": report(1.0)}), ("two", {"report.json": report(2.0)})])
    assert [run.subject for run in history.revisions(9)] == ["one", "two"]
    artifacts.write_metrics("report", report(3.0))
    assert [run.subject for run in history.revisions(9)] == ["one", "two", "not committed"]


def test_a_revision_before_the_pages_kept_figures_is_read_from_its_scorecard_and_a_broken_one_leaves_a_gap(
    empty, monkeypatch
):
    scorecard = {
        "controllers": {"window": {"gap_percent": {"median": 0.5, "low": 0.4, "high": 0.65, "worst": 0.65}}},
        "contestants": {"pi": made.contestant(0.5)},
    }
    parts = {
        "square": {
            "A": {
                "basis": {"rms_percent_of_on_off": 2.5, "worst_line_volume_percent": None},
                "chosen": "basis",
            }
        }
    }
    laws = {"A": {"pixels": {"best_ratio": 0.03}}, "B": {"ours": {"best_ratio": 0.05}}}
    old = {
        "evaluate_temperature.json": scorecard,
        "report.json": "{}",
        "compose_parts.json": parts,
        "train_ilc.json": laws,
    }
    commits(
        [
            ("old", old),
            ("broken", {"report.json": "{", "evaluate_temperature.json": "[]"}),
            ("new", {"report.json": report(1.0)}),
        ]
    )
    first, broken, new = history.revisions(9)
    # by hand: the gap, the largest one of the spread, the quantile of today, the worse material after
    # learning
    assert (
        first.figures["window"]["gap_percent"][:3] == (0.5, 0.4, 0.65)
        and first.figures["window"]["worst_case_gap_percent"][:3] == (0.65,) * 3
        and first.figures["pi"]["cost"][:3] == pytest.approx((0.5, 0.45, 0.55))
    )
    assert {key: f.value for key, f in first.figures["deposition"].items()} == {
        "flow_error_percent": 2.5,
        "learned_percent": 5.0,
    }
    assert broken.figures.keys() == {"deposition", "setpoint"} and not broken.figures["setpoint"]
    assert new.figures["window"]["settling_s"].high == np.inf
    command(monkeypatch)
    assert "not measured" in Page(PAGE).text


def test_runs_before_and_after_the_comparison_as_deployed_stand_on_one_page_and_none_says_deploy(
    empty, monkeypatch
):
    commits([("old", {"report.json": report(2.0)}), ("new", {"report.json": of_today(26.0)})])
    command(monkeypatch)
    page = Page(PAGE).text
    assert "Temperature, earlier runs" in page and "Gap to the optimum" in page
    assert "Rehearsal passed: subspace + LQG." in page and "Passed the rules of its day." in page
    assert "deploy " not in page.lower() and "deploy," not in page.lower()
    assert "Settling now 26 s" in page
    # a figure of the one never stands in the line or column of the other
    assert "0.660" not in page
    runs = list(history.revisions(9))
    assert "settling" not in runs[0].figures["window"] and runs[1].winner == "subspace_lqg"


def test_a_hostile_subject_does_nothing(empty, monkeypatch):
    commits([(made.HOSTILE, {"report.json": report(1.0) | {"verdict": {"decision": made.HOSTILE}}})])
    command(monkeypatch)
    page = Page(PAGE)
    assert [tag for tag, _ in page.tags].count("script") == 1 and not any(
        tag == "img" for tag, _ in page.tags
    )
    assert not any(name.startswith("on") for _, attributes in page.tags for name in attributes)


def test_pages_that_lie_beside_it_are_linked_and_others_are_not(empty, monkeypatch):
    commits([("one", {"report.json": report(1.0)})])
    Path("reports/index.html").write_text("x")
    command(monkeypatch)
    assert 'Pages of the present run: <a href="index.html">index</a>.' in PAGE.read_text()


@pytest.mark.parametrize(
    ("made_git", "sentence"),
    [
        (False, "the history cannot be read (.*); run this inside the git checkout"),
        (True, "git has no revision of it; commit the figures of a run first"),
    ],
)
def test_without_a_git_or_a_revision_it_says_so_and_writes_nothing(
    empty, monkeypatch, capsys, made_git, sentence
):
    if made_git:
        commits([("other", {})])
        Path("a").write_text("a")
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(empty.parent))
    with pytest.raises(SystemExit):
        command(monkeypatch)
    assert re.search(sentence, capsys.readouterr().err)
    assert not PAGE.exists()


def test_in_a_browser_it_says_nothing_on_the_console_and_sorts_by_a_figure(empty, monkeypatch, open_page):
    commits([(f"run {k}", {"report.json": report(gap)}) for k, gap in enumerate((2.0, 0.5, 12.0))])
    command(monkeypatch)
    Path("reports/machine.js").write_text(MACHINE)
    page = open_page("history", folder=empty / "reports")
    page.locator("th button", has_text="Gap").click()
    assert page.locator(".runs tbody td:nth-child(14)").all_inner_texts() == ["0.500", "2.00", "12.0"]
    assert page.console == [] and page.evaluate("document.documentElement.scrollWidth") <= 1280
