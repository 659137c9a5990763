"""One hot end behind every format: each recording is inspected, begun with `init`, ingested and identified;
what is damaged is set aside, and what is no recording is refused."""

import json
import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas
import pytest

from tests.foreign.hot_end import Record
from tests.foreign.hot_end_files import FORMATS, write_csv, write_parquet
from tests.mission.toy_temperature import (  # noqa: F401  hot_end_project and hot_end_record are fixtures
    ROOT,
    Refused,
    accept_recording,
    beadline,
    begin,
    declare,
    declared,
    hot_end_project,
    hot_end_record,
    play,
)

pytestmark = pytest.mark.xdist_group("toy_temperature")
# °C and percent that the format itself rounds away
ROUNDING = {"klippy.log": (0.0501, 0.0501)}


@pytest.fixture(scope="session")
def begun(made_once, hot_end_record) -> Callable[[str], Path]:  # noqa: F811
    """begun("log.mcap"): a project that an owner began from this file, and what `inspect` said of it."""

    def project(name: str) -> Path:
        def make(folder: Path) -> None:
            begin(folder)
            (folder / name).write_bytes(FORMATS[name](hot_end_record))
            (folder / "inspected.txt").write_text(beadline(folder, "inspect", str(folder / name)))
            accept_recording(folder, folder / name)
            play(folder, "ingest")

        return made_once(f"begun_{name.replace('.', '_')}", make)

    return project


@pytest.mark.parametrize("name", FORMATS)
def test_a_recording_is_inspected_begun_and_ingested_in_every_format(name, begun, hot_end_record):  # noqa: F811
    folder = begun(name)
    told = (folder / "inspected.txt").read_text()
    assert "ingest:" in told and "plant:" in told  # a mapping to paste
    plant = declared(folder, "plant")
    (heater,), (output,) = plant["inputs"], plant["outputs"]
    assert plant["sample_time_s"] == 1.0
    table = pandas.read_parquet(folder / "datasets/ingest/record.parquet")
    kept = ~table[f"{output['name']}_masked"].to_numpy()
    assert kept.mean() >= 0.999
    degC, percent = ROUNDING.get(name, (1e-9, 1e-9))
    rows = len(hot_end_record.time_s)
    # the last sample of a format in which the duty holds until the next message may be left out
    assert rows - 2 <= len(table) <= rows
    measured = hot_end_record.temperature_degC, hot_end_record.duty_percent
    expected = [column[: len(table)] for column in measured]
    np.testing.assert_allclose(table[output["name"]][kept], expected[0][kept], rtol=0, atol=degC)
    np.testing.assert_allclose(table[heater["name"]], expected[1], rtol=0, atol=percent)


def fit_percent(folder: Path) -> float:
    """How well the identified plant forecasts the part of the record that it has not seen."""
    metrics = json.loads((folder / "datasets/identify_plant/figures.json").read_text())
    (fit,) = metrics["fit_holdout"].values()
    return fit


@pytest.mark.full
@pytest.mark.parametrize("name", FORMATS)
def test_the_plant_is_identified_alike_from_every_format(name, begun, hot_end_project, tmp_path):  # noqa: F811
    folder = shutil.copytree(begun(name), tmp_path / "copy", symlinks=True)
    play(folder, "identify_plant")
    assert fit_percent(folder) >= 90.0
    assert fit_percent(folder) == pytest.approx(fit_percent(hot_end_project), abs=1.0)


# ---- what is wrong among recordings


def test_a_damaged_recording_is_set_aside_and_the_others_go_on(begun, hot_end_record, tmp_path):  # noqa: F811
    folder = shutil.copytree(begun("log.csv"), tmp_path / "copy", symlinks=True)
    raw = folder / "datasets/raw/temperature"
    whole = write_parquet(hot_end_record)
    (raw / "night.parquet").write_bytes(whole[: len(whole) // 2])
    (raw / "second.csv").write_bytes(write_csv(Record(*(column[500:] for column in hot_end_record))))
    before = {path.name: path.read_bytes() for path in raw.iterdir()}
    play(folder, "ingest")
    quality = pandas.read_parquet(folder / "datasets/ingest/quality.parquet")
    table = pandas.read_parquet(folder / "datasets/ingest/record.parquet")
    assert set(table["recording"]) == {"log.csv", "second.csv"}
    told = quality[quality["recording"] == "night.parquet"]
    assert list(told["kind"]) == ["quarantined"] and "Parquet" in told["message"].iloc[0]
    assert {path.name: path.read_bytes() for path in raw.iterdir()} == before


PARTS = (
    "run", "pyproject.toml", "uv.lock", ".python-version", "README.md", ".dvcignore", "dvc.yaml",
    "params.yaml", "params.expert.yaml", "pipeline", "stages",
)  # fmt: skip


@pytest.fixture
def checkout(tmp_path) -> Path:
    """A copy of this checkout without data, with DVC and the environment of this process."""
    for name in PARTS:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
        elif (ROOT / name).exists():
            shutil.copy(ROOT / name, tmp_path / name)
    (tmp_path / "datasets/raw/temperature").mkdir(parents=True)
    subprocess.run([sys.executable, "-m", "dvc", "init", "--no-scm", "-q"], cwd=tmp_path, check=True)
    return tmp_path


def run_environment(folder: Path) -> dict[str, str]:
    return os.environ | {
        "PYTHONPATH": str(folder),
        "UV_NO_SYNC": "1",
        "UV_PROJECT_ENVIRONMENT": sys.prefix,
        "PATH": f"{os.environ['PATH']}{os.pathsep}{ROOT / '.uv/bin'}",
    }


def test_a_pipe_among_the_recordings_is_refused_within_two_seconds(checkout):
    """Seconds of CPU, so that a busy machine changes nothing; a reader of the pipe would wait for ever."""
    os.mkfifo(checkout / "datasets/raw/temperature/live.csv")

    def spent_s() -> float:
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        return used.ru_utime + used.ru_stime

    before = spent_s()
    ended = subprocess.run(
        ["./run", "dvc", "repro", "ingest"],
        cwd=checkout,
        env=run_environment(checkout),
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert ended.returncode != 0
    assert spent_s() - before < 2.0
    assert "live.csv is a named pipe (FIFO)" in ended.stderr
    assert "Running stage" not in ended.stdout


def test_a_misspelt_section_of_another_stage_is_refused_by_name(begun, tmp_path):
    folder = shutil.copytree(begun("log.csv"), tmp_path / "copy", symlinks=True)
    text = (folder / "params.yaml").read_text()
    (folder / "params.yaml").write_text(text.replace("\nreport:", "\nreprot:"))
    with pytest.raises(Refused, match=r"reprot is no section; did you mean report\?"):
        play(folder, "ingest")


def test_a_misspelt_key_is_refused_by_name_before_the_first_stage(checkout):
    text = (checkout / "params.yaml").read_text(encoding="utf-8")
    assert "  settled_error_degC:" in text
    misspelt = text.replace("  settled_error_degC:", "  settled_eror_degC:")
    (checkout / "params.yaml").write_text(misspelt, encoding="utf-8")
    repro = subprocess.Popen(
        ["./run", "dvc", "repro"],
        cwd=checkout,
        env=run_environment(checkout),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    printed = []
    assert repro.stdout
    for line in repro.stdout:
        printed.append(line)
        if "Running stage" in line:
            os.killpg(repro.pid, 9)
            break
    status = repro.wait(timeout=120)
    assert not any("Running stage" in line for line in printed), printed[-1]
    assert status != 0
    assert any("settled_eror_degC" in line and "settled_error_degC" in line for line in printed)


# ---- pins


def test_a_stage_without_the_pins_refuses_to_write(tmp_path):
    folder = begin(tmp_path / "project")
    declare(folder, {"generate_probing.samples": 200})
    pinned = (
        "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_CORETYPE",
        "NPY_DISABLE_CPU_FEATURES", "XLA_FLAGS", "NPROC", "PYTHONHASHSEED",
    )  # fmt: skip
    bare = {key: value for key, value in os.environ.items() if key not in pinned}
    ended = subprocess.run(
        [sys.executable, "-m", "stages.probe_machine"],
        cwd=folder,
        env=bare | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert ended.returncode != 0, "the stage ended well"
    assert "./run" in ended.stderr
    assert not (folder / "datasets/probe_machine").exists()
