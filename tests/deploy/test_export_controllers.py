"""The stage export_controllers copies what certify prepared, under the limits of section `report`; and the
commands that read its folders."""

import errno
import json
import shutil
import types
from pathlib import Path

import numpy as np
import pytest

from pipeline.commands import export, replay
from pipeline.deploy import certificate, machine, to_c, to_python
from pipeline.store import artifacts
from stages import export_controllers
from tests.deploy.deployed_machines import exported, passed
from tests.deploy.test_certificate import ALLOWED, decided, measure
from tests.deploy.test_certify import made

ROOT = Path(__file__).resolve().parents[2]
SETPOINT = {"controller": "", "why": "Not asked: loops.setpoint is false.", "largest_difference": {}}


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A project in which certify measured one controller, and whose verdict names it."""
    monkeypatch.chdir(tmp_path)
    for name in ("params.yaml", "params.expert.yaml"):
        shutil.copy(ROOT / name, tmp_path)
    of, folder = exported(), tmp_path / "datasets/certify/temperature/lqg"
    draft = passed(of)
    measured = measure()
    measured = measured._replace(
        draft=measured.draft._replace(
            controller="lqg", controller_sha256=draft.controller_sha256, evidence="simulated",
            plant_sha256=draft.plant_sha256, spread_sha256=draft.spread_sha256,
            inputs=draft.inputs, outputs=draft.outputs,
        )
    )  # fmt: skip
    certificate.write(folder, measured)
    machine.write_controller(folder, of)
    for name, text in to_c.code(of, certificate.PLACE).items():
        artifacts.write_text(folder / "c" / name, text)
    artifacts.write_text(folder / "python/controller.py", to_python.code(of, certificate.PLACE))
    found = {"measured": True, "why": "", "largest_difference": {"judged": 0.0, "python": 0.0}}
    cooled = {"measured": False, "why": "It cannot be designed.", "largest_difference": {}}
    told = {"temperature": {"lqg": found, "pi": cooled}, "setpoint": SETPOINT}
    artifacts.write_json(tmp_path / "datasets/certify/certified.json", told)
    name_winner(tmp_path, "lqg")
    return tmp_path


def name_winner(project: Path, winner: str | None, **more) -> None:
    verdict = {"winner": winner, "decision": "Fail (simulation).", "lead": "Not one settles."}
    verdict |= {"reason": "First failed rule: settling."} | more
    artifacts.write_json(project / "datasets/verdict/temperature.json", verdict)


def run(project: Path) -> dict:
    export_controllers.main()
    return json.loads((project / "datasets/export_controllers/exported.json").read_text(encoding="utf-8"))


def test_the_files_of_the_named_controller_are_copied_with_its_certificate(project):
    temperature = run(project)["temperature"]
    assert (temperature["contestant"], temperature["why"]) == ("lqg", "")
    assert temperature["certificate"]["verdict"] == "passed"
    folder = project / "datasets/export_controllers/temperature"
    assert set(temperature["files"]) == {
        path.relative_to(folder.parent).as_posix() for path in folder.rglob("*") if path.is_file()
    }
    read, shown = machine.read(folder)
    assert read.name == "lqg" and certificate.sha256(shown) == temperature["certificate"]["sha256"]
    assert not any(
        certificate.PLACE.encode() in path.read_bytes() for path in folder.rglob("*") if path.is_file()
    )
    digest = certificate.sha256(shown)
    for name, text in to_c.code(read, digest).items():
        assert (folder / "c" / name).read_text(encoding="utf-8") == text
    code = (folder / "python/controller.py").read_text(encoding="utf-8")
    assert code == to_python.code(read, digest)


def test_a_changed_limit_refuses_without_measuring_again(project):
    text = (project / "params.yaml").read_text(encoding="utf-8")
    limit = next(line for line in text.splitlines() if "settled_error_degC:" in line)
    (project / "params.yaml").write_text(text.replace(limit, "  settled_error_degC: 0.001"), encoding="utf-8")
    measured = (project / "datasets/certify/temperature/lqg/measured.json").read_bytes()
    temperature = run(project)["temperature"]
    assert temperature["certificate"]["verdict"] == "refused" and temperature["files"] == {}
    assert temperature["why"].startswith("The certificate is refused by its rule noise. Noise of ")
    left = project / "datasets/export_controllers/temperature"
    assert [path.name for path in left.iterdir()] == ["certificate.json"]
    assert (project / "datasets/certify/temperature/lqg/measured.json").read_bytes() == measured


@pytest.mark.parametrize(
    ("winner", "why"),
    [
        (None, "Not exported: Fail (simulation). Not one settles. First failed rule: settling."),
        ("hold", "Doing nothing is recommended: there is no controller to export."),
        ("pi", "It cannot be designed."),
    ],
)
def test_nothing_is_exported_if_there_is_no_file(project, winner, why):
    name_winner(project, winner)
    temperature = run(project)["temperature"]
    assert temperature["why"] == why and temperature["files"] == {} and temperature["certificate"] is None
    assert not (project / "datasets/export_controllers/temperature").exists()


@pytest.mark.parametrize("on", ["temperature", "deposition"])
def test_loops_that_are_off_are_not_asked(project, on):
    text = (project / "params.yaml").read_text(encoding="utf-8")
    off = [loop for loop in ("temperature", "deposition") if loop != on]
    for loop in off:
        text = text.replace(f"  {loop}: true", f"  {loop}: false", 1)
    (project / "params.yaml").write_text(text, encoding="utf-8")
    found = run(project)
    assert [found[loop]["why"] for loop in off] == [f"Not asked: loops.{loop} is false." for loop in off]
    assert not any(found[loop]["files"] for loop in off)
    assert "Not asked" not in found[on]["why"]


def test_the_results_of_all_controllers_are_read_without_measuring(project):
    found = certificate.results(project / "datasets/certify", **ALLOWED)
    assert found == {
        "lqg": {"passed": True, "why": ""},
        "pi": {"passed": False, "why": "It cannot be designed."},
    }
    tight = certificate.results(project / "datasets/certify", **ALLOWED | {"disk_margin": 1.9})
    assert "refused by its rule disk margin" in tight["lqg"]["why"]
    assert certificate.results(project / "none", **ALLOWED) == {}


def test_measured_figures_are_the_same_after_a_round_trip(project):
    stored = certificate.read(project / "datasets/certify/temperature/lqg")
    assert certificate.decide(stored, **ALLOWED).rules == decided().rules


# ---- commands


def test_an_export_of_what_is_no_controller_is_refused_in_a_sentence(tmp_path):
    with pytest.raises(ValueError, match="is no folder; give a CONTROLLER folder with controller.json"):
        export.export(tmp_path / "none", "c", None)
    why = {"temperature": {"why": "Not exported: Fail. First failed rule: disk margin."}}
    (tmp_path / "exported.json").write_text(json.dumps(why))
    with pytest.raises(
        ValueError, match="temperature has no controller.json. Not exported: Fail. First failed"
    ):
        export.export(tmp_path / "temperature", "c", None)
    (tmp_path / "out").write_text("")
    with pytest.raises(ValueError, match="should be a folder but is a file"):
        export.export(tmp_path, "c", tmp_path / "out")


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
    names = [o.name for o in one.machine.outputs]
    path = recording(tmp_path, **{f"{name}_target": np.full(200, 140.0) for name in names})
    table, named = replay.recorded(path, one)
    assert named == "_target"
    np.testing.assert_array_equal(replay.references(table, named, one, ()), 140.0)
    table, named = replay.recorded(recording(tmp_path), one)
    with pytest.raises(ValueError, match="log.csv: it has no references .*; write --reference"):
        replay.references(table, named, one, ())
    with pytest.raises(ValueError, match="--reference: expected 5 temperatures in °C .*, found 2"):
        replay.references(table, named, one, (150.0, 160.0))


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
    monkeypatch.setattr(export.machine, "read", lambda folder: (made, None))
    monkeypatch.setattr(export.certificate, "sha256", lambda shown: 64 * "0")
    for text in ("first", "second"):
        monkeypatch.setattr(export, "files", lambda *asked, text=text: {"a.c": text, "b.c": text})
        if text == "second":
            monkeypatch.setattr(artifacts, "write_text", full)
            with pytest.raises(OSError, match=r"c/b\.c.*No space left on device"):
                export.export(tmp_path, "c", tmp_path / "c")
        else:
            export.export(tmp_path, "c", tmp_path / "c")
    assert {path.name: path.read_text() for path in (tmp_path / "c").iterdir()} == {
        "a.c": "first",
        "b.c": "first",
    }
