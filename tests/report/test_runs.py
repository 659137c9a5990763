"""Two runs side by side: runs.html beside the accepted run, and `runs A B` of a small git."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from pipeline import cli
from pipeline.report.runs import figures
from pipeline.report.runs.page import Run, render_two
from pipeline.store import artifacts, params
from pipeline.verdict.settings import ReportRules
from pipeline.verdict.verdict import Figure
from tests.report import made
from tests.report.conftest import loaded
from tests.report.made import main
from tests.report.made_runs import Made, ends, make, metrics, parameters
from tests.report.test_pages import RUNS, Page, change


@pytest.fixture
def accepted(project, monkeypatch):
    """A run that was accepted."""
    main()
    monkeypatch.setattr(sys, "argv", ["beadline", "accept"])
    cli.main()
    return project


@pytest.fixture
def git(tmp_path, monkeypatch):
    """git(Made, ...): a git of runs in the working directory, the hash of each."""
    monkeypatch.chdir(tmp_path)
    return lambda *runs: make(runs)


def command(*arguments):
    """`beadline runs` under today's rules; the page that it wrote."""
    shutil.copy(made.ROOT / params.FILE, params.FILE)
    shutil.copy(made.ROOT / params.EXPERT, params.EXPERT)
    before, sys.argv = sys.argv, ["beadline", "runs", *arguments]
    try:
        cli.main()
    finally:
        sys.argv = before


# ---- beside the accepted run


def test_the_page_is_a_function_of_what_it_reads_equal_bytes_in_two_clones(
    accepted, tmp_path_factory, monkeypatch
):
    main()
    here = RUNS.read_bytes()
    other = tmp_path_factory.mktemp("clone") / "of another name"
    shutil.copytree(accepted, other)
    monkeypatch.chdir(other)
    # another clone has another history, machine and clock
    subprocess.run(["git", "init", "-q"], check=True)
    Path("reports/machine.js").write_text("other\n")
    RUNS.unlink()
    main()
    assert RUNS.read_bytes() == here


def test_figures_stand_beside_the_accepted_ones_with_bands_and_the_same_digits(accepted):
    change("evaluate_temperature", contestants__subspace_lqg__settling=made.figure(9.04, 8.51, 9.52))
    main()
    text = Page(RUNS).text
    # 5 to 8 before, 8.5 to 9.5 now
    assert "Settling at most 60 s 6.0 s 5.0–8.0 9.0 s 8.5–9.5 +3 s · worse" in text
    assert "Cost as deployed none 2.00 1.80–2.20 2.00 1.80–2.20 unchanged" in text
    assert text.count("subspace + LQG") >= 2
    assert "1 of 23 figures moved beyond their noise." in text


def test_a_figure_without_a_band_is_neither_better_nor_worse(accepted):
    report = artifacts.read_json("reports/accepted.json")
    report["figures"]["subspace_lqg"]["disk"] = {"median": 0.5, "low": 0.5, "high": 0.5}
    artifacts.write_json("reports/accepted.json", report)
    main()
    row = Page(RUNS).text.split("Margin: disk at least")[1].split("Margin: delay")[0]
    assert "no band" in row and "noise unknown" in row
    assert "better" not in row and "worse" not in row


def test_curves_of_both_runs_are_drawn_and_an_accepted_run_without_curves_says_so(accepted):
    kept = artifacts.read_json("reports/accepted.json")
    assert len(kept["curves"]) == 4 and all(
        len(curve["x"]) <= figures.SAMPLES for curve in kept["curves"].values()
    )
    main()
    drawn = [
        found["d"]
        for tag, found in Page(RUNS).tags
        if tag == "path" and found.get("class") == "line thin dash"
    ]
    assert len(drawn) == 4 and "Grey, dashed: the accepted run." in Page(RUNS).text
    artifacts.write_json("reports/accepted.json", kept | {"curves": {}})
    main()
    assert "The accepted run has no curves." in Page(RUNS).text


def test_a_long_curve_keeps_its_first_and_its_last_sample():
    table = {
        "agent": made.np.array(["li_2025"] * 1000),
        "update": made.np.arange(1000),
        "reward": made.np.append(made.np.nan, made.np.arange(999) / 7),
    }
    ((name, curve),) = figures._agent(table)
    assert (curve["x"][0], curve["x"][-1], curve["y"][-1]) == (1.0, 999.0, 142.6)
    assert len(curve["x"]) == figures.SAMPLES and name.startswith("Setpoint")
    assert json.loads(figures.as_json({name: curve})) == {name: curve}


def test_without_an_accepted_run_the_page_shows_this_run_alone(project):
    main()
    text = Page(RUNS).text
    assert "First run: nothing to compare with. ./run beadline accept marks this one as good." in text
    assert "There is no run to compare with." in text and "Settling at most 60 s not measured 6 s 5–8" in text


def test_the_temperature_loop_of_another_machine_is_not_compared(accepted):
    run = artifacts.read_json("reports/accepted.json")
    run["params"]["plant"]["outputs"][0]["name"] = "bed"
    artifacts.write_json("reports/accepted.json", run)
    main()
    text = Page(RUNS).text
    assert "The accepted run is of another machine" in text
    assert (
        text.count("another machine") >= 9
        and "worse" not in text.split("Settled error, worst zone")[1].split("Deposition")[0]
    )


# ---- any two runs


def test_two_commits_stand_side_by_side_with_bands_verdicts_and_parameters(git, capsys):
    a, b = git(
        Made("a", metrics(26.0) | parameters(seed=1)),
        Made("b", metrics(40.0, stay=20.0) | parameters(seed=2)),
    )
    command(a[:10], "main")
    path = Path(capsys.readouterr().out.strip())
    assert path == Path(f"reports/runs-{a[:8]}-{b[:8]}.html")
    text = Page(path).text
    assert f"{a[:8]} beside main ({b[:8]})" in text
    assert "26 s 23–29 40 s 36–44 +14 s · worse" in text
    assert "tune_weights.seed 1 2" in text
    assert f"./run dvc plots diff {a[:8]} main" in text
    before = path.read_bytes()
    command(a[:10], "main")
    assert path.read_bytes() == before


def test_an_experiment_of_dvc_is_found_by_its_name(git, capsys):
    git(Made("a", metrics(26.0)), Made("tried", metrics(9.0), name="tiny-exp", base=0))
    command("main", "tiny-exp")
    text = Page(Path(capsys.readouterr().out.strip())).text
    assert "tiny-exp (" in text and "· better" in text


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("nobody", "nobody: expected a commit, a tag, a branch or a DVC experiment, found none of this name"),
        ("--help=x", "--help=x: expected a commit"),
        ("empty", "has no reports/metrics; name a commit that holds a run"),
        ("broken", "reports/metrics/report.json of commit"),
    ],
)
def test_what_is_no_run_is_refused_in_one_sentence(git, capsys, name, sentence):
    hashes = git(
        Made("empty", {"a.txt": "a"}),
        Made("broken", {"reports/metrics/report.json": "["}),
        Made("whole", metrics()),
    )
    for tag, commit in zip(("empty", "broken"), hashes, strict=False):
        subprocess.run(["git", "tag", tag, commit], check=True)
    with pytest.raises(SystemExit):
        command("--", "main", name)
    said = capsys.readouterr().err
    assert sentence in said and said.count("\n") == 1
    assert not list(Path("reports").glob("runs-*"))


def test_hostile_names_and_values_stay_text():
    hostile = "<script>alert(1)</script>"
    rules = params.load(ReportRules, "report", made.ROOT / params.FILE)
    run = Run(hostile, {"evaluate_setpoint": {"default": hostile}}, {"x_mine": {hostile: hostile}})
    text = render_two(run, run._replace(parameters={}), rules)
    assert "<script>alert" not in text and "&lt;script&gt;" in text


def test_a_git_of_any_shape_gives_figures_or_none():
    whole = {Path(path).stem: data for path, data in metrics().items()}
    measured = figures.measured(whole)
    assert measured.figures["temperature"]["settling"] == Figure(26.0, 0.9 * 26.0, 1.1 * 26.0)
    assert measured.figures["deposition"] == {
        "flow_error": Figure(2.5, 2.5, 2.5),
        "line_volume": Figure(2.0, 2.0, 2.0),
        "learned": Figure(2.0, 2.0, 2.0),
    }
    # by hand: the worst of two cases, its interval, and the harm that has a bar
    setpoint = measured.figures["setpoint"]
    assert setpoint["settled"].value == 75.0 and setpoint["stay"] == Figure(71.0, 62.0, 80.0)
    assert setpoint["harm"][:3] == (0.5, 0.1, 4.0) and setpoint["right_70_150"] == Figure(82.5, 78.0, 87.0)
    for value in (None, [], 3, "x", {"A": []}, {"default": 3, "cases": [1], "harm": {"perfect": None}}):
        assert figures.measured(dict.fromkeys(whole, value)).figures["temperature"] == {}
    assert figures.figure(ends(float("nan"))) is None and figures.figure({"median": True}) is None


def test_a_page_of_two_commits_overflows_nothing_and_leads_nowhere_else(git, capsys, browser, tmp_path):
    git(Made("a", metrics(26.0) | parameters(seed=1)), Made("b", metrics(40.0) | parameters(seed=2)))
    command("main~1", "main")
    path = Path(capsys.readouterr().out.strip())
    page = loaded(browser, tmp_path / "reports", path.stem, width=390)
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    page.context.close()


# ---- what git keeps of a run


def test_the_headline_is_a_run_in_few_values_and_gives_its_figures_back():
    whole = {Path(path).stem: data for path, data in metrics().items()}
    whole["report"]["verdicts"]["temperature"]["subject"] = "pi_simc"
    kept = figures.headline(whole)
    assert {name: value for name, value in kept.items() if name != "bands"} == {
        "temperature": "pass: pi_simc",
        "settling_s": 26.0,
        "disk_margin": 0.5,
        "cost": 3.0,
        "deposition": "undecided",
        "flow_error_percent": 2.5,
        "line_volume_percent": 2.0,
        "learned_percent": 2.0,
        "setpoint": "fail",
        "settled_percent": 75.0,
        "stay_percent": 71.0,
        "disturbed_percent": 0.5,
        "right_70_150_percent": 82.5,
    }
    again = figures.measured({"report": json.loads(json.dumps(kept))})
    assert again.figures == figures.measured(whole).figures
    assert again.controllers["temperature"] == "pi_simc" and again.verdicts["setpoint"] == "fail"


def test_a_figure_without_an_end_is_infinite_again():
    figure = {"median": None, "low": 20.0, "high": None}
    report = {"figures": {"pi": {"settling": figure}}, "verdict": {"winner": "pi"}}
    kept = figures.headline({"report": report})
    assert kept["settling_s"] is None and kept["bands"]["temperature"] == {"settling": [None, 20.0, None]}
    assert figures.measured({"report": kept}).figures["temperature"]["settling"].value == float("inf")


def test_a_run_of_today_stands_beside_one_whose_metrics_were_all_figures(git, capsys):
    today = figures.headline({Path(path).stem: data for path, data in metrics(40.0).items()})
    git(Made("a", metrics(26.0)), Made("b", {"reports/metrics/report.json": today}))
    command("main~1", "main")
    assert "26 s 23–29 40 s 36–44 +14 s · worse" in Page(Path(capsys.readouterr().out.strip())).text
