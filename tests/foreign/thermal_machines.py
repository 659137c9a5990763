"""Heated machines of six structures with drawn constants, simulated apart from the product: nothing of
pipeline is imported, and no model of the product has their structure.

`draw` gives a machine, `record` and `evening` what its owner logs, `thermal_machine.c` integrates it: here
through ctypes, in normal_life.py linked with an exported controller.
"""

import ctypes
import functools
import hashlib
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.optimize

SOURCE = Path(__file__).with_name("thermal_machine.c")
COMPILE = ["gcc", "-std=c99", "-O2", "-ffp-contract=off", "-fPIC", "-shared"]
NODES, EDGES, HEATERS, SENSORS, LINES, CELLS = 16, 24, 5, 5, 4, 24
ROOM, FAN, FLOW, DOOR = range(4)  # columns of what acts from outside
BELOW_CUT_OFF_DEGC = 15.0
ROOM_DEGC = 8.0  # by which the room wanders


def _doubles(**lengths: int) -> list[tuple[str, object]]:
    return [(name, ctypes.c_double * n if n else ctypes.c_double) for name, n in lengths.items()]


class Parts(ctypes.Structure):
    """thermal_parts of thermal_machine.h, which says what each array is."""

    _fields_ = [
        *_doubles(sample_s=0, substeps=0, nodes=0, edges=0, heaters=0, sensors=0, lines=0),
        *_doubles(capacity=NODES, linear=NODES, convection=NODES, radiation=NODES, fan=NODES, door=NODES),
        *_doubles(feed=NODES, shear=NODES),
        *_doubles(**{"from": EDGES, "to": EDGES, "conduction": EDGES, "natural": EDGES, "blown": EDGES}),
        *_doubles(power=HEATERS, heats=HEATERS, period_s=HEATERS, shortest_s=HEATERS, levels=HEATERS),
        *_doubles(senses=SENSORS, lag_s=SENSORS, step=SENSORS, noise=SENSORS),
        *_doubles(upstream=LINES, downstream=LINES, carried=LINES, cells=LINES, by_cell=LINES),
    ]


class State(ctypes.Structure):
    _fields_ = [
        *_doubles(degC=NODES, sensor=SENSORS, line=LINES * CELLS, moved=LINES, on_s=HEATERS, pulse=HEATERS),
        ("random", ctypes.c_uint64),
    ]


class Pid(ctypes.Structure):
    _fields_ = _doubles(
        proportional=HEATERS, integral=HEATERS, derivative=HEATERS,
        sum=HEATERS, last=HEATERS, slope=HEATERS, begun=0,
    )  # fmt: skip


class Machine(NamedTuple):
    """A machine as its owner knows it, and its parts, which its owner does not. Arrays by heater, of which
    there are as many as sensors."""

    structure: str
    parts: Parts
    inputs: tuple[str, ...]  # percent, 0 to 100
    outputs: tuple[str, ...]  # degC
    sample_time_s: float
    room_degC: float
    cut_off_degC: np.ndarray
    reference_degC: np.ndarray  # typical
    lowest_degC: np.ndarray  # of a set-point
    highest_degC: np.ndarray
    offset_degC: float  # by which zones may differ from their typical distance
    has_door: bool
    recorded: dict[str, tuple[int, float]]  # disturbance: column, and largest value; of a fan 1
    flow: float  # typical
    tau_s: float  # 63 % of heating up, of the slowest zone
    own_control: tuple[np.ndarray, np.ndarray, np.ndarray]  # a person's PI or PID

    @property
    def low_degC(self) -> np.ndarray:
        return np.zeros(len(self.outputs))

    @property
    def high_degC(self) -> np.ndarray:
        return self.cut_off_degC - BELOW_CUT_OFF_DEGC

    @property
    def minutes(self) -> float:
        """How long an experiment with this machine takes."""
        return float(np.clip(8 * self.tau_s / 60, 50, 360))


# ---- the parts


class Network:
    """Parts under construction: each method adds one and gives its number."""

    def __init__(self, sample_s: float):
        self.parts = Parts(sample_s=sample_s)

    def _add(self, kind: str, **values: float) -> int:
        number = int(getattr(self.parts, kind))
        for name, value in values.items():
            getattr(self.parts, name)[number] = value
        setattr(self.parts, kind, number + 1)
        return number

    def node(self, capacity: float, **losses: float) -> int:
        return self._add("nodes", capacity=capacity, **losses)

    def edge(self, a: int, b: int, conduction: float = 0.0, natural: float = 0.0, blown: float = 0.0) -> None:
        self._add("edges", **{"from": a, "to": b}, conduction=conduction, natural=natural, blown=blown)

    def heater(self, node: int, period_s: float, shortest_s: float, levels: int) -> None:
        self._add("heaters", heats=node, period_s=period_s, shortest_s=shortest_s, levels=levels, power=1.0)

    def sensor(self, node: int, lag_s: float, step: float, noise: float) -> None:
        self._add("sensors", senses=node, lag_s=lag_s, step=step, noise=noise)

    def line(self, upstream: int, downstream: int, carried: float, filling: float, cells: int) -> None:
        self._add(
            "lines", upstream=upstream, downstream=downstream, carried=carried, cells=cells,
            by_cell=filling / cells,
        )  # fmt: skip

    def finish(self) -> Parts:
        """With substeps that are a tenth of the quickest time constant, a quarter of a second at most."""
        p = self.parts
        out = np.array(p.linear) + np.array(p.door) + 3 * np.array(p.convection) * 2
        for e in range(int(p.edges)):
            both = p.conduction[e] + 4 * p.natural[e] * (1 + p.blown[e])
            out[int(getattr(p, "from")[e])] += both
            out[int(p.to[e])] += both
        n, s = int(p.nodes), int(p.sensors)
        quickest = min((np.array(p.capacity[:n]) / np.maximum(out[:n], 1e-9)).min(), min(p.lag_s[:s]))
        p.substeps = np.ceil(p.sample_s / min(0.1 * quickest, 0.25))
        for h in range(int(p.heaters)):  # a period is a whole number of substeps
            dt = p.sample_s / p.substeps
            p.period_s[h] = dt * max(round(p.period_s[h] / dt), 1)
        return p


class Wishes(NamedTuple):
    """What a structure says of its machine beside the parts."""

    network: Network
    reference: np.ndarray
    below: np.ndarray  # degC from the reference to the lowest and the highest set-point, and to the cut-off
    above: np.ndarray
    cut_off: np.ndarray
    has_fan: bool = False
    flow: tuple[str, float, float] | None = None  # name, typical, largest
    has_door: bool = False
    offset_degC: float = 0.0


def _converter(rng: np.random.Generator) -> dict[str, float]:
    step = float(rng.choice([0.25, 0.1, 0.02]))
    noise = {0.25: (0.05, 0.12), 0.1: (0.03, 0.1), 0.02: (0.04, 0.2)}[step]
    return {"step": step, "noise": rng.uniform(*noise)}


def _fast_pulse(rng: np.random.Generator) -> dict[str, float]:
    return {"period_s": 0.1, "shortest_s": 0.0, "levels": int(rng.choice([100, 255, 1023]))}


def _slow_pulse(rng: np.random.Generator) -> dict[str, float]:
    """A relay or a solid state relay: seconds, with a dead zone at both ends."""
    period = float(rng.choice([1.0, 2.0, 4.0]))
    return {
        "period_s": period,
        "shortest_s": period * rng.uniform(0.01, 0.06),
        "levels": int(rng.choice([50, 100, 255])),
    }


def hot_end(rng: np.random.Generator) -> Wishes:
    """Cartridge, block, heat break; fan and filament."""
    u, net = rng.uniform, Network(float(rng.choice([0.3, 0.5, 1.0])))
    cartridge = net.node(u(3, 8))
    block = net.node(
        u(10, 40), convection=u(0.01, 0.02), radiation=u(2e-11, 4e-11), fan=u(0.3, 0.9), feed=u(0.004, 0.007)
    )
    cold_end = net.node(u(20, 60), linear=u(0.15, 0.3))
    net.edge(cartridge, block, u(0.6, 1.5))
    net.edge(block, cold_end, u(0.02, 0.05))
    net.heater(cartridge, **_fast_pulse(rng))
    net.sensor(block, u(0.8, 5), **_converter(rng))
    feed = ("feed", u(0.5, 1.5), u(3, 6))
    ends = np.array([u(25, 40)]), np.array([u(20, 30)]), np.array([u(65, 85)])
    return Wishes(net, np.array([u(200, 225)]), *ends, has_fan=True, flow=feed)


def bed(rng: np.random.Generator) -> Wishes:
    """Mat, plate and a slow glass; pulses of seconds."""
    u, net = rng.uniform, Network(float(rng.choice([1.0, 2.0])))
    enclosed = bool(rng.random() < 0.5)
    mat = net.node(u(60, 150), linear=u(0.1, 0.4))
    plate = net.node(u(400, 900), convection=u(0.05, 0.12), fan=u(0.1, 0.4))
    glass = net.node(
        u(300, 700), convection=u(0.1, 0.25), radiation=u(2e-9, 4e-9), fan=u(0.2, 0.5), door=0.6 * enclosed
    )
    net.edge(mat, plate, u(10, 25))
    net.edge(plate, glass, u(2, 5))
    net.heater(mat, **_slow_pulse(rng))
    net.sensor(plate, u(2, 8), **_converter(rng))
    ends = np.array([u(15, 25)]), np.array([u(15, 25)]), np.array([u(45, 60)])
    return Wishes(net, np.array([u(65, 95)]), *ends, has_fan=True, has_door=enclosed)


def barrel(rng: np.random.Generator) -> Wishes:
    """Zones with jackets, and the material that a screw carries, delays and shears."""
    u, net, zones = rng.uniform, Network(float(rng.choice([1.0, 2.0]))), int(rng.integers(2, 6))
    carried, shear = u(0.03, 0.06), u(0.2, 0.5)
    walls = [net.node(u(800, 2500)) for _ in range(zones)]
    stuff = [net.node(u(60, 150), shear=shear * u(0.5, 1.5), feed=carried * (k == 0)) for k in range(zones)]
    jackets = [net.node(u(300, 1200), convection=u(0.1, 0.25), radiation=u(5e-10, 1.5e-9)) for _ in walls]
    throat = net.node(u(1000, 3000), linear=u(3, 6))
    net.edge(throat, walls[0], u(0.5, 1.2))
    for k in range(zones):
        net.edge(walls[k], stuff[k], u(2, 5))
        net.edge(walls[k], jackets[k], u(0.8, 1.6))
        net.heater(walls[k], **_slow_pulse(rng))
        net.sensor(walls[k], u(3, 10), **_converter(rng))
        if k:
            net.edge(walls[k - 1], walls[k], u(0.8, 2.5))
            net.line(stuff[k - 1], stuff[k], carried, u(500, 1500), 16)
    typical = u(170, 185) + np.cumsum(u(0, 12, zones))
    every = np.ones(zones)
    ends = every * u(20, 30), every * u(15, 30), every * u(60, 80)
    return Wishes(net, typical, *ends, flow=("screw", u(20, 35), u(45, 70)), offset_degC=5.0)


def chamber(rng: np.random.Generator) -> Wishes:
    """Element, air, wall and table behind a door; an exhaust fan."""
    u, net = rng.uniform, Network(float(rng.choice([1.0, 2.0])))
    element = net.node(u(100, 300))
    air = net.node(u(400, 900), door=u(12, 35), convection=u(0.1, 0.2), fan=u(2, 6))
    wall = net.node(u(4000, 9000), linear=u(2, 4))
    table = net.node(u(3000, 8000))
    net.edge(element, air, u(5, 9))
    net.edge(air, wall, u(1, 3), natural=u(1, 2))
    net.edge(air, table, u(0.5, 1), natural=u(0.5, 1.5))
    net.heater(element, **_slow_pulse(rng))
    net.sensor(air, u(4, 15), **_converter(rng))
    ends = np.array([u(10, 15)]), np.array([u(10, 18)]), np.array([u(40, 50)])
    return Wishes(net, np.array([u(60, 75)]), *ends, has_fan=True, has_door=True)


def two_zones(rng: np.random.Generator) -> Wishes:
    """Two zones on a frame that stores heat too."""
    u, net = rng.uniform, Network(float(rng.choice([0.5, 1.0])))
    frame = net.node(u(400, 1500), linear=u(0.5, 1.2))
    for _ in range(2):
        zone = net.node(u(40, 120), convection=u(0.05, 0.12), radiation=u(5e-11, 2e-10), fan=u(0.2, 0.8))
        net.edge(zone, frame, u(0.3, 0.8))
        net.heater(zone, **_fast_pulse(rng))
        net.sensor(zone, u(1.5, 8), **_converter(rng))
    every = np.ones(2)
    ends = every * u(20, 30), every * u(20, 30), every * u(60, 80)
    return Wishes(net, u(130, 180) + u(-10, 10, 2), *ends, has_fan=True, offset_degC=10.0)


def enclosed(rng: np.random.Generator) -> Wishes:
    """A hot end in a heated enclosure with an inner and a slow outer wall."""
    u, net = rng.uniform, Network(float(rng.choice([0.5, 1.0])))
    cartridge = net.node(u(3, 8))
    block = net.node(u(12, 40), radiation=u(1e-11, 3e-11), feed=u(0.004, 0.007))
    cold_end = net.node(u(20, 60), linear=u(0.1, 0.2))
    element = net.node(u(60, 150))
    air = net.node(u(80, 200), door=u(4, 12), linear=u(0.1, 0.3))
    inner = net.node(u(800, 2000))
    outer = net.node(u(3000, 8000), linear=u(1.0, 2.0))
    net.edge(cartridge, block, u(0.6, 1.5))
    net.edge(block, cold_end, u(0.02, 0.05))
    net.edge(block, air, 0.0, natural=u(0.01, 0.02), blown=u(0.3, 0.9))
    net.edge(element, air, u(2, 5))
    net.edge(air, inner, u(1, 2), natural=u(0.5, 1))
    net.edge(inner, outer, u(1.5, 3))
    net.heater(cartridge, **_fast_pulse(rng))
    net.heater(element, **_slow_pulse(rng))
    net.sensor(block, u(0.8, 5), **_converter(rng))
    net.sensor(air, u(4, 12), **_converter(rng))
    ends = np.array([u(25, 35), 6.0]), np.array([u(20, 30), u(8, 14)]), np.array([u(65, 85), u(40, 50)])
    feed, typical = ("feed", u(0.5, 1.5), u(3, 6)), np.array([u(215, 240), u(58, 68)])
    return Wishes(net, typical, *ends, has_fan=True, flow=feed, has_door=True, offset_degC=20.0)


STRUCTURES: tuple[Callable[[np.random.Generator], Wishes], ...] = (
    hot_end, bed, barrel, chamber, two_zones, enclosed,
)  # fmt: skip


def draw(seed: int) -> Machine:
    """The machine of a seed: structures take turns, constants are drawn."""
    make = STRUCTURES[(seed - 1) % len(STRUCTURES)]
    rng = np.random.default_rng([seed, 20])
    w = make(rng)
    parts, room = w.network.finish(), float(rng.uniform(19, 26))
    m = int(parts.heaters)
    largest = w.flow[2] if w.flow else 0.0
    lowest = _size(parts, w, room, largest, rng.uniform(1.0, 1.3, m))
    recorded = ({"fan": (FAN, 1.0)} if w.has_fan else {}) | ({w.flow[0]: (FLOW, largest)} if w.flow else {})
    number = [""] if m == 1 else [f"_{i + 1}" for i in range(m)]
    machine = Machine(
        structure=make.__name__,
        parts=parts,
        inputs=tuple(f"heater{k}" for k in number),
        outputs=tuple(f"zone{k}" for k in number),
        sample_time_s=parts.sample_s,
        room_degC=room,
        cut_off_degC=np.round(w.reference + w.cut_off),
        reference_degC=np.round(w.reference),
        lowest_degC=lowest,
        highest_degC=w.reference + w.above,
        offset_degC=w.offset_degC,
        has_door=w.has_door,
        recorded=recorded,
        flow=w.flow[1] if w.flow else 0.0,
        tau_s=0.0,
        own_control=(np.zeros(m),) * 3,
    )
    machine = machine._replace(tau_s=heating_s(machine))
    return machine._replace(own_control=tune(machine))


def sampled(machine: Machine, sample_time_s: float) -> Machine:
    """The same machine read and driven at another sample time."""
    parts = Parts.from_buffer_copy(machine.parts)
    parts.substeps = np.ceil(parts.substeps * sample_time_s / parts.sample_s - 1e-9)
    parts.sample_s = sample_time_s
    return machine._replace(parts=parts, sample_time_s=sample_time_s)


def _size(parts: Parts, w: Wishes, room: float, largest: float, more: np.ndarray) -> np.ndarray:
    """Sets powers by which the highest set-points are held at 80 % on the coldest day. Returns the lowest
    set-points (m,), which heaters still hold by 3 % on the warmest day, with the strongest shear."""
    m, below, flows = len(w.reference), w.below.copy(), sorted({0.0, largest})
    apart = 2 * min(w.offset_degC, float((w.below + w.above).min()) / 4)
    alone = np.eye(m) if m > 1 else np.zeros((1, 1))  # one zone at an end of its range, the others not
    fans = (0.0, 1.0) if w.has_fan else (0.0,)
    for _ in range(40):
        hot = [w.reference + w.above - apart * (1 - one) * (m > 1) for one in (*alone, np.ones(m))]
        cold = [w.reference - below + apart * (1 - one) * (m > 1) for one in (*alone, np.ones(m))]
        out = [(room - ROOM_DEGC, fan, flow, 0.0) for fan in fans for flow in flows]
        needed = np.max([at_rest(parts, target, one)[1] for target in hot for one in out], axis=0)
        parts.power[:m] = list(np.ceil(needed / 0.8 * more))
        warm = [(room + ROOM_DEGC, 0.0, flow, 0.0) for flow in flows]
        least = np.min([at_rest(parts, target, one)[1] for target in cold for one in warm], axis=0)
        short = least < 0.03 * np.array(parts.power[:m])
        if not short.any():
            break
        below[short] *= 0.8
        for i in range(int(parts.nodes)):
            parts.shear[i] *= 0.8
    return w.reference - below


def at_rest(parts: Parts, target: np.ndarray, outside: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Temperatures (nodes,) and powers (m,) in W that hold the sensors at their targets."""
    n, m = int(parts.nodes), int(parts.heaters)
    senses = np.array(parts.senses[:m], int)
    scale = np.full(m, 20.0)

    def missing(x: np.ndarray) -> np.ndarray:
        return np.r_[heat(parts, x[:n], x[n:] * scale, outside), x[senses] - target]

    found = scipy.optimize.root(missing, np.r_[np.full(n, target.mean()), np.ones(m)], tol=1e-10)
    if np.abs(found.fun).max() > 1e-4:
        raise ArithmeticError(f"no rest at {target}: {found.message}")
    return found.x[:n], found.x[n:] * scale


# ---- the integrator


@functools.cache
def library() -> ctypes.CDLL:
    """thermal_machine.c, compiled once a process into a temporary folder."""
    key = hashlib.sha256(SOURCE.read_bytes() + SOURCE.with_suffix(".h").read_bytes()).hexdigest()[:16]
    path = Path(tempfile.mkdtemp(prefix="thermal_machine_")) / f"{key}.so"
    subprocess.run([*COMPILE, "-o", str(path), str(SOURCE), "-lm"], check=True, timeout=120)
    loaded = ctypes.CDLL(str(path))
    loaded.thermal_start.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_double, ctypes.c_uint64]
    return loaded


def pointer(array: np.ndarray) -> ctypes.c_void_p:
    if array.dtype != np.float64 or not array.flags.c_contiguous:
        raise TypeError("expected doubles in rows")
    return ctypes.c_void_p(array.ctypes.data)


def heat(parts: Parts, degC: np.ndarray, watt: np.ndarray, outside: tuple[float, ...]) -> np.ndarray:
    """W into each node at temperatures (nodes,) and powers (m,), lines at rest."""
    degC, watt, found = np.ascontiguousarray(degC), np.ascontiguousarray(watt), np.zeros(NODES)
    arguments = (pointer(degC), pointer(watt), pointer(np.array(outside, float)), pointer(found))
    library().thermal_balance(ctypes.byref(parts), *arguments)
    return found[: int(parts.nodes)]


def start(machine: Machine, seed: int, degC: float | None = None) -> State:
    """The machine at rest, at room temperature unless told."""
    state = State()
    begin = machine.room_degC if degC is None else degC
    library().thermal_start(ctypes.byref(state), ctypes.byref(machine.parts), begin, seed)
    return state


def drive(
    machine: Machine, state: State, u: np.ndarray, outside: np.ndarray, guard: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Readings (T, p) and what acted (T, m) under duties u (T, m) and what acts from outside (T, 4); a person
    shuts a heater off past `guard` (m,) in degC."""
    u, outside = np.array(u, float, order="C"), np.ascontiguousarray(outside, float)
    y, most = np.zeros((len(u), len(machine.outputs))), np.full(HEATERS, np.inf)
    most[: len(machine.outputs)] = np.inf if guard is None else guard
    library().thermal_by_hand(
        ctypes.byref(state), ctypes.byref(machine.parts), len(u), *map(pointer, (u, outside, most, y))
    )
    return y, u


def control(
    machine: Machine, state: State, gains: tuple[np.ndarray, ...], r: np.ndarray, outside: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Readings (T, p) and duties (T, m) under a person's PID with set-points r (T, p)."""
    pid, m = Pid(), len(machine.inputs)
    for name, gain in zip(("proportional", "integral", "derivative"), gains, strict=True):
        getattr(pid, name)[:m] = list(gain)
    r, outside = np.ascontiguousarray(r, float), np.ascontiguousarray(outside, float)
    u, y = np.zeros((len(r), m)), np.zeros((len(r), m))
    at = (ctypes.byref(state), ctypes.byref(machine.parts), ctypes.byref(pid))
    library().thermal_by_pid(*at, len(r), *map(pointer, (r, outside, u, y)))
    return y, u


def quiet(machine: Machine, steps: int) -> np.ndarray:
    """(T, 4): the room as it is, fan off, door shut, the typical screw, no feed."""
    outside = np.zeros((steps, 4))
    outside[:, ROOM] = machine.room_degC
    outside[:, FLOW] = machine.flow if "screw" in machine.recorded else 0.0
    return outside


# ---- what a person does with it


def holding(machine: Machine, target: np.ndarray) -> np.ndarray:
    """Duties (m,) in percent that hold set-points, as a person finds them by trying."""
    watt = at_rest(machine.parts, target, tuple(quiet(machine, 1)[0]))[1]
    return np.clip(100 * watt / np.array(machine.parts.power[: len(target)]), 0, 100)


def heating_s(machine: Machine) -> float:
    """Seconds until the slowest zone has risen 63 % of the way to its typical reference under the duty that
    holds it."""
    duty, T = holding(machine, machine.reference_degC), round(10 * 3600 / machine.sample_time_s)
    y, _ = drive(machine, start(machine, 1), np.tile(duty, (T, 1)), quiet(machine, T))
    reached = y > machine.room_degC + 0.63 * (machine.reference_degC - machine.room_degC)
    return float(np.where(reached.any(axis=0), reached.argmax(axis=0), T).max() * machine.sample_time_s)


def tune(machine: Machine) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """SIMC on the slope and the apparent delay of heating up at full power, each heater alone (Skogestad
    2003, integrating process, tau_c = delay):

        K = 1 / (slope (tau_c + delay)),  T_i = 4 (tau_c + delay)

    detuned by 1.5 until all zones settle. Gains in percent/degC, percent/(degC s), and no derivative."""
    m, dt = len(machine.inputs), machine.sample_time_s
    K, T_i = np.zeros(m), np.zeros(m)
    for h in range(m):
        K[h], T_i[h] = _simc(machine, h)
    for _ in range(12):
        gains = K, K / T_i, np.zeros(m)
        T = round((6 * machine.tau_s + 1800) / dt)
        r = np.tile(machine.reference_degC, (T, 1))
        y, _ = control(machine, start(machine, 2), gains, r, quiet(machine, T))
        last = y[-T // 4 :]
        calm = np.abs(last - r[-1]).max(axis=0) < 1.5 + 4 * np.array(machine.parts.noise[:m])
        if calm.all() and (y.max(axis=0) < machine.reference_degC + 12).all():
            break
        K, T_i = K / 1.5, T_i * 1.2
    return gains


def _simc(machine: Machine, h: int) -> tuple[float, float]:
    """Proportional gain in percent/degC, and the integral time in s, of one heater."""
    dt = machine.sample_time_s
    T = round(min(machine.tau_s, 3600.0) / dt)
    duty = np.zeros((T, len(machine.inputs)))
    duty[:, h] = 100.0
    y, _ = drive(machine, start(machine, 3), duty, quiet(machine, T))
    wide = max(round(5 / dt), 1)
    smooth = np.convolve(y[:, h], np.ones(wide) / wide, "valid")
    slopes = (smooth[wide:] - smooth[:-wide]) / (wide * dt)
    top = int(slopes.argmax())
    delay = max((top + wide) * dt - (smooth[top] - smooth[0]) / slopes[top], 2 * dt)
    return 100 / (2 * delay * slopes[top]), 8 * delay


class Record(NamedTuple):
    """One recording, a row a sample: time (T,) in s, duties (T, m) in percent, readings and set-points (T, p)
    in degC, and what acted from outside (T, 4)."""

    time_s: np.ndarray
    duty_percent: np.ndarray
    reading_degC: np.ndarray
    target_degC: np.ndarray
    outside: np.ndarray


def record(
    machine: Machine, rng: np.random.Generator, minutes: float | None = None, *, disturbed: bool = False
) -> Record:
    """Steps by hand from cold: levels that hold set-points, on each of them switches of some percent, every
    heater on its own. With `disturbed`, fan and feed or screw are moved too."""
    dt, m = machine.sample_time_s, len(machine.inputs)
    T = round((minutes or machine.minutes) * 60 / dt)
    levels = [holding(machine, _set_point(machine, rng)) for _ in range(6)]
    u = np.array(levels)[np.minimum(np.arange(T) * 6 // T, 5)]
    for h in range(m):
        amplitude = max(0.15 * float(np.mean(levels, axis=0)[h]), 4.0)
        u[:, h] += amplitude * _levels(rng, T, 0.06 * machine.tau_s / dt + 10, [-1.0, 1.0])
    u = np.clip(u, 0, 100)
    u[: round(60 / dt)] = 0
    outside = _wander(machine, rng, quiet(machine, T))
    if disturbed:
        outside = disturb(machine, rng, outside)
    y, acted = drive(machine, start(machine, int(rng.integers(2**40))), u, outside, machine.high_degC - 5)
    return Record(dt * np.arange(T), acted, y, np.tile(machine.reference_degC, (T, 1)), outside)


def evening(
    machine: Machine, rng: np.random.Generator, minutes: float | None = None, *, disturbed: bool = False
) -> Record:
    """The operator's own control from cold, and set-points that change."""
    dt = machine.sample_time_s
    T = round((minutes or machine.minutes) * 60 / dt)
    changes = np.sort(rng.integers(0, T, 8))
    targets = np.array([_set_point(machine, rng) for _ in range(9)])
    r = targets[np.searchsorted(changes, np.arange(T), side="right")]
    outside = _wander(machine, rng, quiet(machine, T))
    if disturbed:
        outside = disturb(machine, rng, outside)
    y, u = control(machine, start(machine, int(rng.integers(2**40))), machine.own_control, r, outside)
    return Record(dt * np.arange(T), u, y, r, outside)


def write_csv(path: Path, machine: Machine, recorded: Record, *, disturbed: bool = False) -> None:
    """The recording as a logger writes it; with `disturbed`, fan in percent and feed or screw beside."""
    columns = {"time_s": recorded.time_s}
    columns |= dict(zip([f"{name}_pct" for name in machine.inputs], recorded.duty_percent.T, strict=True))
    for name, (column, _) in machine.recorded.items() if disturbed else ():
        columns["fan_pct" if column == FAN else name] = recorded.outside[:, column] * (
            100.0 if column == FAN else 1.0
        )
    columns |= dict(zip([f"{name}_C" for name in machine.outputs], recorded.reading_degC.T, strict=True))
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    lines = [",".join(columns), *(",".join(f"{value:.8g}" for value in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


# ---- what acts on it


def _levels(rng: np.random.Generator, T: int, mean: float, of: list[float] | None = None) -> np.ndarray:
    """(T,) random levels from 0 to 1, or `of` these, each for a random time about `mean` samples."""
    found, t = np.zeros(T), 0
    while t < T:
        end = t + 1 + int(rng.exponential(mean))
        found[t:end] = rng.uniform() if of is None else rng.choice(of)
        t = end
    return found


def _wander(machine: Machine, rng: np.random.Generator, outside: np.ndarray) -> np.ndarray:
    """The room wanders over hours within 8 degC: a daily wave and a slower drift."""
    hours = np.arange(len(outside)) * machine.sample_time_s / 3600
    waves = [
        rng.uniform(1, 4) * np.sin(2 * np.pi * (hours / period + rng.uniform()))
        for period in rng.uniform([3, 20], [8, 28])
    ]
    outside[:, ROOM] = machine.room_degC + np.clip(sum(waves), -ROOM_DEGC, ROOM_DEGC)
    return outside


def disturb(machine: Machine, rng: np.random.Generator, outside: np.ndarray) -> np.ndarray:
    """Fan, feed or screw, each at a level for some minutes."""
    dt = machine.sample_time_s
    for name, (column, largest) in machine.recorded.items():
        moves = _levels(rng, len(outside), 300 / dt)
        if name == "fan":  # off, full, or between
            moves = np.clip(2 * moves - 0.5, 0, 1)
        if name == "screw":
            moves = np.clip(0.2 + moves, 0, 1) * (moves > 0.1)
        outside[:, column] = largest * moves
    return outside


def _set_point(machine: Machine, rng: np.random.Generator) -> np.ndarray:
    """Set-points (p,) in degC: all zones a share of the way from lowest to highest, and a little apart."""
    low, high = machine.lowest_degC, machine.highest_degC
    apart = rng.uniform(-1, 1, len(low)) * min(machine.offset_degC, float((high - low).min()) / 4)
    return np.round(np.clip(low + rng.uniform() * (high - low) + apart, low, high))


def life(machine: Machine, rng: np.random.Generator, hours: float) -> tuple[np.ndarray, np.ndarray]:
    """Normal life: set-points (T, p) that change by 5 to 60 degC every 20 to 120 min, and what acts from
    outside (T, 4): the room, the fan, feed or screw, and doors of 20 to 90 s, about two in three hours."""
    dt = machine.sample_time_s
    T = round(hours * 3600 / dt)
    r, t, target = np.zeros((T, len(machine.outputs))), 0, _set_point(machine, rng)
    while t < T:
        end = t + round(rng.uniform(20, 120) * 60 / dt)
        r[t:end], t = target, end
        for _ in range(20):
            wish = _set_point(machine, rng)
            if 5 <= np.abs(wish - target).max() <= 60:
                break
        target = wish
    outside = disturb(machine, rng, _wander(machine, rng, quiet(machine, T)))
    if machine.has_door:
        t = rng.exponential(5400)
        while t < hours * 3600:
            open_s = rng.uniform(20, 90)
            outside[round(t / dt) : round((t + open_s) / dt), DOOR] = 1.0
            t += open_s + 600 + rng.exponential(4800)
    return r, outside
