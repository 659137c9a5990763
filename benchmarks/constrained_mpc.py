"""The governed laws beside constrained model predictive control by a maintained solver, where an output limit
lies 3 °C above the reference: how long each takes to settle, and how often it crosses the limit.

`./run --with daqp==0.7.2 python -m benchmarks.constrained_mpc` prints the figures beside the bars and writes
benchmarks/results/constrained_mpc.json. Every controller plays the same 60 plants of the panel from 20 °C and
from 90 °C. DAQP (Arnstrom, Bemporad, Axehill 2022) solves a quadratic programme each step. All MPC is told
the state of the heated cells without noise.

* nominal: its model is the nominal plant, in time.
* family: it keeps the limit for weakest and strongest, in time and late: what the governor guards. The bar.
* told: it is told each plant and all its state, as no controller of a machine is: what inputs allow at all.

The governed laws measure with noise of 0.1 °C and know the record only. Their weights are not searched: the
study's identity, with the best of four integrators tried on this panel (0.02 to 0.2 of the error a step). The
governor's own constants were set on these 60 plants too; tests/temperature/test_governor.py has others.
"""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import daqp
import numpy as np

from pipeline.store import artifacts
from pipeline.temperature import baseline, kernel, panel, tracking, window
from pipeline.temperature import plant as plants_of
from pipeline.temperature.controller import Limits, deployed
from pipeline.temperature.governor import OutputLimits, governor
from pipeline.temperature.plant import Plant
from pipeline.temperature.published import REFERENCE

RESULTS = Path(__file__).parent / "results" / "constrained_mpc.json"
DATASETS = Path("datasets")
SPREAD = panel.Spread(input_gain=0.15, slower=0.2, extra_heat_loss=0.005, delayed=0.5, ambient_degC=8.0)
LIMITS = Limits(np.zeros(7), np.full(7, 100.0), np.full(7, np.inf))
STARTS = np.array([[20.0] * 5, [90.0] * 5])
NOISE, ABOVE, BAND, STEPS, MPC_STEPS, AHEAD, GAMMA = 0.1, 3.0, 1.0, 300, 150, 6, 0.99


def panel_cases() -> panel.Cases:
    plants = panel.drawn([plants_of.baam()], 60, SPREAD, cells=True, rng=np.random.default_rng(1))
    questions = panel.Questions(STARTS, REFERENCE[None], None, None, None)
    noise = np.full(5, NOISE)
    return panel.asked(plants, questions, noise=noise, seed=1, steps=STEPS, hold=30, cells=True)


# ---- the governed laws


def governed_laws(cases: panel.Cases) -> dict[str, dict]:
    """Figures of each law with its governor, as the artifacts of the last run have them."""
    read = artifacts.read_arrays
    model = plants_of.restored(read(DATASETS / "identify_plant" / "plant.parquet", "plant", 1))[0]
    model = plants_of.strictly_proper(model)
    learned = window.restored(read(DATASETS / "learn_kernel" / "window.parquet", "window", 1))
    H = kernel.restored(read(DATASETS / "learn_kernel" / "kernel.parquet", "kernel", 1))
    contestants = {
        "subspace_lqg": tracking.model_based(model, GAMMA, tau=1.0),
        "varx_riccati": window.controller(learned, GAMMA),
        "learned_kernel": kernel.controller(H, GAMMA, window.predictor(learned)),
        "pi_simc": baseline.controller(model, (LIMITS.low, LIMITS.high), horizon=600),
    }
    family, strength = panel.corners([model], SPREAD)
    outputs = OutputLimits(np.full(5, -np.inf), REFERENCE + ABOVE, np.full(5, 3 * NOISE), 0.5)
    guard = governor(family, LIMITS, outputs, strength)
    results = {}
    for name, contestant in contestants.items():
        law = contestant.design(np.ones(5), np.ones(7), 0.2)
        ready = deployed(law, LIMITS, integral_limit=1.0, governor=guard)
        at = panel.rests(contestant.model, cases, LIMITS)
        rollout = panel.rolled_out(ready, cases, panel.aims(law, at, cases))
        results[name] = figures_of(rollout.y, rollout.u)
    return results


# ---- model predictive control


class Member(NamedTuple):
    """How outputs of one model answer over AHEAD steps: free (AHEAD p, n) of the state, drift (AHEAD p, n) of
    what is added to the state every step, response (AHEAD p, AHEAD m) of the inputs."""

    model: Plant
    free: np.ndarray
    drift: np.ndarray
    response: np.ndarray


def member(model: Plant) -> Member:
    n, m, p = model.n, model.m, model.p
    power, summed = np.eye(n), np.zeros((n, n))
    free, drift, response = np.zeros((AHEAD, p, n)), np.zeros((AHEAD, p, n)), np.zeros((AHEAD, p, AHEAD, m))
    for h in range(AHEAD):
        for k in range(AHEAD - h):
            response[k + h, :, k] = model.C @ power @ model.B
        summed = summed + power
        power = model.A @ power
        free[h], drift[h] = model.C @ power, model.C @ summed
    return Member(model, free.reshape(-1, n), drift.reshape(-1, n), response.reshape(AHEAD * p, AHEAD * m))


class Predictive:
    """min over u within 0 to 100 percent of the sum over members, and AHEAD steps, of |y - r|^2, and of 1e-3
    |u - u_target|^2, each member's outputs at most the limit, or where they would be without input."""

    def __init__(self, models: list[Plant]):
        self.members = [member(model) for model in models]
        self.rows = np.vstack([one.response for one in self.members])
        inputs = self.rows.shape[1]
        self.H = 2 * (self.rows.T @ self.rows + 1e-3 * np.eye(inputs))
        self.sense = np.zeros(inputs + len(self.rows), np.int32)

    def input(self, states: list[np.ndarray], rests: list[np.ndarray]) -> np.ndarray:
        """u (m,) at the members' states (n,), where `rests` (n,) are added to them every step."""
        m, inputs = self.members[0].model.m, self.rows.shape[1]
        free = np.concatenate(
            [
                one.free @ x + one.drift @ rest + np.tile(one.model.d, AHEAD)
                for one, x, rest in zip(self.members, states, rests, strict=True)
            ]
        )
        aim = np.tile(held(self.members[0].model, rests[0]), AHEAD)
        f = 2 * (self.rows.T @ (free - np.tile(REFERENCE, len(free) // len(REFERENCE))) - 1e-3 * aim)
        most = np.maximum(np.tile(REFERENCE + ABOVE, len(free) // len(REFERENCE)) - free, 0.05)
        upper = np.r_[np.full(inputs, 100.0), most]
        lower = np.r_[np.zeros(inputs), np.full(len(most), -1e30)]
        u, _, flag, _ = daqp.solve(self.H, f, self.rows, upper, lower, self.sense)
        if flag != 1:
            raise ValueError(f"DAQP ended with flag {flag}: expected 1, solved")
        return np.clip(u[:m], 0.0, 100.0)


def held(model: Plant, rest: np.ndarray) -> np.ndarray:
    """The input of least norm that holds the model at the reference under a drift of `rest` (n,) a step, cut
    to the limits."""
    balance = np.eye(model.n) - model.A
    per_u, at_rest = np.linalg.solve(balance, model.B), np.linalg.solve(balance, rest)
    return np.clip(np.linalg.pinv(model.C @ per_u) @ (REFERENCE - model.d - model.C @ at_rest), 0.0, 100.0)


def predictive(cases: panel.Cases, models: Callable[[Plant], list[Plant]]) -> dict:
    """Figures of the panel under MPC whose members for each plant are models(plant). It is told the heated
    cells; what a member's forecast of them missed is a drift to it, a fifth of the news a step, and of 1 °C
    at most: more belongs to gains and delays."""
    y = np.empty((MPC_STEPS, len(cases.plant), 5))
    u = np.empty((MPC_STEPS, len(cases.plant), 7))
    cells = plants_of.baam().n
    for case, which in enumerate(cases.plant):
        truth = cases.plants[which]
        mpc = Predictive(models(truth))
        x, before = cases.x0[case], cases.u0[case]
        drifts = [np.zeros(one.model.n) for one in mpc.members]
        for t in range(MPC_STEPS):
            y[t, case] = truth.C @ x + truth.d
            states = [np.r_[x[:cells], before][: one.model.n] for one in mpc.members]
            rests = [one.model.b + drift for one, drift in zip(mpc.members, drifts, strict=True)]
            before = u[t, case] = mpc.input(states, rests)
            x = truth.A @ x + truth.B @ before + truth.b
            for one, state, drift in zip(mpc.members, states, drifts, strict=True):
                forecast = one.model.A @ state + one.model.B @ before + one.model.b + drift
                drift[:cells] += 0.2 * np.clip(x[:cells] - forecast[:cells], -1.0, 1.0)
    return figures_of(y, u)


def scaled(plant: Plant, strength: float, late: bool) -> Plant:
    return panel.delayed(plant._replace(B=strength * plant.B), late)


def whole_family() -> list[Plant]:
    """The nominal plant, then weakest and strongest, in time and a sample late: what the governor guards."""
    _, strength = panel.corners([plants_of.baam()], SPREAD)
    range_ = (strength.weakest, strength.strongest)
    return [panel.delayed(plants_of.baam(), False)] + [
        scaled(plants_of.baam(), factor, late) for factor in range_ for late in (False, True)
    ]


def figures_of(y: np.ndarray, u: np.ndarray) -> dict:
    """Settling in steps: median, 90 % quantile and worst (null: never), overshoot and crossings in °C, of
    outputs y (steps, s, p) under inputs u (steps, s, m)."""
    off = y - REFERENCE
    outside = np.abs(off).max(axis=2) > BAND
    settling = np.where(outside.any(axis=0), len(y) - outside[::-1].argmax(axis=0), 0).astype(float)
    settling[outside[-1]] = np.inf
    over = off.max(axis=(0, 2))
    at = {
        name: float(np.quantile(settling, level, method="inverted_cdf"))
        for name, level in (("median", 0.5), ("q90", 0.9), ("worst", 1.0))
    }
    return {
        "settling_s": {name: value if np.isfinite(value) else None for name, value in at.items()},
        "overshoot_degC": {"median": round(float(np.median(over)), 3), "worst": round(float(over.max()), 3)},
        "crossings": {"cases": int((over > ABOVE).sum()), "of": len(over)},
        "input_beyond_limits_percent": float(max(0.0, (u - 100.0).max(), (-u).max())),
    }


def main() -> None:
    cases, results = panel_cases(), {}
    for name, models in (
        ("nominal", lambda _: [plants_of.baam()]),
        ("family", lambda _: whole_family()),
        ("told", lambda truth: [truth]),
    ):
        began = time.perf_counter()
        results[name] = predictive(cases, models)
        print("MPC,", name, results[name], f"{time.perf_counter() - began:.0f} s", flush=True)
    laws = governed_laws(cases)
    bar = {key: 1.3 * (value or np.inf) for key, value in results["family"]["settling_s"].items()}
    for name, figures in laws.items():
        settling = figures["settling_s"]
        figures["within_bar"] = {key: bool((settling[key] or np.inf) <= bar[key]) for key in bar}
        print(name, figures)
    RESULTS.write_text(
        json.dumps({"solver": "daqp 0.7.2", "mpc": results, "governed": laws}, indent=1) + "\n"
    )


if __name__ == "__main__":
    main()
