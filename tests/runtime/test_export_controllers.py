"""What is exported is what was judged: commands, files and words of the stage, on six plants of the study's
machine."""

import errno
import types
from functools import cache

import numpy as np
import pytest
from pipeline.runtime.workflow import export_controllers as export
from pipeline.runtime.workflow import exports, replay

from pipeline.runtime import machine
from pipeline.store import artifacts
from tests.temperature.test_evaluate_temperature import judged, small


@cache
def given() -> tuple[export.Judged, dict[str, np.ndarray]]:
    """What evaluate_temperature read and wrote."""
    of = small()
    result = judged(of)
    told = export.Judged(of.machine, of.setting, of.problem, of.weights, result.summary, True)
    return told, {name: np.asarray(values) for name, values in result.trajectories.items()}


def made(name: str) -> machine.Exported:
    return export.exported(given()[0], name)


@pytest.mark.parametrize("name", ["pi", "subspace_lqg", "varx_riccati", "learned_kernel"])
def test_the_exported_law_gives_the_judged_commands_of_the_deciding_case(name):
    told, trajectories = given()
    difference = export.replayed(made(name), told, trajectories)
    assert difference <= 1e-9 * 100
    export.check_same(made(name), difference)


def test_a_law_that_was_changed_since_is_not_exported():
    told, trajectories = given()
    one = made("subspace_lqg")
    law = one.controller.law
    changed = one._replace(controller=one.controller._replace(law=law._replace(K=1.001 * law.K)))
    difference = export.replayed(changed, told, trajectories)
    with pytest.raises(
        ValueError, match=r"subspace_lqg asks for commands .* percent away from those that were"
    ):
        export.check_same(changed, difference)


def test_an_exported_machine_is_the_declared_one():
    one, declared = made("pi"), given()[0].machine
    machine.check(one)
    assert [signal.name for signal in one.machine.inputs] == [signal.name for signal in declared.inputs]
    assert [(o.low, o.high) for o in one.machine.outputs] == [(o.low, o.high) for o in declared.outputs]
    assert one.simulated and one.fallback is not None


@pytest.mark.parametrize(
    ("best", "name", "why"),
    [
        ("pi", "pi", ""),
        (None, "", "The verdict names no controller to run: Fail (simulation)."),
        ("hold", "", "Doing nothing is recommended"),
    ],
)
def test_nothing_is_exported_where_the_verdict_recommends_no_controller(best, name, why):
    found, reason = export.chosen(best, "Fail (simulation).")
    assert found == name and reason.startswith(why)
    assert export.nothing(reason).files == {}


def test_only_learned_gains_have_bands():
    told = given()[0]
    assert export.learning("subspace_lqg", told) is None and export.learning("pi", told) is None
    assert export.learning("varx_riccati", told).route == "window"
    assert export.learning("learned_kernel", told).N == told.problem.kernel.N


def test_an_export_of_what_is_no_controller_is_refused_in_a_sentence(tmp_path):
    with pytest.raises(ValueError, match="is no folder; give a CONTROLLER folder with controller.json"):
        exports.export(tmp_path / "none", "c", None, "extruder", None)
    with pytest.raises(ValueError, match="--power: expected the heater's power above 0 W, found -4"):
        exports.export(tmp_path, "klipper", None, "extruder", -4.0)
    (tmp_path / "out").write_text("")
    with pytest.raises(ValueError, match="should be a folder but is a file"):
        exports.export(tmp_path, "c", tmp_path / "out", "extruder", None)


# ---- what a recording must have


def recording(folder, **changed):
    """A CSV of the study's machine at rest, with some columns changed or (None) left out."""
    wired, rng = made("pi").machine, np.random.default_rng(1)
    columns = {"time_s": np.arange(200.0)}
    columns |= {one.name: np.full(200, 5.0) for one in wired.inputs}
    columns |= {one.name: 150 + 0.1 * rng.standard_normal(200) for one in wired.outputs}
    columns = {name: values for name, values in (columns | changed).items() if values is not None}
    artifacts.write_csv(folder / "log.csv", columns)
    return folder / "log.csv"


def test_references_are_those_of_the_recording_or_of_the_command_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where there is no params.yaml
    one = made("pi")
    names, asked = [o.name for o in one.machine.outputs], replay.Asked((), tmp_path)
    path = recording(tmp_path, **{f"{name}_target": np.full(200, 140.0) for name in names})
    table, named = replay.recorded(path, one)
    assert named == "_target"
    np.testing.assert_array_equal(replay.references(table, named, one, asked), 140.0)
    table, named = replay.recorded(recording(tmp_path), one)
    with pytest.raises(ValueError, match="log.csv: it has no references .*; write --reference"):
        replay.references(table, named, one, asked)
    with pytest.raises(ValueError, match="--reference: expected 5 temperatures in °C .*, found 2"):
        replay.references(table, named, one, asked._replace(reference=(150.0, 160.0)))


def test_a_recording_without_a_signal_of_the_machine_is_refused_by_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match="log.csv.*sensor_3"):
        replay.recorded(recording(tmp_path, sensor_3=None), made("pi"))


def test_missing_values_are_held_and_told(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    one = made("pi")
    lost = np.full(200, 150.0)
    lost[50:60] = np.nan
    table, _ = replay.recorded(recording(tmp_path, sensor_2=lost), one)
    done = replay.replayed(one, None, table, np.full((200, 5), 150.0))
    assert np.isfinite(done.measured).all() and np.isfinite(done.asked).all()
    assert any("samples lack a signal; the last value stands for it" in told for told in done.told)
    told = replay.summary(done, one, tmp_path / "log.csv")
    assert told["samples"] == 200 and not told["abstains"]
    columns = replay.signals(done, one)
    shown = {
        path["value"].removeprefix("/replay.")
        for panel in replay.layout(one)["configById"].values()
        for path in panel["paths"]
    }
    assert shown <= set(columns)


def test_an_export_that_finds_the_disk_full_leaves_what_was_there(tmp_path, monkeypatch):
    real = artifacts.write_text

    def full(path, text):
        if path.name == "b.c":
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        real(path, text)

    made = types.SimpleNamespace(name="law", simulated=False)
    monkeypatch.setattr(exports.machine, "read", lambda folder: (made, None))
    monkeypatch.setattr(exports.certificate, "sha256", lambda shown: 64 * "0")
    for text in ("first", "second"):
        monkeypatch.setattr(exports, "files", lambda *asked, text=text: {"a.c": text, "b.c": text})
        if text == "second":
            monkeypatch.setattr(artifacts, "write_text", full)
            with pytest.raises(OSError, match=r"c/b\.c.*No space left on device"):
                exports.export(tmp_path, "c", tmp_path / "c", "", None)
        else:
            exports.export(tmp_path, "c", tmp_path / "c", "", None)
    assert {path.name: path.read_text() for path in (tmp_path / "c").iterdir()} == {
        "a.c": "first",
        "b.c": "first",
    }
