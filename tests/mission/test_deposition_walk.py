"""Frames -> flow -> next command -> library -> part -> G-code, on a foreign extruder before a turned camera:
three rounds of two routines, then the parts are composed and the pages written."""

import csv
import json
import re
import shutil
import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader

from tests.mission.toy_deposition import (
    AREA_MM2,
    OWN,
    REFERENCE,
    SHORT,
    Played,
    beadline,
    lay_out,
    machine,
    page_text,
    play_all,
    run_stage,
)

ROUTINES = [REFERENCE, {"speed_mm_per_s": 5.0, "pause_s": 0.4, **SHORT}]
NOMINAL_GAIN = 1.08
FILAMENT_MM, LINE_MM = 1.75, 3 * 48.0
# three lines of 48 mm whose E, in mm of filament, asks for the declared bead's area
E_OF_A_LINE = 48.0 * AREA_MM2 / (np.pi * FILAMENT_MM**2 / 4)
PROGRAM = f"""; filament_diameter = {FILAMENT_MM}
G21
G90
M83
T0
G0 X-40 Y0 Z0.3 F600
G0 X0 Y0 F480
G1 X48 Y0 E{E_OF_A_LINE:.5f} F480
G1 X48 Y48 E{E_OF_A_LINE:.5f}
G1 X0 Y48 E{E_OF_A_LINE:.5f}
G0 X-40 Y48
"""


class Walk(NamedTuple):
    """The project's folder, what was played in each round, and what `beadline compose` printed."""

    folder: Path
    rounds: list[list[Played]]
    composed: str


@pytest.fixture(scope="module")
def walk(tmp_path_factory) -> Walk:
    """Three rounds, the parts, the pages, and a part program of the owner's composed into all forms."""
    folder, foreign, rounds = tmp_path_factory.mktemp("walk"), machine(), []
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        lay_out(OWN | {"printer.routines": ROUTINES[1:]}, ("fig9", "dashes"))
        run_stage("train_ilc")
        for trial in range(3):
            rounds.append(play_all(foreign, ROUTINES, seed=trial))
            run_stage("train_ilc")
        for name in ("segment_library", "compose_parts", "report"):
            run_stage(name)
        Path("square.gcode").write_text(PROGRAM)
        composed = beadline("compose", "square.gcode", "--as", "csv,parquet,mcap,gcode", "--out", "jobs")
    return Walk(folder, rounds, composed)


@pytest.fixture(scope="module")
def lessons(walk) -> pd.DataFrame:
    return pq.read_table(walk.folder / "datasets/train_ilc/lessons.parquet").to_pandas()


# ---- frames -> flow -> next command


def test_the_flow_from_frames_is_the_foreign_extruders(walk, lessons):
    for trial, played in enumerate(walk.rounds):
        for one in played:
            mine = lessons[(lessons["routine"] == one.routine) & (lessons["trial"] == trial)]
            measured, true = mine["measured_mm3_per_s"].to_numpy(), one.printed.true
            steady = one.printed.planned.max()
            seen = np.isfinite(measured)
            assert seen.mean() > 0.9
            rms = np.sqrt(np.mean((measured - true)[seen] ** 2)) / steady
            assert rms <= 0.03, f"r.m.s. error of the measured flow in {one.name}: {100 * rms:.2f} %"
            level = seen & (one.printed.planned > 0.99 * steady)
            bias = np.mean(measured[level]) / np.mean(true[level]) - 1
            assert abs(bias) <= 0.02, f"measured mean flow of the line in {one.name}: {100 * bias:+.2f} %"


def test_the_latency_of_the_camera_is_found_from_its_frames(walk):
    figures = json.loads((walk.folder / "datasets/train_ilc/figures.json").read_text())["A"]["pixels"]
    assert figures["latency_s"] == pytest.approx(0.04, abs=0.005)


def test_the_true_error_falls_round_after_round(walk):
    for routine in range(len(ROUTINES)):
        errors = np.array([played[routine].printed.error for played in walk.rounds])
        ratio = errors / errors[0]
        assert ratio[1] <= 0.2 and ratio[2] <= 0.05


def test_the_next_command_is_written_as_csv_and_mcap_with_its_record(walk):
    folder = walk.folder / "datasets/train_ilc/next"
    names = sorted(path.stem for path in folder.glob("*.csv"))
    assert names == [f"A_routine_{number}_trial_03" for number in range(len(ROUTINES))]
    for name in names:
        time_s, u = np.loadtxt(folder / f"{name}.csv", delimiter=",", skiprows=1).T
        assert np.isfinite(u).all() and np.allclose(np.diff(time_s), 0.02)
        stamps, values, records = plunger(folder / f"{name}.mcap")
        np.testing.assert_allclose(stamps, time_s, atol=1e-9)
        np.testing.assert_array_equal(values, u)
        assert records["beadline.trial"]["trial"] == "3" and records["beadline.trial"]["material"] == "A"


def test_the_record_of_a_command_holds_the_whole_plan_of_its_routine(walk):
    plan = {"off_s", "on_s", "pause_s", "tail_s", "speed_mm_per_s"}
    for path in sorted((walk.folder / "datasets/train_ilc/next").glob("*.mcap")):
        record = plunger(path)[2]["beadline.trial"]
        assert plan <= record.keys(), f"{path.name}: the record lacks {sorted(plan - record.keys())}"


def plunger(path: Path) -> tuple[np.ndarray, np.ndarray, dict[str, dict[str, str]]]:
    """Stamps in s and values of the plunger's topic, and the metadata records, by the mcap package: the value
    is the last number of a message in CDR."""
    with path.open("rb") as stream:
        reader = make_reader(stream)
        messages = [
            (message.log_time / 1e9, struct.unpack("<d", message.data[-8:])[0])
            for _, channel, message in reader.iter_messages()
            if channel.topic.startswith("/plunger")
        ]
        records = {record.name: dict(record.metadata) for record in reader.iter_metadata()}
    stamps, values = np.array(messages).T
    return stamps, values, records


# ---- library -> part -> files


def test_the_command_of_a_part_is_the_same_as_csv_parquet_and_mcap(walk):
    jobs = walk.folder / "jobs"
    with (jobs / "square.signal.csv").open(newline="") as file:
        rows = list(csv.reader(file))
    assert rows[0] == ["time_s", "T0_A_mm"]
    time_s, u = np.array(rows[1:], float).T
    table = pq.read_table(jobs / "square.signal.parquet").to_pandas()
    np.testing.assert_array_equal(table["time_s"], time_s)
    np.testing.assert_array_equal(table["T0_A_mm"], u)
    stamps, values, _ = plunger(jobs / "square.signal.mcap")
    np.testing.assert_allclose(stamps, time_s, atol=1e-9)
    np.testing.assert_array_equal(values, u)
    assert np.ptp(u) > 1.0


def test_a_composed_part_prints_far_better_than_on_off_on_the_foreign_extruder(walk):
    """The volume of the part within 5 % of its plan, and a fifth of on-off control's error: what the chain's
    straight line from pressure to flow leaves of a paste with an exponent of 1.1."""
    played, on_off, wanted = part_played(walk, "fig9")
    assert np.sum(played) == pytest.approx(np.sum(wanted), rel=0.05)
    assert np.linalg.norm(played - wanted) <= 0.2 * np.linalg.norm(on_off - wanted)


def part_played(walk: Walk, part: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """True flow (T,) of a composed part and of on-off control on the foreign extruder, and the wanted one."""
    signals = pq.read_table(walk.folder / "datasets/compose_parts/signals.parquet").to_pandas()
    mine = signals[signals["part"] == part]
    time_s, wanted = mine["time_s"].to_numpy(), mine["wanted_mm3_per_s"].to_numpy()
    extruder = machine().extruder
    played, on_off = (
        extruder.flow(time_s, u) for u in (mine["command_mm"].to_numpy(), wanted / NOMINAL_GAIN)
    )
    return played, on_off, wanted


@pytest.fixture(scope="module")
def net_e_mm(walk) -> float:
    """E of the composed G-code from its begin to its end, by the rules of M82, M83 and G92."""
    net = at = 0.0
    relative, lines = False, (walk.folder / "jobs/square.leads.gcode").read_text().splitlines()
    for line in lines:
        code = line.split(";")[0]
        relative = "M83" in code or (relative and "M82" not in code)
        found = re.search(r"E(-?[\d.]+)", code)
        if found and code.startswith("G92"):
            at = float(found.group(1))
        elif found:
            move = float(found.group(1)) - (0.0 if relative else at)
            net, at = net + move, at + move
    assert sum(line.startswith("G1") for line in lines) > 10
    return net


def test_e_of_the_composed_gcode_presses_out_the_planned_volume(net_e_mm):
    pressed, planned = net_e_mm * np.pi * FILAMENT_MM**2 / 4, LINE_MM * AREA_MM2
    assert pressed == pytest.approx(planned, rel=0.01), (
        f"net E is {net_e_mm:.3f} mm over {LINE_MM:g} mm of line: {pressed:.2f} of {planned:.2f} mm^3"
    )


# ---- what is said of parts


@pytest.fixture(scope="module")
def unjudged(walk) -> tuple[str, list[str]]:
    """The text of the page, and why no forecast was judged, part by part: two learned trials are too few."""
    reports = json.loads((walk.folder / "datasets/compose_parts/conformance.json").read_text())
    forecasts = [report["forecast"]["A"] for report in reports.values()]
    assert len(forecasts) == 2 and not any(one["judged"] for one in forecasts)
    return page_text(walk.folder / "reports/deposition.html"), [one["reason"] for one in forecasts]


def test_no_number_of_a_forecast_is_shown_when_none_is_judged(walk, unjudged):
    lines = pq.read_table(walk.folder / "datasets/compose_parts/lines.parquet").to_pandas()
    planned, predicted = (
        {f"{value:.3g}" for value in lines[name]} for name in ("planned_mm3", "predicted_mm3")
    )
    assert predicted - planned, "no predicted volume differs from its plan: nothing can be told"
    # what was identified is no forecast, and its numbers may be the same by chance
    text = unjudged[0].split("The machine that was identified A:")[0]
    shown = (predicted - planned) & set(re.findall(r"\d+\.?\d*", text))
    assert not shown, f"predicted volumes are shown of parts that nobody judged: {sorted(shown)}"
    assert not re.search(r"is predicted|better|worse than", unjudged[0])


def test_the_command_line_gives_no_volume_of_a_part_that_is_not_judged(walk):
    assert "forecast not judged" in walk.composed
    assert not re.search(r"volume of \d+ lines?|flow error forecast", walk.composed)


def test_that_nothing_is_judged_is_said_once(unjudged):
    text, reasons = unjudged
    assert len(set(reasons)) == 1
    assert text.count(reasons[0]) == 1, f"the reason stands {text.count(reasons[0])} times on the page"


@pytest.fixture(scope="module")
def measured(walk, tmp_path_factory) -> tuple[float, dict, str]:
    """The part fig9 printed and measured to 2 %, composed again in a copy of the project: its true error in %
    of on-off control's, what the report of the part says of its forecast, and the page."""
    played, on_off, wanted = part_played(walk, "fig9")
    noisy = played * (1 + 0.02 * np.random.default_rng(1).standard_normal(len(played)))
    rows = np.column_stack([np.arange(len(noisy)) * 0.02, noisy])
    folder = tmp_path_factory.mktemp("measured") / "project"
    shutil.copytree(walk.folder, folder, symlinks=True)
    np.savetxt(
        folder / "datasets/parts/fig9_A_measured.csv", rows, fmt="%.6f", delimiter=",", comments="",
        header="time_s,flow_mm3_per_s",
    )  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        run_stage("compose_parts")
        run_stage("report")
    report = json.loads((folder / "datasets/compose_parts/conformance.json").read_text())["fig9"]
    true = 100 * float(np.linalg.norm(noisy - wanted) / np.linalg.norm(on_off - wanted))
    return true, report["forecast"]["A"], page_text(folder / "reports/deposition.html")


def test_a_measured_part_stands_beside_its_forecast(measured):
    true, forecast, text = measured
    assert forecast["measured_percent"] == pytest.approx(true, rel=0.25)
    assert f"measured {forecast['measured_percent']:.2g}" in text
