"""Twenty heated machines of random size and speed under PI, under a printer firmware's PID and under a small
MPC, and with their inputs set by a plan: is feedback recognised, and what becomes of the gains?

`./run python -m benchmarks.closed_loop` prints the table and writes benchmarks/results/closed_loop.json; a
number behind it plays only so many machines. The truth is known: every heater warms every zone.
"""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.optimize

from benchmarks.foreign_records import levels, quantised
from pipeline.temperature.identification import Settings, identify
from pipeline.temperature.trust import forbidden_gains, steps
from pipeline.temperature.validation import bootstrap_spread

RESULTS = Path(__file__).parent / "results" / "closed_loop.json"
MACHINES, SAMPLES, ROOM = 20, 2400, 22.0


class Machine(NamedTuple):
    """Zones with a block and a sensor each, sampled once a second: heating in °C per percent and second, loss
    and exchange with the neighbours a second, sensor lag, dead time in samples, noise and step of the
    converter."""

    heating: np.ndarray
    loss: np.ndarray
    exchange: float
    lag: float
    delay: int
    noise: float
    step: float
    wander: float

    @property
    def zones(self) -> int:
        return len(self.heating)

    def dynamics(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """A, B, C of [blocks; sensors] about the room's temperature, without the dead time."""
        p = self.zones
        neighbours = np.eye(p, k=1) + np.eye(p, k=-1)
        blocks = (
            np.eye(p) - np.diag(self.loss) + self.exchange * (neighbours - np.diag(neighbours.sum(axis=1)))
        )
        A = np.block([[blocks, np.zeros((p, p))], [self.lag * np.eye(p), (1 - self.lag) * np.eye(p)]])
        return (
            A,
            np.vstack([np.diag(self.heating), np.zeros((p, p))]),
            np.hstack([np.zeros((p, p)), np.eye(p)]),
        )

    def gain(self) -> np.ndarray:
        """Steady gains (p, p) in °C per percent."""
        A, B, C = self.dynamics()
        return C @ np.linalg.solve(np.eye(len(A)) - A, B)


def machine(rng: np.random.Generator) -> Machine:
    p = int(rng.integers(1, 4))
    tau = rng.uniform(40, 250, p)
    return Machine(
        heating=rng.uniform(1.0, 3.0, p) / tau,
        loss=1 / tau,
        exchange=float(rng.uniform(0.1, 0.5) / tau.mean()),
        lag=float(rng.uniform(0.1, 0.5)),
        delay=int(rng.integers(0, 4)),
        noise=float(rng.uniform(0.03, 0.2)),
        step=float(rng.choice([0.0, 0.1, 0.25])),
        wander=float(rng.choice([0.0, 0.02])),
    )


class Pi:
    """PI a zone by SIMC on the zone's own first-order model, integrator held at the limits."""

    def __init__(self, plant: Machine):
        theta = plant.delay + 1 / plant.lag
        gain = np.diag(plant.gain())
        self.K = 1 / (gain * plant.loss * 2 * theta)
        self.reset = np.minimum(1 / plant.loss, 8 * theta)
        self.integral = np.zeros(plant.zones)

    def __call__(self, y: np.ndarray, r: np.ndarray) -> np.ndarray:
        e = r - y
        raw = self.K * (e + self.integral)
        self.integral = self.integral + np.where((raw > 0) & (raw < 100), e / self.reset, 0.0)
        return np.clip(raw, 0, 100)


class Pid(Pi):
    """The law of Klipper's ControlPID (heaters.py): derivative of the measured value smoothed over a second,
    the integral bounded and kept where the output is; a change below 5 % waits for up to 5 s, as its set_pwm
    does."""

    def __init__(self, plant: Machine):
        super().__init__(plant)
        self.Ki, self.Kd = self.K / self.reset, 0.5 * self.K * (plant.delay + 1 / plant.lag)
        self.last, self.sum, self.pwm = None, np.zeros(plant.zones), np.zeros(plant.zones)
        self.waits = np.zeros(plant.zones)

    def __call__(self, y: np.ndarray, r: np.ndarray) -> np.ndarray:
        derivative = np.zeros(len(y)) if self.last is None else y - self.last
        total = np.clip(self.sum + (r - y), 0, 100 / self.Ki)
        raw = self.K * (r - y) + self.Ki * total - self.Kd * derivative
        bounded = np.clip(raw, 0, 100)
        self.last, self.sum = y, np.where(raw == bounded, total, self.sum)
        moved = (np.abs(bounded - self.pwm) >= 5) | ((self.waits >= 4) & (self.pwm > 0))
        self.pwm, self.waits = np.where(moved, bounded, self.pwm), np.where(moved, 0, self.waits + 1)
        return self.pwm


class Mpc:
    """Least squares over 30 s with one input held, limits as bounds, on a model with 20 % too little heat,
    and an observer with one output disturbance a zone."""

    def __init__(self, plant: Machine):
        self.A, self.B, self.C = plant.dynamics()
        self.B, p = 0.8 * self.B, plant.zones
        A, free, moved, total = self.A, [], [], np.zeros_like(self.B)
        power = np.eye(len(A))
        for _ in range(30):
            total, power = A @ total + self.B, A @ power
            free.append(self.C @ power)
            moved.append(self.C @ total)
        self.free, self.moved = np.vstack(free), np.vstack(moved)
        self.x, self.d, self.u = np.zeros(len(A)), np.zeros(p), np.zeros(p)

    def __call__(self, y: np.ndarray, r: np.ndarray) -> np.ndarray:
        e = y - ROOM - self.C @ self.x - self.d
        self.x, self.d = self.x + self.C.T @ (0.2 * e), self.d + 0.05 * e
        p = len(y)
        right = np.tile(r - ROOM - self.d, 30) - self.free @ self.x
        rows = np.vstack([self.moved, 0.05 * np.eye(p)])
        best = scipy.optimize.lsq_linear(rows, np.r_[right, 0.05 * self.u], (0, 100), method="bvls")
        self.u = best.x
        self.x = self.A @ self.x + self.B @ self.u
        return self.u


CONTROLLERS: dict[str, Callable[[Machine], Callable]] = {"pi": Pi, "klipper_pid": Pid, "mpc": Mpc}
PLANS = ("steps", "prbs", "noise")


def planned(rng: np.random.Generator, kind: str, p: int) -> np.ndarray:
    """Inputs (T, p) that nobody changes for what is measured."""
    if kind == "steps":
        return levels(rng, SAMPLES, p, 120, 10, 60)
    if kind == "prbs":
        return 35.0 + 15.0 * np.sign(levels(rng, SAMPLES, p, 15, -1, 1))
    return 35.0 + 8.0 * rng.standard_normal((SAMPLES, p))


def record(rng: np.random.Generator, plant: Machine, how: str) -> tuple[np.ndarray, np.ndarray]:
    """u, y (T, p) of the machine under a controller or a plan, set-points moved now and then."""
    A, B, _ = plant.dynamics()
    p, law = plant.zones, CONTROLLERS[how](plant) if how in CONTROLLERS else None
    reachable = ROOM + 55 * plant.gain().sum(axis=1)
    r = ROOM + levels(rng, SAMPLES, p, 250, 0.35, 1.0) * (reachable - ROOM)
    plan = None if law else planned(rng, how, p)
    room = ROOM + plant.wander * np.cumsum(rng.standard_normal(SAMPLES))
    x, u, y = np.zeros(2 * p), np.zeros((SAMPLES, p)), np.empty((SAMPLES, p))
    for t in range(SAMPLES):
        y[t] = room[t] + x[p:] + plant.noise * rng.standard_normal(p)
        y[t] = quantised(y[t], plant.step) if plant.step else y[t]
        u[t] = law(y[t], r[t]) if law else plan[t]
        x = A @ x + B @ u[max(t - plant.delay, 0)]
    return u, y


def judged(i: int, how: str) -> dict:
    """One machine once: whether feedback was recognised, and how many of its gains, all positive in truth,
    came out negative and were flagged, or positive and were flagged all the same."""
    rng = np.random.default_rng([i, 7])
    plant = machine(rng)
    u, y = record(rng, plant, how)
    fitted = identify([u], [y], sample_time_s=1.0, settings=Settings(refinement="validated"))
    family = bootstrap_spread([u], [y], fitted, count=20, order=fitted.order + 1, rng=rng)
    p = plant.zones
    shown = steps(fitted.plant, family, len(u))
    names = [str(k) for k in range(p)]
    flagged = {(g.output, g.input) for g in forbidden_gains(shown, names, names, [True] * p, [100.0] * p)}
    wrong = {(str(o), str(j)) for o in range(p) for j in range(p) if shown.gain[0, o, j] < 0}
    error = np.abs(np.diag(shown.gain[0]) / np.diag(plant.gain()) - 1)
    return {
        "closed": bool(fitted.feedback.closed) if fitted.feedback else False,
        "wrong": len(wrong),
        "wrong_flagged": len(wrong & flagged),
        "right": p * p - len(wrong),
        "right_flagged": len(flagged - wrong),
        "gain_error_percent": round(100 * float(error.max()), 1),
    }


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else MACHINES
    result = {}
    for how in (*CONTROLLERS, *PLANS):
        rows = [judged(i, how) for i in range(count)]
        total = {name: sum(row[name] for row in rows) for name in rows[0] if name != "gain_error_percent"}
        median = float(np.median([row["gain_error_percent"] for row in rows]))
        result[how] = total | {"machines": count, "median_gain_error_percent": median}
        print(how, result[how], flush=True)
    if count == MACHINES:
        RESULTS.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
