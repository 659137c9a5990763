"""Deposition and setpoint, from what their stages scored to what is in production: a better challenger goes
in, a worse one or one with a worse guard does not."""

import json
from pathlib import Path

import numpy as np
import pytest

from pipeline.cli import render_night
from pipeline.deposition.tables import SCORES
from pipeline.nightly import (
    by_hand,
    champion,
    inputs,
    night,
    promoting,
    remembered,
    reporting,
    reproducing,
    screening,
    watch,
)
from pipeline.nightly.records import Alarm, Memory, Night, NightDrift
from pipeline.nightly.settings import Nightly
from pipeline.setpoint import tables
from pipeline.store import artifacts, params
from pipeline.verdict.verdict import PASSED, Verdict
from tests.nightly.toy_nights import Project, entered

LOOPS = {
    "deposition": ["datasets/compose_parts/scores.parquet"],
    "setpoint": ["datasets/evaluate_setpoint/choice.json", "datasets/evaluate_setpoint/scoreboard.parquet"],
}


@pytest.fixture(scope="module")
def empty(tmp_path_factory):
    return Project(tmp_path_factory.mktemp("loops") / "toy").make()


@pytest.fixture
def project(empty, tmp_path, monkeypatch):
    """A project with one loop, whose stages score what the test says in place of `dvc repro`, and whose pages
    pass."""
    copy = entered(empty, tmp_path / "toy", monkeypatch)
    monkeypatch.setattr(
        promoting, "read_verdicts", lambda settings, night: dict(map(passing, settings.loops))
    )
    Path("dvc.lock").write_text("schema: '2.0'\nstages: {}\n")
    return copy


def own(*names: str) -> dict[str, dict]:
    """These loops as section nightly has them, without recordings."""
    return {loop: {"judge": loop, "cases": "", "recordings": "", "artifacts": LOOPS[loop]} for loop in names}


def passing(loop: str) -> tuple[str, Verdict]:
    said = "Pass (simulation): ours.", "All six rules passed.", "", "", ""
    return loop, Verdict(loop, PASSED, *said, winner="ours", subject="ours", rehearsal=True)


def played(*_: None) -> tuple[dict, list]:
    """Stages that did what they were played to do."""
    return {}, []


def deposition(cost: float, guard: float) -> None:
    """Eight parts whose composed flow leaves `cost` percent of on-off control's error, the worst line's
    volume wrong by `guard` percent; the yardstick beside each is not judged."""
    names = [f"part {k}" for k in range(8)]
    columns = {
        "part": 2 * names, "material": ["A"] * 16, "composer": ["basis"] * 8 + ["on_off"] * 8,
        "chosen": [True] * 8 + [False] * 8,
        "rms_percent_of_on_off": [cost + 0.1 * k for k in range(8)] + [100.0] * 8,
        "predicted_percent": [cost] * 8 + [np.nan] * 8,
        "worst_line_volume_percent": [guard] * 8 + [50.0] * 8,
    }  # fmt: skip
    artifacts.write_table("datasets/compose_parts/scores.parquet", SCORES, columns)


def setpoint(cost: float, guard: float) -> None:
    """Eight cases in which the chosen controller does not settle `cost` percent of its runs, the slowest in
    `guard` steps; a case that does not count, and another controller."""
    rows = [("ours", f"case {k}", True, 100 - cost - 0.1 * k) for k in range(8)]
    rows += [("ours", "beyond the box", False, 0.0), ("pid", "case 0", True, 0.0)]
    filler = {
        c.name: ["agent"] * 10
        if str(c.type) == "string"
        else np.ones(10, int)
        if "int" in str(c.type)
        else np.ones(10)
        for c in tables.SCOREBOARD.columns
    }
    named = {
        "controller": [r[0] for r in rows],
        "simulator": ["paper"] * 10,
        "case": [r[1] for r in rows],
        "counts": [r[2] for r in rows],
        "settled_percent": [r[3] for r in rows],
        "p90_steps": [guard] * 8 + [99.0] * 2,
    }
    artifacts.write_table("datasets/evaluate_setpoint/scoreboard.parquet", tables.SCOREBOARD, filler | named)
    artifacts.write_json("datasets/evaluate_setpoint/choice.json", {"name": "ours"})


@pytest.mark.parametrize(("loop", "score"), [("deposition", deposition), ("setpoint", setpoint)])
def test_a_better_challenger_is_promoted_and_a_worse_one_or_one_with_a_worse_guard_is_not(
    project, monkeypatch, loop, score
):
    project.set(loops=own(loop))
    # cost, guard, and what the night must say of it
    nights = [
        (10.0, 2.0, "first champion", ""),
        (15.0, 2.0, "kept", "the challenger is no better"),
        (5.0, 4.0, "kept", "more is allowed"),  # better, and its worst case worse
        (9.8, 2.0, "kept", "at least 5 % is worth a change"),
        (8.0, 2.0, "promoted", "no guard is worse"),
        (10.0, 2.0, "kept", "the challenger is no better"),
    ]
    for k, (cost, guard, decision, reason) in enumerate(nights):
        monkeypatch.setattr(reproducing, "reproduce", lambda *_, of=(cost, guard), **__: played(score(*of)))
        project.record(f"night {k}", [10.0])
        Path("learn.py").write_text(f"# night {k}\n")  # something is new
        status, summary = night.nightly(render_night)
        decided = remembered.read().nights[-1].decisions[loop]
        assert (
            status == reporting.OK and decided.decision == decision and reason in " ".join(decided.reasons)
        ), (summary, decided)
        assert champion.read().champions[loop].run == ("night-0005" if k >= 4 else "night-0001")
    # production holds what was promoted, not what was scored last
    present = champion.read().champions[loop]
    assert present.rehearsal and present.contestant == "ours"


def test_a_loop_that_is_switched_off_is_no_part_of_the_night(project, monkeypatch):
    alarm = Alarm("setpoint", "setpoint: ink", "a print", "the ink looks different", 9.0)
    monkeypatch.setattr(
        reproducing, "reproduce", lambda *_, **__: played(deposition(10.0, 2.0), setpoint(10.0, 2.0))
    )
    remembered.write(Memory(alarms=[alarm], recordings={"setpoint": {}}))
    project.set(loops_on={"setpoint": False}, loops=own(*LOOPS))
    status, summary = night.nightly(render_night)
    tonight = remembered.read().nights[-1]
    assert status == reporting.OK and tonight.promoted == ["deposition"], summary
    assert "no part of the night, by section loops: setpoint" in summary
    assert list(tonight.decisions) == list(champion.read().champions) == ["deposition"]
    assert not tonight.drift.alarms
    # switched on, the night has it again
    project.set(loops=own(*LOOPS))
    status, summary = night.nightly(render_night)
    assert status == reporting.OK and "promoted setpoint" in summary and "no part" not in summary
    # without any there is nothing to do
    project.set(loops_on=dict.fromkeys(LOOPS, False), loops=own(*LOOPS))
    monkeypatch.setattr(reproducing, "reproduce", lambda *_, **__: pytest.fail("no stage is asked"))
    status, summary = night.nightly(render_night)
    assert status == reporting.OK and "section loops switches off every loop" in summary


def test_every_section_of_the_parameters_is_checked_before_the_first_stage(project, monkeypatch):
    project.set(loops=own("deposition"))
    written = Path("params.yaml").read_text()
    Path("params.yaml").write_text(written.replace('"max_order"', '"max_ordre"'))
    monkeypatch.setattr(reproducing, "reproduce", lambda *_, **__: pytest.fail("no stage is asked"))
    status, summary = night.nightly(render_night)
    assert status == reporting.FAILED and "max_ordre" in summary and "max_order" in summary
    assert "max_ordre" in Path("reports/nightly.html").read_text()


def test_a_recording_that_cannot_be_read_is_set_aside_and_the_scheduler_is_told(project, monkeypatch):
    recordings = {"recordings": "datasets/raw/deposition"}
    project.set(loops={"deposition": own("deposition")["deposition"] | recordings})
    sections = json.loads(Path("params.yaml").read_text())
    camera = params.read(Path(__file__).resolve().parents[2] / "params.yaml")["camera"]
    Path("params.yaml").write_text(json.dumps(sections | {"camera": camera}))
    monkeypatch.setattr(reproducing, "reproduce", lambda *_, **__: played(deposition(10.0, 2.0)))
    status, summary = night.nightly(render_night)
    assert status == reporting.OK, summary
    broken = Path("datasets/raw/deposition/trial_7.mcap")
    broken.parent.mkdir(parents=True)
    broken.write_bytes(b"\x89MCAP0\r\n half a file")
    Path("learn.py").write_text("# something else is new\n")
    status, summary = night.nightly(render_night)
    assert status == reporting.QUARANTINED == 4 and "trial_7.mcap" in summary, summary
    assert not broken.exists() and (inputs.QUARANTINE / "deposition/trial_7.mcap").read_bytes().endswith(
        b"half a file"
    )
    assert champion.read().champions["deposition"].run == "night-0001"
    alarm = artifacts.read_json(watch.ALARM)
    assert alarm["kind"] == "quarantined" and "trial_7.mcap" in alarm["reasons"][0]
    assert "Bad recordings are set aside." in Path("reports/nightly.html").read_text()


def test_the_gravest_of_a_night_is_its_exit_status():
    alarm = Alarm("toy", "key", "a.csv", "cause", 9.0)

    def status(outcome: str = "kept", *, unpushed: bool = False, **drift) -> int:
        night = Night(1, "night-0001", "2030-01-01T02:00:00+00:00", outcome, drift=NightDrift(**drift))
        night.unpushed = unpushed
        return reporting.exit_status(night)

    both = {"quarantined": {"a.csv": "reason"}, "alarms": [alarm]}
    assert (status(), status(quarantined={"a.csv": "reason"}), status(**both)) == (0, 4, 3)
    assert status("failed", **both) == status(unpushed=True) == 1


def test_drift_that_is_meant_is_accepted_by_hand_and_the_champion_stays(project, monkeypatch):
    project.set(loops=own("deposition"))
    monkeypatch.setattr(reproducing, "reproduce", lambda *_, **__: played(deposition(10.0, 2.0)))
    assert night.nightly(render_night)[0] == reporting.OK
    with pytest.raises(
        ValueError,
        match="expected a loop with a champion and a drift alarm, found none; loops with an alarm: none",
    ):
        by_hand.accept("deposition", "a new camera")
    before = project.production_of("deposition")
    memory = remembered.read()
    memory.pending, memory.drifted = ["deposition: camera"], {"deposition": ["trial_8.mcap"]}
    remembered.write(memory)
    monkeypatch.setattr(
        screening,
        "reference",
        lambda loop, folder, only: {"schema": "reference", "version": 1, "camera": list(only)},
    )
    assert "is held against trial_8.mcap from now on" in by_hand.accept("deposition", "a new camera")
    after = project.production_of("deposition")
    assert artifacts.read_json("champion/deposition/reference.json")["camera"] == ["trial_8.mcap"]
    assert {name: after[name] for name in before} == before
    assert remembered.read().drifted == {"deposition": []}
    line = champion.read().history[-1]
    assert (line.event, line.why, line.run) == ("drift accepted", "a new camera", "night-0001")
    assert not any(entry.endswith(("champion.json", ".dvc")) for entry in project.dirty())


def test_an_alarm_of_the_setpoint_camera_changes_nothing_for_another_loop(project, monkeypatch):
    project.set(loops=own(*LOOPS))
    monkeypatch.setattr(
        reproducing, "reproduce", lambda *_, **__: played(deposition(10.0, 2.0), setpoint(10.0, 2.0))
    )
    assert night.nightly(render_night)[0] == reporting.OK
    raised = Alarm(
        "setpoint", "setpoint: contrast", "print_8.csv", "the line stands out by 25 gray levels", 9.0
    )
    memory = remembered.read()
    memory.alarms, memory.drifted = [raised], {"setpoint": ["print_8.csv"]}
    remembered.write(memory)
    monkeypatch.setattr(
        reproducing, "reproduce", lambda *_, **__: played(deposition(5.0, 2.0), setpoint(5.0, 2.0))
    )
    Path("learn.py").write_text("# something is new\n")
    status, summary = night.nightly(render_night)
    tonight = remembered.read().nights[-1]
    # the setpoint loop, whose camera it is, keeps its champion; the other is promoted as on any night
    assert status == reporting.DRIFTED and tonight.promoted == ["deposition"], summary
    assert tonight.drift.alarms == [raised]
    assert not any("drift" in reason for reason in tonight.decisions["deposition"].reasons)
    assert "drift: the line stands out" in " ".join(tonight.decisions["setpoint"].reasons)
    html = Path("reports/nightly.html").read_text()
    assert "Drift of setpoint; promoted: deposition." in html and "--accept-drift setpoint" in html
    assert "machine has drifted" not in html and "--accept-drift deposition" not in html


def test_a_loop_is_named_after_its_judge_so_that_no_alarm_is_read_as_another_s(project):
    project.set(loops={"nozzle": {"judge": "setpoint", "cases": "", "recordings": "", "artifacts": ["a"]}})
    with pytest.raises(ValueError, match="has loop nozzle with judge setpoint; name the loop setpoint"):
        params.load(Nightly, "nightly")
