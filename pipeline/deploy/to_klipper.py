"""Settings for printers that run Klipper or Kalico: the section of our module, and for comparison the PID of
one heater and the model of Kalico's MPC.

PID by SIMC (baseline.pairing) from the model that the controller was made on. Klipper divides pid_Kp, pid_Ki
and pid_Kd by 255 (PID_PARAM_BASE) and works with a duty of 0..1, so that

    pid_Kp = 255 / 100 K_c,   pid_Ki = pid_Kp / T_i,   pid_Kd = 0

with K_c in percent per degC and T_i in s. SIMC's rule for a first-order model with delay has no derivative.

Kalico's MPC (docs/MPC.md) knows a block of heat capacity C that loses h per degree to the room, and a sensor
that follows the block:

    C dT_b/dt = P - h (T_b - T_room),   dT_s/dt = s (T_b - T_s)

block_heat_capacity is C in J/K, ambient_transfer h in W/K, sensor_responsiveness s in K/s/K. They follow from
the model's step response and from the heater's power, which only the owner knows.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.optimize

from pipeline.deploy import to_python
from pipeline.deploy.certificate import Certificate, sha256
from pipeline.deploy.machine import check, check_certificate
from pipeline.deploy.supervise import PERCENT, Exported, Signal
from pipeline.temperature.controllers import baseline
from pipeline.temperature.controllers.law import Plant
from pipeline.temperature.plant import markov_parameters, strictly_proper

FILE = "beadline.cfg"  # never printer.cfg: that one is the owner's
MODULE = Path(__file__).parent / "templates" / "beadline.py.txt"  # for klippy/extras/
SECTIONS = ("extruder", "heater_bed")
PID_PARAM_BASE = 255.0
HORIZON_S, LONGEST = 600.0, 2000  # of the step response that is fitted, in s and in samples at most
STRANGE = 0.1  # of the largest excursion: a response further off is not that of a block and a sensor


class Mpc(NamedTuple):
    """Kalico's model: block heat capacity in J/K, ambient transfer in W/K, sensor responsiveness in K/s/K;
    `error` is how far its step response is from ours, as a share of the largest excursion."""

    block_heat_capacity: float
    ambient_transfer: float
    sensor_responsiveness: float
    error: float


def settings(
    exported: Exported, certificate: Certificate, *, section: str, heater_power_W: float | None = None
) -> str:
    """The text of FILE, which printer.cfg includes: the section of the module. PI by SIMC, and with the
    heater's power in W what Kalico's MPC would need, follow as comments: the owner's own PID, limits and
    max_temp stay as they are.

    Raises ValueError for a machine of more than one heater or sensor, for an unknown section, and where the
    certificate was not passed, or is of another controller."""
    check(exported)
    check_certificate(exported, certificate)
    one_heater(exported)
    if section not in SECTIONS:
        raise ValueError(
            f"section {section}: expected one of {', '.join(SECTIONS)}, the heaters that both firmwares "
            "control; name one of them"
        )
    heater, sensor = exported.machine.inputs[0], exported.machine.outputs[0]
    Kp, Ki = pi_gains(exported)
    lines = [
        f"# {heater.name} and {sensor.name}: controller {exported.name} in place of the PID of [{section}],",
        "# which stays in printer.cfg and goes on if this one fails",
        f"# certificate {sha256(certificate)}",
        "[beadline]",
        f"heater: {section}",
        f"plant: {exported.plant_sha256}",
        *(_disturbance_line(one, section) for one in exported.machine.disturbances),
        *(["# rehearsal: True  # the plant was simulated: never on a printer"] if exported.simulated else []),
        "",
        "# For comparison only, PI by SIMC from the same model. [beadline] does not need it:",
        f"# pid_Kp: {Kp:.4g}  # 1/255 of full duty per degC",
        f"# pid_Ki: {Ki:.4g}  # 1/255 of full duty per degC and s",
        "# pid_Kd: 0  # SIMC's rule for a first-order model has no derivative",
    ]
    if heater_power_W is not None:
        lines += _mpc_lines(mpc(exported.model, heater_power_W), heater_power_W, section)
    return "\n".join(lines) + "\n"


def _disturbance_line(signal: Signal, section: str) -> str:
    """What measures a disturbance, from its unit; an owner changes it to another fan or extruder, or none."""
    sources = {PERCENT: "fan", "mm/s": section if section == "extruder" else "none"}
    return f"disturbance_{signal.name}: {sources.get(signal.unit, 'none')}  # in {signal.unit}"


def module(exported: Exported, certificate: Certificate) -> dict[str, str]:
    """The two files for klippy/extras/ by which the controller itself runs the heater. Raises ValueError as
    `settings` does."""
    one_heater(exported)
    return {
        MODULE.stem: MODULE.read_text(encoding="utf-8"),
        "beadline_controller.py": to_python.text(exported, certificate),
    }


def one_heater(exported: Exported) -> None:
    """Raises ValueError for a machine that Klipper's control of one heater cannot run."""
    inputs, outputs = ([one.name for one in side] for side in exported.machine[:2])
    if (len(inputs), len(outputs)) != (1, 1):
        raise ValueError(
            f"controller {exported.name}: Klipper and Kalico control one heater by one sensor, but this "
            f"machine has inputs {', '.join(inputs)} and outputs {', '.join(outputs)}; export it to c or "
            "python"
        )
    heater = exported.machine.inputs[0]
    if heater.low != 0 or heater.high > 100:
        raise ValueError(
            f"input {heater.name}: Klipper's duty goes from 0 to max_power, at most 100 percent, but the "
            f"machine declares {heater.low:g} to {heater.high:g} percent; declare the heater's own limits"
        )


def pi_gains(exported: Exported) -> tuple[float, float]:
    """SIMC's PI in Klipper's units: pid_Kp in 1/255 of full duty per degC, pid_Ki per degC and s. Raises
    ValueError if the heater does not warm the sensor."""
    model, limits = strictly_proper(exported.model), exported.controller.limits
    T = exported.machine.sample_time_s
    pairs = baseline.pairing(
        model, limits.low, limits.high, horizon=_horizon(T), noise_degC=exported.supervision.noise_degC
    )
    if not pairs.gain[0] > 0:
        raise ValueError(
            f"input {exported.machine.inputs[0].name} cools output {exported.machine.outputs[0].name} in the "
            "identified model; Klipper's PID heats, look at the record"
        )
    Kp = PID_PARAM_BASE / 100.0 * float(pairs.gain[0])
    return Kp, Kp / (float(pairs.reset[0]) * T)


def _horizon(sample_time_s: float) -> int:
    return min(max(round(HORIZON_S / sample_time_s), 20), LONGEST)


def mpc(model: Plant, heater_power_W: float) -> Mpc:
    """Kalico's parameters from the step response of a model of one heater and one sensor; one without a
    steady state of its own within the horizon has none. Raises ValueError where it is not that of a block
    and a sensor."""
    if not (np.isfinite(heater_power_W) and heater_power_W > 0):
        raise ValueError(
            f"heater_power: expected watts above zero but found {heater_power_W:g}; read it off the heater"
        )
    T = model.sample_time_s
    response = np.cumsum(markov_parameters(strictly_proper(model), _horizon(T))[:, 0, 0])
    time_s = T * np.arange(1, len(response) + 1)
    gain, block_s, sensor_s = _fitted(time_s, response)
    left = _two_lags(time_s, gain, block_s, sensor_s) - response
    error = float(np.abs(left).max() / np.abs(response).max())
    if not (gain > 0 and error < STRANGE):
        raise ValueError(
            f"the model's step response is {100 * error:.0f} % of its height off that of a heater block and "
            f"a sensor, of at most {100 * STRANGE:.0f} %; leave Kalico's own MPC_CALIBRATE to find its model"
        )
    transfer = heater_power_W / 100.0 / gain
    return Mpc(transfer * block_s, transfer, 1.0 / sensor_s, error)


def _two_lags(time_s: np.ndarray, gain: float, slow_s: float, fast_s: float) -> np.ndarray:
    """gain (1 - (slow e^(-t / slow) - fast e^(-t / fast)) / (slow - fast)), the response of block and sensor
    to a step of one percent, in degC."""
    fast_s = min(fast_s, 0.999 * slow_s)
    decays = slow_s * np.exp(-time_s / slow_s) - fast_s * np.exp(-time_s / fast_s)
    return gain * (1 - decays / (slow_s - fast_s))


def _fitted(time_s: np.ndarray, response: np.ndarray) -> tuple[float, float, float]:
    """Gain in degC per percent, and the time constants of block and sensor in s, by least squares."""
    height, span = float(response[-1]), float(time_s[-1])

    def left(p: np.ndarray) -> np.ndarray:
        return (_two_lags(time_s, *np.exp(p)) - response) / max(abs(height), 1e-9)

    starts = [
        np.log([max(height, 1e-6) * share, span * share / 4, span / fast])
        for share in (1.0, 3.0)
        for fast in (30.0, 200.0)
    ]
    fits = [scipy.optimize.least_squares(left, at, x_scale=1.0) for at in starts]
    gain, block_s, sensor_s = np.exp(min(fits, key=lambda fit: fit.cost).x)
    return float(gain), float(block_s), float(sensor_s)


def _mpc_lines(made: Mpc, heater_power_W: float, section: str) -> list[str]:
    return [
        "",
        "# For comparison only, Kalico's MPC from the same model:",
        f"# [{section}]",
        "# control: mpc",
        f"# heater_power: {heater_power_W:g}  # W, as its owner says",
        f"# block_heat_capacity: {made.block_heat_capacity:.4g}  # J/K",
        f"# ambient_transfer: {made.ambient_transfer:.4g}  # W/K",
        f"# sensor_responsiveness: {made.sensor_responsiveness:.4g}  # K/s/K",
        f"# the step response of these is within {100 * made.error:.1f} % of the model's",
    ]
