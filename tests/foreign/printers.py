"""Two printers of another structure than the setpoint loop's simulator, and their cameras, in plain numpy.

The bead printer: moves of the flow count by a gain, the melt follows by one time constant, and clogs close
and open at once. The camera misreads each stretch of 5 to 40 decisions by one normal bias, and each window by
another. The gear printer: what it feeds is a factor of what it is told, which drifts; the gear slips where
much is asked; the melt follows by two time constants, and clogs grow and wash out over decisions. Its camera
compresses the scale, drifts from one bias to the next along a line, and shows anything in one window of
fifty.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats

from pipeline.setpoint.published import FLOW_MOVES, TEMPERATURE_MOVES
from pipeline.setpoint.simulation import actuation
from pipeline.setpoint.simulation.recorded import WindowTable
from pipeline.setpoint.simulation.simulator import Observation, SetpointController

DECISIONS, WINDOW_S, HEATER_S = 200, 1.0, 15.0
LIMITS = actuation.SetpointLimits(
    np.array([20.0, 180.0]), np.array([310.0, 240.0]), np.array([10.0, 20.0]), np.array([100.0, 60.0])
)
START_FLOWS, START_TEMPERATURES = (30.0, 60.0, 80.0, 120.0, 150.0, 200.0, 300.0), (190.0, 210.0, 230.0)
IN_BAND = (92.5, 95.0, 97.5, 100.0, 102.5, 105.0, 107.5)
EDGES = np.r_[20, 30, 40, 50, 60, np.arange(70, 130.1, 2.5), 150, 180, 220, 260, 310]


class Case(NamedTuple):
    """What n runs meet. starts (k, 2): flow in percent and temperature in °C, taken in turn; melt_s and waits
    (s); gain and how far it wanders (deviation of its logarithm, a decision); clog: factor on the flow from
    clog_at on; come_and_go: clogs of 0.6 to 0.85 a decision, each lasting 10 to 60; seen: factor on the flow
    that the camera reads, against its table; stuck and blind: decisions from fault_at on in which it repeats
    itself, or shows nothing."""

    starts: np.ndarray
    melt_s: float = 0.0
    waits_s: tuple[float, ...] = (6.0,)
    gain: tuple[float, float] = (1.0, 1.0)
    gain_wander: float = 0.0
    clog: float = 1.0
    clog_at: int = 60
    come_and_go: float = 0.0
    seen: float = 1.0
    stuck: int = 0
    blind: int = 0
    fault_at: int = 40


class Printer(NamedTuple):
    """begin(rng, case, flow) -> state; feed(rng, case, state, move, wait_s, blockage) -> state, true flow
    (n,); camera: begin(rng, n) -> memory, look(rng, memory, flow) -> memory, flow_seen (n,); spread: of log
    flow_seen as the camera states it."""

    begin: Callable[..., Any]
    feed: Callable[..., tuple[Any, np.ndarray]]
    camera: "Camera"


class Camera(NamedTuple):
    begin: Callable[..., Any]
    look: Callable[..., tuple[Any, np.ndarray]]
    spread: float


class Bead(NamedTuple):
    """True flows before blockage that the moves reach, in the melt, and the gain, each (n,)."""

    reached: np.ndarray
    melt: np.ndarray
    gain: np.ndarray


def bead_begin(rng: np.random.Generator, case: Case, flow: np.ndarray) -> Bead:
    return Bead(flow, flow, rng.uniform(*case.gain, len(flow)))


def bead_feed(rng, case: Case, state: Bead, move, wait_s, blockage) -> tuple[Bead, np.ndarray]:
    """What is fed enters the melt, which empties by melt_s; the window is the second after the wait."""
    wander = np.exp(case.gain_wander * rng.standard_normal(len(move)))
    gain = np.clip(state.gain * wander, min(0.5, case.gain[0]), max(1.2, case.gain[1]))
    reached = np.clip(state.reached + gain * move, 20.0, 310.0)
    late = np.exp(-(wait_s + WINDOW_S / 2) / case.melt_s) if case.melt_s else 0.0
    melt = reached * blockage + (state.melt - reached * blockage) * late
    return Bead(reached, melt, gain), melt


class Stretch(NamedTuple):
    """Biases of log flow_seen (n,) now and at the end of this stretch, and decisions left of it."""

    bias: np.ndarray
    towards: np.ndarray
    left: np.ndarray


def bead_camera(*, bias: float = 0.05, noise: float = 0.05, scale: float = 1.0) -> Camera:
    """log flow_seen = scale log flow + bias of the stretch + noise of the window."""

    def begin(rng, n):
        return Stretch(rng.normal(0, bias, n), np.zeros(n), rng.integers(5, 41, n))

    def look(rng, now, flow):
        over = now.left <= 0
        n = len(flow)
        drawn = rng.normal(0, bias, n), rng.integers(5, 41, n)
        now = Stretch(np.where(over, drawn[0], now.bias), now.towards, np.where(over, drawn[1], now.left) - 1)
        shown = scale * np.log(flow / 100) + now.bias + rng.normal(0, noise, n)
        return now, 100 * np.exp(shown)

    return Camera(begin, look, float(np.hypot(bias, noise)))


class Gear(NamedTuple):
    """What is told (percent), the factor of what is fed, the two melts and the clog's growth, each (n,)."""

    told: np.ndarray
    factor: np.ndarray
    first: np.ndarray
    second: np.ndarray
    closed: np.ndarray


def _slipping(told: np.ndarray) -> np.ndarray:
    """The gear loses up to a tenth where more than 200 % is asked."""
    return told * (1 - 0.1 / (1 + np.exp(-(told - 200) / 20)))


def gear_begin(rng: np.random.Generator, case: Case, flow: np.ndarray) -> Gear:
    factor = rng.uniform(*case.gain, len(flow))
    told = np.clip(flow / factor, 20, 310)
    flow = factor * _slipping(told)
    return Gear(told, factor, flow, flow, np.ones(len(flow)))


def gear_feed(rng, case: Case, state: Gear, move, wait_s, blockage) -> tuple[Gear, np.ndarray]:
    """A clog closes by half of what is missing each decision; the melt follows by two time constants, half
    of melt_s each."""
    n = len(move)
    told = np.clip(state.told + move, 20.0, 310.0)
    factor = np.clip(state.factor * np.exp(0.25 * case.gain_wander * rng.standard_normal(n)), 0.5, 1.3)
    closed = state.closed + 0.5 * (blockage - state.closed)
    fed = factor * _slipping(told) * closed
    if not case.melt_s:
        return Gear(told, factor, fed, fed, closed), fed
    late = np.exp(-(wait_s + WINDOW_S / 2) / (case.melt_s / 2))
    first = fed + (state.first - fed) * late
    second = first + (state.second - first) * late
    return Gear(told, factor, first, second, closed), second


def gear_camera(*, bias: float = 0.05, noise: float = 0.04, scale: float = 0.9) -> Camera:
    """The bias goes along a line from one Laplace number to the next in 5 to 40 decisions; noise has the
    heavy tails of Student's t with 4 degrees of freedom; one window of fifty shows any flow."""

    def begin(rng, n):
        drawn = rng.laplace(0, bias / np.sqrt(2), (2, n))
        return Stretch(drawn[0], drawn[1], rng.integers(5, 41, n))

    def look(rng, now, flow):
        n = len(flow)
        drawn, length = rng.laplace(0, bias / np.sqrt(2), n), rng.integers(5, 41, n)
        over = now.left <= 0
        towards, left = np.where(over, drawn, now.towards), np.where(over, length, now.left)
        now = Stretch(now.bias + (towards - now.bias) / left, towards, left - 1)
        heavy = noise * rng.standard_t(4, n) / np.sqrt(2)
        shown = 100 * (flow / 100) ** scale * np.exp(now.bias + heavy)
        anything = rng.random(n) < 0.02
        return now, np.where(anything, np.exp(rng.uniform(np.log(20), np.log(310), n)), shown)

    return Camera(begin, look, float(np.hypot(bias, noise)))


PRINTERS = {
    "bead": Printer(bead_begin, bead_feed, bead_camera()),
    "gear": Printer(gear_begin, gear_feed, gear_camera()),
}


def recorded_table(camera: Camera, rng: np.random.Generator, *, segments: int, windows: int) -> WindowTable:
    """The camera's own table: segments at flows log-uniform from 20 to 310 %, each for some windows."""
    flow = np.exp(rng.uniform(np.log(20), np.log(310), segments))
    extra = (EDGES[1:] + EDGES[:-1]) / 2  # one of each bin, so that none is empty
    flow = np.r_[flow, extra]
    memory, shown = camera.begin(rng, len(flow)), []
    memory = memory._replace(left=np.maximum(memory.left, windows + 1))
    for _ in range(windows):
        memory, seen = camera.look(rng, memory, flow)
        shown.append(seen)
    seen, flow = np.clip(np.array(shown).T.ravel(), 15, 400), np.repeat(flow, windows)
    spread = np.full(len(flow), camera.spread)
    shares = window_shares(seen, spread)
    flow_bin = np.clip(np.searchsorted(EDGES, flow, side="right") - 1, 0, len(EDGES) - 2)
    segment = np.repeat(np.arange(len(flow) // windows), windows)
    return WindowTable(shares, shares.argmax(axis=1), flow_bin, segment, EDGES, seen, spread, flow)


def window_shares(seen: np.ndarray, spread: np.ndarray | float) -> np.ndarray:
    """(n, 3): of under 90 %, good, over 110 %, under N(log seen, spread^2)."""
    low, high = (scipy.stats.norm.cdf((np.log(b) - np.log(seen)) / spread) for b in (90.0, 110.0))
    return np.stack([low, high - low, 1 - high], axis=-1)


class Runs(NamedTuple):
    """flow and temperature (n, D + 1), before the first decision and after each; moves (n, D) of the flow as
    sent; reason (n, D) of actuation.REASONS."""

    flow: np.ndarray
    temperature: np.ndarray
    moves: np.ndarray
    reason: np.ndarray


def loop(
    printer: Printer, controller: SetpointController, parameters: Any, case: Case, n: int, *, seed: int,
    camera: Camera | None = None,
) -> Runs:  # fmt: skip
    """n runs of a controller as deployed: limits, waits and holds are deployment's. The chances of printer
    and camera do not depend on the controller."""
    rng, camera = np.random.default_rng(seed), camera or printer.camera
    start = case.starts[np.arange(n) % len(case.starts)]
    wait_s, state, looks = (
        rng.choice(case.waits_s, n),
        printer.begin(rng, case, start[:, 0]),
        camera.begin(rng, n),
    )
    sent, flow, temperature = actuation.setpoints(start, LIMITS), start[:, 0], start[:, 1]
    clog = np.ones(n), np.zeros(n)
    memory = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (n, *jnp.shape(leaf))), controller.start())
    since, acted, seen, steps = np.zeros(n), np.zeros(n, int), np.full(n, np.nan), []
    keys = jax.random.split(jax.random.key(seed), n)
    for t in range(DECISIONS):
        looks, fresh = camera.look(rng, looks, case.seen * flow)
        last, faulty = seen, t - case.fault_at
        seen = last if 0 <= faulty < case.stuck else np.clip(fresh, 15.0, 400.0)
        blind = np.full(n, 0 <= faulty < case.blind)
        reason = np.where(blind, actuation.FEW, actuation.still(np.float32(seen), np.float32(last)))
        shares = window_shares(seen, camera.spread)
        shown = _observation(shares, seen, since, temperature, sent.value[:, 1], acted)
        memory, action = _decided(controller, parameters, memory, shown, jnp.asarray(reason), keys)
        acts, clock = reason == actuation.ACTS, acted % 10 == 0
        wanted = np.stack(
            [
                np.asarray(FLOW_MOVES)[action.flow] * acts,
                np.asarray(TEMPERATURE_MOVES)[action.temperature] * (acts & clock),
            ],
            axis=1,
        )
        before, sent = sent.value, actuation.moved(sent, wanted, t * (wait_s + WINDOW_S), LIMITS)
        move = sent.value[:, 0] - before[:, 0]
        since = move + np.where(acts, 0.0, since)
        acted = acted + acts
        clog = _clogged(rng, case, t + 1, *clog)
        state, flow = printer.feed(rng, case, state, move, wait_s, clog[0])
        late = np.exp(-(wait_s + WINDOW_S) / HEATER_S)
        temperature = sent.value[:, 1] + (temperature - sent.value[:, 1]) * late
        steps.append((flow, temperature, move, reason))
    flows, temperatures, moves, reasons = (np.stack(a, axis=1) for a in zip(*steps, strict=True))
    return Runs(
        np.concatenate([start[:, :1], flows], axis=1), np.concatenate([start[:, 1:], temperatures], axis=1),
        moves, reasons,
    )  # fmt: skip


_decided = eqx.filter_jit(jax.vmap(actuation.decide, (None, None, 0, 0, 0, 0)))


def _observation(shares, seen, since, temperature, target, acted) -> Observation:
    floats = (jnp.asarray(a, jnp.float32) for a in (seen, since, temperature, target))
    named = jnp.asarray(shares.argmax(axis=1), jnp.int32)
    return Observation(jnp.asarray(shares, jnp.float32), named, *floats, jnp.asarray(acted, jnp.int32))


def _clogged(rng, case: Case, t: int, blockage, freed):
    """Blockage (n,) and when it goes, in decisions: at clog_at for good, or come and go."""
    n = len(blockage)
    comes, deep, lasts = rng.random(n) < case.come_and_go, rng.uniform(0.6, 0.85, n), rng.integers(10, 61, n)
    blockage = np.where((freed == t) & (blockage < 1), 1.0, blockage)
    comes &= blockage == 1.0
    blockage, freed = np.where(comes, deep, blockage), np.where(comes, t + lasts, freed)
    return np.where(t == case.clog_at, blockage * case.clog, blockage), freed
