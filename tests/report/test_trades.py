"""What a controller trades, plant by plant, and which stages were made anew: against figures made by hand and dvc.yaml."""

import re
from pathlib import Path

import yaml

from pipeline import artifacts
from pipeline.report import trades, workflow
from stages.report import main
from tests.report import made
from tests.report.test_pages import INDEX as PAGE_ONE
from tests.report.test_pages import TEMPERATURE, Page


def test_the_front_holds_whom_no_other_beats_in_both():
    points = {"cheap": (1.0, 5.0), "good": (3.0, 1.0), "between": (2.0, 2.0), "beaten": (2.5, 2.5), "worst": (3.0, 5.0)}
    assert trades.front(points) == ["cheap", "between", "good"]
    # two that are equal do not beat one another
    assert trades.front({"a": (1.0, 1.0), "b": (1.0, 1.0)}) == ["a", "b"]


def test_the_hardest_plant_is_the_last_one_with_its_largest_gap(project):
    made.write(project, worst={"window": 110.0})
    main()
    labels = re.findall(r'aria-label="(Data-driven: worst run of the easiest[^"]*)"', TEMPERATURE.read_text())
    # by hand: 110 (0.01 + 0.99 plant + 0.0001 seed), plants 0 and 1, seeds to 3
    assert [label.replace("\u202f", " ") for label in labels] == [
        "Data-driven: worst run of the easiest plant 1.1 %, of the hardest 110 %; 1 of 2 plants beyond 50 %"
    ]


def test_the_drawn_stages_are_those_of_dvc_yaml_and_read_what_they_read_there(root):
    stages = yaml.safe_load((root / "dvc.yaml").read_text())["stages"]
    written = {
        path: stage for stage, entry in stages.items() for kind in ("outs", "metrics") for out in entry.get(kind, []) for path in out
    }
    reads = {
        stage: {written[path] for dep in entry["deps"] for path in written if f"{dep}/".startswith(f"{path}/")}
        for stage, entry in stages.items()
        if stage != "report"
    }
    assert {stage: set(found) for stage, found in workflow.READS.items()} == reads, "add the stage to READS in pipeline/report/workflow.py"


def test_no_two_stages_share_a_place_and_every_arrow_points_right():
    at = workflow.places(workflow.READS)
    assert len(set(at.values())) == len(at)
    assert all(at[read][0] < at[stage][0] for stage, found in workflow.READS.items() for read in found)
    # evaluate_temperature reads identify_plant by way of tune_weights too: one arrow is enough
    assert workflow.reduced(workflow.READS)["evaluate_temperature"] == ["learn_kernel", "tune_weights"]


def test_a_stage_is_as_accepted_made_anew_or_not_there(project):
    main()
    assert "No run was accepted yet: nothing says what is new." in Page(PAGE_ONE).text
    metrics = {path.stem: artifacts.read_json(path) for path in Path("reports/metrics").glob("*.json") if path.stem != "report"}
    hashes = {path.as_posix(): artifacts.sha256(path) for path in Path("datasets").rglob("*") if path.is_file()}
    artifacts.write_json("reports/accepted.json", {"metrics": metrics, "params": {}, "hashes": hashes})
    main()
    assert "The results of 12 of 12 stages are those of the accepted run, to the byte." in Page(PAGE_ONE).text
    artifacts.write_json("datasets/tune_weights/weights.json", {"practical": {"q": [1.0, 3.0], "r": [0.1, 0.2]}})
    Path("datasets/segment_library/library.parquet").unlink()
    main()
    text = PAGE_ONE.read_text()
    assert "New results begin at tune_weights." in text
    assert "Made anew: tune_weights; not there: segment_library; as accepted: " in text
