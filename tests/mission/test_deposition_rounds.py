"""An owner's rounds: the commands of datasets/train_ilc/next are played on a foreign extruder, its recordings
with topics of their own and a turned camera are put into datasets/raw/deposition, and the stage is called
again."""

import json
import re
from pathlib import Path

import pytest
import yaml

from tests.foreign.deposition_machine import DepositionMachine
from tests.foreign.syringe import PneumaticSyringe
from tests.mission.toy_deposition import (
    LIKE_THE_SHIPPED,
    NEXT,
    OWN,
    REFERENCE,
    ROOT,
    SHORT,
    lay_out,
    machine,
    page_text,
    play,
    play_all,
    run_stage,
)

ALL = ("train_ilc", "segment_library", "compose_parts", "report")
SLOWER = {"speed_mm_per_s": 5.0, "pause_s": 0.4, **SHORT}


@pytest.fixture
def project(tmp_path, monkeypatch):
    """An owner's project: the reference, two routines like the shipped ones, on-off commands in next/."""
    monkeypatch.chdir(tmp_path)
    lay_out(OWN | {"printer.routines": LIKE_THE_SHIPPED})
    run_stage("train_ilc")
    return tmp_path


@pytest.fixture
def two_speeds(tmp_path, monkeypatch):
    """An owner's project with the reference and a slower routine, on-off commands in next/."""
    monkeypatch.chdir(tmp_path)
    lay_out(OWN | {"printer.routines": [SLOWER]})
    run_stage("train_ilc")
    return tmp_path


@pytest.fixture
def shipped(tmp_path, monkeypatch):
    """The shipped routines on one material, with a drive that is not declared; on-off commands in next/."""
    monkeypatch.chdir(tmp_path)
    owner, expert = (
        yaml.safe_load((ROOT / name).read_text()) for name in ("params.yaml", "params.expert.yaml")
    )
    printer = expert["printer"]
    lay_out(
        OWN
        | {
            "printer.drive": None,
            "printer.materials": owner["printer"]["materials"][:1],
            "printer.reference": printer["reference"],
            "printer.routines": printer["routines"],
        }
    )
    run_stage("train_ilc")
    return [printer["reference"], *printer["routines"]]


def walk(foreign: DepositionMachine, routines: list[dict[str, float]]) -> dict[int, list[float]]:
    """Three rounds of all commands, the page written after each: {routine: true errors in mm^3/s}."""
    errors: dict[int, list[float]] = {number: [] for number in range(len(routines))}
    for trial in range(3):
        played = play_all(foreign, routines, seed=trial)
        assert [one.name for one in played] == [
            f"A_routine_{number}_trial_{trial:02d}" for number in range(len(routines))
        ], "next/ holds one command a routine, of this round"
        for one in played:
            errors[one.routine].append(one.printed.error)
        before = Path("reports/deposition.html").stat().st_mtime_ns if trial else 0
        for stage in ALL:
            run_stage(stage)
        assert Path("datasets/segment_library/learned.json").exists() == (trial > 0)
        assert Path("reports/deposition.html").stat().st_mtime_ns > before
    return errors


def test_all_commands_of_next_are_played_for_three_rounds(project):
    errors = walk(machine(), [REFERENCE, *LIKE_THE_SHIPPED])
    for of_routine in errors.values():
        assert of_routine[2] <= 0.1 * of_routine[0]


@pytest.mark.full
def test_all_commands_of_the_shipped_routines_are_played_for_three_rounds(shipped):
    slow = PneumaticSyringe(fill_s=2.9, vent_s=2.4)
    errors = walk(machine(slow, frames_hz=10.0), shipped)
    for of_routine in errors.values():
        assert of_routine[2] <= 0.2 * of_routine[0]


def test_the_recording_of_one_routine_alone_is_learned_as_that_routine(project):
    play(machine(), NEXT / "A_routine_1_trial_00.csv", [REFERENCE, *LIKE_THE_SHIPPED], seed=0)
    run_stage("train_ilc")
    assert sorted(path.stem for path in NEXT.glob("*.csv")) == [
        "A_routine_0_trial_00", "A_routine_1_trial_01", "A_routine_2_trial_00",
    ]  # fmt: skip


def test_the_page_is_written_when_the_reference_routine_is_not_recorded_yet(two_speeds):
    play(machine(), NEXT / "A_routine_1_trial_00.csv", [REFERENCE, SLOWER], seed=0)
    for stage in ALL:
        run_stage(stage)
    assert Path("reports/deposition.html").exists()


def test_the_pages_of_a_machine_without_a_trial_are_written_and_say_so(project):
    for stage in ALL:
        run_stage(stage)
    text = page_text(Path("reports/deposition.html"))
    assert text.count("datasets/train_ilc/next") == 1, "what to do is said once"
    assert not re.search(r"is predicted|better|worse than|flow error forecast", text)


@pytest.mark.full
def test_every_forecast_of_the_shipped_parts_is_judged_on_the_shipped_machine(tmp_path, monkeypatch):
    """The lengths and the drive of params.yaml; nothing is filmed, and whole parts are hardly learned."""
    monkeypatch.chdir(tmp_path)
    names = tuple(path.stem for path in sorted((ROOT / "datasets/parts").glob("*.gcode")))
    changes = {"train_ilc.pixel_trials": 0, "compose_parts.full_part_updates": 1, "execution.jobs": 1}
    lay_out(changes, names)
    for stage in ("train_ilc", "segment_library", "compose_parts"):
        run_stage(stage)
    figures = json.loads(Path("datasets/compose_parts/figures.json").read_text())
    streams = {(name, material): one for name in names for material, one in figures[name].items()}
    assert {place[0] for place in streams} == set(names)
    for place, stream in streams.items():
        assert stream["judged"]["judged"], f"{place}: {stream['judged']['reason']}"
        assert stream["true"] <= stream["forecast"]["high"], place
