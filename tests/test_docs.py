"""The walk-throughs in docs/ run as they stand, what they print holds, and the version is one."""

import re
import runpy
from pathlib import Path

import numpy as np
import pytest

from pipeline import cli
from pipeline.report.shared.verdict import ReportRules
from pipeline.report.temperature import readme
from pipeline.report.temperature.verdict import decide
from pipeline.setpoint import score
from pipeline.store import artifacts, params
from pipeline.temperature.workflow.settings import Plant

LOOPS = ("temperature", "deposition", "setpoint")


@pytest.fixture
def walked(root, tmp_path, monkeypatch):
    """walked("setpoint"): the names that the walk-through leaves behind."""
    monkeypatch.chdir(tmp_path)

    def walk(loop: str) -> dict:
        left = runpy.run_path(str(root / f"docs/{loop}.py"))
        assert (tmp_path / f"{loop}.svg").read_text(encoding="utf-8").rstrip().endswith("</svg>")
        return left

    return walk


@pytest.mark.parametrize("loop", LOOPS)
def test_a_walk_through_is_read_in_a_sitting(root, loop):
    text = (root / f"docs/{loop}.py").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 80 and text.count("\n# %% ") >= 5


def test_every_learned_law_of_the_temperature_walk_through_is_within_a_percent_of_the_optimum(walked):
    left = walked("temperature")
    assert set(left["gaps"]) == {"subspace + LQG", "VARX + Riccati", "learned kernel"}
    assert max(left["gaps"].values()) < 0.01
    for name in left["gaps"]:  # as deployed, all zones settle on their references
        np.testing.assert_allclose(left["runs"][name].y[-1, 0], left["references"][0], atol=0.5)  # noise 0.1


def test_the_deposition_walk_through_learns_the_line_and_the_model_inverse_learns_it_sooner(walked):
    ratios = walked("deposition")["ratios"]
    assert ratios["model inverse"].min() < 0.15 and ratios["Hoelzle 2009"].min() < 0.6
    assert ratios["model inverse"][3] < ratios["Hoelzle 2009"][3]


def test_the_bayes_filter_of_the_setpoint_walk_through_stays_and_one_that_expects_jumps_survives_a_clog(
    walked,
):
    left = walked("setpoint")
    stay = {name: one.stay.percent for name, one in left["scores"].items()}
    assert max(stay, key=stay.get) == "Bayes filter" and stay["Bayes filter"] > 95
    last = {
        name: np.median(np.asarray(run.flow)[:, score.RECOVERED_UNTIL])
        for name, run in left["clogged"].items()
    }
    assert last["Bayes filter"] < 90 < last["Bayes filter, expects jumps"]


def test_the_version_is_one_and_the_same_wherever_it_stands(root, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["beadline", "--version"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    version = capsys.readouterr().out.split()[1]
    assert ended.value.code == 0
    assert f"\nversion: {version}\n" in (root / "CITATION.cff").read_text(encoding="utf-8")
    assert f'name = "beadline"\nversion = "{version}"\n' in (root / "uv.lock").read_text(encoding="utf-8")
    changes = (root / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.findall(r"^## \[(.*?)\]", changes, re.MULTILINE)[0] == version


def told(monkeypatch, capsys, *arguments: str) -> str:
    """What the command prints with these arguments and --help."""
    monkeypatch.setattr("sys.argv", ["beadline", *arguments, "--help"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 0
    return " ".join(capsys.readouterr().out.split())


def test_the_help_of_every_command_has_a_sentence_an_example_and_the_exit_statuses(monkeypatch, capsys):
    names = re.findall(r"choose from|'([\w-]+)'", _choices(monkeypatch, capsys))
    names = [name for name in names if name]
    assert {"accept", "runs", "nightly", "export"} <= set(names) <= set(cli.EXAMPLES)
    for name in names:
        text = told(monkeypatch, capsys, name)
        assert f"Example: ./run beadline {name} {cli.EXAMPLES[name]}".rstrip() in text, name
        assert re.search(r"Exit status: 0 .*; 1 ", text), name
        # its sentence stands between the usage and the options
        assert re.search(r"\S[.:] (positional arguments|options):", text), (name, text)


def _choices(monkeypatch, capsys) -> str:
    monkeypatch.setattr("sys.argv", ["beadline", "no-such-command"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 2
    return capsys.readouterr().err.split("choose from")[1]


def test_the_pictures_of_the_readme_are_those_that_the_command_takes(root):
    from pipeline.report.screenshots import SHOTS

    shown = re.findall(r"!\[[^\]]+\]\((reports/[^)]+)\)", (root / "README.md").read_text(encoding="utf-8"))
    assert shown == [f"reports/{shot.file}" for shot in SHOTS]
    assert all((root / path).read_bytes().startswith(b"\x89PNG") for path in shown)


def test_where_there_is_no_page_no_picture_is_taken(tmp_path):
    from pipeline.report.screenshots import take

    with pytest.raises(ValueError, match="index.html: expected the page, found none; run ./run dvc repro"):
        take(tmp_path)


def readme_of_today(root: Path) -> str:
    """README.md with the temperature loop's figures as reports/metrics has them, and the verdict that the
    pages say of them."""
    metrics = {
        stage: artifacts.read_json(root / f"reports/metrics/{stage}.json")
        for stage in ("evaluate_temperature", "identify_plant", "learn_kernel")
    }
    rules = params.load(ReportRules, "report", root / params.FILE)
    machine = params.load(Plant, "plant", root / params.FILE)
    verdict = decide(
        metrics,
        rules,
        recorded=False,
        undeclared=[output.name for output in machine.outputs if output.low is None or output.high is None],
    )
    text = readme.block(metrics, rules, verdict)
    return readme.rewritten((root / "README.md").read_text(encoding="utf-8"), text)


def test_the_temperature_figures_of_the_readme_are_those_of_the_last_run(root):
    assert (root / "README.md").read_text(encoding="utf-8") == readme_of_today(root), (
        "run ./run python -m tests.test_docs, which writes them"
    )


def test_no_page_and_no_document_advises_to_deploy(root):
    pages = [*(root / "pipeline/report/templates").glob("*"), *(root / "docs").glob("*"), root / "README.md"]
    advice = re.compile(r"\bdeploy\b", re.IGNORECASE)
    assert not [
        path.name for path in pages if path.is_file() and advice.search(path.read_text(encoding="utf-8"))
    ]


if __name__ == "__main__":
    here = Path(__file__).resolve().parents[1]
    (here / "README.md").write_text(readme_of_today(here), encoding="utf-8")
