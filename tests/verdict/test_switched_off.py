"""A loop that is switched off has no verdict, and the pages leave it out."""

from pathlib import Path

import pytest
import yaml

from pipeline.store import artifacts, params
from pipeline.verdict.verdict import LOOPS, read
from stages import report
from tests.report import made
from tests.report.test_pages import INDEX, Page

STAGES = {
    "temperature": (
        "probe_machine", "generate_probing", "ingest", "identify_plant", "learn_kernel", "tune_weights",
        "evaluate_temperature",
    ),
    "deposition": ("train_ilc", "segment_library", "compose_parts"),
    "setpoint": ("train_classifier", "evaluate_setpoint"),
}  # fmt: skip


@pytest.mark.parametrize(
    "on", [("temperature",), ("deposition",), ("setpoint",), ("temperature", "setpoint")]
)
def test_a_loop_that_is_switched_off_has_no_verdict_and_no_card(project, on):
    sections = params.read("params.yaml")
    sections["loops"] = {loop: loop in on for loop in LOOPS}
    Path("params.yaml").write_text(yaml.safe_dump(sections))
    for loop in set(LOOPS) - set(on):
        for stage in STAGES[loop]:
            artifacts.write_metrics(stage, {"asked": False})
    made.main()
    assert tuple(read("datasets/verdict")) == on
    index = Page(INDEX).text
    for loop in LOOPS:
        page = Path(f"reports/{loop}.html").read_text()
        assert (f'href="{loop}.html"' in INDEX.read_text()) == (loop in on)
        assert ("This loop is switched off" in page) == (loop not in on)
    decision = artifacts.read_figures("report")["verdicts"]
    assert tuple(decision) == on
    assert ("Plunger command to flow" in index) == ("deposition" in on)


@pytest.mark.parametrize(
    ("files", "sentence"),
    [
        ("*", "datasets/verdict holds no verdict of a loop; run ./run dvc repro verdict"),
        ("identification", "datasets/verdict/identification.json is missing; run ./run dvc repro verdict"),
    ],
)
def test_pages_without_a_verdict_name_the_command_that_makes_one(project, capsys, files, sentence):
    made.main()
    last = INDEX.read_text()
    for path in Path("datasets/verdict").glob(f"{files}.json"):
        path.unlink()
    with pytest.raises(SystemExit) as ended:
        report.main()
    assert ended.value.code == 1 and INDEX.read_text() == last
    assert sentence in capsys.readouterr().err
