"""The governor where sensors lag behind what heats them: heat that is on its way peaks in a sensor sooner
than a pulse from now does. The machines are written apart, in joules and watts, and differ from the model."""

from typing import NamedTuple

import numpy as np
import pytest
import scipy.linalg

from pipeline.temperature import tracking
from pipeline.temperature.controllers import governor as governing
from pipeline.temperature.controllers.governor import OutputLimits, governor
from pipeline.temperature.controllers.law import (
    ActuatorLimits,
    Governor,
    RunningController,
    Strength,
    corrected,
    deployed,
    governed,
    predicted,
    started,
)
from pipeline.temperature.plant import Plant, plant

ROOM, NOISE, MARGIN, SUBSTEPS = 22.0, 0.1, 0.3, 20


class Blocks(NamedTuple):
    """Blocks in a row, each with its heater and, behind `lags_s`, its sensor; J/K, W/K, W, s. `late`: samples
    by which the heaters act late."""

    zones: int
    lags_s: tuple[float, ...]
    capacity: float = 20.0
    loss: float = 0.15
    between: float = 0.1
    power: float = 40.0
    sample_time_s: float = 1.0
    late: int = 0


MACHINES = {
    "one lag": Blocks(1, (8.0,)),
    "two zones": Blocks(2, (8.0,)),
    "two lags, three zones": Blocks(3, (4.0, 10.0)),
    "dead time": Blocks(2, (6.0,), late=5),
    "four zones": Blocks(4, (12.0,), sample_time_s=2.0),
    "quick heater": Blocks(1, (8.0,), power=160.0),
    "bed": Blocks(1, (25.0,), capacity=600.0, loss=1.0, power=300.0, sample_time_s=2.0),
}


def model(of: Blocks) -> Plant:
    """What identification at its best would give: exact matrices of the blocks as they are declared."""
    k, lags = of.zones, len(of.lags_s)
    n = k * (1 + lags)
    A, B = np.zeros((n, n)), np.vstack([np.eye(k) * of.power / 100, np.zeros((k * lags, k))]) / of.capacity
    chain = np.diag(np.full(k - 1, of.between), 1) + np.diag(np.full(k - 1, of.between), -1)
    A[:k, :k] = (chain - np.diag(of.loss + chain.sum(axis=1))) / of.capacity
    for i, lag in enumerate(of.lags_s, start=1):
        rows = slice(i * k, (i + 1) * k)
        A[rows, (i - 1) * k : i * k], A[rows, rows] = np.eye(k) / lag, -np.eye(k) / lag
    moved = scipy.linalg.expm(of.sample_time_s * np.block([[A, B], [np.zeros((k, n + k))]]))[:n]
    A, B, C = moved[:, :n], moved[:, n:], np.eye(n)[-k:]
    for _ in range(of.late):
        A = np.block([[A, B], [np.zeros((k, A.shape[1] + k))]])
        B = np.vstack([np.zeros((len(A) - k, k)), np.eye(k)])
        C = np.hstack([C, np.zeros((k, k))])
    return plant(A, B, C, d=np.full(k, ROOM), sample_time_s=of.sample_time_s)


class Machine:
    """The blocks step by step, heaters `gain` times as strong as declared, lags `lag` times as long."""

    def __init__(self, of: Blocks, rest: np.ndarray, *, gain: float, lag: float):
        self.of, self.gain, self.lags = of, gain, [lag * one for one in of.lags_s]
        self.block = rest.copy()
        self.behind = [rest.copy() for _ in of.lags_s]
        self.way = [self.held(rest) for _ in range(of.late)]

    def held(self, y: np.ndarray) -> np.ndarray:
        """The inputs that hold blocks at y."""
        watts = self.of.loss * (y - ROOM) - self.exchanged(y)
        return 100 * watts / (self.gain * self.of.power)

    def exchanged(self, block: np.ndarray) -> np.ndarray:
        flow = self.of.between * np.diff(block)
        return np.append(flow, 0.0) - np.append(0.0, flow)

    def heat(self, u: np.ndarray) -> np.ndarray:
        """The sensors a sample on."""
        self.way.append(u)
        watts = self.gain * self.of.power * self.way.pop(0) / 100
        dt = self.of.sample_time_s / SUBSTEPS
        for _ in range(SUBSTEPS):
            behind = self.block
            loss = self.of.loss * (self.block - ROOM)
            self.block = self.block + dt * (watts - loss + self.exchanged(self.block)) / self.of.capacity
            for i, lag in enumerate(self.lags):
                self.behind[i] = self.behind[i] + dt * (behind - self.behind[i]) / lag
                behind = self.behind[i]
        return self.behind[-1]


def level(of: Blocks) -> float:
    """°C that 60 % of full power hold, 260 at most."""
    return min(ROOM + 0.6 * of.power / of.loss, 260.0)


def guard(of: Blocks, high: float) -> Governor:
    """Limits with three standard deviations of margin; inputs act 0.85 to 1.15 times as declared."""
    k = of.zones
    limits = ActuatorLimits(np.zeros(k), np.full(k, 100.0), np.full(k, np.inf))
    outputs = OutputLimits(np.full(k, -np.inf), np.full(k, high), np.full(k, MARGIN), 0.5)
    return governor([model(of)], limits, outputs, Strength(0.85, 1.15, 0.1))


def greedy(of: Blocks, *, gain: float, seconds: float = 450.0) -> np.ndarray:
    """Sensors (T, p) less their limit, while a law asks for full power all the time."""
    high, k, rng = level(of), of.zones, np.random.default_rng(4)
    family = guard(of, high)
    rest = np.full(k, ROOM + 0.4 * (high - ROOM))
    machine = Machine(of, rest, gain=gain, lag=1.0)
    memory, y, out = started(family, rest[None]), rest, []
    target = np.full((1, k), high + 20.0)
    low, most = np.zeros((1, k)), np.full((1, k), 100.0)
    for t in range(int(seconds / of.sample_time_s)):
        memory = corrected(family, memory, (y + NOISE * rng.standard_normal(k))[None])
        u = machine.held(rest)[None] if t < 25 else governed(family, memory, most, target, low, most)
        memory = predicted(family, memory, u)
        y = machine.heat(u[0])
        out.append(y - high)
    return np.array(out)


@pytest.mark.parametrize("name", MACHINES)
def test_full_power_is_stopped_below_the_limit(name: str):
    """The margin of 0.3 °C is for noise of 0.1: at most a noise deviation beyond what is declared."""
    worst = [greedy(MACHINES[name], gain=gain).max() for gain in (0.87, 1.14)]
    assert max(worst) <= NOISE
    # it is used: what is not dared is at most what the strength leaves open
    assert max(worst) > -1.0


def test_who_looks_from_the_peak_of_a_pulse_on_crosses_by_degrees(monkeypatch):
    """The bar above has teeth: it is missed twenty times over."""
    monkeypatch.setattr(governing, "REACHED", 1.0)
    monkeypatch.setattr(governing, "SHOULDER", 0.0)
    assert greedy(MACHINES["two zones"], gain=1.0).max() > 20 * NOISE


class Run(NamedTuple):
    """What a run came to: °C beyond limit and target at most; samples to the band of 1 °C; mean move of an
    input a sample in the last third, percent."""

    beyond_limit: float
    overshoot: float
    settled: int
    restless: float


def controlled(of: Blocks, *, effort: float, gain: float, lag: float, watched: bool) -> Run:
    """A linear-quadratic law from cold to a target 3 °C below its limit."""
    target, k, rng = np.full(of.zones, level(of)), of.zones, np.random.default_rng(5)
    known = model(of)
    design = tracking.model_based(known, np.ones(k), np.full(k, effort), 0.05, gamma=0.99, tau=1.0)
    limits = ActuatorLimits(np.zeros(k), np.full(k, 100.0), np.full(k, np.inf))
    watch = guard(of, level(of) + 3.0) if watched else None
    running = RunningController(deployed(design, limits, integral_limit=1.0, governor=watch), known)
    rest = np.full(k, ROOM + 0.3 * (level(of) - ROOM))
    machine = Machine(of, rest, gain=gain, lag=lag)
    y, hold, ys, us = rest, machine.held(rest), [], []
    for t in range(int(500 * (1 + of.late / 10))):
        seen = y + NOISE * rng.standard_normal(k)
        if t < 25:
            u = hold
            running.watch(u, seen, seen)
        else:
            if t == 25:
                running.hand_over(seen)
            u = running.step(seen, target, t)
        y = machine.heat(u)
        ys.append(y - target)
        us.append(u)
    ys, third = np.array(ys), len(us) // 3
    off = np.flatnonzero(np.abs(ys).max(axis=1) > 1.0)
    moves = np.abs(np.diff(us[-third:], axis=0)).mean()
    return Run(ys.max() - 3.0, ys.max(), int(off[-1]) + 1, float(moves))


@pytest.mark.parametrize("name", ["two zones", "two lags, three zones", "dead time"])
@pytest.mark.parametrize("effort", [0.1, 1e-4])
def test_a_law_is_kept_from_its_limit_settles_no_later_and_rests_as_quietly(name: str, effort: float):
    """Heaters 10 % stronger and lags 15 % longer than the model; without its governor the law crosses."""
    of = MACHINES[name]
    alone, watched = (
        controlled(of, effort=effort, gain=1.1, lag=1.15, watched=watched) for watched in (False, True)
    )
    assert alone.beyond_limit > 1.0
    assert watched.beyond_limit <= 0.0
    assert watched.overshoot < 0.6 * alone.overshoot
    assert watched.settled <= alone.settled
    # what noise makes of the law's own gains, once it has arrived
    assert watched.restless <= 1.05 * alone.restless + 0.01


def test_a_lag_outside_the_declared_spread_costs_two_degrees_where_a_heater_is_quick():
    """4 °C a second and a lag 15 % longer than the model's: what the README says is not promised."""
    of = MACHINES["quick heater"]
    alone, watched = (
        controlled(of, effort=1e-4, gain=1.12, lag=1.15, watched=watched) for watched in (False, True)
    )
    assert alone.beyond_limit > 10.0
    assert 0.0 < watched.beyond_limit < 2.0
