"""The module for Klipper and Kalico on a heater that behaves as theirs: its Heater calls the control as
klippy/extras/heaters.py does (Heater.temperature_callback, set_pwm, set_control, ControlPID), under its
lock."""

import importlib.util
import sys
import threading
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from pipeline.runtime.export import klipper
from tests.runtime.deployed_machines import exported, passed

REPORT_S, ROOM_DEGC = 0.3, 25.0
BASE = 255.0


class ControlPID:
    """Klipper's own, with the names that the module looks for."""

    def __init__(self, heater, Kp, Ki, Kd):
        self.heater, self.dt = heater, REPORT_S
        self.Kp, self.Ki, self.Kd = Kp / BASE, Ki / BASE, Kd / BASE
        self.prev_temp, self.prev_err, self.prev_der, self.int_sum = 25.0, 0.0, 0.0, 0.0
        self.smooth = 1.0 + heater.get_smooth_time() / self.dt

    def temperature_update(self, read_time, temp, target_temp):
        err = target_temp - temp
        i = self.int_sum + (self.prev_err + err) / 2.0 * self.dt
        dc = ((self.smooth - 1.0) * self.prev_der - (temp - self.prev_temp) / self.dt) / self.smooth
        o = self.Kp * err + self.Ki * i + self.Kd * dc
        so = max(0.0, min(self.heater.get_max_power(), o))
        self.heater.set_pwm(read_time, so)
        self.prev_temp, self.prev_der, self.prev_err = temp, dc, err
        if o == so:
            self.int_sum = i

    def check_busy(self, eventtime, smoothed_temp, target_temp):
        return abs(target_temp - smoothed_temp) > 1.0

    def get_type(self):
        return "pid"


class Heater:
    """Heater of klippy/extras/heaters.py without its pins."""

    def __init__(self, max_power=1.0):
        self.max_power, self.lock = max_power, threading.Lock()
        self.smoothed_temp = self.target_temp = self.last_temp_time = 0.0
        self.next_pwm_time = self.last_pwm_value = 0.0
        self.control = ControlPID(self, 10.0, 0.3, 40.0)

    def get_pwm_delay(self):
        return REPORT_S

    def get_max_power(self):
        return self.max_power

    def get_smooth_time(self):
        return 1.0

    def set_control(self, control):
        assert self.lock.acquire(blocking=False), "set_control waits for a lock that is held"
        old, self.control, self.target_temp = self.control, control, 0.0
        self.lock.release()
        return old

    def set_pwm(self, read_time, value):
        value = value if self.target_temp > 0.0 else 0.0
        if (read_time < self.next_pwm_time or not self.last_pwm_value) and abs(
            value - self.last_pwm_value
        ) < 0.05:
            return
        self.next_pwm_time, self.last_pwm_value = read_time + REPORT_S + 0.75 * 5.0, value

    def temperature_callback(self, read_time, temp):
        with self.lock:
            passed = read_time - self.last_temp_time
            self.last_temp_time = read_time
            self.control.temperature_update(read_time, temp, self.target_temp)
            self.smoothed_temp += (temp - self.smoothed_temp) * min(passed, 1.0)


class Printer:
    """Printer, its section [beadline], and its objects `heaters` and gcode, as far as they are asked."""

    def __init__(self, behind, options):
        self.behind, self.options, self.handlers = behind, options, {}

    def get_printer(self):
        return self

    def get(self, name):
        return self.options[name]

    def getboolean(self, name, default):
        return self.options.get(name, default)

    def error(self, message):
        return RuntimeError(message)

    config_error = error

    def register_event_handler(self, event, handler):
        self.handlers[event] = handler

    def lookup_object(self, name):
        assert name == "heaters"
        return self

    def lookup_heater(self, name):
        return {"extruder": self.behind}[name]


def extras(folder: Path, of) -> ModuleType:
    """Both files as a package, as in klippy/extras/."""
    folder.mkdir(exist_ok=True)
    name = f"extras_{folder.name}"
    for file, text in klipper.module(of, passed(of)).items():
        (folder / file).write_text(text)
    (folder / "__init__.py").write_text("")
    spec = importlib.util.spec_from_file_location(
        name, folder / "__init__.py", submodule_search_locations=[str(folder)]
    )
    assert spec and spec.loader
    sys.modules[name] = importlib.util.module_from_spec(spec)
    return importlib.import_module(f"{name}.beadline")


def connected(folder: Path, of, heater: Heater, **options):
    options = {"heater": "extruder", "plant": of.plant_sha256, "rehearsal": True} | options
    printer = Printer(heater, options)
    made = extras(folder, of).load_config(printer)
    printer.handlers["klippy:connect"]()
    return made


class Block:
    """The block and sensor of 0.3 s a step, written as its differential equation: 20 J/K, 40 W, 0.15 W/K."""

    def __init__(self):
        self.block = self.sensor = ROOM_DEGC

    def after(self, seconds, duty):
        for _ in range(30):
            dt = seconds / 30
            self.block += dt * (40.0 * duty - 0.15 * (self.block - ROOM_DEGC)) / 20.0
            self.sensor += dt * (self.block - self.sensor) / 8.0
        return self.sensor


def driven(heater: Heater, block: Block, targets, start_s=0.0, rng=None) -> np.ndarray:
    """Temperatures at each report under `targets` (T,); a report's moment is off by a millisecond or so."""
    rng = rng or np.random.default_rng(4)
    y = np.empty(len(targets))
    for k, target in enumerate(targets):
        heater.target_temp = target
        y[k] = block.after(REPORT_S, heater.last_pwm_value)
        at = start_s + REPORT_S * (k + 1) + rng.uniform(-1e-3, 1e-3)
        heater.temperature_callback(at, y[k] + 0.05 * rng.standard_normal())
    return y


@pytest.fixture
def of():
    return exported("lqg", zones=1, sample_time_s=0.9)


def test_it_settles_the_heater_and_is_off_at_a_target_of_zero(of, tmp_path):
    heater, block = Heater(), Block()
    made = connected(tmp_path, of, heater)
    y = driven(heater, block, [0.0] * 20 + [210.0] * 2000)
    assert heater.control is made and not made.failed and made.mode == "law"
    # noise of 0.05 degC at the sensor, and the plant's own model: well within half a degree
    assert np.abs(y[-300:] - 210.0).max() < 0.5 and y.max() < 215.0
    # changes below 5 % are applied at once
    assert heater.last_pwm_value == made.duty > 0.05
    assert not made.check_busy(0.0, heater.smoothed_temp, 210.0) and made.check_busy(0.0, 150.0, 210.0)
    driven(heater, block, [0.0] * 50, start_s=606.0)
    assert heater.last_pwm_value == 0.0 and made.duty == 0.0
    again = driven(heater, block, [180.0] * 1200, start_s=621.0)
    assert np.abs(again[-200:] - 180.0).max() < 0.5


def test_it_steps_once_a_sample_of_its_own_however_often_the_sensor_reports(of, tmp_path, monkeypatch):
    heater = Heater()
    made = connected(tmp_path, of, heater)
    times, step = [], made.controller.step
    monkeypatch.setattr(
        made.controller, "step", lambda y, r, t_s: times.append(t_s) or step(y, r, t_s), raising=True
    )
    driven(heater, Block(), [150.0] * 300)
    # 0.9 s are three reports; the clock's own jitter is two milliseconds
    assert len(times) == 100 and np.abs(np.diff(times) - 0.9).max() < 5e-3


def test_what_the_controller_raises_gives_the_heater_back_to_its_pid_without_a_kick(
    of, tmp_path, monkeypatch
):
    heater, block = Heater(), Block()
    made = connected(tmp_path, of, heater)
    driven(heater, block, [210.0] * 1500)
    before = heater.last_pwm_value

    def broken(*_):
        raise ZeroDivisionError("on purpose")

    monkeypatch.setattr(made.controller, "step", broken)
    driven(heater, block, [210.0] * 3, start_s=450.0)
    assert made.failed and made.get_type() == "pid"
    assert made.get_status(0.0)["mode"] == "own control"
    # sensor noise of 0.05 degC through Kp and the smoothed Kd
    assert abs(heater.last_pwm_value - before) < 0.08
    y = driven(heater, block, [210.0] * 1500, start_s=450.9)
    assert np.abs(y - 210.0).max() < 3.0 and np.abs(y[-100:] - 210.0).max() < 1.0


def test_a_duty_that_is_none_is_never_applied(of, tmp_path, monkeypatch):
    heater, block = Heater(), Block()
    made = connected(tmp_path, of, heater)
    driven(heater, block, [210.0] * 600)
    told = made.controller.step
    monkeypatch.setattr(made.controller, "step", lambda *given: told(*given)._replace(u=np.array([np.nan])))
    driven(heater, block, [210.0] * 6, start_s=180.0)
    assert made.failed and 0.0 <= heater.last_pwm_value <= 1.0


def test_another_plant_sample_time_or_power_is_refused(of, tmp_path):
    with pytest.raises(RuntimeError, match=r"\[beadline\]: .* certificate is of another plant"):
        connected(tmp_path, of, Heater(), plant="0" * 64)
    with pytest.raises(RuntimeError, match=r"\[beadline\]: .*rehearsal=True"):
        connected(tmp_path, of, Heater(), rehearsal=False)
    with pytest.raises(
        RuntimeError, match="max_power of extruder is 0.7 but the controller is certified for 1"
    ):
        connected(tmp_path, of, Heater(0.7))
    other = exported("lqg", zones=1, sample_time_s=1.0)
    with pytest.raises(RuntimeError, match="1 s, which is no multiple of the 0.3 s after which the sensor"):
        connected(tmp_path / "other", other, Heater())
