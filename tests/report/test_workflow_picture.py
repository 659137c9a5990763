"""Which stages were made anew: against dvc.yaml and artifacts made by hand."""

from pathlib import Path

import yaml

from pipeline.report.about import workflow
from pipeline.store import artifacts
from stages.report import main
from tests.report.test_pages import WORKFLOW, Page


def test_the_drawn_stages_are_those_of_dvc_yaml_and_read_what_they_read_there(root):
    stages = yaml.safe_load((root / "dvc.yaml").read_text())["stages"]
    written = {
        path: stage
        for stage, entry in stages.items()
        for kind in ("outs", "metrics")
        for out in entry.get(kind, [])
        for path in out
    }
    reads = {
        stage: {
            written[path] for dep in entry["deps"] for path in written if f"{dep}/".startswith(f"{path}/")
        }
        for stage, entry in stages.items()
        if stage != "report"
    }
    assert {stage: set(found) for stage, found in workflow.READS.items()} == reads, (
        "add the stage to READS in pipeline/report/about/workflow.py"
    )


def test_no_two_stages_share_a_place_and_every_arrow_points_right():
    at = workflow.places(workflow.READS)
    assert len(set(at.values())) == len(at)
    assert all(at[read][0] < at[stage][0] for stage, found in workflow.READS.items() for read in found)
    # evaluate_temperature reads what tune_weights reads: one arrow is enough
    assert workflow.reduced(workflow.READS)["evaluate_temperature"] == ["tune_weights"]


def test_a_stage_is_unchanged_made_anew_or_not_there(project):
    main()
    assert "No run was accepted yet: nothing says what is new." in Page(WORKFLOW).text
    metrics = {
        path.stem: artifacts.read_json(path)
        for path in Path("reports/metrics").glob("*.json")
        if path.stem != "report"
    }
    hashes = {
        path.as_posix(): artifacts.sha256(path) for path in Path("datasets").rglob("*") if path.is_file()
    }
    artifacts.write_json("reports/accepted.json", {"metrics": metrics, "params": {}, "hashes": hashes})
    main()
    assert "The results of 16 of 16 stages are those of the accepted run, to the byte." in Page(WORKFLOW).text
    artifacts.write_json("datasets/tune_weights/weights.json", {"contestants": {"pi": {"cost": 3.0}}})
    Path("datasets/segment_library/library.parquet").unlink()
    main()
    text = WORKFLOW.read_text()
    assert "New results begin at tune_weights." in text
    assert "Made anew: tune_weights; not there: segment_library; unchanged: " in text
