"""`beadline nightly`: on a toy project promotes, keeps, and rolls back; on an owner's project, with its own
parameters and machine, it sets aside what is broken and alarms on drift and on a sensor that stands still."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from tests.foreign import two_zones
from tests.mission.conftest import STAGES, Project, params_of
from tests.nightly import toy_nights

PROMOTED, DRIFTED, QUARANTINED = 0, 3, 4
# of a night: one loop, no other machine is told, and rules that so few plants and searches can pass
NIGHTLY = {
    "nightly.loops": {
        "temperature": {
            "artifacts": [
                "datasets/identify_plant/plant.parquet", "datasets/identify_plant/spread.parquet",
                "datasets/learn_kernel/window.parquet", "datasets/tune_weights/weights.json",
            ],
            "judge": "temperature", "cases": "", "recordings": "datasets/raw/temperature",
        }
    },
    "nightly.least_free_mb": 1,
    "nightly.holdout.starts_degC": [50],
    "nightly.holdout.reference_offsets_degC": [0],
    "nightly.holdout.plants": 8,
    "nightly.holdout.steps": 200,
    "report.settled_error_degC": 1000,
    "report.settling_s": 1e6,
    "report.overshoot_degC": 1000,
    "report.at_limits_percent": 100,
    "report.disk_margin": 0.01,
    "report.delay_margin_s": 0.01,
    "evaluate_temperature.resamples": 20,
}  # fmt: skip


# ---- a toy project of two stages


@pytest.fixture
def toy(made_once, tmp_path) -> toy_nights.Project:
    """A copy of the project after its first night, which promoted."""
    first = made_once("toy_nights", lambda folder: toy_nights.Project(folder).make().promoted())
    shutil.copytree(first, tmp_path / "toy", symlinks=True)
    return toy_nights.Project(tmp_path / "toy")


def test_a_night_promotes_what_is_better_keeps_what_is_not_and_rolls_back(toy):
    first = toy.production()
    toy.record("better", [9.0, 9.0, 9.0])
    better = toy.night()
    assert better.returncode == 0 and "promoted toy" in better.stdout
    second = toy.production()
    assert second != first
    toy.record("worse", [30.0])
    worse = toy.night()
    assert worse.returncode == 0 and "kept" in worse.stdout
    assert toy.production() == second
    back = toy.beadline("nightly", "--rollback")
    assert back.returncode == 0
    assert toy.production() == first


# ---- an owner's machine


@pytest.fixture(scope="session")
def commissioned(made_once, owner) -> Project:
    """The owner's project after its first night, whose controller is in production."""

    def make(folder: Path) -> None:
        project = owner.copy(folder)
        shutil.copy(toy_nights.ROOT / "dvc.yaml", folder / "dvc.yaml")
        project.keep_stages(*STAGES, "evaluate_temperature", "verdict")
        without_other_loops(folder / "dvc.yaml")
        for k in range(2):
            shift = two_zones.record_shift(np.random.default_rng(100 + k))
            two_zones.write_csv(folder / f"datasets/holdout/temperature/holdout_{k}.csv", shift)
        project.declare(NIGHTLY).commit()
        first = project.beadline("nightly")
        if "promoted temperature" not in first.stdout:
            raise RuntimeError(first.stdout)

    return Project(made_once("commissioned", make))


def without_other_loops(path: Path) -> None:
    """dvc.yaml whose stages depend on nothing that no stage in it makes."""
    stages = params_of(path)["stages"]
    for stage in stages.values():
        made = {dep: Path(dep).parts[1] for dep in stage["deps"] if dep.startswith("datasets/")}
        gone = {dep for dep, maker in made.items() if maker not in (*stages, "raw")}
        stage["deps"] = [dep for dep in stage["deps"] if dep not in gone]
    path.write_text(yaml.safe_dump({"stages": stages}, sort_keys=False))


@pytest.fixture
def machine(commissioned, tmp_path) -> Project:
    return commissioned.copy(tmp_path / "project")


def night_with(project: Project, columns: dict[str, np.ndarray]):
    """The night after one more shift."""
    two_zones.write_csv(project.folder / "datasets/raw/temperature/shift_9.csv", columns)
    return project.beadline("nightly", check=False)


@pytest.mark.full
def test_a_gain_that_fell_by_a_tenth_is_an_alarm_that_names_the_heater(machine):
    shift = two_zones.record_shift(np.random.default_rng(9), gain=(0.9, 1.0))
    ended = night_with(machine, shift)
    assert ended.returncode == DRIFTED, ended.stdout + ended.stderr
    assert "heater_1" in ended.stderr


@pytest.mark.full
def test_a_frozen_sensor_is_an_alarm_that_names_the_sensor(machine):
    shift = two_zones.record_shift(np.random.default_rng(9))
    ended = night_with(machine, two_zones.freeze(shift, "zone_1_C", after=0.5))
    said = ended.stdout + ended.stderr
    assert ended.returncode == DRIFTED and "temperature_1" in ended.stderr, said


@pytest.mark.full
def test_a_broken_recording_is_set_aside_and_the_champion_stays(machine):
    before = production(machine)
    broken = machine.folder / "datasets/raw/temperature/broken.csv"
    broken.write_text("no table at all")
    ended = machine.beadline("nightly", check=False)
    assert ended.returncode == QUARANTINED, ended.stdout + ended.stderr
    assert broken.name in ended.stderr and not broken.exists()
    assert production(machine) == before


def production(project: Project) -> dict[str, bytes]:
    folder = project.folder / "champion"
    return {path.as_posix(): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}
