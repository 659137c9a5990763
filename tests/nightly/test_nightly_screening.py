"""New recordings of the temperature loop before anything learns from them: set
aside, or measured against the champion's own nights."""

import copy
import json
import re
import shutil
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import yaml

from pipeline.nightly import drift, inputs, judge, screening, sensors, temperature_drift
from pipeline.nightly.records import SENSOR, Alarm, Memory, NightDrift, from_json, to_json
from pipeline.nightly.settings import Nightly
from pipeline.recordings import plain_files
from pipeline.store import artifacts, params
from pipeline.temperature import plant
from pipeline.temperature.identification import model_choice as identification
from pipeline.temperature.settings import Plant
from tests.mcap_writing import Written
from tests.nightly import shifts_recorded as nights

CHAMPIONS = {"temperature"}
RAW = Path("datasets/raw/temperature")
CALM = {"dither": 1.0}


def commissioned(folder, loop):
    """Four good shifts of a machine of two zones, the model identified from them,
    and what they say of it: the champion's folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        Path("params.yaml").write_text(yaml.safe_dump(nights.settings()))
        shifts = [nights.a_night(1, k, loop=loop) for k in range(4)]
        for k, columns in enumerate(shifts):
            nights.write(RAW / f"shift_{k}.csv", columns)
        u, y = (
            [np.column_stack([shift[f"{kind}_1"], shift[f"{kind}_2"]]) for shift in shifts]
            for kind in ("heater", "sensor")
        )
        model = identification.identify(
            u,
            y,
            sample_time_s=1.0,
            settings=identification.Settings(max_order=3),
            names=["heater_1", "heater_2"],
        ).plant
        champion = Path("champion/temperature")
        artifacts.write_arrays(champion / "identify_plant/plant.parquet", "plant", 1, plant.stored([model]))
        artifacts.write_json(
            champion / "tune_weights/weights.json",
            {"contestants": {"subspace_lqg": {"effort_weight": 1.0, "observer_tau": 1.0, "integral": 0.02}}},
        )
        artifacts.write_json(
            champion / screening.REFERENCE,
            screening.reference(params.load(Nightly, "nightly").loops["temperature"], champion),
        )
    return folder


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return commissioned(tmp_path_factory.mktemp("screening"), {})


@pytest.fixture(scope="module")
def calm(tmp_path_factory):
    """The same from shifts of production: a dither of 1 % hides no offset."""
    return commissioned(tmp_path_factory.mktemp("calm"), CALM)


NEW = RAW / "new.csv"


class Screening(NamedTuple):
    drift: NightDrift
    memory: Memory


def screen(new: list[str], memory: Memory | None = None) -> Screening:
    """The screening of new recordings, and the memory after it."""
    after = copy.copy(memory or Memory())
    found = {"temperature": new} if new else {}
    return Screening(screening.look(params.load(Nightly, "nightly"), CHAMPIONS, found, after), after)


def screened(columns, memory: Memory | None = None) -> Screening:
    """The screening of one new shift."""
    nights.write(NEW, columns)
    try:
        return screen([str(NEW)], memory)
    finally:
        NEW.unlink(missing_ok=True)


@pytest.fixture
def look(made, monkeypatch):
    monkeypatch.chdir(made)
    shutil.rmtree(inputs.QUARANTINE, ignore_errors=True)
    return screened


def test_a_good_shift_raises_nothing(look):
    for k in range(5):
        result = look(nights.a_night(1, 100 + k))
        assert result.drift.alarms == [] and result.drift.quarantined == {}, result


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"gain": (0.9, 1.0)}, "gain from heater_1"),
        ({"gain": (1.0, 1.1)}, "gain from heater_2"),
        ({"slower": (1.1, 1.1)}, "time constants of what answers to every input"),
    ],
)
def test_ten_percent_of_drift_is_named_within_two_nights(look, changes, words):
    memory = Memory()
    for k in (200, 201):
        result = look(nights.a_night(1, k, **changes), memory)
        memory = result.memory
        if result.drift.alarms:
            break
    assert any(words in alarm.cause for alarm in result.drift.alarms), result.drift.alarms


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"loop": CALM | {"aim_degC": (9.0, 0.0)}},
            "closed loop: sensor_1 settles +",
        ),  # its loop's gain is 0.8: 0.8 / 1.8 of 9 °C
        ({"loop": CALM, "colder_degC": 15.0}, "it is "),
    ],
)
def test_a_loop_that_settles_elsewhere_or_works_in_the_cold_is_found_within_two_nights(
    calm, monkeypatch, changes, words
):
    monkeypatch.chdir(calm)
    memory = Memory()
    for k in (250, 251):
        result = screened(nights.a_night(1, k, **changes), memory)
        memory = result.memory
        if any(alarm.cause.startswith(words) for alarm in result.drift.alarms):
            break
    assert any(alarm.cause.startswith(words) for alarm in result.drift.alarms), (
        result.drift.alarms,
        result.drift.watched,
    )
    # the plant has not changed
    assert not any("gain" in alarm.cause or "time constant" in alarm.cause for alarm in result.drift.alarms)


def test_what_the_cold_makes_a_loop_do_is_said_as_what_follows_from_it(calm, monkeypatch):
    monkeypatch.chdir(calm)
    (alarm,) = screened(nights.a_night(1, 250, loop=CALM, colder_degC=15.0)).drift.alarms
    assert alarm.kind == "ambient" and "colder" in alarm.cause
    # 15 °C at 1.6 °C a percent are 9.4 points
    assert any(said.startswith("closed loop: heater_1 needs +9.") for said in alarm.consequences)


def test_good_shifts_of_production_raise_nothing(calm, monkeypatch):
    monkeypatch.chdir(calm)
    for k in range(5):
        result = screened(nights.a_night(1, 400 + k, loop=CALM))
        assert (
            result.drift.alarms == []
            and "sensor_1 offset_degC" in result.drift.figures[str(NEW)]["closed_loop"]
        ), result


def test_a_step_below_its_limit_is_no_alarm_and_one_past_it_is_at_once(look):
    memory = Memory()
    for k in range(4):
        result = look(nights.a_night(1, 600 + k, gain=(0.97, 1.0)), memory)
        memory = result.memory
        assert result.drift.alarms == []
    (alarm,) = look(nights.a_night(1, 610, gain=(0.94, 1.0)), memory).drift.alarms
    assert (alarm.kind, alarm.channel) == (
        "gain",
        "heater_1",
    ) and alarm.key == "temperature: gain of heater_1"


def test_what_nights_agree_in_is_pooled_and_what_was_held_against_another_reference_is_not(look):
    estimates = [[4.3, 0.3], [4.3, 0.3], [4.3, 0.3]]
    # each is one sigma past 4; three of them together 1.7
    assert temperature_drift.past_limit(estimates[:1], 4.0) == pytest.approx(1.0)
    assert temperature_drift.past_limit(estimates, 4.0) == pytest.approx(3**0.5)
    assert temperature_drift.past_limit([*estimates, None], 4.0) == -np.inf
    assert temperature_drift.past_limit([*estimates[:2], [-4.3, 0.3]], 4.0) == pytest.approx(1.0)
    memory = look(nights.a_night(1, 620, gain=(0.97, 1.0))).memory
    again = from_json(Memory, json.loads(json.dumps(to_json(memory))))
    assert again == memory and "gain of heater_1" in again.recent["temperature"]["nights"][0]
    other = copy.copy(memory)
    other.recent = {"temperature": memory.recent["temperature"] | {"reference": "another"}}
    assert len(look(nights.a_night(1, 621), memory).memory.recent["temperature"]["nights"]) == 2
    assert len(look(nights.a_night(1, 621), other).memory.recent["temperature"]["nights"]) == 1


def a_record(wanted: np.ndarray, readings: np.ndarray) -> dict[str, np.ndarray]:
    """Columns as `ingest` has them, of both sensors alike, with the set-points beside."""
    record = {"time_s": np.arange(float(len(wanted))), "segment": np.zeros(len(wanted), int)}
    for k in (1, 2):
        columns = {f"heater_{k}": np.full(len(wanted), 40.0), f"sensor_{k}": readings}
        record |= columns | {f"{name}_masked": np.zeros(len(wanted), bool) for name in columns}
        record[f"sensor_{k}_set_point"] = wanted
    return record


def test_a_closed_loop_is_held_against_the_set_points_of_the_record(made, monkeypatch):
    monkeypatch.chdir(made)
    machine = params.load(Plant, "plant")
    wanted = np.repeat([100.0, 140.0, 0.0], 300)  # the last: off
    late = np.arange(900) % 300 < 100
    figures = temperature_drift._closed_loop(a_record(wanted, wanted + np.where(late, -30.0, 0.7)), machine)
    # 0.7 °C too warm at either set-point, however long it took to get there
    np.testing.assert_allclose(figures["offset_degC"][0], [0.7, 0.7], atol=1e-9)
    np.testing.assert_allclose(figures["set_point_degC"][0], [120.0, 120.0])
    ramp = np.linspace(100.0, 140.0, 900)
    assert temperature_drift._closed_loop(a_record(ramp, ramp), machine) == {}


def test_each_night_of_the_champion_is_held_against_a_model_identified_without_it(made, monkeypatch):
    monkeypatch.chdir(made)
    identify, seen = identification.identify, []

    def spy(u, y, **settings):
        seen.append([float(one[0, 0]) for one in y])
        return identify(u, y, **settings)

    monkeypatch.setattr(identification, "identify", spy)
    shifts = [nights.a_night(1, k) for k in range(6)]
    segments = [
        [tuple(np.column_stack([one[f"{kind}_1"], one[f"{kind}_2"]]) for kind in ("heater", "sensor"))]
        for one in shifts
    ]
    models = temperature_drift._without_each(params.load(Plant, "plant"), segments, 600)
    # nights share models: 0 and 4, 1 and 5
    assert len(models) == 6 and models[0] is models[4] and models[1] is models[5]
    first = [float(one["sensor_1"][0]) for one in shifts]
    for k, fold in enumerate((0, 1, 2, 3, 0, 1)):
        assert first[k] not in seen[fold] and len(seen[fold]) == (4 if fold < 2 else 5)


def test_a_cap_that_takes_next_to_nothing_is_none():
    asked = np.r_[np.full(80, 50.0), np.full(20, 61.0)][:, None]
    assert drift.above([(asked, asked)], 0, 60.0) == 0.0
    assert drift.above([(asked, asked)], 0, 55.0) == 20.0


def test_of_a_long_record_its_last_samples_are_asked():
    parts = [(np.full((size, 1), k), np.full((size, 2), k)) for k, size in enumerate((3000, 5000, 4000))]
    kept = temperature_drift._last(parts)
    assert [(len(u), len(y), u[0, 0]) for u, y in kept] == [(3200, 3200, 1), (4000, 4000, 2)]


def test_a_recording_that_is_set_aside_is_held_against_drift_all_the_same(look):
    """Its corrected version: quarantine must never silence the alarm."""
    drifted = nights.a_night(1, 630, gain=(0.9, 1.0))
    assert "gain from heater_1" in look(drifted).drift.alarms[0].cause
    swapped = nights.a_night(1, 631)
    result = look(swapped | {f"sensor_{k}": 1.8 * swapped[f"sensor_{k}"] + 32 for k in (1, 2)})
    assert "every sensor is in °F" in result.drift.quarantined[str(NEW)]
    assert result.drift.alarms == [] and str(NEW) in result.drift.figures
    assert len(result.memory.recent["temperature"]["nights"]) == 1


def test_a_creeping_gain_under_proportional_control_is_no_fahrenheit(look):
    memory = Memory()
    for k in range(1, 20, 3):
        result = look(nights.a_night(1, 700 + k, gain=(1 - 0.005 * k, 1.0)), memory)
        memory = result.memory
        assert result.drift.quarantined == {}
        assert [alarm.kind for alarm in result.drift.alarms] == (["gain"] if k > 8 else [])


def test_a_reference_of_an_older_version_is_said_so_and_never_misread(look):
    path = Path("champion/temperature") / screening.REFERENCE
    before = artifacts.read_json(path)
    try:
        artifacts.write_json(path, {"schema": "reference", "version": 1, "own": [], "slow": [], "loop": []})
        result = look(nights.a_night(1, 640, gain=(0.8, 1.0)))
        assert result.drift.alarms == []
        assert "no reference of its own recordings that this version reads" in result.drift.notes[0]
    finally:
        artifacts.write_json(path, before)


def test_swapped_sensors_are_set_aside_with_the_reason_beside_them(look):
    good = nights.a_night(1, 300)
    result = look(good | {"sensor_1": good["sensor_2"], "sensor_2": good["sensor_1"]})
    assert "the sensors sensor_1 and sensor_2 are swapped" in result.drift.quarantined[str(NEW)]
    assert (inputs.QUARANTINE / "temperature/new.csv").exists()
    assert "swapped" in (inputs.QUARANTINE / "temperature/new.csv.reason.txt").read_text()
    # another of the same name does not take its place
    again = look(good | {"sensor_1": good["sensor_2"], "sensor_2": good["sensor_1"]})
    assert (
        again.drift.quarantined
        and (inputs.QUARANTINE / "temperature/new.2.csv").exists()
        and (inputs.QUARANTINE / "temperature/new.csv").exists()
    )


def test_readings_in_kelvin_are_past_every_limit_and_yet_no_broken_sensor(look):
    good = nights.a_night(1, 301)
    result = look(good | {name: good[name] + 273.15 for name in ("sensor_1", "sensor_2")})
    assert result.drift.alarms == []
    assert "every sensor is in K where °C is declared" in result.drift.quarantined[str(NEW)]


def test_a_cause_that_cannot_be_is_a_wrong_record_with_its_likeliest_mistake(look):
    """Wrong in two ways: no single mistake leaves an honest record, so none is believed by itself."""
    good = nights.a_night(1, 302)
    fahrenheit = {name: 1.8 * good[name] + 32 for name in ("sensor_1", "sensor_2")}
    result = look(good | fahrenheit | {"heater_2": 0.8 * good["heater_2"]})
    reason = result.drift.quarantined[str(NEW)]
    assert result.drift.alarms == [] and "this record does not fit the machine: likeliest mistake: " in reason
    assert re.search(r"°F where °C is declared.*; undone, it fits \d+ times better$", reason)


@pytest.mark.parametrize(
    ("kind", "amount", "cannot_be"),
    [
        ("gain", 90.0, True),
        ("gain", -60.0, False),
        ("offset", -55.0, True),
        ("offset or gain", 30.0, False),
        ("ambient", 45.0, True),  # air of 65 °C
        ("ambient", -55.0, True),
        ("ambient", 30.0, False),
        ("time constant", 150.0, False),
    ],
)
def test_no_machine_changes_beyond_what_is_possible_within_a_night(kind, amount, cannot_be):
    assert temperature_drift.cannot_be(kind, amount) is cannot_be


def test_a_heater_that_is_dead_is_an_alarm_and_no_mistake_of_the_record(look):
    result = look(nights.a_night(1, 303, gain=(0.04, 1.0)))
    assert any("gain from heater_1 has changed by -9" in alarm.cause for alarm in result.drift.alarms)
    assert result.drift.quarantined == {}


def test_a_night_without_recordings_keeps_the_alarm_of_the_one_before(look):
    cause = "the gain from heater_1 has changed by -10 %"
    alarm = Alarm("temperature", "temperature: plant at heater_1", "shift_8.csv", cause, -9.0)
    result = screen([], Memory(alarms=[alarm]))
    assert result.drift.alarms == result.memory.alarms == [alarm]


def test_what_drifted_is_remembered_until_a_good_night_and_can_be_what_later_nights_are_held_against(look):
    result = look(nights.a_night(1, 200, gain=(0.9, 1.0)))
    assert result.drift.alarms and result.memory.drifted == {"temperature": [str(NEW)]}
    assert look(nights.a_night(1, 101), result.memory).memory.drifted == {"temperature": []}
    # held against one drifted shift alone, another one like it is no news, and a shift as before is
    folder, loop = Path("champion/temperature"), params.load(Nightly, "nightly").loops["temperature"]
    before = artifacts.read_json(folder / screening.REFERENCE)
    try:
        nights.write(RAW / "drifted.csv", nights.a_night(1, 200, gain=(0.9, 1.0)))
        artifacts.write_json(
            folder / screening.REFERENCE, screening.reference(loop, folder, only=[str(RAW / "drifted.csv")])
        )
        assert look(nights.a_night(1, 201, gain=(0.9, 1.0))).drift.alarms == []
        assert "gain from heater_1 has changed by +1" in look(nights.a_night(1, 101)).drift.alarms[0].cause
    finally:
        artifacts.write_json(folder / screening.REFERENCE, before)
        (RAW / "drifted.csv").unlink()


def as_bag(folder: Path, columns, parts: int = 2) -> dict[str, str]:
    """A shift as a bag of several files, and what the night finds in it: {bag: digest}."""
    folder.mkdir(parents=True)
    names = [f"{folder.name}_{i}.mcap" for i in range(parts)]
    for name, rows in zip(names, np.array_split(np.arange(len(columns["time_s"])), parts), strict=True):
        made_part = Written()
        channel = made_part.topic("/machine", "json")
        for k in rows:
            numbers = {signal: float(values[k]) for signal, values in columns.items() if signal != "time_s"}
            made_part.message(channel, float(columns["time_s"][k]), numbers)
        (folder / name).write_bytes(made_part.bytes())
    information = {"version": 5, "storage_identifier": "mcap", "relative_file_paths": names}
    (folder / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": information}))
    digests = inputs.contents([str(RAW)], {})
    return inputs.recordings(digests, params.load(Nightly, "nightly").loops["temperature"])


@pytest.mark.parametrize("swapped", [False, True])
def test_a_bag_is_one_recording_judged_or_set_aside_whole(made, monkeypatch, swapped):
    monkeypatch.chdir(made)
    good, bag = nights.a_night(1, 400), RAW / "run"
    turned = {"sensor_1": good["sensor_2"], "sensor_2": good["sensor_1"]}
    below = as_bag(bag, good | turned if swapped else good)
    try:
        assert set(below) == {*(f"{RAW}/shift_{k}.csv" for k in range(4)), str(bag)}
        result = screen([str(bag)])
        assert set(result.drift.quarantined) == ({str(bag)} if swapped else set())
        assert bag.exists() != swapped
        if swapped:
            aside = inputs.QUARANTINE / "temperature/run"
            assert sorted(path.name for path in aside.iterdir()) == [
                "metadata.yaml",
                "run_0.mcap",
                "run_1.mcap",
            ]
        else:
            assert str(bag) in result.drift.figures
    finally:
        shutil.rmtree(bag, ignore_errors=True)


def test_one_more_part_makes_a_bag_new(made, monkeypatch):
    monkeypatch.chdir(made)
    bag = RAW / "run"
    try:
        before = as_bag(bag, nights.a_night(1, 401))[str(bag)]
        shutil.rmtree(bag)
        assert as_bag(bag, nights.a_night(1, 401), parts=3)[str(bag)] != before
    finally:
        shutil.rmtree(bag, ignore_errors=True)


def test_a_copy_that_is_not_complete_is_no_recording_of_the_night_and_is_not_set_aside(tmp_path, monkeypatch):
    growing, partial = tmp_path / "rig.csv", tmp_path / "rig.csv.part"
    growing.write_text("time_s,T1\n")
    partial.write_text("time")
    assert list(inputs.contents([str(tmp_path)], {})) == [growing.as_posix()]
    monkeypatch.setattr(plain_files, "REST_S", 10.0)
    monkeypatch.setattr(plain_files.time, "sleep", lambda _: growing.write_text("time_s,T1\n0,1\n"))
    assert "is still being written: it stays" in inputs.quarantine(str(growing), "temperature", "too short")
    assert growing.is_file()


# ---- a sensor that stands still


def spoilt(good: np.ndarray, how: str) -> np.ndarray:
    """A sensor's readings (T,) that end a third of the way, or where the name says."""
    at = {"half": len(good) // 2, "all": 0, "no number at all": 0}.get(how, len(good) // 3)
    ends = {"open": 1000.0, "at zero": 0.0, "no number": np.nan, "no number at all": np.nan}
    return np.r_[good[:at], np.full(len(good) - at, ends.get(how, good[at]))]


@pytest.mark.parametrize("sensor", ["sensor_1", "sensor_2"])
@pytest.mark.parametrize("how", ["open", "at zero", "third", "half", "all", "no number", "no number at all"])
def test_a_sensor_that_stands_still_is_the_first_alarm_and_its_record_is_set_aside(look, sensor, how):
    shift = nights.a_night(1, 700, gain=(0.9, 1.0))  # a drift that would be an alarm of its own
    result = look(shift | {sensor: spoilt(shift[sensor], how)})
    alarm = result.drift.alarms[0]
    assert (alarm.kind, alarm.channel) == (SENSOR, sensor), result.drift.alarms
    assert "Check the sensor" in alarm.cause and str(NEW) in result.drift.quarantined
    assert result.memory.drifted == {"temperature": []}  # nobody may accept it as how things are


def test_a_coarse_sensor_that_a_good_loop_holds_still_and_that_moves_again_is_not_dead(look):
    shift = nights.a_night(1, 740)
    still = shift["sensor_2"].copy()
    still[200:330] = still[200]
    assert [a for a in look(shift | {"sensor_2": still}).drift.alarms if a.kind == SENSOR] == []


def held(step_degC: float, rounds: np.ndarray) -> dict[str, np.ndarray]:
    """A shift whose loop holds both zones, with nothing that moves them; sensors in steps of so many °C."""
    shift = nights.a_night(1, 750, loop={"dither": 0.0})
    return shift | {
        name: np.round((shift[name] + rounds) / step_degC) * step_degC for name in ("sensor_1", "sensor_2")
    }


def test_a_sensor_that_is_stuck_while_the_loop_holds_its_zone_is_an_alarm(look, monkeypatch):
    """The model foretells no move that could be missing; the noise of the sensor is."""
    good = held(1e-4, np.zeros(600))
    assert [a for a in look(good).drift.alarms if a.kind == SENSOR] == []
    stuck = good | {"sensor_2": np.r_[good["sensor_2"][:300], np.full(300, 110.0)]}
    alarm = look(stuck).drift.alarms[0]
    assert (alarm.kind, alarm.channel) == (SENSOR, "sensor_2")
    assert alarm.cause.startswith("sensor_2 stands still at 110.0 °C while heater_2 heats.")
    off = stuck | {"heater_2": np.zeros(600)}
    assert not any("sensor_2 stands still" in a.cause for a in look(off).drift.alarms)
    monkeypatch.setattr("pipeline.nightly.sensors.MISSING", 1e9)
    assert [a for a in look(stuck).drift.alarms if a.kind == SENSOR] == []


def test_a_sensor_that_is_rounded_to_a_degree_from_tonight_on_is_not_stuck(look):
    rounded = held(1.0, np.r_[np.tile([0.5, -0.5], 50), np.zeros(500)])
    assert len(set(rounded["sensor_2"][120:])) == 1
    assert [a for a in look(rounded).drift.alarms if a.kind == SENSOR] == []


def test_a_sensor_whose_noise_is_small_beside_its_step_owes_no_reversals():
    rng = np.random.default_rng(3)
    course = 200 + np.cumsum(0.02 * rng.standard_normal(20000))
    of = [sensors.reversals([[(course, q * np.round(course[:, None] / q + noise))]])[0]
          for q, noise in ((0.25, 0.0), (0.1, 0.5 * rng.standard_normal((20000, 1))))]  # fmt: skip
    assert of[0] < sensors.RESTLESS < of[1]


def test_good_shifts_with_coarse_sensors_are_no_dead_sensors(look):
    for k in range(4):
        shift = nights.a_night(1, 720 + k)
        coarse = {name: np.round(shift[name] * 4) / 4 for name in ("sensor_1", "sensor_2")}
        assert [a for a in look(shift | coarse).drift.alarms if a.kind == SENSOR] == []


@pytest.mark.parametrize(("inputs_", "told"), [(1, True), (2, False)])
def test_of_one_input_a_delay_may_be_the_clock_s(look, inputs_, told):
    machine = params.load(Plant, "plant")
    folder, limits = Path("champion/temperature"), params.load(Nightly, "nightly").drift
    production = temperature_drift.read_reference(folder, machine, limits)
    assert production is not None
    production = production._replace(plant=machine.model_copy(update={"inputs": machine.inputs[:inputs_]}))
    fit = drift.CauseFit(drift.DriftCause("delay", 0), 20.0, 1.0, 900.0)
    said = temperature_drift._say(production, fit, ())
    assert said.words.startswith("heater_1 acts ") and ("or the clock of the outputs" in said.words) == told


def test_a_night_says_what_it_used_and_what_would_have_shown(look):
    shift = nights.a_night(1, 730)
    silent = np.where((np.arange(600) >= 300) & (np.arange(600) < 320), np.nan, shift["sensor_2"])
    measured = look(shift | {"sensor_2": silent}).drift
    (shown,), (figures,) = measured.notes, measured.figures.values()
    assert shown == f"new.csv would have shown {figures['least']}"  # as the page says too
    nights.write(NEW, shift | {"sensor_2": silent})
    share = judge.measure_shares(params.load(Nightly, "nightly"), [str(NEW)])[str(NEW)]
    NEW.unlink()
    # 20 of 600 samples lack a signal, one of four
    assert share == {"used_percent": 96.7, "masked_percent": 0.8, "cut_percent": 0.0}
    found = re.fullmatch(
        r"new.csv would have shown a gain of heater_\d from (\S+) % on "
        r"and an offset of sensor_\d from (\S+) °C on",
        shown,
    )
    limits = params.load(Nightly, "nightly").drift
    assert found and limits.parameter_percent < float(found[1]) < 2 * limits.parameter_percent
    assert limits.offset_degC < float(found[2]) < 2 * limits.offset_degC
