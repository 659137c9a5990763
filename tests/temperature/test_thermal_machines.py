"""The drawn machines are physical, and the same in C and in Python."""

import ast
import ctypes
import shutil

import numpy as np
import pytest

from pipeline.deploy import to_c
from tests.deploy import deployed_machines
from tests.foreign import normal_life, thermal_machines
from tests.foreign.thermal_machines import DOOR, FAN, FLOW, ROOM, Machine, State, draw, drive, quiet, start

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc on this machine; install gcc")
SEEDS = range(1, 7)  # every structure once
KELVIN = 273.15


def nodes(machine: Machine, name: str) -> np.ndarray:
    return np.array(getattr(machine.parts, name)[: int(machine.parts.nodes)])


def rest(machine: Machine) -> tuple[State, np.ndarray, float]:
    """The machine after twelve time constants and four hours under the duty that holds its typical
    references, readings (T, p) of the last tenth, and the heaters' mean power in W."""
    duty = thermal_machines.holding(machine, machine.reference_degC)
    T = round((12 * machine.tau_s + 4 * 3600) / machine.sample_time_s)
    state, outside = start(machine, 5), quiet(machine, T)
    y, _ = drive(machine, state, np.tile(duty, (T, 1)), outside)
    watt = duty / 100 @ np.array(machine.parts.power[: len(duty)])
    return state, y[-T // 10 :], float(watt)


def lost(machine: Machine, degC: np.ndarray, outside: np.ndarray) -> float:
    """W that a machine at temperatures (nodes,) gives to the room and to what flows, less the shear."""
    above, flow = degC - outside[ROOM], outside[FLOW]
    k = nodes(machine, "convection") * (1 + nodes(machine, "fan") * outside[FAN])
    radiation = nodes(machine, "radiation") * ((degC + KELVIN) ** 4 - (outside[ROOM] + KELVIN) ** 4)
    found = (nodes(machine, "linear") * above + k * np.sign(above) * np.abs(above) ** 1.25 + radiation).sum()
    found += (nodes(machine, "feed") * flow * above).sum()
    found -= (nodes(machine, "shear") * flow**1.4 * np.exp(-0.012 * (degC - 200))).sum()
    for line in range(int(machine.parts.lines)):
        a, b = int(machine.parts.upstream[line]), int(machine.parts.downstream[line])
        found += machine.parts.carried[line] * flow * (degC[b] - degC[a])
    return float(found)


@pytest.mark.parametrize("seed", SEEDS)
def test_at_rest_the_heaters_give_what_the_machine_loses(seed):
    machine = draw(seed)
    state, y, watt = rest(machine)
    degC = np.array(state.degC[: int(machine.parts.nodes)])
    assert lost(machine, degC, quiet(machine, 1)[0]) == pytest.approx(watt, rel=0.03)
    np.testing.assert_allclose(y.mean(axis=0), machine.reference_degC, atol=4)


@pytest.mark.parametrize("seed", SEEDS)
def test_capacities_and_conductances_are_no_less_than_nothing(seed):
    parts = draw(seed).parts
    assert min(parts.capacity[: int(parts.nodes)]) > 0
    names = [name for name, _ in parts._fields_ if name not in ("sample_s", "substeps")]
    assert all(np.min(getattr(parts, name)) >= 0 for name in names)


@pytest.mark.parametrize("seed", range(1, 13))
def test_readings_are_steps_near_the_sensor(seed):
    machine = draw(seed)
    m, y = len(machine.inputs), np.zeros(thermal_machines.SENSORS)
    state, step = start(machine, 1, 180.0), np.array(machine.parts.step[: len(machine.inputs)])
    for _ in range(50):
        thermal_machines.library().thermal_read(
            ctypes.byref(state), ctypes.byref(machine.parts), thermal_machines.pointer(y)
        )
        np.testing.assert_allclose(np.rint(y[:m] / step), y[:m] / step, atol=1e-6)
        assert (np.abs(y[:m] - 180) <= 6 * np.array(machine.parts.noise[:m]) + step / 2 + 1e-9).all()


def after(machine: Machine, seconds: float, **outside: float) -> np.ndarray:
    """Mean readings (p,) of the last fifth of some time from rest, heaters as before."""
    state, _, _ = rest(machine)
    acts = quiet(machine, round(seconds / machine.sample_time_s))
    for name, value in outside.items():
        acts[:, {"fan": FAN, "flow": FLOW, "door": DOOR, "room": ROOM}[name]] = value
    duty = thermal_machines.holding(machine, machine.reference_degC)
    y, _ = drive(machine, state, np.tile(duty, (len(acts), 1)), acts)
    return y[-len(y) // 5 :].mean(axis=0)


@pytest.mark.parametrize("seed", [4, 6, 10])
def test_an_open_door_cools(seed):
    machine = draw(seed)
    assert machine.has_door
    assert after(machine, 90, door=1)[-1] < after(machine, 90)[-1] - 1


@pytest.mark.parametrize("seed", [1, 2, 4, 5, 6])
def test_the_fan_cools(seed):
    machine = draw(seed)
    assert "fan" in machine.recorded
    assert after(machine, 600, fan=1)[0] < after(machine, 600)[0] - 0.3


def test_cold_filament_cools():
    machine = draw(1)
    assert after(machine, 600, flow=machine.recorded["feed"][1])[0] < after(machine, 600)[0] - 3


def test_material_arrives_a_filling_of_the_line_later():
    """A zone that is heated warms the material of the next one after by_cell x cells / flow seconds."""
    machine = draw(3)
    parts, state = machine.parts, start(machine, 1, 20.0)
    state.degC[int(parts.upstream[0])] = 500.0
    for edge in range(int(parts.edges)):
        parts.conduction[edge] = 0.0
    screw, dt = 60.0, machine.sample_time_s
    later = parts.by_cell[0] * parts.cells[0] / screw
    outside = np.array([[20.0, 0.0, screw, 0.0]])
    warm = []
    for _ in range(round(2 * later / dt)):
        drive(machine, state, np.zeros((1, len(machine.inputs))), outside)
        warm.append(state.degC[int(parts.downstream[0])])
    rise = np.diff(warm)
    assert dt * (int(rise.argmax()) + 1) == pytest.approx(later, rel=0.2)


def test_a_pulse_shorter_than_the_relay_s_does_not_heat():
    machine = draw(2)
    short = 90 * machine.parts.shortest_s[0] / machine.parts.period_s[0]
    y, _ = drive(machine, start(machine, 1), np.full((600, 1), short), quiet(machine, 600))
    assert np.abs(y - machine.room_degC).max() < 1.5


@pytest.mark.parametrize("seed", SEEDS)
def test_the_same_seed_gives_the_same_bytes(seed):
    once, again = draw(seed), draw(seed)
    assert bytes(once.parts) == bytes(again.parts) != bytes(draw(seed + 6).parts)
    for make in (thermal_machines.record, thermal_machines.evening):
        both = [make(one, np.random.default_rng(1), 30, disturbed=True) for one in (once, again)]
        assert all(a.tobytes() == b.tobytes() for a, b in zip(*both, strict=True))


@pytest.mark.parametrize("seed", range(1, 13))
def test_the_owner_s_control_holds_the_references(seed):
    machine = draw(seed)
    T = round(8 * machine.tau_s / machine.sample_time_s)
    r = np.tile(machine.reference_degC, (T, 1))
    y, _ = thermal_machines.control(machine, start(machine, 9), machine.own_control, r, quiet(machine, T))
    assert np.abs(y[-T // 4 :].mean(axis=0) - machine.reference_degC).max() < 1
    assert (y.max(axis=0) < machine.high_degC).all()


@pytest.mark.parametrize("seed", SEEDS)
def test_a_normal_life_stays_in_what_is_declared(seed):
    machine = draw(seed)
    r, outside = thermal_machines.life(machine, np.random.default_rng(3), 50)
    assert (r >= np.floor(machine.lowest_degC)).all() and (r <= machine.high_degC - 10).all()
    changes = np.abs(np.diff(r, axis=0)).max(axis=1)
    assert 25 <= (changes > 0).sum() <= 150 and changes.max() <= 60
    assert np.abs(outside[:, ROOM] - machine.room_degC).max() <= 8
    assert (outside[:, DOOR].mean() > 0) == machine.has_door and outside[:, DOOR].mean() < 0.05


@pytest.mark.parametrize("seed", [*SEEDS, 9])
def test_every_set_point_can_be_held_on_every_day(seed):
    machine, rng = draw(seed), np.random.default_rng(4)
    m, largest = len(machine.inputs), dict(machine.recorded.values())
    for _ in range(10):
        r, _ = thermal_machines.life(machine, rng, 0.5)
        for room in (-8.0, 8.0):
            for fan in {0.0, largest.get(FAN, 0.0)}:
                for flow in {0.0, largest.get(FLOW, 0.0)}:
                    outside = (machine.room_degC + room, fan, flow, 0.0)
                    watt = thermal_machines.at_rest(machine.parts, r[0], outside)[1]
                    share = watt / np.array(machine.parts.power[:m])
                    assert 0.0 < share.min() and share.max() < 0.9


def test_the_machines_know_nothing_of_the_product():
    tree = ast.parse((normal_life.HERE / "thermal_machines.py").read_text(encoding="utf-8"))
    imported = [ast.unparse(node) for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]
    assert imported and not any("pipeline" in line for line in imported)


# ---- a life in C


@pytest.fixture(scope="module")
def lives(tmp_path_factory):
    """A life without a fault and one with a heater stuck on: two zones, and a controller of other zones."""
    folder = tmp_path_factory.mktemp("life")
    (folder / "c").mkdir()
    for name, text in to_c.code(deployed_machines.exported("pi", zones=2), "no certificate").items():
        (folder / "c" / name).write_text(text)
    return [normal_life.play(folder, 5, 2.0, fault=fault) for fault in ("no fault", "heater stuck on")]


def test_a_life_in_c_is_the_machine_under_its_commands_in_python(lives):
    machine, life = draw(5), lives[0]
    _, outside, noise, _ = normal_life.scenario(machine, 5, 2.0, 0)
    y, _ = drive(machine, start(machine, noise), life.command, outside)
    np.testing.assert_array_equal(y, life.reading)


def test_a_fault_begins_in_the_same_life_and_shows_later(lives):
    healthy, stuck = lives
    assert 0 < stuck.began < stuck.shows
    np.testing.assert_array_equal(healthy.reading[: stuck.began], stuck.reading[: stuck.began])
    assert stuck.sensor[-1].max() > healthy.sensor.max() + 20
