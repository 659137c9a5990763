"""What the pages say they were made from: everything matches right after a run,
and one changed byte anywhere is found and named."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from pipeline import cli
from pipeline.report.shared import provenance
from pipeline.report.shared.page import placed
from pipeline.store import artifacts
from stages.report import main


def lock():
    """dvc.lock of the small project as DVC would write it: folders of
    stages, and what the report stage wrote."""
    outs = [
        Path("datasets") / name
        for name in ("compose_parts", "evaluate_temperature", "identify_plant", "ingest")
    ]
    outs += [Path("datasets") / name for name in ("segment_library", "train_ilc", "tune_weights")]
    outs += [Path("datasets") / name for name in ("train_classifier", "train_agent", "evaluate_setpoint")]
    outs += [Path("datasets/export_controllers")]
    stages = {path.name: {"outs": [{"path": str(path), "md5": provenance.md5(path)}]} for path in outs}
    written = [*Path("reports").glob("*.html"), *Path("reports/metrics").glob("*.json"), Path("reports/data")]
    stages["report"] = {
        "outs": [{"path": str(path), "md5": provenance.md5(path)} for path in sorted(written)]
    }
    Path("dvc.lock").write_text(yaml.safe_dump({"schema": "2.0", "stages": stages}))


@pytest.fixture
def checked(project):
    main()
    lock()
    return project


def wrong():
    return [sentence for check in provenance.checks() for sentence in check.wrong]


def flip(path):
    """One byte of the file, in its middle."""
    data = bytearray(Path(path).read_bytes())
    data[len(data) // 2] ^= 1
    Path(path).write_bytes(data)


def test_right_after_a_run_everything_matches_and_the_command_says_how_much(checked, monkeypatch, capsys):
    assert wrong() == []
    monkeypatch.setattr(sys, "argv", ["beadline", "verify"])
    cli.main()
    said = capsys.readouterr().out
    read = artifacts.read_metrics("report")["read"]
    assert (
        f"{len(read)} sources of the pages: all match" in said
        and "references of figures and tables: all match" in said
    )


def test_one_changed_byte_of_any_source_is_found_and_named(checked):
    read = artifacts.read_metrics("report")["read"]
    assert len(read) > 40
    for path in read:
        whole = Path(path).read_bytes()
        flip(path)
        assert f"{path} has changed since" in wrong(), path
        Path(path).write_bytes(whole)
    assert wrong() == []


@pytest.mark.parametrize(
    ("path", "sentence"),
    [
        ("params.yaml", "params.yaml has changed since"),
        ("params.expert.yaml", "params.yaml or params.expert.yaml has changed since"),
        ("pipeline/code.py", "the code (pipeline, stages) has changed since"),
        ("reports/temperature.html", "reports/temperature.html has changed since"),
    ],
)
def test_a_change_of_parameters_code_or_a_page_is_found(checked, path, sentence):
    text = Path(path).read_text() if Path(path).exists() else ""
    changed = {
        "params.yaml": text.replace("disk_margin: 0.4", "disk_margin: 0.41", 1),
        "params.expert.yaml": "train_agent: {more: 1}\n", "pipeline/code.py": "2\n",
    }.get(path, text + "\n")  # fmt: skip
    assert changed != text
    Path(path).write_text(changed)
    assert sentence in wrong()


def test_a_link_to_other_bytes_than_were_read_or_with_another_hash_is_found(checked):
    page, path = Path("reports/index.html"), "reports/metrics/evaluate_temperature.json"
    recorded = artifacts.read_metrics("report")["read"][path]
    text = page.read_text()
    page.write_text(text.replace(f"SHA-256 {recorded[:8]}", f"SHA-256 {'0' * 8}"))
    assert f"reports/index.html gives another hash of {path} than was read" in wrong()
    page.write_text(text.replace('href="metrics/evaluate_temperature.json"', 'href="metrics/ingest.json"'))
    assert (
        f"reports/index.html leads to reports/metrics/ingest.json, which is not {path} as it was read"
        in wrong()
    )
    page.write_text(text)
    every, row = Path("reports/provenance.html"), artifacts.read_metrics("report")["read"]
    every.write_text(every.read_text().replace(row["datasets/ingest/record.parquet"], "1" * 64))
    assert (
        "reports/provenance.html gives another hash of datasets/ingest/record.parquet than was read"
        in wrong()
    )


def test_the_hash_of_a_file_without_a_link_is_compared_too(checked):
    path, page = "datasets/ingest/record.parquet", Path("reports/provenance.html")
    recorded, text = artifacts.read_metrics("report")["read"][path], page.read_text()
    linked = re.search(rf'<td>(<a class="from" href="[^"]+"><code>{path}</code></a>)</td>', text)
    assert linked
    unlinked = text.replace(linked[1], str(placed("../" + path, path, path)))
    said = f"reports/provenance.html gives another hash of {path} than was read"
    page.write_text(unlinked)
    assert said not in wrong()
    page.write_text(unlinked.replace(recorded, "1" * 64))
    assert said in wrong()


def test_a_copy_beside_the_pages_that_is_not_what_was_read_is_found(checked):
    flip("reports/data/ingest.record.parquet")
    assert any("leads to reports/data/ingest.record.parquet, which is not" in one for one in wrong())


def test_what_dvc_recorded_otherwise_is_found_and_a_source_of_no_stage_too(checked):
    Path("datasets/train_ilc/extra.txt").write_text("x")
    assert wrong() == ["datasets/train_ilc is not what dvc.lock has of train_ilc"]
    locked = yaml.safe_load(Path("dvc.lock").read_text())
    del locked["stages"]["train_ilc"]
    Path("dvc.lock").write_text(yaml.safe_dump(locked))
    assert "datasets/train_ilc/trials.parquet is in no entry of dvc.lock" in wrong()
    Path("dvc.lock").unlink()
    assert wrong() == ["dvc.lock is missing: nothing says which run the files are of"]


def test_the_command_names_what_no_longer_matches_and_ends_with_one(checked, monkeypatch, capsys):
    flip("datasets/ingest/quality.parquet")
    monkeypatch.setattr(sys, "argv", ["beadline", "verify"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 1
    said = capsys.readouterr().err
    assert (
        "datasets/ingest/quality.parquet has changed since; datasets/ingest is not what dvc.lock has of "
        "ingest; run ./run dvc repro" in said
    )


def test_the_metrics_of_an_older_version_are_refused_in_one_sentence(checked):
    artifacts.write_json("reports/metrics/report.json", {"read": {}})
    with pytest.raises(
        ValueError, match="it does not say what the pages were made from; run ./run dvc repro report"
    ):
        provenance.checks()


def test_the_digest_of_a_folder_is_the_one_that_dvc_writes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("b.txt", "a/c d.txt", "a/é.txt", "Z.txt"):
        Path("folder", name).parent.mkdir(parents=True, exist_ok=True)
        Path("folder", name).write_text(name)
    for command in (["init", "--no-scm", "-q"], ["add", "-q", "folder"]):
        subprocess.run([sys.executable, "-m", "dvc", *command], check=True, capture_output=True)
    recorded = yaml.safe_load(Path("folder.dvc").read_text())["outs"][0]
    assert provenance.md5(Path("folder")) == recorded["md5"]
