"""The way back to an earlier champion, recordings that git or DVC keeps, and what a change runs again."""

import json
import sys
from pathlib import Path

import pytest

from pipeline.cli import render_night
from pipeline.nightly import champion, inputs, night, reporting, reproducing
from pipeline.nightly.records import Champion, ChampionState
from pipeline.recordings import excluded
from pipeline.store import artifacts, params
from pipeline.verdict import verdict
from tests.conftest import ROOT
from tests.nightly.toy_nights import SETTINGS, Project


def play(steps: str) -> str:
    """The runs in production after promotions (n1; bn1 of loop b), accepted drifts (n1+) and rollbacks (<;
    <n1 to a run; <:a of a loop), one after the other."""
    state = ChampionState()
    for step in steps.split():
        loop, run = ("b", step[1:]) if step.startswith("b") else ("a", step)
        if step.startswith("<"):
            run, _, loop = step[1:].partition(":")
            for name, former in champion.find_earlier(state, run, loop).items():
                state = champion.promote(state, name, former, event="rolled back", when="by hand")
        elif step.endswith("+"):  # with another reference
            accepted = state.champions[loop]._replace(folder={"md5": step})
            state = champion.promote(state, loop, accepted, event="drift accepted")
        else:
            first = Champion(run, run, "", {"md5": f"{loop} {run}"})
            state = champion.promote(state, loop, first, event="promoted")
    return " ".join(one.run for one in state.champions.values())


@pytest.mark.parametrize(
    ("steps", "production"),
    [
        ("n1 n2 n3 <", "n2"),
        ("n1 n2 n3 < <", "n1"),
        # after n4 was promoted in the place of n3, the one before it is n2
        ("n1 n2 n3 < n4 <", "n2"),
        ("n1 n2 n3 < n4 < <", "n1"),
        # one that was left is put back by its name alone; before it is what it then replaced
        ("n1 n2 n3 < n4 <n3", "n3"),
        ("n1 n2 n3 < n4 <n3 <", "n4"),
        ("n1 n2 n3 <n1 <n3", "n3"),
        # the last promotions of all loops are taken back in their order
        ("n1 bn1 bn2 n3 bn4 <", "n3 n2"),
        ("n1 bn1 bn2 n3 bn4 < <", "n1 n2"),
        ("n1 bn1 bn2 n3 bn4 < < <", "n1 n1"),
        ("n1 bn1 bn2 n3 bn4 < < < n5 <:a", "n1 n1"),
        # with an accepted drift it is the same champion
        ("n1 n2 n2+ <", "n1"),
    ],
)
def test_rollback_goes_back_the_way_that_production_came(steps, production):
    assert play(steps) == production


def test_before_the_first_champion_there_is_none():
    with pytest.raises(ValueError, match="expected an earlier champion to go back to, found none"):
        play("n1 n2 n3 < < <")


# ---- what git or DVC keeps is left where it lies


def with_deposition(project: Project, **changes) -> Path:
    """A loop whose recordings are looked at without a champion; its folder."""
    loop = {
        "judge": "deposition", "cases": "", "recordings": "datasets/raw/deposition",
        "artifacts": ["datasets/segment_library/library.parquet"],
    }  # fmt: skip
    project.set(loops=SETTINGS["loops"] | {"deposition": loop}, **changes)
    change_params(project)
    raw = project.folder / "datasets/raw/deposition"
    raw.mkdir(parents=True, exist_ok=True)
    undecided = verdict.Verdict("deposition", verdict.OPEN, "Undecided (simulation).", "", "", "", "", None)
    verdict.write({"deposition": undecided}, project.folder / "datasets/verdict")
    project.run("git", "add", "-A")
    project.run("git", "commit", "-qm", "another loop")
    return raw


def change_params(project: Project, **nightly) -> None:
    """Keys of section nightly changed, beside the sections that the pages of the other loops go by."""
    sections = params.read(ROOT / "params.yaml")
    sections["nightly"] = json.loads((project.folder / "params.yaml").read_text())["nightly"] | nightly
    (project.folder / "params.yaml").write_text(json.dumps(sections, indent=1))


BROKEN = b"\x89MCAP0\r\n half a file"


@pytest.mark.parametrize("kept_by", ["git", "DVC"])
def test_a_recording_that_git_or_dvc_keeps_stays_is_excluded_and_alarms_once(project, kept_by):
    raw = with_deposition(project)
    (raw / "kept.mcap").write_bytes(BROKEN)
    if kept_by == "DVC":
        project.run(sys.executable, "-m", "dvc", "add", "-q", "datasets/raw/deposition")
    project.run("git", "add", "-A")
    project.run("git", "commit", "-qm", "a recording")
    (raw / "dropped.mcap").write_bytes(BROKEN)
    status, summary = night.nightly(render_night)
    assert status == reporting.QUARANTINED and f"kept.mcap ({kept_by} keeps it" not in summary
    assert (
        f"({kept_by} keeps it: it stays, and is listed in datasets/raw/deposition/excluded.yaml)" in summary
    )
    assert (raw / "kept.mcap").read_bytes() == BROKEN and not (raw / "dropped.mcap").exists()
    assert (inputs.QUARANTINE / "deposition/dropped.mcap").exists()
    entry = excluded.read_list(raw)["kept.mcap"]
    assert entry["sha256"] == artifacts.sha256(raw / "kept.mcap") and "kept.mcap" in entry["reason"]
    assert excluded.readable([raw / "kept.mcap", raw / "other.mcap"], raw) == [raw / "other.mcap"]
    # the list is committed with the recordings, and no night speaks of it again
    assert project.dirty() == []
    assert "nothing new" in night.nightly(render_night)[1]
    change_params(project, watch_h=40)
    status, summary = night.nightly(render_night)
    assert status == reporting.OK and "kept.mcap" not in summary
    # mended, it is a new recording, and looked at again
    (raw / "kept.mcap").write_bytes(BROKEN + b" mended")
    assert night.nightly(render_night)[0] == reporting.QUARANTINED


def test_who_keeps_a_recording_goes_by_its_own_name_and_not_by_a_pattern(project):
    kept, dropped = project.record("shift 1", [11.0]), project.record("shift [1]", [11.0])
    project.run("git", "add", str(kept))
    assert inputs.keeper(kept.relative_to(project.folder)) == "git"
    assert inputs.keeper(dropped.relative_to(project.folder)) == ""
    inputs.quarantine(str(dropped.relative_to(project.folder)), "toy", "far off")
    assert kept.exists() and (inputs.QUARANTINE / "toy/shift [1].csv").exists()


# ---- what runs again


@pytest.mark.parametrize(
    ("loop", "stages"),
    [
        (
            "temperature",
            "ingest identify_plant learn_kernel generate_probing tune_weights evaluate_temperature "
            "certify verdict export_controllers report",
        ),
        ("deposition", "train_ilc segment_library compose_parts verdict export_controllers report"),
        ("setpoint", "train_classifier evaluate_setpoint certify verdict export_controllers report"),
    ],
)
def test_a_new_recording_reruns_the_stages_of_its_own_loop_and_the_pages(monkeypatch, loop, stages):
    monkeypatch.chdir(ROOT)
    place = f"datasets/raw/{loop}/"
    wired = reproducing.read_stages("dvc.yaml")
    readers = {
        name for name, stage in wired.items() if any(place.startswith(f"{dep}/") for dep in stage["deps"])
    }
    upstream = reproducing.read_upstream()
    assert {name for name in wired if upstream[name] & readers} == set(stages.split())
