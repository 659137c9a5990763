"""Page one, report.json, the exported controller and README tell one story."""

import json
import re
import shutil
from pathlib import Path

import pytest

from pipeline.store import artifacts
from tests.mission.conftest import Project

LOOPS = ("temperature", "deposition", "setpoint")


@pytest.fixture(scope="session")
def cloned(made_once, root) -> Project:
    """A clone as git has it, with the figures of the accepted run and no other result, and the pages made of
    them."""

    def make(folder: Path) -> None:
        project = Project(folder).make()
        accepted = root / "reports/accepted.json"
        (folder / "reports").mkdir(exist_ok=True)
        shutil.copy(accepted, folder / "reports")
        for stage, figures in json.loads(accepted.read_text(encoding="utf-8"))["metrics"].items():
            artifacts.write_json(folder / "datasets" / stage / "figures.json", figures)
        project.run("python", "-m", "stages.verdict")
        project.run("python", "-m", "stages.report")

    return Project(made_once("cloned", make))


@pytest.fixture
def report(cloned) -> dict:
    return json.loads((cloned.folder / "datasets/report/figures.json").read_text(encoding="utf-8"))


def words(text: str) -> str:
    return " ".join(re.sub(r"<[^>]+>|[*`]", "", text).replace("&amp;", "&").split())


def test_page_one_says_the_verdicts_of_report_json(cloned, report):
    page = words((cloned.folder / "reports/index.html").read_text(encoding="utf-8"))
    for loop in LOOPS:
        verdict = report["verdicts"][loop]
        for sentence in (verdict["decision"], verdict["lead"]):
            assert words(sentence) in page, (loop, sentence)


def test_the_controller_that_page_one_names_is_the_one_that_was_exported(cloned, report):
    """Ready, or passed, means a file: one certified controller, and it is the one that is named."""
    exported = json.loads((cloned.folder / "datasets/export_controllers/figures.json").read_text())
    verdict = report["verdicts"]["temperature"]
    assert verdict["state"] == "passed"
    assert exported["temperature"]["contestant"] == verdict["winner"]
    assert exported["temperature"]["certificate"]["verdict"] == "passed"


def test_readme_says_the_verdicts_of_the_accepted_run(root):
    readme = words((root / "README.md").read_text(encoding="utf-8"))
    accepted = json.loads((root / "reports/accepted.json").read_text(encoding="utf-8"))
    verdicts = accepted.get("verdicts", {})
    missing = [
        loop for loop in LOOPS if loop not in verdicts or words(verdicts[loop]["decision"]) not in readme
    ]
    assert missing == []
