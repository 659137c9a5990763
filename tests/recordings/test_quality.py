import numpy as np
import pytest

from pipeline.recordings.quality import (
    MANY_VALUES,
    _may_rest,
    _none_stands_out,
    _usual_of_others,
    quantisation_step,
    runs,
    stands_still,
)
from pipeline.recordings.recordings import Flag, Source, Table, flag, read, resample

LIMITS = {"u": (0.0, 100.0)}
UNITS = {"u": "percent", "y": "degC", "z": "degC"}


def rig(samples: int = 2000, seed: int = 0, step: float = 0.03) -> dict[str, np.ndarray]:
    """Duty in levels held 100 s, two slow temperatures after it with noise,
    as a converter with steps of 0.03 °C shows them."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([20.0, 30, 40], samples // 100), 100)
    y, z = np.full(samples, 40.0), np.full(samples, 35.0)
    for k in range(1, samples):
        y[k] = y[k - 1] + 0.01 * (20 + 0.8 * u[k - 1] - y[k - 1])
        z[k] = z[k - 1] + 0.01 * (18 + 0.6 * u[k - 1] - z[k - 1])
    noisy = [np.round((x + rng.normal(0, 0.05, samples)) / step) * step for x in (y, z)]
    return {"u": u, "y": noisy[0], "z": noisy[1]}


def flagged(
    values: dict[str, np.ndarray], limits=LIMITS, units=UNITS, segment: np.ndarray | None = None
) -> Table:
    count = len(next(iter(values.values())))
    segment = np.zeros(count, np.int32) if segment is None else segment
    masked = {name: ~np.isfinite(signal) for name, signal in values.items()}
    return flag(
        Table("rig.csv", segment, np.arange(float(count)), values, masked, [], {}), units=units, limits=limits
    )


def of(table: Table, *kinds: str) -> list[Flag]:
    return [one for one in table.flags if one.kind in kinds]


def test_a_healthy_record_has_no_finding_but_its_quantisation_and_nothing_is_masked():
    for seed in range(5):
        table = flagged(rig(seed=seed))
        assert {(one.signal, one.kind) for one in table.flags} == {("y", "quantised"), ("z", "quantised")}
        assert not any(mask.any() for mask in table.masked.values())
        assert all("steps of 0.03 " in one.message for one in table.flags)


def test_values_are_never_altered():
    values = rig()
    values["y"][500] = 0.0
    before = {name: signal.copy() for name, signal in values.items()}
    table = flagged(values)
    for name, signal in before.items():
        np.testing.assert_array_equal(table.values[name], signal)


@pytest.mark.parametrize("size", [1.5, -1.5, 5.0, -40.0])
@pytest.mark.parametrize("length", [1, 2])
def test_isolated_spikes_are_found_where_they_are_and_masked(size, length):
    rng = np.random.default_rng(1)
    for place in rng.integers(20, 1980, 10):
        values = rig()
        values["y"][place : place + length] += size
        table = flagged(values)
        (spike,) = of(table, "spike")
        assert (spike.signal, spike.start_s, spike.end_s, spike.count) == (
            "y",
            place,
            place + length - 1,
            length,
        )
        assert np.flatnonzero(table.masked["y"]).tolist() == list(range(place, place + length))
        assert not table.masked["z"].any()


def test_steps_ramps_and_smooth_peaks_are_no_spikes():
    time = np.arange(400.0)
    for signal in (
        np.where(time < 200, 20.0, 60.0),
        np.maximum(0, time - 200),
        50 - 0.01 * (time - 200) ** 2,
        10 * np.sin(time / 3),
        np.abs(time - 200),
        20 + 30 * (1 - np.exp(-np.maximum(0, time - 100) / 20)),
    ):
        assert of(flagged({"u": time % 50, "y": signal}), "spike") == []


def test_a_spike_at_the_edge_of_a_segment_is_left_alone_for_nothing_tells_which_side_is_right():
    values = rig()
    values["y"][1000:] += 10
    segment = np.repeat([0, 1], 1000).astype(np.int32)
    assert of(flagged(values, segment=segment), "spike") == []


def test_a_frozen_sensor_is_masked_from_its_second_sample_on():
    values = rig()
    values["y"][700:1000] = values["y"][700]
    table = flagged(values)
    (frozen,) = of(table, "frozen")
    assert (frozen.signal, frozen.start_s, frozen.end_s) == ("y", 701, 999)
    assert table.masked["y"][701:1000].all()
    assert table.masked["y"].sum() == 299
    assert "while u" in frozen.message


def test_a_coarse_slow_or_resting_signal_is_not_frozen():
    values = rig(step=1.0)
    assert of(flagged(values), "frozen") == []
    values = {
        "u": np.full(500, 30.0),
        "y": np.r_[np.linspace(20, 40, 100), np.full(400, 40.0)],
        "z": np.full(500, 25.0),
    }
    assert of(flagged(values), "frozen") == []


def approach(
    samples: int = 3000, *, time_constant: float = 120.0, step: float = 0.0
) -> dict[str, np.ndarray]:
    """A heater that is switched now and then for long, and a temperature that comes to rest each time,
    without noise, as a sensor of that step shows it."""
    u = np.zeros(samples)
    u[20:1200], u[1200:2000], u[2000:] = 40.0, 70.0, 30.0
    y = np.full(samples, 21.5)
    for k in range(1, samples):
        y[k] = y[k - 1] + (21.5 + 0.7 * u[k - 1] - y[k - 1]) / time_constant
    other = 20 + 5 * np.sin(np.arange(samples) / 90)
    return {"u": u, "y": np.round(y / step) * step if step else y, "z": other}


@pytest.mark.parametrize("time_constant", [8.0, 40.0, 120.0, 900.0])
@pytest.mark.parametrize("step", [0.0, 0.001, 0.01, 0.1, 0.25, 1.0])
def test_a_clean_slow_record_that_comes_to_rest_has_no_finding_but_its_quantisation(time_constant, step):
    table = flagged(approach(time_constant=time_constant, step=step))
    assert {one.kind for one in table.flags} <= {"quantised"}
    assert not any(mask.any() for mask in table.masked.values())


def test_a_smooth_signal_that_stops_at_once_and_jumps_on_release_was_frozen():
    values = approach()
    values["y"][60:140] = values["y"][60]
    (frozen,) = of(flagged(values), "frozen")
    assert (frozen.signal, frozen.start_s, frozen.end_s) == ("y", 61, 139)


def test_noise_that_ends_for_good_is_a_frozen_sensor_though_nothing_else_moves():
    values = {"u": np.full(1000, 30.0), "y": rig(1000)["z"]}
    values["y"][800:] = values["y"][:800].mean()
    (frozen,) = of(flagged(values), "frozen")
    assert (frozen.start_s, frozen.end_s) == (801, 999)


def test_a_spike_on_a_record_without_noise_is_found():
    values = approach()
    values["y"][[300, 1250]] = [0.0, 85.0]
    table = flagged(values)
    assert [(one.start_s, one.count) for one in of(table, "spike")] == [(300, 1), (1250, 1)]
    assert np.flatnonzero(table.masked["y"]).tolist() == [300, 1250]


def test_a_heater_that_is_switched_off_is_not_held_back_by_its_limit_and_a_controller_at_it_is():
    values = approach()
    assert of(flagged(values), "saturated") == []
    controlled = np.clip(60 - values["y"] + values["z"] - 20, 0.0, 100.0)
    flags = of(flagged(values | {"u": controlled}), "saturated")
    assert [(one.signal, one.count) for one in flags] == [("u", (controlled == 0).sum())]
    assert "at its limit 0" in flags[0].message


def test_an_output_on_its_rail_is_saturated_and_not_masked():
    values = rig()
    top = float(np.percentile(values["y"], 80))
    values["y"] = np.minimum(values["y"], top)
    table = flagged(values)
    (rail,) = of(table, "saturated")
    assert rail.signal == "y"
    assert rail.count <= (values["y"] == top).sum()
    assert "its largest value" in rail.message
    assert not table.masked["y"].any()


def test_inputs_at_and_beyond_their_limits_are_counted():
    values = rig()
    values["u"] = np.where(values["u"] == 40, 100.0, values["u"])
    values["u"][:5] = 120.0
    table = flagged(values)
    assert [(one.signal, one.count) for one in of(table, "saturated")] == [("u", (values["u"] == 100).sum())]
    assert [(one.signal, one.count) for one in of(table, "outside")] == [("u", 5)]
    assert "beyond its limits 0 to 100 in 5 samples (up to 120)" in of(table, "outside")[0].message


def test_constant_signals_are_named():
    values = rig() | {"u": np.full(2000, 30.0)}
    (constant,) = of(flagged(values), "constant")
    assert (constant.signal, constant.count) == ("u", 2000)
    assert "u is 30 throughout" in constant.message


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (
            lambda v: v | {"y": v["y"] - 20 + 273.15, "z": v["z"] - 15 + 273.15},
            "looks like kelvin; set offset: -273.15",
        ),
        (lambda v: v | {"y": v["y"] + 480}, "looks like kelvin"),
        (
            lambda v: v | {"y": (v["y"] - 20) * 1.8 + 32, "z": (v["z"] - 15) * 1.8 + 32},
            "looks like fahrenheit; set scale: 0.555556",
        ),
        (lambda v: v | {"u": v["u"] / 100}, "looks like a duty of 0 to 1; set scale: 100"),
        (lambda v: v | {"u": np.round(v["u"] * 2.55 * 2)}, "a converter's 0 to 255; set scale: 0.392157"),
        (lambda v: v | {"y": v["y"] - 400}, "which no temperature does"),
    ],
)
def test_suspicious_units_are_said_and_nothing_is_changed(change, sentence):
    values = change(rig())
    table = flagged(values)
    flags = of(table, "unit")
    assert flags
    assert all(sentence in one.message for one in flags)
    for name in values:
        np.testing.assert_array_equal(table.values[name], values[name])
        assert not table.masked[name].any()


def test_plausible_units_are_not_suspected():
    assert of(flagged(rig()), "unit") == []
    hot = rig()
    hot["y"], hot["z"] = hot["y"] + 190, hot["z"] + 200
    assert of(flagged(hot), "unit") == []
    flow = rig()
    flow["u"] = np.round(flow["u"] * 5)
    assert of(flagged(flow, limits={"u": (0.0, 200.0)}), "unit") == []


def test_a_signal_without_any_value_gets_no_finding():
    table = flagged(rig() | {"y": np.full(2000, np.nan)})
    assert {one.signal for one in table.flags} == {"z"}


def test_the_spike_of_the_two_heater_kit_and_nothing_else_is_masked(shared):
    columns = {"heater_1": "Q1_pct", "heater_2": "Q2_pct", "temperature_1": "T1_C", "temperature_2": "T2_C"}
    raw = read(
        shared("data/tclab_mlid_prbs/prbs.csv"),
        [Source(name, column, "") for name, column in columns.items()],
    )
    inputs, outputs = ["heater_1", "heater_2"], ["temperature_1", "temperature_2"]
    table = resample(raw, sample_time_s=1.0, inputs=inputs, outputs=outputs)
    table = flag(
        table,
        units={**dict.fromkeys(inputs, "percent"), **dict.fromkeys(outputs, "degC")},
        limits=dict.fromkeys(inputs, (0.0, 100.0)),
    )
    flags = {(one.signal, one.kind, one.start_s, one.count) for one in table.flags}
    assert flags == {
        ("temperature_1", "spike", 1789, 1),
        ("temperature_1", "quantised", 0, 5099),
        ("temperature_2", "quantised", 0, 5100),
    }
    assert np.flatnonzero(table.masked["temperature_1"]).tolist() == [1789]
    assert table.values["temperature_1"][1789] == 40.718
    assert not table.masked["temperature_2"].any()


@pytest.mark.parametrize("step", [0.5, 2.0, 10.0, 16.0])
@pytest.mark.parametrize("noise", [0.02, 0.2, 0.45])
@pytest.mark.parametrize("even", [True, False])
def test_steps_of_a_coarse_converter_are_no_spikes(step, noise, even):
    """A thermistor's converter has steps that differ from level to level."""
    rng = np.random.default_rng(4)
    counts = np.round(40 + 2 * np.sin(np.arange(2000) / 200) + rng.normal(0, noise, 2000)).astype(int)
    levels = step * np.cumsum(1 + (0 if even else 0.3) * np.sin(np.arange(100) / 3))
    table = flagged({"u": rig()["u"], "y": levels[counts]})
    assert not of(table, "spike", "frozen")
    assert not table.masked["y"].any()


def test_a_limit_decides_where_commands_that_move_in_most_samples_are_cut_off_and_no_controller_is_claimed():
    """Clipped noise has no controller, and a record alone does not tell it from one that has."""
    rng = np.random.default_rng(5)
    plan = np.repeat(np.clip(rng.uniform(-20, 120, 40), 0, 100), 50)
    (low, high) = of(flagged(rig() | {"u": plan}), "saturated")
    assert "decides" not in low.message + high.message
    noise = np.clip(50 + 40 * rng.normal(size=2000), 0, 100)
    (low, high) = of(flagged(rig() | {"u": noise}), "saturated")
    for finding in (low, high):
        assert finding.message.endswith("samples: there the limit decides, not what commands it")


# ---- quick answers, which the checks give before they sort


def test_the_step_of_a_long_signal_is_that_of_all_its_values_wherever_its_digits_stand():
    rng = np.random.default_rng(6)
    count = 2 * MANY_VALUES
    fine, coarse = rng.normal(size=count), 0.25 * rng.integers(0, 40, count)
    share = np.arange(count) / count
    for digits, step in (
        (share < 0.3, 0.0),  # levels of both, of which too few are 0.25 apart
        (share < 0.38, 0.0),  # more levels than a third of the values, seen in the first of them
        (share > 0.6, 0.0),  # seen in the last of them alone
        (share < 0.0, 0.25),
    ):
        values = np.where(digits, fine, coarse)
        assert quantisation_step(values) == step
        # no value stands for itself by its place
        assert quantisation_step(rng.permutation(values)) == step
    few = np.repeat(np.round(rng.normal(size=count // 4), 9), 4)
    assert quantisation_step(few) == quantisation_step(rng.permutation(few))


@pytest.mark.parametrize("tails", [1.0, 1.5, 3.0, 30.0])
def test_no_residual_is_passed_over_that_is_beyond_eight_deviations_of_the_ninetieth_percentile(tails):
    rng = np.random.default_rng(7)
    said = []
    for count in (21, 22, 30, 101, 1000):
        for _ in range(200):
            size = np.abs(rng.standard_t(tails, count)) * rng.choice([0.0, 1.0], count, p=[0.2, 0.8])
            said.append(_none_stands_out(size))
            if said[-1]:
                assert size.max() <= 8 * np.percentile(size, 90) / 1.645
    assert any(said)
    assert tails == 30.0 or not all(said)


def test_the_usual_stretch_of_the_others_is_counted_without_the_one_that_is_judged():
    rng = np.random.default_rng(8)
    for count in (1, 2, 3, 10, 60):
        lengths = rng.integers(1, rng.integers(2, 400), count)
        for i, quick in enumerate(_usual_of_others(lengths, lengths)):
            others = np.sort(np.delete(lengths, i))
            held = np.cumsum(others)
            usual = others[np.searchsorted(held, 0.9 * held[-1])] if count > 1 else np.inf
            assert quick == usual


def test_a_signal_that_is_passed_over_as_restless_has_no_stretch_of_that_length():
    rng = np.random.default_rng(9)
    for _ in range(200):
        values = np.repeat(rng.integers(0, 3, 8), rng.integers(1, 9, 8)).astype(float)
        segment = np.sort(rng.integers(0, 2, len(values)))
        first, last = runs(values, segment)
        longest = int((last - first + 1).max())
        assert _may_rest(values, longest)
    alone = np.array([0.0, 1, 1, 1, 2])
    assert _may_rest(alone, 3)
    assert not _may_rest(alone, 4)


def test_a_temperature_that_is_held_stands_still_and_one_that_is_moved_does_not():
    rng, samples = np.random.default_rng(0), 3000
    held = np.round(60 + rng.normal(0, 0.05, samples), 1)
    quiet = np.round(60 + rng.normal(0, 0.025, samples), 1)
    assert stands_still(quiet, None), "its readings take three values"
    swings = 60 + 0.6 * np.sin(np.arange(samples) / 20)
    constant, moved = np.full(samples, 60.0), np.where(np.arange(samples) < 1500, 60.0, 61.0)
    assert stands_still(held, None) and stands_still(held, constant) and stands_still(swings, constant)
    assert not stands_still(swings, None), "nobody says that it was to stand still"
    assert not stands_still(swings, moved), "its set-point was changed"
    assert not stands_still(np.linspace(24, 60, samples), constant), "it was heated up"
    assert not stands_still(rig()["y"], None)


def test_a_signal_that_was_computed_from_a_printed_file_has_no_findings_of_a_sensor():
    values = rig()
    fan = np.repeat(np.arange(20.0) % 2 * 100, 100)
    fan[450] = 30.0  # for a sample, in a layer of its own
    table = {"u": values["u"], "y": values["y"], "fan": fan}
    measured, computed = (
        flag(
            Table(
                "rig.csv",
                np.zeros(2000, np.int32),
                np.arange(2000.0),
                table,
                {name: np.zeros(2000, bool) for name in table},
                [],
                {},
            ),
            units={**UNITS, "fan": "percent"},
            limits=LIMITS,
            computed=names,
        )
        for names in ((), ("fan",))
    )
    assert measured.masked["fan"].any() and not computed.masked["fan"].any()
    assert not [one for one in computed.flags if one.signal == "fan"]
