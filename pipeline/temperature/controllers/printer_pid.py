"""The printer's own PID, for comparison: Klipper's (klippy/extras/heaters.py, class ControlPID).

With e = r - y, once per sample of T = 0.3 s, Klipper computes

    d(t) = ((a - T) d(t-1) + y(t) - y(t-1)) / a,  a = max(smooth time, T)
    I(t) = I(t-1) + T e(t), within 0 ... most / Ki
    u(t) = Kp e(t) + Ki I(t) - Kd d(t), cut to 0 ... most

and keeps the new I(t) only if u was not cut. Here T is our sample time, and I is kept within the machine's
limits after u is computed, not before. If our T is longer, d is what Klipper's own samples would give if y
were a straight line between two of ours. At T = 1 s Klipper's formula would not smooth at all, and loops that
are stable at 0.3 s would appear unstable. u is constant for our T, which reduces the margin, so a loop near
the limit may be stable at 0.3 s but not here.
"""

from typing import NamedTuple

import numpy as np

from pipeline.temperature.plant import Plant
from pipeline.temperature.tracking import Law

# interval at which Klipper reads a heater's thermistor (klippy/extras/adc_temperature.py, REPORT_TIME)
KLIPPER_S = 0.3


class HeaterPid(NamedTuple):
    """The PID of one heater, from output `output` to input `input` of the plant. Kp in percent per °C, Ki in
    percent per °C and s, Kd in percent times s per °C; the command is limited to `most_percent`, and the
    derivative is smoothed over `smooth_s`."""

    input: int
    output: int
    Kp: float
    Ki: float
    Kd: float
    most_percent: float
    smooth_s: float


def law_of_printer(pids: tuple[HeaterPid, ...], plant: Plant, limits: tuple[np.ndarray, np.ndarray]) -> Law:
    """Returns the PIDs of all heaters as one law. `limits`: low and high (m,) in percent. Raises ValueError
    if the heaters' PIDs do not control every input and output of the machine, if a gain has the wrong sign,
    or if an input may go higher than its PID's maximum."""
    pids = tuple(sorted(pids, key=lambda pid: pid.output))
    inputs = sorted(pid.input for pid in pids)
    if [pid.output for pid in pids] != list(range(plant.p)) or inputs != list(range(plant.m)):
        raise ValueError(
            f"the printer's own PID needs one PID for each of the {plant.p} outputs and {plant.m} inputs; "
            f"found those of {len(pids)} heaters in the log"
        )
    for pid in pids:
        if pid.Kp <= 0 or pid.Ki < 0:
            raise ValueError(
                "the printer's own PID needs Kp above zero and Ki of at least zero; "
                f"found Kp {pid.Kp:g}, Ki {pid.Ki:g} for output {pid.output + 1}"
            )
        if pid.most_percent < limits[1][pid.input] - 1e-6:
            raise ValueError(
                f"the printer's own PID ends at {pid.most_percent:g} % of duty (max_power), but input "
                f"{pid.input + 1} may go to {limits[1][pid.input]:g} %; set its high in plant.inputs to that"
            )
    return law(pids, sample_time_s=plant.sample_time_s)


def law(pids: tuple[HeaterPid, ...], *, sample_time_s: float) -> Law:
    """Returns Klipper's PIDs as one law, in the order of the outputs; memory z = [y(t-1); d(t-1)].

    d(t) = phi d(t-1) + (1 - phi) (y(t) - y(t-1)) / T
    phi = (1 - 0.3 s / a)^(T / 0.3 s)
    u = G (r + xi - y) - Kd d
    xi(t+1) = xi(t) + Ki T / G e(t)

    Ki I(t) is split: its part Ki T e(t) joins the proportional gain G = Kp + Ki T, and the rest is G xi(t).
    """
    p, T = len(pids), sample_time_s
    Kp, Ki, Kd, smooth = (
        np.array([getattr(pid, key) for pid in pids], float) for key in ("Kp", "Ki", "Kd", "smooth_s")
    )
    phi = (1 - KLIPPER_S / np.maximum(smooth, KLIPPER_S)) ** (T / KLIPPER_S)
    slope, G = (1 - phi) / T, Kp + Ki * T
    to_input = np.zeros((p, p))
    to_input[[pid.input for pid in pids], np.arange(p)] = 1.0
    none, one = np.zeros((p, p)), np.eye(p)
    return Law(
        A=np.block([[none, none], [np.diag(-slope), np.diag(phi)]]),
        B_u=np.zeros((2 * p, p)),
        B_y=np.vstack([one, np.diag(slope)]),
        B_r=np.zeros((2 * p, p)),
        c=np.zeros(2 * p),
        K=to_input @ np.hstack([np.diag(-Kd * slope), np.diag(Kd * phi)]),
        D=to_input @ np.diag(G + Kd * slope),
        K_r=to_input @ np.diag(-G),
        k=np.zeros(p),
        start_u=np.zeros((2 * p, p)),
        start_y=np.vstack([one, none]),
        start=np.zeros(2 * p),
        integral=Ki * T / G,
        conditional=True,
    )
