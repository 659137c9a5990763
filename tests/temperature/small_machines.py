"""Ten simulated small machines, written apart from `Plant`: heat in watts, losses to the room, radiation, a
fan, dead time of transport, a sensor that lags and a converter with coarse steps. Their records are what an
owner would have: steps, staircases, walks.

None is linear, and none has the structure of an identified model.
"""

from functools import cache
from typing import NamedTuple

import numpy as np

from pipeline.temperature.identification.model_choice import Settings, identify, within_limits
from pipeline.temperature.identification.refinement import one_step_errors
from pipeline.temperature.identification.validation import bootstrap_spread
from pipeline.temperature.plant import Plant
from pipeline.temperature.tracking import Law

KELVIN = 273.15
FAMILY = 20  # plants around an identified one, as identify_plant.spread_plants


class SmallMachine(NamedTuple):
    """Masses (n,) that are heated, and what hangs on them; SI units, temperatures in °C, inputs 0..100 %.

    capacity (n,) J/K; loss (n,) W/K to the room; radiates (n,) W/K^4; between (n, n) W/K, symmetric; power
    (n, m) W per percent; fan (n, m) W/K per percent, further loss to the room. Sensors (p,): the mass that
    each measures, its lag, the dead time before it, the step of its converter; `noise_degC` is white.
    `record` names the inputs of the record, `centre` (m,) percent about which they move, `reference` (p,)
    what is asked for.
    """

    name: str
    record: str
    sample_time_s: float
    samples: int
    capacity: tuple[float, ...]
    loss: tuple[float, ...]
    radiates: tuple[float, ...]
    between: tuple[tuple[float, ...], ...]
    power: tuple[tuple[float, ...], ...]
    fan: tuple[tuple[float, ...], ...]
    sensor: tuple[int, ...]
    lag_s: tuple[float, ...]
    delay_s: tuple[float, ...]
    step_degC: tuple[float, ...]
    centre: tuple[float, ...]
    reference: tuple[float, ...]
    room_degC: float = 22.0
    noise_degC: float = 0.08

    @property
    def m(self) -> int:
        return len(self.power[0])

    @property
    def p(self) -> int:
        return len(self.sensor)


class MachineState(NamedTuple):
    """Temperatures of masses and lagging sensors (n + p,), and what is on its way to each sensor: a list of p
    arrays, newest first, one entry a substep."""

    x: np.ndarray
    way: tuple[np.ndarray, ...]


def substeps(machine: SmallMachine) -> int:
    """A sample is cut so that no step is longer than a third of the fastest lag or 2 s."""
    return int(np.ceil(machine.sample_time_s / min(min(machine.lag_s) / 3, 2.0)))


def slope(machine: SmallMachine, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """dx/dt (n + p,) in K/s of masses and sensors at inputs u (m,)."""
    n = len(machine.capacity)
    mass, above = x[:n], x[:n] - machine.room_degC
    heat = np.asarray(machine.power) @ u - (machine.loss + np.asarray(machine.fan) @ u) * above
    heat -= machine.radiates * ((mass + KELVIN) ** 4 - (machine.room_degC + KELVIN) ** 4)
    between = np.asarray(machine.between)
    heat += between @ mass - between.sum(axis=1) * mass
    return np.r_[heat / machine.capacity, (mass[list(machine.sensor)] - x[n:]) / machine.lag_s]


def at_rest(machine: SmallMachine, u: np.ndarray) -> MachineState:
    """The state that inputs u (m,) hold for ever; u of zeros is the machine switched off in its room."""
    n, x = len(machine.capacity), np.full(len(machine.capacity) + machine.p, machine.room_degC)
    step = np.ones_like(x)
    while np.abs(step).max() > 1e-9:  # Newton by differences; losses grow with temperature, so it settles
        f = slope(machine, x, u)
        J = np.column_stack([(slope(machine, x + 1e-4 * e, u) - f) / 1e-4 for e in np.eye(len(x))])
        step = np.linalg.solve(J, f)
        x = x - step
    dt = machine.sample_time_s / substeps(machine)
    return MachineState(x, tuple(np.full(round(d / dt) + 1, x[n + j]) for j, d in enumerate(machine.delay_s)))


def measured(machine: SmallMachine, state: MachineState, rng: np.random.Generator) -> np.ndarray:
    """What the converter says (p,): the late sensor with its noise, in coarse steps."""
    noisy = true_outputs(state) + machine.noise_degC * rng.standard_normal(machine.p)
    return np.round(noisy / machine.step_degC) * machine.step_degC


def true_outputs(state: MachineState) -> np.ndarray:
    return np.array([way[-1] for way in state.way])


def advanced(machine: SmallMachine, state: MachineState, u: np.ndarray) -> MachineState:
    """One sample later, u (m,) held: Runge and Kutta's fourth order on each substep."""
    count, n = substeps(machine), len(machine.capacity)
    dt, x, way = machine.sample_time_s / count, state.x, list(state.way)
    for _ in range(count):
        k1 = slope(machine, x, u)
        k2 = slope(machine, x + dt / 2 * k1, u)
        k3 = slope(machine, x + dt / 2 * k2, u)
        k4 = slope(machine, x + dt * k3, u)
        x = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        way = [np.r_[x[n + j], line[:-1]] for j, line in enumerate(way)]
    return MachineState(x, tuple(way))


def inputs(machine: SmallMachine, rng: np.random.Generator) -> np.ndarray:
    """Inputs (samples, m) of the machine's kind of record, in percent, each on its own clock."""
    T, centre = machine.samples, np.asarray(machine.centre)
    if machine.record == "steps":
        return _steps(T, centre)
    if machine.record == "staircase":
        return _staircase(T, centre)
    return _walk(T, centre, rng)


def _steps(T: int, centre: np.ndarray) -> np.ndarray:
    """Off, then up to the centre, up, down and back, the inputs one after the other."""
    u, m = np.zeros((T, len(centre))), len(centre)
    for j, level in enumerate(centre):
        moves = np.linspace(0.06, 0.92, 4 * m).reshape(4, m)[:, j] * T
        for at, share in zip(moves.astype(int), (1.0, 1.35, 0.7, 1.0), strict=True):
            u[at:, j] = level * share
    return u


def _staircase(T: int, centre: np.ndarray) -> np.ndarray:
    """Five stairs up and four down to 1.5 of the centre, the inputs' holds of different length."""
    u = np.zeros((T, len(centre)))
    stairs = np.r_[np.arange(0, 6), np.arange(4, 0, -1)] / 5 * 1.5
    for j, level in enumerate(centre):
        hold = T // (len(stairs) + 2 * j)
        u[:, j] = level * stairs[np.minimum(np.arange(T) // hold, 10 * T) % len(stairs)]
    return u


def _walk(T: int, centre: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Levels that wander about the centre, each held for some twentieth of the record."""
    u = np.empty((T, len(centre)))
    for j, level in enumerate(centre):
        at, value = 0, level
        while at < T:
            stop = at + 5 + int(rng.exponential(T / 25))
            u[at:stop, j], at = value, stop
            value = float(np.clip(value + level * rng.uniform(-0.5, 0.5), 0.3 * level, 1.7 * level))
    return u


def record(machine: SmallMachine, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """u (T, m) and what the converter said y (T, p) of one recording, from the machine switched off."""
    rng = np.random.default_rng(seed)
    u = inputs(machine, rng)
    state, y = at_rest(machine, np.zeros(machine.m)), np.empty((len(u), machine.p))
    for t, applied in enumerate(u):
        y[t] = measured(machine, state, rng)
        state = advanced(machine, state, applied)
    return u, y


class IdentifiedMachine(NamedTuple):
    """A record u (T, m), y (T, p), the plant that the project's identification makes of it, the plants of its
    spread, and the deviation (p,) in °C of its one-step errors."""

    u: np.ndarray
    y: np.ndarray
    plant: Plant
    family: list[Plant]
    noise_degC: np.ndarray


def identified_record(u: np.ndarray, y: np.ndarray, sample_time_s: float, limits) -> IdentifiedMachine:
    """As stage identify_plant does it, on all of the record."""
    settings = Settings(feedthrough=None, refinement="validated")
    (u,), _ = ([u], []) if limits is None else within_limits([u], limits)
    fit = identify([u], [y], sample_time_s=sample_time_s, settings=settings)
    rng = np.random.default_rng(1)
    family = bootstrap_spread([u], [y], fit, count=FAMILY, order=fit.order + 1, rng=rng)
    errors = np.vstack(one_step_errors(fit.plant, [u], [y]))
    return IdentifiedMachine(u, y, fit.plant, family, np.nanstd(errors, axis=0))


@cache
def identified(machine: SmallMachine) -> IdentifiedMachine:
    """The machine as its own record shows it."""
    limits = np.zeros(machine.m), np.full(machine.m, 100.0)
    return identified_record(*record(machine), machine.sample_time_s, limits)


class Driven(NamedTuple):
    """True outputs (steps, p) in °C and applied inputs (steps, m) in percent of one run in closed loop."""

    y: np.ndarray
    u: np.ndarray


def driven(
    machine: SmallMachine, law: Law, state: MachineState, r: np.ndarray, steps: int, seed: int = 2
) -> Driven:
    """The true machine under a law aimed at the reference r (p,), commands cut to 0..100 %: its integrator
    takes errors of at most 1 °C, and rests in a zone whose command is cut."""
    y, u = np.empty((steps, machine.p)), np.empty((steps, machine.m))
    rng = np.random.default_rng(seed)
    z, xi, moved = np.zeros(len(law.A)), np.zeros(machine.p), law.K_r != 0
    for t in range(steps):
        y[t], read = true_outputs(state), measured(machine, state, rng)
        command = -(law.K @ z + law.D @ read + law.K_r @ (r + xi) + law.k)
        u[t] = np.clip(command, 0.0, 100.0)
        z = law.A @ z + law.B_u @ u[t] + law.B_y @ read + law.B_r @ r + law.c
        inside = ~(moved & (command != u[t])[:, None]).any(axis=0)
        xi = xi + inside * law.integral * np.clip(r - read, -1.0, 1.0)
        state = advanced(machine, state, u[t])
    return Driven(y, u)


NO_FAN_1, NO_FAN_2, NO_FAN_3 = ((0.0,),) * 2, ((0.0, 0.0),) * 2, ((0.0, 0.0, 0.0),) * 3

# fmt: off
HOT_END = SmallMachine("hot end", "steps", 1.0, 1800, (12.0, 6.0), (0.08, 0.03), (6e-11, 3e-11),
    ((0.0, 1.2), (1.2, 0.0)), ((0.4,), (0.0,)), NO_FAN_1, (0,), (2.0,), (1.5,), (0.1,), (50.0,), (200.0,))
HOT_END_WITH_FAN = SmallMachine("hot end with fan", "staircase", 1.0, 2400, (14.0, 5.0), (0.09, 0.02),
    (7e-11, 3e-11), ((0.0, 0.9), (0.9, 0.0)), ((0.5, 0.0), (0.0, 0.0)), ((0.0, 0.0), (0.0, 0.0008)), (0,),
    (3.0,), (2.0,), (0.2,), (40.0, 40.0), (210.0,))
HIGH_FLOW_HOT_END = SmallMachine("high-flow hot end", "walk", 1.0, 2000, (30.0, 12.0), (0.1, 0.06),
    (1.1e-10, 4e-11), ((0.0, 1.5), (1.5, 0.0)), ((0.7,), (0.0,)), NO_FAN_1, (1,), (3.0,), (4.0,), (0.3,),
    (40.0,), (220.0,))
BED = SmallMachine("bed", "steps", 2.0, 1800, (700.0, 250.0), (2.2, 0.8), (1e-9, 1e-9),
    ((0.0, 12.0), (12.0, 0.0)), ((3.0,), (0.0,)), NO_FAN_1, (0,), (6.0,), (4.0,), (0.1,), (45.0,), (70.0,))
MAINS_BED = SmallMachine("mains bed", "staircase", 2.0, 2400, (1500.0, 400.0), (3.4, 1.1), (2e-9, 2e-9),
    ((0.0, 9.0), (9.0, 0.0)), ((5.0,), (0.0,)), NO_FAN_1, (0,), (8.0,), (2.0,), (0.5,), (45.0,), (80.0,))
GLASS_BED = SmallMachine("glass bed", "walk", 3.0, 1800, (600.0, 700.0), (1.2, 2.4), (1e-9, 2e-9),
    ((0.0, 8.0), (8.0, 0.0)), ((2.4,), (0.0,)), NO_FAN_1, (1,), (5.0,), (3.0,), (0.25,), (60.0,), (50.0,))
KIT = SmallMachine("two-heater kit", "steps", 1.0, 2400, (2.0, 2.0), (0.009, 0.009), (5e-11, 5e-11),
    ((0.0, 0.0035), (0.0035, 0.0)), ((0.01, 0.0), (0.0, 0.0075)), NO_FAN_2, (0, 1), (15.0, 17.0), (0.0, 0.0),
    (0.32, 0.32), (50.0, 50.0), (45.0, 40.0))
KIT_IN_DRAUGHT = SmallMachine("two-heater kit in a draught", "walk", 1.0, 2400, (2.1, 1.8), (0.011, 0.012),
    (8e-11, 8e-11), ((0.0, 0.006), (0.006, 0.0)), ((0.01, 0.0), (0.0, 0.008)), NO_FAN_2, (0, 1), (12.0, 20.0),
    (3.0, 2.0), (0.1, 0.1), (50.0, 50.0), (42.0, 38.0), 17.0)
CHAMBER = SmallMachine("bed in a chamber", "steps", 5.0, 2400, (900.0, 3500.0), (0.5, 4.5), (1e-9, 0.0),
    ((0.0, 3.0), (3.0, 0.0)), ((3.5, 0.0), (0.0, 4.0)), NO_FAN_2, (0, 1), (8.0, 20.0), (5.0, 10.0),
    (0.1, 0.2), (45.0, 35.0), (80.0, 50.0))
BARREL = SmallMachine("barrel of three zones", "walk", 2.0, 2400, (160.0, 200.0, 170.0), (0.35, 0.25, 0.4),
    (2e-10, 2e-10, 2e-10), ((0.0, 0.3, 0.0), (0.3, 0.0, 0.35), (0.0, 0.35, 0.0)),
    ((1.6, 0.0, 0.0), (0.0, 1.5, 0.0), (0.0, 0.0, 1.6)), NO_FAN_3, (0, 1, 2), (5.0, 6.0, 5.0),
    (3.0, 4.0, 3.0), (0.5, 0.5, 0.25), (50.0, 45.0, 50.0), (150.0, 170.0, 160.0))
# fmt: on

MACHINES = (
    HOT_END,
    HOT_END_WITH_FAN,
    HIGH_FLOW_HOT_END,
    BED,
    MAINS_BED,
    GLASS_BED,
    KIT,
    KIT_IN_DRAUGHT,
    CHAMBER,
    BARREL,
)
