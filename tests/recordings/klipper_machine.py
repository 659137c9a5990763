"""A printer with Klipper in simulation, written from what Klipper does and not from our reader: a hot end and
a bed, each under Klipper's PID, and the log that it leaves.

Klipper measures a heater every 0.3 s, computes its PID there, and changes the duty only where it moved by
0.05 or the last change is older than 3.75 s. Once a second it writes a Stats line as long as a heater is on.
"""

import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

STEP_S, STATS_S = 0.3, 1.0


class HeaterModel(NamedTuple):
    """tau dT/dt = gain u + ambient - T, measured `delay_s` late; PID gains as in printer.cfg."""

    name: str
    gain_degC: float
    tau_s: float
    delay_s: float
    pid: tuple[float, float, float]
    max_temp: float
    max_power: float = 1.0


EXTRUDER = HeaterModel("extruder", 420.0, 150.0, 2.0, (22.2, 1.08, 114.0), 260.0)
BED = HeaterModel("heater_bed", 110.0, 600.0, 6.0, (54.0, 0.77, 948.0), 130.0)


class Simulated:
    """One heater with its controller; `step` advances it by 0.3 s."""

    def __init__(self, model: HeaterModel, rng: np.random.Generator, ambient: float = 24.0):
        self.model, self.rng, self.ambient = model, rng, ambient
        self.true = self.measured = self.before = ambient
        self.late = [ambient] * max(1, round(model.delay_s / STEP_S))
        self.integral = self.error = self.slope = self.duty = 0.0
        self.next_change_s, self.target = 0.0, 0.0

    def step(self, now_s: float, load_degC: float) -> None:
        model = self.model
        equilibrium = self.ambient + model.gain_degC * self.duty - load_degC
        self.true += (equilibrium - self.true) * (1 - np.exp(-STEP_S / model.tau_s))
        self.late.append(self.true)
        self.measured = self.late.pop(0) + self.rng.normal(0, 0.03)
        self._switch(now_s, self._pid())

    def _pid(self) -> float:
        kp, ki, kd = (gain / 255.0 for gain in self.model.pid)
        error = self.target - self.measured
        added = (self.error + error) / 2 * STEP_S
        slope = -(self.measured - self.before) / STEP_S
        weight = 1.0 + 1.0 / STEP_S  # smooth_time 1 s
        self.slope = ((weight - 1) * self.slope + slope) / weight
        wanted = kp * error + ki * (self.integral + added) + kd * self.slope
        duty = min(max(wanted, 0.0), self.model.max_power)
        self.before = self.measured
        if self.target <= 0:
            self.error = self.integral = 0.0
            return 0.0
        self.error = error
        if duty == wanted or np.sign(wanted) != np.sign(added):
            self.integral += added
        return duty

    def _switch(self, now_s: float, duty: float) -> None:
        late = now_s < self.next_change_s or not self.duty
        if late and abs(duty - self.duty) < 0.05:
            return
        self.next_change_s, self.duty = now_s + STEP_S + 3.75, duty

    def stats(self) -> str:
        name = self.model.name
        return f"{name}: target={self.target:.0f} temp={self.measured:.1f} pwm={self.duty:.3f}"


def config_lines(models: Sequence[HeaterModel]) -> list[str]:
    lines = ["===== Config file ====="]
    for model in models:
        kp, ki, kd = model.pid
        lines += [
            f"[{model.name}]",
            "heater_pin = PA1",
            "sensor_type = EPCOS 100K B57560G104F",
            "control = pid",
            f"pid_kp = {kp:g}",
            f"pid_ki = {ki:g}",
            f"pid_kd = {kd:g}",
            "min_temp = 0",
            f"max_temp = {model.max_temp:g}",
            f"max_power = {model.max_power:g}",
            "",
        ]
    return [*lines, "[printer]", "kinematics = corexy", "max_velocity = 300", "=======================", ""]


def print_log(
    targets: Sequence[tuple[float, float, float]],
    *,
    longest_s: float,
    seed: int = 0,
    start_s: float = 1_752_314_400.0,
    count_s: float = 100.0,
    off: bool = False,
) -> str:
    """The log of one print. `targets` are (time, extruder, bed) in s and °C; `count_s` is how long the
    computer is on at the start. `off` leaves the heaters cold, so that no line is written."""
    rng = np.random.default_rng(seed)
    heaters = [Simulated(EXTRUDER, rng), Simulated(BED, rng)]
    date = time.asctime(time.gmtime(start_s))
    lines = [
        "Starting Klippy...",
        "Args: ['/home/pi/klipper/klippy/klippy.py', '/home/pi/printer.cfg', '-l', '/tmp/klippy.log']",
        "Git version: 'v0.12.0-272-g13c75ea87'",
        f"Start printer at {date} ({start_s:.1f} {count_s:.1f})",
        *config_lines([EXTRUDER, BED]),
        "Loaded MCU 'mcu' 121 commands (v0.12.0 / gcc: (15:8-2019-q3-1+b1) 8.3.1)",
        "Starting serial connect",
    ]
    flow, next_stats = 0.0, 0.0
    for step in range(round(longest_s / STEP_S)):
        now = step * STEP_S
        _, hot, bed = [target for target in targets if target[0] <= now][-1]
        heaters[0].target, heaters[1].target = hot, bed
        if step % 100 == 0:
            flow = rng.uniform(0, 30) if hot else 0.0  # °C that the filament takes away
        for heater, load in zip(heaters, (flow, 0.05 * flow), strict=True):
            heater.step(now, load)
        if now >= next_stats:
            written, next_stats = count_s + next_stats, next_stats + STATS_S
            active = any(heater.target or heater.measured > 50 for heater in heaters)
            if active and not off:
                lines.append(stats_line(written, heaters[1].stats(), heaters[0].stats()))
    return "\n".join(lines) + "\n"


def stats_line(count_s: float, bed: str, extruder: str) -> str:
    written = round(900 * count_s)
    return (
        f"Stats {count_s:.1f}: gcodein=0 "
        f"mcu: mcu_awake=0.014 mcu_task_avg=0.000022 mcu_task_stddev=0.000029 bytes_write={written} "
        f"bytes_read={written // 3} bytes_retransmit=0 bytes_invalid=0 send_seq={written // 40} "
        f"receive_seq={written // 40} retransmit_seq=0 srtt=0.001 rttvar=0.000 rto=0.025 ready_bytes=30 "
        f"stalled_bytes=3326 freq=180003476 sd_pos={written // 9} {bed} mcu: temp=31.3 "
        f"raspberry_pi: temp=44.0 sysload=1.40 cputime={count_s / 9:.3f} memavail=552400 "
        f"print_time={count_s - 7:.3f} buffer_time=2.417 print_stall=0 {extruder}"
    )
