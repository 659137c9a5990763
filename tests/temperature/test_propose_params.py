"""beadline init: from recordings of a new machine to params files that its stages read."""

import runpy
import shutil
import sys

import numpy as np
import pytest
import yaml

from pipeline import cli
from pipeline.commands import propose_params
from pipeline.store import artifacts, params
from pipeline.store.params_text import replaced
from pipeline.temperature import tables
from pipeline.temperature.identification.first_order import time_constant
from pipeline.temperature.settings import GenerateProbing, Panel, Plant, TuneWeights, given_centre
from pipeline.temperature.test_set import best
from stages.identify_plant import IdentifyPlant
from stages.ingest import Ingest
from tests.recordings.klipper_machine import BED, EXTRUDER, print_log
from tests.recordings.test_real_record import project, run
from tests.recordings.test_signal_roles import HEADERS, record

PRINT = [(0, 0, 60), (60, 200, 60), (600, 215, 70), (900, 205, 65), (1200, 220, 75), (1500, 200, 60),
         (1750, 0, 0)]  # fmt: skip


@pytest.fixture
def tree(root, tmp_path, monkeypatch):
    """The params files as shipped, in a folder of their own."""
    for name in ("params.yaml", "params.expert.yaml"):
        shutil.copy(root / name, tmp_path)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "klippy.log").write_text(print_log(PRINT, longest_s=1900))
    return tmp_path


def init(monkeypatch, *arguments: str) -> None:
    monkeypatch.setattr(sys, "argv", ["beadline", "init", *arguments])
    cli.main()


def test_what_init_takes_for_untouched_is_what_is_shipped(root):
    sections = params.read(root / "params.yaml")
    for dotted, shipped in propose_params.SHIPPED.items():
        section, *keys = dotted.split(".")
        value = sections[section]
        for key in keys:
            value = value.get(key, [])  # none of the study's signals is a disturbance
        assert value == shipped, dotted


def test_a_klippy_log_fills_the_files_and_keeps_their_comments(tree, monkeypatch, capsys):
    before = (tree / "params.yaml").read_text()
    init(monkeypatch, "klippy.log", "--copy")
    machine = params.load(Plant, "plant")
    assert [signal.name for signal in machine.inputs] == ["heater_bed", "heater_extruder"]
    limits = {signal.name: (signal.reference, signal.low, signal.high) for signal in machine.outputs}
    # 15 °C below max_temp, at which the firmware switches everything off
    assert limits == {"temperature_bed": (60, 0, 115), "temperature_extruder": (200, 0, 245)}
    assert machine.sample_time_s == 1.0
    mapping = params.load(Ingest, "ingest").mapping
    assert mapping["temperature_bed"].set_point == "heater_bed.target"
    assert params.value("generate_probing.source", one_of=("simulated", "recordings")) == "recordings"
    params.load(Panel, "panel"), params.load(TuneWeights, "tune_weights")
    assert (tree / "datasets/raw/temperature/klippy.log").exists()
    after = (tree / "params.yaml").read_text()
    kept = [line for line in before.splitlines() if "#" in line]
    comments = [line.partition("#")[2] for line in kept]
    comments.remove(" the study gives no limits; 0 and 250 are declared by us")  # of values that are gone
    assert [line.partition("#")[2] for line in after.splitlines() if "#" in line] == comments
    to_decide = capsys.readouterr().out
    assert "where each should settle" in to_decide
    assert "high is 15 °C below the firmware's cut-off (max_temp)" in to_decide
    assert "temperature_bed 130, temperature_extruder 260 °C" in to_decide


@pytest.mark.parametrize(
    ("clock_s", "fastest_s", "sample_time_s"),
    [
        (1.0, 150.0, 1.0),
        (0.1, 150.0, 0.8),  # 200 samples in the fastest time constant
        (0.04, 2.0, 0.04),
        (5.0, 20.0, 5.0),  # the record has no more; it is asked about
        (1.0, 2000.0, 10.0),
    ],
)
def test_the_sample_time_is_a_multiple_of_the_clock_that_the_machine_allows(
    clock_s, fastest_s, sample_time_s
):
    assert propose_params.sample_time_s(clock_s, fastest_s) == pytest.approx(sample_time_s)


def test_a_record_too_slow_for_the_machine_is_asked_about(tree, monkeypatch, capsys):
    k = np.arange(400)
    heat = 40.0 + 30 * (k // 10 % 2)
    y = 20 + np.convolve(heat - 40, 0.2 * np.exp(-k / 4))[:400]
    rows = "".join(f"{5 * i},{u},{v:.3f}\n" for i, u, v in zip(k, heat, y, strict=True))
    (tree / "rig.csv").write_text("time_s,heater_1_pct,zone_1_C\n" + rows)
    init(monkeypatch, "rig.csv")
    assert "5 s is more than a tenth of the fastest time constant" in capsys.readouterr().out


def test_a_german_header_gives_a_plant_with_set_points_and_disturbances_that_ingest_reads(
    tree, monkeypatch, capsys
):
    record(tree / "extruder.csv", HEADERS["Siemens S7, German"])
    init(monkeypatch, "extruder.csv", "--copy")
    machine, ingest = params.load(Plant, "plant"), params.load(Ingest, "ingest")
    assert [signal.name for signal in machine.inputs] == ["heater_1", "heater_2"]
    assert [signal.name for signal in machine.outputs] == ["temperature_1", "temperature_2"]
    assert [signal.name for signal in machine.disturbances] == ["schneckendrehzahl", "raumtemperatur"]
    assert ingest.mapping["temperature_2"].set_point == "Zone2_Soll"
    to_decide = capsys.readouterr().out
    assert (
        "schneckendrehzahl, raumtemperatur: does the controller move it, or is it only recorded?" in to_decide
    )
    text = (tree / "params.yaml").read_text()
    (tree / "params.yaml").write_text(text.replace("low: null, high: null", "low: 0, high: 250"))
    monkeypatch.delitem(sys.modules, "stages.ingest")
    runpy.run_module("stages.ingest", run_name="__main__", alter_sys=True)
    figures = artifacts.read_json("datasets/ingest/figures.json")
    assert (figures["recordings"], figures["quarantined"], figures["samples"]) == (1, 0, 900)
    init(monkeypatch, "extruder.csv", "--force")
    assert params.load(Plant, "plant").disturbances == machine.disturbances


def test_the_log_of_a_firmware_without_limits_says_how_to_set_them(tree, monkeypatch, capsys):
    duty = [int(60 + 40 * (k // 40 % 2)) for k in range(400)]
    heat = 24 + np.convolve(duty, 0.02 * np.exp(-np.arange(400) / 60))[:400]
    lines = [
        f"2025-11-21 13:{k // 60:02d}:{k % 60:02d},500 - "
        f"Recv: ok T:{y:.1f} /200.0 B:60.{k % 9} /60.0 @:{u} B@:{u}"
        for k, (y, u) in enumerate(zip(heat, duty, strict=True))
    ]
    (tree / "serial.log").write_text("\n".join(lines) + "\n")
    init(monkeypatch, "serial.log")
    assert "set high 15 °C below the firmware's cut-off" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("file", "old", "new", "on"),
    [
        ("", "", "", {"temperature"}),
        ("datasets/raw/setpoint/README.md", "", "", {"temperature"}),
        ("datasets/raw/setpoint/print/frame.jpg", "", "", {"temperature", "setpoint"}),
        ("datasets/raw/deposition/trial.mcap", "", "", {"temperature", "deposition"}),
        ("", "train_ilc:", "train_ilc:\n  source: recordings", {"temperature", "deposition"}),
    ],
)
def test_a_loop_without_recordings_is_switched_off(tree, monkeypatch, capsys, file, old, new, on):
    if file:
        (tree / file).parent.mkdir(parents=True)
        (tree / file).touch()
    text = (tree / "params.yaml").read_text()
    if old:
        head, tail = text.split(f"\n{old}", 1)
        (tree / "params.yaml").write_text(f"{head}\n{new}{tail.replace('  source: simulated', '  #', 1)}")
    init(monkeypatch, "klippy.log")
    loops = params.load(params.Loops, "loops").model_dump()
    assert {loop for loop, is_on in loops.items() if is_on} == on
    told = capsys.readouterr().out
    assert f"off: {' and '.join(loop for loop in loops if loop not in on)}, without recordings" in told


def test_a_loop_that_its_owner_switches_on_stays_on(tree, monkeypatch):
    init(monkeypatch, "klippy.log")
    text = (tree / "params.yaml").read_text()
    (tree / "params.yaml").write_text(text.replace("setpoint: false", "setpoint: true"))
    init(monkeypatch, "klippy.log")
    assert params.load(params.Loops, "loops").setpoint


def test_a_second_run_changes_nothing_and_an_edited_value_is_not_overwritten(tree, monkeypatch, capsys):
    init(monkeypatch, "klippy.log")
    first = (tree / "params.yaml").read_bytes(), (tree / "params.expert.yaml").read_bytes()
    init(monkeypatch, "klippy.log")
    assert "nothing to change" in capsys.readouterr().out
    assert ((tree / "params.yaml").read_bytes(), (tree / "params.expert.yaml").read_bytes()) == first
    edited = (tree / "params.yaml").read_text().replace("reference: 200.0", "reference: 210.0")
    (tree / "params.yaml").write_text(edited)
    init(monkeypatch, "klippy.log")
    printed = capsys.readouterr().out
    assert "kept as they are: plant.outputs. Nothing was written. With --force they would be:" in printed
    assert "  plant.outputs: - {name: " in printed and "reference: 200.0" in printed
    assert (tree / "params.yaml").read_text() == edited
    init(monkeypatch, "klippy.log", "--force")
    assert ((tree / "params.yaml").read_bytes(), (tree / "params.expert.yaml").read_bytes()) == first


def test_limits_that_no_file_tells_are_left_to_a_person_and_asked_for_by_the_stage(
    tree, root, monkeypatch, capsys
):
    k = np.arange(400)
    heat = 40.0 + 30 * (k // 100 % 2)
    y = 20 + np.convolve(heat - 40, 0.02 * np.exp(-k / 50))[:400]
    rows = "".join(f"{i},{u},{v:.3f}\n" for i, u, v in zip(k, heat, y, strict=True))
    (tree / "rig.csv").write_text("time_s,heater_1_pct,zone_1_C\n" + rows)
    init(monkeypatch, "rig.csv", "--copy")
    assert "low and high of temperature_1: between which °C the machine must stay" in capsys.readouterr().out
    monkeypatch.delitem(sys.modules, "stages.ingest")
    with pytest.raises(SystemExit):
        runpy.run_module("stages.ingest", run_name="__main__", alter_sys=True)
    asked = capsys.readouterr().err
    assert "plant.outputs: temperature_1 should have low and high" in asked


def test_the_next_experiment_is_asked_at_the_machines_pace_and_its_centre_left_to_the_model(
    tree, monkeypatch, capsys
):
    rng, tau = np.random.default_rng(1), 200.0
    u = np.repeat(rng.choice([10.0, 30.0], (20, 2)), 200, axis=0)
    y = np.full((len(u) + 1, 2), 90.0)
    for t in range(len(u)):
        y[t + 1] = y[t] + (20 + u[t] @ np.array([[3.0, 0.5], [0.5, 3.0]]) - y[t]) / tau
    rows = np.column_stack([np.arange(len(u)), u, y[:-1] + rng.normal(0, 0.1, (len(u), 2))])
    header = "time_s,heater_1_pct,heater_2_pct,zone_1_C,zone_2_C"
    np.savetxt(tree / "rig.csv", rows, delimiter=",", header=header, comments="", fmt="%.3f")
    init(monkeypatch, "rig.csv")
    assert "is written only if its forecast stays within low and high" in capsys.readouterr().out
    settings = params.load(GenerateProbing, "generate_probing")
    assert settings.centre_percent is None and settings.signal == "prbs"
    assert settings.amplitude_percent <= 10.0  # no wider than the inputs moved
    assert 50 <= settings.shortest_steps <= 150  # half of 200 s, found within a half
    assert settings.samples >= 2000  # 20 time constants, found within a half


def test_an_operating_point_for_each_input_is_refused_where_there_are_more_inputs(tree, monkeypatch):
    text = (tree / "params.expert.yaml").read_text()
    (tree / "params.expert.yaml").write_text(text.replace("centre_percent: null", "centre_percent: [20, 30]"))
    settings, machine = params.load(GenerateProbing, "generate_probing"), params.load(Plant, "plant")
    with pytest.raises(ValueError, match="centre_percent has 2 values, but plant has 7 inputs; give one"):
        given_centre(settings, machine)


def test_the_sample_time_of_a_record_without_one_is_given_and_all_times_follow(tree, monkeypatch, capsys):
    rng = np.random.default_rng(0)
    u = np.repeat(rng.choice([3.4, 6.4], 100), 10)
    y = np.convolve(u, 0.1 * np.exp(-np.arange(60) / 10))[:1000]
    np.savetxt(tree / "rig.dat", np.column_stack([u, y + rng.normal(0, 0.05, 1000)]))
    init(monkeypatch, "rig.dat")
    asked = capsys.readouterr().out
    assert "1.0 s was assumed, on which all times rest" in asked
    assert (
        "plant.inputs low and high, what the machine can give: now what was recorded, heater_1 3 to 7"
        in asked
    )
    assert "plant.inputs heats of heater_1" in asked
    slow = params.read("params.yaml")
    init(monkeypatch, "rig.dat", "--time", "every 0.1 s", "--force")
    assert "assumed" not in capsys.readouterr().out
    fast = params.read("params.yaml")
    assert (fast["plant"]["sample_time_s"], fast["ingest"]["time"]) == (0.1, "every 0.1 s")
    # the next experiment lasts for the same number of time constants
    pace = [
        (record["plant"]["sample_time_s"], record["generate_probing"]["samples"]) for record in (slow, fast)
    ]
    assert pace == [(1.0, pace[0][1]), (0.1, pace[0][1])]
    with pytest.raises(SystemExit):
        init(monkeypatch, "rig.dat", "--time", "0.1")
    assert "--time is '0.1' but should be such as 'every 0.08 s'" in capsys.readouterr().err


def test_recordings_of_two_machines_and_one_without_heaters_are_refused(tree, monkeypatch, capsys):
    header = "time_s,heater_1_pct,zone_1_C\n"
    (tree / "a.csv").write_text(header + "".join(f"{k},{k % 50},{20 + k / 9}\n" for k in range(60)))
    (tree / "b.csv").write_text("time_s,duty,T1\n" + "".join(f"{k},{k % 5},{20 + k}\n" for k in range(60)))
    (tree / "c.csv").write_text("time_s,zone_1_C\n" + "".join(f"{k},{20 + k / 9}\n" for k in range(60)))
    before = (tree / "params.yaml").read_bytes()
    for files, sentence in (
        (("a.csv", "b.csv"), "give recordings of one machine"),
        (("c.csv",), "nothing in it looks like a heater or a motor"),
    ):
        with pytest.raises(SystemExit):
            init(monkeypatch, *files)
        assert sentence in capsys.readouterr().err
    assert (tree / "params.yaml").read_bytes() == before


@pytest.mark.parametrize(
    "name",
    [
        "daisy_a/dryer.dat",
        "daisy_a/glassfurnace.dat",
        "tclab_apmonitor/second_order_mimo.csv",
        "tclab_mlid_prbs/prbs.csv",
        "paper_reference/probing_log_seed1.parquet",
    ],
)
def test_real_records_give_files_that_the_stages_load(shared, tree, name):
    initialised = propose_params.proposed([shared(f"data/{name}")])
    propose_params.write(initialised.values, force=False)
    machine, ingest = params.load(Plant, "plant"), params.load(Ingest, "ingest")
    assert machine.sample_time_s > 0 and machine.inputs
    assert ingest.max_gap_s >= machine.sample_time_s
    params.load(GenerateProbing, "generate_probing")  # refuses what the stage would


def test_what_a_rehearsal_asks_is_left_to_the_record(shared, tree):
    """Starts, references, times and bands follow from it wherever recordings are the source."""
    before = params.read("params.yaml")
    initialised = propose_params.proposed([shared("data/tclab_apmonitor/second_order_mimo.csv")])
    propose_params.write(initialised.values, force=False)
    after = params.read("params.yaml")
    for section in ("panel", "tracking", "tune_weights", "evaluate_temperature"):
        assert after[section] == before[section]
    assert after["report"] | {"overshoot_degC": 5.0} == before["report"]
    assert after["report"]["settling_s"] is None


def test_the_time_constant_is_the_one_that_made_the_record():
    rng, tau = np.random.default_rng(0), 80.0
    u = np.repeat(rng.choice([0.0, 100.0], (40, 2)), 50, axis=0)
    y = np.zeros(2000)
    for t in range(1999):
        y[t + 1] = y[t] + (0.5 * u[t, 0] + 0.2 * u[t, 1] - y[t]) / tau
    estimate = time_constant([u], [y + rng.normal(0, 0.1, 2000)], sample_time_s=1.0)
    assert tau / 1.25 < estimate < 1.25 * tau  # the grid has steps of 24 %


@pytest.mark.parametrize(
    ("dotted", "lines", "result"),
    [
        ("a.b", ["2"], "a:  # one\n  b: 2    # two\n  c:\n    - 1\n    # three\nd: 4\n"),
        (
            "a.b",
            ["- 5", "- 6"],
            "a:  # one\n  b:  # two\n    - 5\n    - 6\n  c:\n    - 1\n    # three\nd: 4\n",
        ),
        ("a.c", ["[]"], "a:  # one\n  b: 1    # two\n  c: []\n    # three\nd: 4\n"),
        ("a.c", ["- 7"], "a:  # one\n  b: 1    # two\n  c:\n    - 7\n    # three\nd: 4\n"),
        ("a", ["2"], "a: 2  # one\n    # three\nd: 4\n"),
        ("a", ["e: 2", "f: 3"], "a:  # one\n  e: 2\n  f: 3\n    # three\nd: 4\n"),
    ],
)
def test_a_value_is_replaced_in_place(dotted, lines, result):
    text = "a:  # one\n  b: 1    # two\n  c:\n    - 1\n    # three\nd: 4\n"
    assert replaced(text, dotted, lines) == result
    assert yaml.safe_load(result)


# ---- from the log to the plant


@pytest.fixture(scope="module")
def printer(root, tmp_path_factory):
    """A project whose only recording is a printer's own log, through init, ingest and identify_plant."""
    folder = tmp_path_factory.mktemp("printer")
    tree = project(root, folder, {})
    # as shipped, with comments: what init edits
    for name in ("params.yaml", "params.expert.yaml"):
        shutil.copy(root / name, tree)
    (tree / "klippy.log").write_text(print_log(PRINT, longest_s=1900))
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.chdir(tree)
        init(monkeypatch, "klippy.log", "--copy")
    expert = (tree / "params.expert.yaml").read_text()
    (tree / "params.expert.yaml").write_text(expert.replace("max_order: 12", "max_order: 4"))
    return run(tree, "probe_machine", "ingest", "identify_plant", "generate_probing")


def test_the_record_is_the_print_without_a_conversion(printer):
    machine = params.load(Plant, "plant", printer / "params.yaml")
    record = artifacts.read_table(
        printer / "datasets/ingest/record.parquet", tables.record(machine.inputs, machine.outputs)
    )
    assert set(record["recording"]) == {"klippy.log"}
    lines = [line for line in (printer / "klippy.log").read_text().splitlines() if line.startswith("Stats")]
    assert len(record["time_s"]) == len(lines)
    temperatures = [float(line.rpartition("extruder:")[2].split("temp=")[1].split()[0]) for line in lines]
    # Klipper's 0.3 s and the log's 1 s meet every 3 s, so that nothing is interpolated
    np.testing.assert_array_equal(record["temperature_extruder"], temperatures)
    findings = artifacts.read_json(printer / "datasets/ingest/figures.json")
    assert findings["quarantined"] == 0


def test_the_record_has_the_set_points_of_the_print_beside_it(printer):
    machine = params.load(Plant, "plant", printer / "params.yaml")
    folder = printer / "datasets/ingest"
    set_points = artifacts.read_table(folder / "set_points.parquet", tables.set_points(machine.outputs))
    record = artifacts.read_table(folder / "record.parquet", tables.record(machine.inputs, machine.outputs))
    assert len(record["time_s"]) == len(next(iter(set_points.values())))
    for output in machine.outputs:
        asked = set_points[f"{output.name}_set_point"]
        assert output.reference in asked
        # what a firmware holds is at its set-point most of the time
        late = asked > 0
        assert np.median(np.abs(record[output.name] - asked)[late]) < 3.0


def test_the_plant_of_the_print_has_both_heaters_and_their_pace(printer):
    settings = params.load(IdentifyPlant, "identify_plant", printer / "params.yaml")
    assert settings.max_order == 4
    figures = artifacts.read_json(printer / "datasets/identify_plant/figures.json")
    assert set(figures["fit_holdout"]) == {"temperature_bed", "temperature_extruder"}
    # one-minute predictions: the printer's PID holds the bed within its noise, where a fit says little
    assert figures["fit_holdout_ahead"]["temperature_extruder"] > 50
    assert EXTRUDER.tau_s < BED.tau_s


def test_the_printers_own_pid_is_judged_beside_the_others_and_swings_as_its_log_does(printer):
    """In the log the hot end's duty goes from limit to limit: that PID holds few plants of it stable."""
    file = printer / "params.expert.yaml"
    before = file.read_text()
    sections = yaml.safe_load(before)
    sections["panel"]["judging"]["plants"], sections["panel"]["training"]["plants"] = 6, 3
    sections["tune_weights"] |= {"practical_initial": 5, "practical_evaluations": 8}
    file.write_text(yaml.safe_dump(sections))
    run(printer, "learn_kernel", "tune_weights", "evaluate_temperature")
    file.write_text(before)
    figures = artifacts.read_json(printer / "datasets/evaluate_temperature/figures.json")
    judged = figures["contestants"]["printer_pid"]
    lines = [line for line in (printer / "klippy.log").read_text().splitlines() if line.startswith("Stats")]
    duty = np.array([float(line.rpartition("pwm=")[2].split()[0]) for line in lines[600:800]])
    assert duty.max() > 0.9 and duty.min() < 0.1
    assert judged["stable"]["of"] == 6 and judged["stable"]["count"] <= 3
    assert judged["at_limits"]["median"] > 10
    limits = best.limits_of(figures["pace"], params.read(printer / "params.yaml")["report"])
    assert not best.passes(judged, limits)
    # simpler than what is identified, after doing nothing
    assert figures["order"][:2] == ["hold", "printer_pid"]
    assert figures["contestants"]["subspace_lqg"]["stable"] == {"count": 6, "of": 6}


def test_what_to_play_next_on_the_printer_is_forecast_within_its_limits_or_left_out_with_a_reason(printer):
    machine = params.load(Plant, "plant", printer / "params.yaml")
    figures = artifacts.read_json(printer / "datasets/generate_probing/figures.json")
    for key, file in (("next_experiment", "next_experiment"), ("closed_loop", "next_experiment_closed_loop")):
        told = figures[key]
        assert (printer / f"datasets/generate_probing/{file}.csv").exists() == told["written"]
        assert told["written"] or len(told["reason"]) > 20
        if told["written"]:
            for o in machine.outputs:
                assert o.low <= told["lowest_degC"][o.name] <= told["highest_degC"][o.name] <= o.high
    assert artifacts.read_json(printer / "datasets/generate_probing/forecast.json") == figures


def test_a_bed_that_is_held_all_night_does_not_set_the_sample_time(tree):
    """Its noise looks like a machine of 4 s."""
    rng, k = np.random.default_rng(0), np.arange(4000)
    duty = np.repeat(rng.uniform(20, 60, 40), 100)
    hot = np.full(4000, 200.0)
    for t in range(1, 4000):
        hot[t] = 0.995 * hot[t - 1] + 0.005 * (25 + 4 * duty[t - 1])
    columns = {
        "time_s": k.astype(float),
        "heater_extruder_pct": duty,
        "heater_bed_pct": rng.uniform(20, 40, 4000),
        "extruder_C": np.round(hot + rng.normal(0, 0.03, 4000), 2),
        "bed_C": np.round(60 + rng.normal(0, 0.05, 4000), 1),
    }
    artifacts.write_csv(tree / "night.csv", columns)
    values = propose_params.proposed([tree / "night.csv"]).values
    (reference,) = values["plant.sample_time_s"]
    artifacts.write_csv(
        tree / "alone.csv", {name: values for name, values in columns.items() if "bed" not in name}
    )
    alone = propose_params.proposed([tree / "alone.csv"]).values
    assert [reference] == alone["plant.sample_time_s"]
    assert values["generate_probing.shortest_steps"] == alone["generate_probing.shortest_steps"]
