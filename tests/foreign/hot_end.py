"""A printer's hot end, simulated apart from the product: nothing of pipeline is imported, and no model of the
product has its structure.

Power of a heater cartridge flows into a block. The block loses heat by convection, which grows with the
temperature difference to the power 5/4 and with the part fan, by radiation, and into the cold end:

    C_h dT_h/dt = P s(t) - k (T_h - T_b)
    C_b dT_b/dt = k (T_h - T_b) - h (1 + c f) (T_b - T_room)^(5/4) - e (T_b^4 - T_room^4) - g (T_b - T_cold)
    tau dT_s/dt = T_b - T_s

s(t) is 0 or 1: the heater is switched by pulse width. The thermistor T_s lags, and its converter has steps.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

KELVIN = 273.15
SUBSTEP_S, PULSE_SUBSTEPS = 0.05, 4  # a pulse of the heater's width modulation lasts 0.2 s


class Parts(NamedTuple):
    """What a hot end is made of, in SI units; `step_degC` is the resolution of the converter."""

    power_W: float = 40.0
    cartridge_J_per_K: float = 4.0
    block_J_per_K: float = 15.0
    cartridge_to_block_W_per_K: float = 0.9
    convection_W: float = 0.0142  # per K^(5/4)
    fan: float = 0.5  # share by which the full fan raises convection
    radiation_W_per_K4: float = 3.5e-11
    cold_end_W_per_K: float = 0.018
    cold_end_degC: float = 38.0
    room_degC: float = 23.0
    thermistor_s: float = 3.0
    step_degC: float = 0.25
    noise_degC: float = 0.06  # before the converter
    duty_steps: int = 255


PARTS = Parts()


class HotEnd:
    """The machine at work: `read` gives the thermistor in °C, `advance` applies a duty in percent."""

    def __init__(self, rng: np.random.Generator, parts: Parts = PARTS):
        self.parts, self.rng = parts, rng
        self.cartridge = self.block = self.thermistor = parts.room_degC
        self.substeps = 0

    def read(self) -> float:
        """The temperature in °C as the firmware has it."""
        noisy = self.thermistor + self.rng.normal(0.0, self.parts.noise_degC)
        return round(noisy / self.parts.step_degC) * self.parts.step_degC

    def advance(self, duty_percent: float, fan_percent: float, seconds: float) -> None:
        """`seconds` of machine time at a duty and a part fan."""
        steps = self.parts.duty_steps
        duty = round(min(max(duty_percent, 0.0), 100.0) / 100 * steps) / steps
        for _ in range(round(seconds / SUBSTEP_S)):
            self._substep(duty, fan_percent / 100)

    def _substep(self, duty: float, fan: float) -> None:
        parts, block = self.parts, self.block
        on = min(max(duty * PULSE_SUBSTEPS - self.substeps % PULSE_SUBSTEPS, 0.0), 1.0)
        between = parts.cartridge_to_block_W_per_K * (self.cartridge - block)
        above = max(block - parts.room_degC, 0.0)
        lost = parts.convection_W * (1 + parts.fan * fan) * above**1.25
        lost += parts.radiation_W_per_K4 * ((block + KELVIN) ** 4 - (parts.room_degC + KELVIN) ** 4)
        lost += parts.cold_end_W_per_K * max(block - parts.cold_end_degC, 0.0)
        self.cartridge += SUBSTEP_S * (parts.power_W * on - between) / parts.cartridge_J_per_K
        self.block += SUBSTEP_S * (between - lost) / parts.block_J_per_K
        self.thermistor += SUBSTEP_S * (block - self.thermistor) / parts.thermistor_s
        self.substeps += 1


class Record(NamedTuple):
    """One recording, a row a sample: time (T,) in s, duty (T,) and part fan (T,) in percent, temperature (T,)
    and the firmware's target (T,) in °C. The duty of a row acts until the next one."""

    time_s: np.ndarray
    duty_percent: np.ndarray
    fan_percent: np.ndarray
    temperature_degC: np.ndarray
    target_degC: np.ndarray


def record(
    rng: np.random.Generator, *, minutes: float = 50.0, fan: bool = False, parts: Parts = PARTS
) -> Record:
    """A heater stepped by hand about what holds printing temperatures, from cold: levels of some minutes, and
    on each of them switches of a few percent, a sample a second. With `fan` the part fan goes on and off
    too."""
    count = round(minutes * 60)
    time_s, levels = np.arange(float(count)), np.array([36.0, 40.0, 34.0, 42.0, 37.0, 32.0])
    level = levels[np.minimum((time_s / count * len(levels)).astype(int), len(levels) - 1)]
    switched = np.repeat(rng.choice([-6.0, 6.0], count // 30 + 1), 30)[:count]
    duty = np.where(time_s < 60, 0.0, level + switched)
    blown = 100.0 * np.repeat(rng.integers(0, 2, count // 120 + 1), 120)[:count] * fan
    machine, read = HotEnd(rng, parts), np.empty(count)
    for k in range(count):
        read[k] = machine.read()
        machine.advance(duty[k], blown[k], 1.0)
    return Record(time_s, duty, blown, read, np.full(count, 210.0))


def record_print(rng: np.random.Generator, *, minutes: float = 60.0, parts: Parts = PARTS) -> Record:
    """A printer's evening: the firmware's PI controller heats from cold and follows a target that changes
    every four minutes, a sample a second."""
    count = round(minutes * 60)
    target = np.repeat(rng.choice(np.arange(185.0, 236.0, 5.0), count // 240 + 1), 240)[:count]
    machine, read, duty, integral = HotEnd(rng, parts), np.empty(count), np.empty(count), 0.0
    for k in range(count):
        read[k] = machine.read()
        error = target[k] - read[k]
        wanted = 4.0 * error + integral
        duty[k] = min(max(wanted, 0.0), 100.0)
        if duty[k] == wanted:
            integral += 0.03 * error
        machine.advance(duty[k], 0.0, 1.0)
    return Record(np.arange(float(count)), duty, np.zeros(count), read, target)


def write_csv(path: Path, recorded: Record, *, fan: bool = False) -> None:
    """The recording as a logger writes it."""
    columns = {
        "time_s": recorded.time_s,
        "heater_pct": recorded.duty_percent,
        **({"fan_pct": recorded.fan_percent} if fan else {}),
        "hotend_C": recorded.temperature_degC,
    }
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    lines = [",".join(columns), *(",".join(f"{value:g}" for value in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
