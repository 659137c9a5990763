"""The stage's work on a record of several days: disturbances, recordings, forbidden gains, first-order
models."""

import numpy as np
import pytest

from pipeline.store import artifacts
from pipeline.temperature import tables
from pipeline.temperature.settings import Input, Output, Plant, PlantSignal
from stages.identify_plant import IdentifyPlant, identify

SETTINGS = IdentifyPlant(
    seed=1,
    order=0,
    max_order=6,
    offset=True,
    feedthrough="chosen",
    refinement="validated",
    holdout_share=0.3,
    ahead_steps=10,
    spread_plants=20,
)


def machine(*, room=False, heats=False):
    return Plant(
        inputs=[Input(name="heater", unit="percent", low=0, high=100, heats=heats)],
        disturbances=[PlantSignal(name="room", unit="degC")] if room else [],
        outputs=[Output(name="zone", unit="degC", reference=60)],
        sample_time_s=2.0,
    )


@pytest.fixture
def days(tmp_path):
    """Writes the record of three days of 500 samples: y settles at room + 0.8 u by 1 / 25 a sample, rooms of
    18, 24 and 30 °C that wander; `sign` -1 makes a heater that cools."""

    def write(plant, sign=1.0):
        rng, columns = (
            np.random.default_rng(0),
            {name: [] for name in ("recording", "time_s", "heater", "room", "zone")},
        )
        for day, mean in enumerate((18.0, 24.0, 30.0)):
            room = mean + np.cumsum(0.05 * rng.standard_normal(500))
            u, x = np.repeat(rng.uniform(20, 80, 20), 25), mean
            columns["recording"] += [f"day{day}.csv"] * 500
            columns["time_s"].append(2.0 * np.arange(500))
            columns["heater"].append(u)
            columns["room"].append(room)
            zone = np.empty(500)
            for t in range(500):
                zone[t] = x + 0.05 * rng.standard_normal()
                x += (room[t] + sign * 0.8 * u[t] - x) / 25
            columns["zone"].append(zone)
        record = {"recording": columns.pop("recording"), "segment": np.zeros(1500, np.int32)}
        record |= {name: np.concatenate(part) for name, part in columns.items()}
        schema = tables.record(plant.acting, plant.outputs)
        record |= {
            column.name: np.zeros(1500, bool) for column in schema.columns if column.name.endswith("_masked")
        }
        wanted = {column.name for column in schema.columns}
        path = tmp_path / "record.parquet"
        artifacts.write_table(path, schema, {name: part for name, part in record.items() if name in wanted})
        return str(path)

    return write


def test_a_recorded_room_explains_what_an_unrecorded_one_costs(days):
    with_room = identify(SETTINGS, machine(room=True), days(machine(room=True)))[-1]
    without = identify(SETTINGS, machine(), days(machine()))[-1]
    told, untold = with_room["fit_holdout"]["zone"], without["fit_holdout"]["zone"]
    assert told > 98  # the noise is 0.05 of a movement of some 15 °C
    assert 100 - told < 0.6 * (100 - untold)
    assert without["fit_holdout_free_mean"]["zone"] > untold
    # what wanders and is not recorded becomes a state that hardly decays, found anew at the start of each day
    assert without["largest_pole"] > 0.98
    assert with_room["validation"] == "recordings"


def test_controllers_get_the_inputs_alone_with_the_room_at_its_mean(days):
    plant = machine(room=True)
    model, spread, tables, _ = identify(SETTINGS, plant, days(plant))
    assert model.B.shape[1] == 1
    assert all(member.m == 1 for member in spread)
    rest = model.C @ np.linalg.solve(np.eye(model.n) - model.A, model.b + model.B[:, 0] * 50)
    # at 50 % the zone settles at the mean room, 24 °C give or take its wandering, and 40 °C above it
    assert (rest + model.d)[0] == pytest.approx(64, abs=2.5)
    assert set(tables["dynamics"][1]["input"]) == {"heater"}


def test_the_first_order_model_and_its_pid_are_those_of_the_zone(days):
    plant = machine(room=True)
    schema, rows = identify(SETTINGS, plant, days(plant))[2]["first_order"]
    assert schema is tables.FIRST_ORDER
    # 1,500 samples at 0.05 °C: some per cent, and the grid of time constants is a tenth
    assert rows["gain"][0] == pytest.approx(0.8, rel=0.05)
    assert rows["time_constant_s"][0] == pytest.approx(50, rel=0.15)
    assert rows["gain_low"][0] <= rows["gain"][0] * 1.01
    assert rows["gain_high"][0] >= rows["gain"][0] * 0.99
    assert rows["Kp"][0] > 0
    assert rows["Ki"][0] > 0


def test_a_heater_that_cools_is_flagged_with_its_band_and_one_that_heats_is_not(days):
    plant = machine(room=True, heats=True)
    assert identify(SETTINGS, plant, days(plant))[-1]["forbidden_gains"] == []
    (flagged,) = identify(SETTINGS, plant, days(plant, sign=-1.0))[-1]["forbidden_gains"]
    assert (flagged["output"], flagged["input"], flagged["certain"]) == ("zone", "heater", True)
    assert flagged["low"] <= flagged["gain"] <= flagged["high"] < 0
    assert flagged["reason"] == "a heater that cools"
    unsaid = machine(room=True)
    assert identify(SETTINGS, unsaid, days(unsaid, sign=-1.0))[-1]["forbidden_gains"] == []
