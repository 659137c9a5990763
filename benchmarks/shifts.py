"""Shifts of made-up machines under an operator's hand: what a night's recording holds, with faults put in.

Two machines of two heated zones. `linear` is that of `benchmarks.nights`. `walls` is of another structure
than the models that are identified from it: heaters that lag, a wall behind each zone, a loss to the air
that grows faster than the temperature:

    h_i dq_i/dt = u_i - q_i
    tau_i dT_i/dt = K_i q_i + k (T_j - T_i) - a (1 + r (T_i - amb)) (T_i - amb) - c (T_i - w_i)
    v_i dw_i/dt = c (T_i - w_i) - c (w_i - amb)

Two operators, both dithered: a proportional one, who holds by hand the inputs that the machine needed when it
was commissioned, and an integrating one. The loops are written here, apart from the project's own.
"""

from collections import deque
from typing import NamedTuple

import numpy as np
import scipy.optimize

SAMPLES, WARM_UP = 600, 900  # of 1 s: a record, and what is played before it, so that it begins settled
REFERENCE_DEGC, AMBIENT_DEGC, NOISE_DEGC = (120.0, 110.0), 20.0, 0.1
LOW, HIGH, RATE = 0.0, 100.0, 20.0  # percent, percent, percent a second
SUBSTEPS = 2  # of a second
DITHER, SHORTEST = 8.0, 20  # percent; samples


class Machine(NamedTuple):
    """Of zones 1 and 2: heater lag h in s (0: none), time constant tau in s, gain K in °C a percent at unit
    loss, time constant of the wall in s; then coupling k, loss a and its growth r in 1/°C, and the walls'
    conductance c (0: none)."""

    heater_s: tuple[float, float]
    tau_s: tuple[float, float]
    gain: tuple[float, float]
    wall_s: tuple[float, float]
    coupling: float
    loss: float
    growth: float
    wall: float


MACHINES = {
    "linear": Machine((0.0, 0.0), (60.0, 90.0), (1.6, 1.2), (1.0, 1.0), 0.1, 1.0, 0.0, 0.0),
    "walls": Machine((5.0, 8.0), (70.0, 95.0), (1.8, 1.3), (240.0, 240.0), 0.1, 0.6, 0.003, 0.6),
}


class Operator(NamedTuple):
    """u = u0 + gain (reference - y) + its integral over `reset_s` + dither; reset_s 0: no integral."""

    gain: float
    reset_s: float


OPERATORS = {"proportional": Operator(0.5, 0.0), "integrating": Operator(0.5, 100.0)}


class Fault(NamedTuple):
    """What is other than when the machine was commissioned. Shares of the nominal gains and time constants,
    by zone; a sensor's offset in °C and its noise as a share; the most a heater gives in percent, whatever
    is commanded; the transport delay of an input in s."""

    gain: tuple[float, float] = (1.0, 1.0)
    slower: tuple[float, float] = (1.0, 1.0)
    sensor_degC: tuple[float, float] = (0.0, 0.0)
    noise: tuple[float, float] = (1.0, 1.0)
    cap_percent: tuple[float, float] = (HIGH, HIGH)
    delay_s: tuple[int, int] = (0, 0)


class Surroundings(NamedTuple):
    """Ambient temperature (samples,) in °C, and heat (samples,) that draughts take from both zones, in
    percent of the heater."""

    ambient_degC: np.ndarray
    draught_percent: np.ndarray


def calm(ambient_degC: float, samples: int = SAMPLES) -> Surroundings:
    return Surroundings(np.full(samples, ambient_degC), np.zeros(samples))


def needed(machine: Machine) -> np.ndarray:
    """Inputs (2,) in percent that hold the nominal machine at its references, as an operator notes them:
    whole percents."""

    def rates(q: np.ndarray) -> list[float]:
        walls = [0.5 * (T + AMBIENT_DEGC) for T in REFERENCE_DEGC]
        return [_heat(machine, i, q[i], REFERENCE_DEGC, walls, AMBIENT_DEGC) for i in (0, 1)]

    return np.round(scipy.optimize.fsolve(rates, [50.0, 50.0]))


def _heat(machine: Machine, i: int, q: float, T, w, ambient: float) -> float:
    """tau_i dT_i/dt of zone i in °C."""
    above = T[i] - ambient
    lost = machine.loss * (1.0 + machine.growth * above) * above + machine.wall * (T[i] - w[i])
    return machine.gain[i] * q + machine.coupling * (T[1 - i] - T[i]) - lost


def record(
    machine: Machine, operator: Operator, fault: Fault, around: Surroundings, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """One recording, columns as a user's CSV has them: inputs as commanded, outputs as read."""
    samples = len(around.ambient_degC)
    signal = _dither(rng, samples + WARM_UP)
    noise = NOISE_DEGC * np.array(fault.noise) * rng.standard_normal((samples + WARM_UP, 2))
    ambient, draught = (np.concatenate([np.full(WARM_UP, part[0]), part]) for part in around)
    u0 = needed(machine)
    plant = _faulty(machine, fault)
    T, q, w = list(REFERENCE_DEGC), list(u0), [0.5 * (T + AMBIENT_DEGC) for T in REFERENCE_DEGC]
    waiting = [deque([u0[i]] * (fault.delay_s[i] + 1), fault.delay_s[i] + 1) for i in (0, 1)]
    last, integral = list(u0), [0.0, 0.0]
    u, y = np.empty((samples + WARM_UP, 2)), np.empty((samples + WARM_UP, 2))
    for t in range(samples + WARM_UP):
        for i in (0, 1):
            y[t, i] = T[i] + fault.sensor_degC[i] + noise[t, i]
            u[t, i], integral[i] = _commanded(
                operator, REFERENCE_DEGC[i] - y[t, i], u0[i] + signal[t, i], last[i], integral[i]
            )
            last[i] = u[t, i]
            waiting[i].append(u[t, i])
        given = [min(waiting[i][0], fault.cap_percent[i]) - draught[t] for i in (0, 1)]
        T, q, w = _second(plant, given, ambient[t], T, q, w)
    kept = slice(WARM_UP, None)
    return {
        "time_s": np.arange(samples, dtype=float),
        "heater_1": u[kept, 0],
        "heater_2": u[kept, 1],
        "sensor_1": y[kept, 0],
        "sensor_2": y[kept, 1],
    }


def _faulty(machine: Machine, fault: Fault) -> Machine:
    """With every time constant of a zone `fault.slower` as long: heater, zone and wall."""

    def scaled(values: tuple[float, float], by: tuple[float, float]) -> tuple[float, float]:
        return values[0] * by[0], values[1] * by[1]

    return machine._replace(
        gain=scaled(machine.gain, fault.gain),
        heater_s=scaled(machine.heater_s, fault.slower),
        tau_s=scaled(machine.tau_s, fault.slower),
        wall_s=scaled(machine.wall_s, fault.slower),
    )


def _dither(rng: np.random.Generator, samples: int) -> np.ndarray:
    bits = rng.integers(0, 2, (-(-samples // SHORTEST), 2))
    return DITHER * (2.0 * np.repeat(bits, SHORTEST, axis=0)[:samples] - 1.0)


def _commanded(
    operator: Operator, error: float, open_loop: float, last: float, integral: float
) -> tuple[float, float]:
    """Input in percent within its limits, and the integral, which rests while the input is at one."""
    grown = integral + (operator.gain * error / operator.reset_s if operator.reset_s else 0.0)
    wanted = open_loop + operator.gain * error + grown
    given = min(max(min(max(wanted, last - RATE), last + RATE), LOW), HIGH)
    return given, grown if LOW < wanted < HIGH else integral


def _second(
    machine: Machine, given: list[float], ambient: float, T: list[float], q: list[float], w: list[float]
) -> tuple[list[float], list[float], list[float]]:
    """Temperatures, heaters and walls a second later, by the midpoint rule."""
    step = 1.0 / SUBSTEPS

    def rates(T, q, w):
        warm = [_heat(machine, i, q[i], T, w, ambient) / machine.tau_s[i] for i in (0, 1)]
        lag = [(given[i] - q[i]) / machine.heater_s[i] if machine.heater_s[i] else 0.0 for i in (0, 1)]
        wall = [machine.wall * (T[i] - 2 * w[i] + ambient) / machine.wall_s[i] for i in (0, 1)]
        return warm, lag, wall

    def moved(by, share):
        return [
            [a + share * step * b for a, b in zip(*pair, strict=True)]
            for pair in zip((T, q, w), by, strict=True)
        ]

    for _ in range(SUBSTEPS):
        q = [q[i] if machine.heater_s[i] else given[i] for i in (0, 1)]
        T, q, w = moved(rates(*moved(rates(T, q, w), 0.5)), 1.0)
    return T, q, w
