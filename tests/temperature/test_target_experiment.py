"""G-code of targets: its length and hottest target are said, and foreign hot ends stay below."""

import re
import sys

import numpy as np
import pytest

from pipeline import cli
from pipeline.commands import first_experiment as first
from pipeline.temperature.settings import Output
from tests.foreign.thermal_machines import FAN, control, draw, quiet, start
from tests.mission import toy_temperature

HOT_END = {"extruder": Output(name="hotend", unit="degC", reference=210, low=0, high=285)}


def played(text: str) -> list[tuple[float, float, float]]:
    """(time in s, target in °C, fan in percent) of every dwell of a G-code."""
    now = target = fan = 0.0
    rows = []
    for line in text.splitlines():
        if line.startswith("SET_HEATER_TEMPERATURE"):
            target = float(re.search(r"TARGET=(\S+)", line)[1])
        elif line.startswith(("M106", "M107")):
            fan = float(line.split("S")[1]) / 2.55 if "S" in line else 0.0
        elif line.startswith("G4"):
            now += float(line.split("P")[1]) / 1000
            rows.append((now, target, fan))
    return rows


def test_length_and_hottest_target_are_those_of_the_file():
    plan = first.targets(HOT_END, 60)
    rows = played(first.gcode(plan, 0.0))
    assert rows[-1][0] == pytest.approx(3600, abs=5) and max(target for _, target, _ in rows) == 220
    assert min(target for _, target, _ in rows) == 180 and {0.0, 100.0} <= {fan for *_, fan in rows}
    said = first.printed(plan, "x.gcode")
    assert "60 min; hottest target of extruder 220 °C." in said
    assert "[gcode_macro FIRST_EXPERIMENT]\n   gcode: SDCARD_PRINT_FILE FILENAME=x.gcode\n" in said
    # a Klipper that counts characters loses its place in others
    assert first.gcode(plan, 0.0).isascii()
    assert first.gcode(plan, 0.0).startswith("; 60 min") and first.gcode(plan, 0.0).endswith(
        "TURN_OFF_HEATERS\n"
    )


def test_the_hottest_target_stays_below_the_limit():
    tight = HOT_END["extruder"].model_copy(update={"high": 220})
    assert first.targets({"extruder": tight}, 60).hottest_degC("extruder") == 205
    with pytest.raises(ValueError, match="hotend has reference 210 and high 190"):
        first.targets({"extruder": tight.model_copy(update={"high": 190})}, 60)


def test_a_length_or_ramp_that_is_none_is_refused():
    for minutes in (-5.0, 0.0, float("nan"), 1e6):
        with pytest.raises(ValueError, match="--minutes is .*expected 10 to 600"):
            first.targets(HOT_END, minutes)
    for ramp in (-1.0, float("nan")):
        with pytest.raises(ValueError, match="--ramp is .*expected 0"):
            first.gcode(first.targets(HOT_END, 60), ramp)


def test_a_ramp_is_kept():
    rows = played(first.gcode(first.targets(HOT_END, 60), 30.0))
    targets = np.array([25.0, *[target for _, target, _ in rows]])
    assert np.abs(np.diff(targets)).max() <= 1.0
    assert max(len(set(np.round(targets[k : k + 16]))) for k in range(len(targets))) <= 32


def test_two_heaters_do_not_step_together():
    bed = HOT_END["extruder"].model_copy(update={"name": "bed", "reference": 60, "high": 120})
    steps = first.targets(HOT_END | {"heater_bed": bed}, 60).steps
    moves = [
        [abs(after[0][name] - before[0][name]) > 0 for name in ("extruder", "heater_bed")]
        for before, after in zip(steps, steps[1:], strict=False)
    ]
    assert sum(sum(pair) == 1 for pair in moves) >= 6 and min(step[0]["heater_bed"] for step in steps) > 45


def test_a_printer_gets_gcode_from_the_command(tmp_path, monkeypatch, capsys):
    folder = toy_temperature.begin(tmp_path / "project")
    mapped = {"unit": "degC", "scale": 1.0, "offset": 0.0}
    (output,) = [{"name": "hotend", "unit": "degC", "reference": 210, "low": 0, "high": 285}]
    toy_temperature.declare(
        folder,
        {
            "plant.outputs": [output],
            "plant.inputs": [{"name": "heater", "unit": "percent", "low": 0, "high": 100}],
            "ingest.mapping": {"hotend": {"source": "extruder.temp", **mapped}},
        },
    )
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "argv", ["beadline", "experiment", "temperature", "--minutes", "30"])
    cli.main()
    assert "30 min; hottest target of extruder 220 °C." in capsys.readouterr().out
    assert played((folder / "first_experiment.gcode").read_text())[-1][0] == pytest.approx(1800, abs=5)


@pytest.mark.parametrize("seed", range(1, 121, 6))
def test_foreign_hot_ends_stay_below_their_cut_off(seed):
    machine = draw(seed)
    reference, cut_off = float(machine.reference_degC[0]), float(machine.cut_off_degC[0])
    output = Output(name="hotend", unit="degC", reference=reference, low=0, high=cut_off)
    rows = np.array(played(first.gcode(first.targets({"extruder": output}, 60), 0.0)))
    time_s = np.arange(0, rows[-1, 0], machine.sample_time_s)
    now = np.searchsorted(rows[:, 0], time_s, side="right").clip(max=len(rows) - 1)
    outside = quiet(machine, len(time_s))
    outside[:, FAN] = rows[now, 2] / 100
    r = np.ascontiguousarray(rows[now, 1][:, None])
    y, _ = control(machine, start(machine, 1), machine.own_control, r, outside)
    assert y.max() <= cut_off - 15
    assert machine.structure == "hot_end" and np.abs(y[-60:] - r[-60:]).max() < 5
