"""What `beadline replay` leaves of a recording: every file opens, and names what is in the others."""

import json
import re
import sys

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import pytest
from mcap.reader import make_reader

from pipeline import cli
from pipeline.commands import replay
from pipeline.deploy import machine, support
from pipeline.deploy.replay import GaplessLog
from pipeline.deploy.support import write_support
from pipeline.store import artifacts
from pipeline.temperature.plant import padded
from pipeline.temperature.test_set import panel
from tests.deploy.deployed_machines import block_and_sensor, exported, passed

T = 400


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A controller's folder with its support."""
    of, rng = exported("pi"), np.random.default_rng(2)
    folder = tmp_path / "controller"
    machine.write(folder, of, passed(of))
    plants = padded(
        panel.drawn([of.model], 8, panel.PlantSpread(0.15, 0.2, 0.0, 0.0, 5.0), cells=False, rng=rng)
    )
    logs = [rolled(seed) for seed in range(4)]
    within = support.support(plants, [], np.full(2, 0.1), logs)
    write_support(folder, within, machine.controller_sha256(of))
    monkeypatch.chdir(tmp_path)
    return folder


def rolled(seed: int) -> GaplessLog:
    """The block and sensor of two zones under steps."""
    plant, rng = block_and_sensor(zones=2), np.random.default_rng(seed)
    u = np.repeat(rng.uniform(20, 60, (T // 40, 2)), 40, axis=0)
    x, y = np.linalg.solve(np.eye(plant.n) - plant.A, plant.B @ u[0]), np.empty((T, 2))
    for t in range(T):
        y[t] = plant.C @ x + plant.d + 0.1 * rng.standard_normal(2)
        x = plant.A @ x + plant.B @ u[t]
    return GaplessLog(u, y, np.full((T, 2), 150.0))


def recording(path, log: GaplessLog) -> None:
    columns = {"heater_1": log.u[:, 0], "heater_2": log.u[:, 1]}
    columns |= {"sensor_1": log.y[:, 0], "sensor_2": log.y[:, 1]}
    time = np.arange(float(T))
    if path.suffix == ".mcap":
        units = {name: "percent" if name.startswith("heater") else "degC" for name in columns}
        shown = {name: (values, units[name], "as recorded") for name, values in columns.items()}
        artifacts.write_recording(path, time, shown, topic="/machine")
        return
    table = pa.table({"time_s": time, **columns})
    (pa.csv.write_csv if path.suffix == ".csv" else pa.parquet.write_table)(table, path)


def replayed(folder, path):
    out = path.with_suffix("")
    return replay.replay_recording(folder, path, out, (150.0, 150.0)), out


def test_every_topic_of_the_layout_is_in_the_recording_it_is_for(folder, tmp_path):
    recording(tmp_path / "print.csv", rolled(9))
    (_, _, told), out = replayed(folder, tmp_path / "print.csv")
    with open(out / "replay.mcap", "rb") as stream:
        messages = [(channel.topic, json.loads(message.data)) for _, channel, message in
                    make_reader(stream).iter_messages()]  # fmt: skip
    assert len(messages) == T == told["samples"]
    panels = json.loads((out / "layout.json").read_text())["configById"]
    paths = [one["value"] for panel_ in panels.values() for one in panel_["paths"]]
    assert len(paths) > 8
    for path in paths:
        topic, name = path.split(".")
        assert all(at == topic and name in fields for at, fields in messages)


def test_the_three_formats_of_one_recording_are_answered_alike(folder, tmp_path):
    answers = []
    for ending in ("csv", "parquet", "mcap"):
        path = tmp_path / ending / f"print.{ending}"
        path.parent.mkdir()
        recording(path, rolled(9))
        answers.append(replayed(folder, path)[0][0].asked)
    assert np.array_equal(answers[0], answers[1])
    # nanoseconds of the MCAP's clock
    np.testing.assert_allclose(answers[0], answers[2], atol=1e-6)


def test_it_says_why_it_abstains(folder, tmp_path):
    log = rolled(9)
    recording(tmp_path / "swapped.csv", log._replace(y=log.y[:, ::-1]))
    done, _, told = replayed(folder, tmp_path / "swapped.csv")[0]
    assert done.abstains and any("signals may be swapped" in note for note in told["notes"])


def test_a_still_log_is_replayed_and_its_page_says_what_cannot_be_told_and_links_nowhere(
    folder, tmp_path, monkeypatch, capsys
):
    moving = rolled(9)
    noise = 0.1 * np.random.default_rng(3).standard_normal((T, 2))
    still = GaplessLog(np.tile(moving.u.mean(axis=0), (T, 1)), moving.y.mean(axis=0) + noise, moving.r)
    recording(tmp_path / "still.csv", still)
    out = tmp_path / "out"
    argv = ["beadline", "replay", str(folder), str(tmp_path / "still.csv"), "--reference", "150,150"]
    monkeypatch.setattr(sys, "argv", [*argv, "--out", str(out)])
    cli.main()
    told = json.loads((out / "replay.json").read_text())
    assert (told["abstains"], told["notes"]) == (False, [support.STILL_TOLD])
    page = (out / "index.html").read_text()
    assert support.STILL_TOLD in page
    capsys.readouterr()
    monkeypatch.setattr(sys, "argv", [*argv, "--out", str(out), "--json"])
    cli.main()
    assert json.loads(capsys.readouterr().out) == told
    # it lies in a folder of its own, with no other page beside it
    assert re.findall(r'href="(?!data:|#)[^"]*"', page) == []


def test_references_that_are_no_temperatures_are_refused():
    assert replay.temperatures("150,160.5") == (150.0, 160.5)
    assert replay.temperatures("") == ()
    for words in ("150;160", "150,", "nan,150", "1e9"):
        with pytest.raises(ValueError, match="--reference: expected temperatures in °C .* found"):
            replay.temperatures(words)
