"""Controllers of the flow on two printers of another structure, written apart in plain numpy: what they
spoil, settle, keep and recover, and whether the table of another camera is noticed.

`./run python -m benchmarks.foreign_printers [runs] [processes]` writes
benchmarks/results/foreign_printers.json; 2,000 runs a row are the whole. The filter's table is recorded from
the same camera on other segments, TABLES times, and every row takes its runs from all of them in equal parts;
intervals resample tables, and runs within them. Settings were tuned on other seeds (TUNED) than those
reported (REPORTED).

The bead printer: moves of the flow count by a gain, the melt follows by one time constant, and clogs close
and open at once. The camera misreads each stretch of 5 to 40 decisions by one normal bias, and each window by
another. The gear printer: what it feeds is a factor of what it is told, which drifts; the gear slips where
much is asked; the melt follows by two time constants, and clogs grow and wash out over decisions. Its camera
compresses the scale, drifts from one bias to the next along a line, and shows anything in one window of
fifty.

What 20 windows of another camera can tell, the bead printer's own against it, at rest: to find 95 % with 2 %
false alarms takes 3.5 nats of divergence by any test. Beside them what the best test would find that knows
the other camera and how long segments last, and spends its 2 % on these windows:

    noise twice             13.0 nats   97 %
    noise and bias twice    14.4        98
    three times             49.7       100
    scale and errors halved  6.2        98
    hardly follows the flow 22.1       100
    bias twice               1.0        29   no test finds it in 20 windows
    a factor on the flow     0           2   nor this one in any number, without a move that is known

If segments may be as short as a window, errors of hypot(bias, noise) are the table's own too, and noise twice
is told from those by 3.1 nats alone: less than the 3.5.
"""

import json
import os
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import joblib
import numpy as np
import scipy.stats

from pipeline.setpoint import actuation, bayes
from pipeline.setpoint.baselines import nearest, nothing, temperature_move
from pipeline.setpoint.published import FLOW_MOVES, TEMPERATURE_MOVES
from pipeline.setpoint.recorded import WindowTable
from pipeline.setpoint.simulator import Action, Controller, Observation
from pipeline.setpoint.workflow.settings import EvaluateSetpoint
from pipeline.store import params

RESULTS = Path(__file__).parent / "results" / "foreign_printers.json"
DECISIONS, WINDOW_S, HEATER_S = 200, 1.0, 15.0
LIMITS = actuation.Limits(
    np.array([20.0, 180.0]), np.array([310.0, 240.0]), np.array([10.0, 20.0]), np.array([100.0, 60.0])
)
START_FLOWS, START_TEMPERATURES = (30.0, 60.0, 80.0, 120.0, 150.0, 200.0, 300.0), (190.0, 210.0, 230.0)
IN_BAND = (92.5, 95.0, 97.5, 100.0, 102.5, 105.0, 107.5)
EDGES = np.r_[20, 30, 40, 50, 60, np.arange(70, 130.1, 2.5), 150, 180, 220, 260, 310]
TUNED, REPORTED = 100, 1


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


# ---- the bead printer


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


# ---- the gear printer


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


# ---- the loop


class Runs(NamedTuple):
    """flow and temperature (n, D + 1), before the first decision and after each; moves (n, D) of the flow as
    sent; reason (n, D) of actuation.REASONS."""

    flow: np.ndarray
    temperature: np.ndarray
    moves: np.ndarray
    reason: np.ndarray


def loop(
    printer: Printer, controller: Controller, parameters: Any, case: Case, n: int, *, seed: int,
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
        memory, action, reason = _decided(controller, parameters, memory, shown, jnp.asarray(reason), keys)
        reason = np.asarray(reason)
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
        since = move + np.where(actuation.is_evidence(reason), 0.0, since)
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


# ---- controllers without a table: of the flow seen


class Smoothed(NamedTuple):
    """band: percent of smoothed flow that is left alone; weight: of the newest window."""

    band: jax.Array
    weight: jax.Array


def _towards(smoothed: jax.Array, band: jax.Array, observation: Observation) -> Action:
    wrong = jnp.where(jnp.abs(smoothed - 100.0) > band, 100.0 - smoothed, 0.0)
    return Action(nearest(FLOW_MOVES, wrong), temperature_move(observation))


@cache
def ewma() -> Controller:
    """Exponentially weighted mean of the flow seen, which a move shifts by as much; Roberts 1959."""

    def act(parameters: Smoothed, memory, observation, key):
        mean, n = memory
        weight = jnp.maximum(parameters.weight, 1.0 / (n + 1.0))
        mean = mean + observation.flow_move
        mean = mean + weight * (observation.flow_seen - mean)
        ready = n >= 2
        action = _towards(jnp.where(ready, mean, 100.0), parameters.band, observation)
        return (mean, n + 1.0), action

    return Controller(lambda: (jnp.float32(100.0), jnp.float32(0.0)), act)


WIDEST = 16  # windows that a moving average may hold


@cache
def moving_average() -> Controller:
    """Mean of the last 1 / weight flows seen, each shifted by the moves since; it acts once it is full."""

    def act(parameters: Smoothed, memory, observation, key):
        seen, n = memory
        seen = jnp.append(seen[1:] + observation.flow_move, observation.flow_seen)
        length = jnp.round(1.0 / parameters.weight)
        counts = jnp.arange(WIDEST) >= WIDEST - length
        mean = jnp.where(counts, seen, 0.0).sum() / length
        full = n + 1.0 >= length
        return (seen, n + 1.0), _towards(jnp.where(full, mean, 100.0), parameters.band, observation)

    return Controller(lambda: (jnp.full(WIDEST, 100.0), jnp.float32(0.0)), act)


class Cusum(NamedTuple):
    """slack and limit in units of log flow."""

    slack: jax.Array
    limit: jax.Array


@cache
def cusum() -> Controller:
    """Two sums of log flow_seen / 100 % beyond the slack (Page 1954); past the limit it moves by the mean
    since the sum began, and begins anew."""

    def act(parameters: Cusum, memory, observation, key):
        x = jnp.log(observation.flow_seen / 100.0)
        up, down, n_up, n_down = memory
        up, down = jnp.maximum(0.0, up + x - parameters.slack), jnp.maximum(0.0, down - x - parameters.slack)
        n_up, n_down = jnp.where(up > 0, n_up + 1.0, 0.0), jnp.where(down > 0, n_down + 1.0, 0.0)
        high, low = up > parameters.limit, down > parameters.limit
        mean = jnp.where(high, up / jnp.maximum(n_up, 1.0), -down / jnp.maximum(n_down, 1.0))
        mean = mean + jnp.where(high, parameters.slack, -parameters.slack)
        wrong = jnp.where(high | low, 100.0 - 100.0 * jnp.exp(mean), 0.0)
        memory = jax.tree.map(lambda a: jnp.where(high | low, 0.0, a), (up, down, n_up, n_down))
        return memory, Action(nearest(FLOW_MOVES, wrong), temperature_move(observation))

    return Controller(lambda: (jnp.float32(0.0),) * 4, act)


# ---- rows


def starts(flows: tuple[float, ...], temperatures: tuple[float, ...] = (210.0,)) -> np.ndarray:
    return np.array([[q, u] for q in flows for u in temperatures])


PERFECT, BAND, FAR = starts((100.0,)), starts(IN_BAND), starts(START_FLOWS, START_TEMPERATURES)
LAGS = {"melt_s": 3.0, "waits_s": (3.0, 6.0), "gain": (0.5, 1.2), "gain_wander": 0.02}
CASES = {
    "perfect start": Case(PERFECT),
    "in-band starts": Case(BAND),
    "in-band starts, stuck 30": Case(BAND, stuck=30),
    "in-band starts, blind 30": Case(BAND, blind=30),
    "in-band starts, stuck 30 from the start": Case(BAND, stuck=30, fault_at=1),
    "21 starts": Case(FAR),
    "clog to 0.6": Case(FAR, clog=0.6),
    "clog to 0.75": Case(PERFECT, clog=0.75),
    "borders -8 %": Case(FAR, seen=1 / 0.92),
    "borders +8 %": Case(FAR, seen=1 / 1.08),
    "lag and gain drift": Case(FAR, **LAGS),
    "clogs come and go": Case(FAR, come_and_go=0.01),
    "stuck 30": Case(FAR, stuck=30),
    "blind 30": Case(FAR, blind=30),
    "everything": Case(FAR, seen=1 / 1.04, come_and_go=0.01, stuck=15, **LAGS),
}


def figures(runs: Runs, case: Case) -> dict[str, Any]:
    """Shares in percent. beyond: from 100 %, ever in the episode; settled, stay and recovered as in score;
    back: within 15 % again from 30 decisions after a clog until 60 after; foreign: held as the camera is not
    the table's, ever and within 20 decisions. recovered_median in decisions after the clog."""
    miss, inside = np.abs(runs.flow - 100), _inside(runs)
    good = outcomes(runs, case)
    back = np.array([_since(one[case.clog_at :]) for one in (miss <= 15 + 1e-3)[:, :121]])
    again = np.array([_since(one[case.clog_at :]) for one in inside[:, :121]])
    held = runs.reason == actuation.TABLE
    share = {
        "beyond_10": (miss > 10 + 1e-3).any(axis=1),
        "beyond_25": (miss > 25 + 1e-3).any(axis=1),
        **dict(zip(("beyond_15", "settled", "stay", "recovered"), good.T, strict=True)),
        "back_15": back <= 30,
        "foreign": held.any(axis=1),
        "foreign_20": held[:, :20].any(axis=1),
    }
    recovered = good[:, 3]
    return {name: round(100 * float(a.mean()), 2) for name, a in share.items()} | {
        "recovered_median": float(np.median(again[recovered])) if recovered.any() else None,
        "moves_per_100": round(100 * float((runs.moves != 0).mean()), 2),
    }


def _inside(runs: Runs) -> np.ndarray:
    """(n, D + 1) whether within 90-110 % and 210 +- 5 °C."""
    return (np.abs(runs.flow - 100) <= 10 + 1e-3) & (np.abs(runs.temperature - 210) <= 5 + 1e-3)


def outcomes(runs: Runs, case: Case) -> np.ndarray:
    """(n, 4) of each run: ever beyond 15 %, settled, stayed, recovered."""
    inside = _inside(runs)
    settled, recovered = inside[:, 90:101].all(axis=1), inside[:, 90:121].all(axis=1)
    beyond = (np.abs(runs.flow - 100) > 15 + 1e-3).any(axis=1)
    return np.stack([beyond, settled, settled & inside[:, 100:].all(axis=1), recovered], axis=1)


def _since(inside: np.ndarray) -> int:
    """The first step from which all is inside; the length where it ends outside."""
    return int(len(inside) - np.argmin(np.r_[inside[::-1], False]))


SMOOTHED = {
    "EWMA": (ewma(), Smoothed(jnp.float32(6.0), jnp.float32(0.1))),
    "moving average": (moving_average(), Smoothed(jnp.float32(6.0), jnp.float32(1 / 12))),
    "CUSUM": (cusum(), Cusum(jnp.float32(0.07), jnp.float32(0.5))),
    "nothing": (nothing(), ()),
}
TABLES, SEGMENTS, WINDOWS = 4, 400, 8  # of the filter
ANOTHER = {  # cameras that the bead printer's table is not of
    "its own": bead_camera(),
    "noise twice": bead_camera(noise=0.1),
    "noise and bias twice": bead_camera(bias=0.1, noise=0.1),
    "noise and bias three times": bead_camera(bias=0.15, noise=0.15),
    "bias twice": bead_camera(bias=0.1),
    "scale and errors halved": bead_camera(bias=0.025, noise=0.025, scale=0.5),
    "hardly follows the flow": bead_camera(bias=0.01, noise=0.01, scale=0.1),
    "the gear printer's": gear_camera(),
}


def filters(printer: Printer, *, seed: int) -> list[tuple[Controller, Any]]:
    """The filter of params.expert.yaml on TABLES tables of the printer's own camera."""
    section = params.load(EvaluateSetpoint, "evaluate_setpoint").baselines.bayes_robust
    model, made = bayes.CameraErrorModel(**section.model_dump()), []
    for k in range(TABLES):
        rng = np.random.default_rng([seed, k])
        table = recorded_table(printer.camera, rng, segments=SEGMENTS, windows=WINDOWS)
        fitted = bayes.watching_filter(table, model)
        parameters = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), fitted)
        made.append((bayes.bayes(section.hypotheses()), parameters))
    return made


def row(contestants: list[tuple[Controller, Any]], printer: Printer, case: Case, runs: int, *, seed: int):
    """Figures of `runs` runs in equal parts by each of the contestants, which differ by their tables; the
    interval holds 95 % of resamplings of tables and of runs within them."""
    each = runs // len(contestants)
    parts = [
        loop(printer, *contestant, case, each, seed=1000 * seed + k)
        for k, contestant in enumerate(contestants)
    ]
    together = Runs(*(np.concatenate(field) for field in zip(*parts, strict=True)))
    found, spread, rng = figures(together, case), [], np.random.default_rng(0)
    good = [outcomes(part, case) for part in parts]
    for _ in range(200):
        drawn = [good[k] for k in rng.integers(len(good), size=len(good))]
        drawn = [one[rng.integers(each, size=each)] for one in drawn]
        spread.append(100 * np.concatenate(drawn).mean(axis=0))
    low, high = np.percentile(spread, [2.5, 97.5], axis=0).round(1)
    names = ("beyond_15", "settled", "stay", "recovered")
    return {"runs": each * len(parts)} | found | {
        f"{name}_95": [low[i], high[i]] for i, name in enumerate(names)
    }  # fmt: skip


@cache
def contestants(name: str) -> dict[str, list[tuple[Controller, Any]]]:
    """By rule the controllers on the printer of this name, those of the filter by table."""
    robust = {"Bayes, robust": filters(PRINTERS[name], seed=REPORTED)}
    return robust | {rule: [pair] for rule, pair in SMOOTHED.items()}


def asked(name: str, title: str, rule: str, runs: int) -> dict[str, Any]:
    """The row of one rule in one case."""
    return row(contestants(name)[rule], PRINTERS[name], CASES[title], runs, seed=REPORTED)


def foreign(title: str, start: str, runs: int) -> dict[str, Any]:
    """The row of the bead printer's filters with the camera of this title."""
    other = PRINTERS["bead"]._replace(camera=ANOTHER[title])
    return row(contestants("bead")["Bayes, robust"], other, CASES[start], runs, seed=REPORTED)


def main(runs: int, processes: int) -> None:
    report: dict[str, Any] = {
        "command": f"./run python -m benchmarks.foreign_printers {runs}",
        "tables": TABLES,
        "rows": {},
        "another_camera": {},
    }
    rules = ("Bayes, robust", *SMOOTHED)
    rows = [(name, title, rule) for rule in rules for name in PRINTERS for title in CASES]
    cameras = [(title, start) for title in ANOTHER for start in ("perfect start", "21 starts")]
    calls = [joblib.delayed(asked)(*one, runs) for one in rows]
    calls += [joblib.delayed(foreign)(*one, runs // 2) for one in cameras]
    done = joblib.Parallel(processes, return_as="generator")(calls)
    for one, found in zip([*rows, *cameras], done, strict=True):
        if len(one) == 3:
            name, title, rule = one
            report["rows"].setdefault(f"{name}: {title}", {})[rule] = found
            print(*one, *(found[k] for k in ("beyond_10", "beyond_15", "settled", "stay")), flush=True)
        else:
            report["another_camera"].setdefault(one[0], {})[one[1]] = found
            print(*one, *(found[k] for k in ("foreign", "foreign_20")), flush=True)
        RESULTS.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    numbers = [int(a) for a in sys.argv[1:]]
    # by its name, so that other processes find it
    from benchmarks import foreign_printers

    foreign_printers.main(*(numbers + [2000, os.cpu_count() or 1][len(numbers) :]))
