"""Published figures of the agent of Li and Pattinson (2025) on their simulator, compared with agents trained
here."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from pipeline.setpoint.agents import agent
from pipeline.setpoint.agents.agent import JUDGED_SEED, RUNS, run_starts
from pipeline.setpoint.agents.score import judge
from pipeline.setpoint.simulation.simulator import Trajectory, nominal, paper_windows, rollout

# decisions of a run from a single start, and the last ones, over which the resting flow is averaged
SHOWN, RESTING = 100, 20


def simulated_figures(networks: Sequence[agent.QNetwork]) -> dict[str, dict[str, Any]]:
    """Returns figures of the networks after three phases and after the last, from the 21 starts, with the
    class always right and right with probability 0.7."""
    cases = {"phase3": (2, 1.0), "phase4": (3, 0.7), "phase4_at_1": (3, 1.0), "phase3_at_0.7": (2, 0.7)}
    return {
        name: _figures(run_starts(networks[i], accuracy=accuracy))
        for name, (i, accuracy) in cases.items()
        if i < len(networks)
    }


def run_start(network: agent.QNetwork, flow: float, temperature: float, *, accuracy: float) -> Trajectory:
    """Simulates RUNS runs of SHOWN decisions from one start in percent and °C, with the random seed of
    `run_starts`."""
    key, conditions = (
        jax.random.key(JUDGED_SEED),
        nominal(np.full(RUNS, flow), temperature, accuracy=accuracy),
    )
    return rollout(agent.published(network), network, paper_windows(), conditions, key, steps=SHOWN)


def compare_starts(networks: Sequence[agent.QNetwork], *, accuracy: float) -> dict[str, dict[str, Any]]:
    """Returns what Li and Pattinson (2025) publish for single starts (sections 3.3 and 3.4, figures 7 and 8),
    and the medians of RUNS runs of ours, in percent of flow and °C. `accuracy`: of the last phase.

    `rests_at`: mean flow of the last decisions; `least` and `most`: of the flow after it first came within 10
    % of 100 %; `flow_range` and `temperature_range`: largest minus smallest over the second half of the run.
    """
    last = networks[-1]
    printed = {
        "300 %, 230 °C": ({"rests_at": 95.0, "least": 75.0, "most": 130.0}, last, 300.0, 230.0, accuracy),
        "30 %, 190 °C": ({"rests_at": 100.0, "most": 130.0}, last, 30.0, 190.0, accuracy),
    } | {
        f"232 %, 190 °C after phase {number}": (claim, networks[number - 1], 232.0, 190.0, 1.0)
        for number, claim in (
            (1, {}),
            (2, {"temperature_range": 0.0}),
            (3, {"flow_range": 0.0, "temperature_range": 0.0}),
        )
    }
    compared = {}
    for name, (claim, network, flow, temperature, right) in printed.items():
        path = run_start(network, flow, temperature, accuracy=right)
        compared[name] = {
            "printed": claim,
            "measured": measure_runs(np.asarray(path.flow, float), np.asarray(path.temperature, float)),
        }
    return compared


def measure_runs(flow: np.ndarray, temperature: np.ndarray) -> dict[str, float | None]:
    """Returns the medians of `compare_starts` for runs (n, steps + 1)."""
    q, u = flow, temperature
    since = np.maximum.accumulate(np.abs(q - 100.0) <= 10.0 + 1e-3, axis=1)
    came, half = since.any(axis=1), (q.shape[1] - 1) // 2
    least, most = (
        float(np.median(bound(np.where(since, q, fill), axis=1)[came])) if came.any() else None
        for bound, fill in ((np.min, np.inf), (np.max, -np.inf))
    )
    return {
        "rests_at": float(np.median(q[:, -RESTING:].mean(axis=1))),
        "least": least,
        "most": most,
        "flow_range": float(np.median(np.ptp(q[:, half:], axis=1))),
        "temperature_range": float(np.median(np.ptp(u[:, half:], axis=1))),
    }


def parameters(network: Any) -> int:
    """Returns the number of parameters of a network."""
    return sum(np.size(leaf) for leaf in jax.tree.leaves(network))


def _figures(path: Trajectory) -> dict[str, Any]:
    score = judge(np.asarray(path.flow), np.asarray(path.temperature))
    steps = {
        name: float(value) if np.isfinite(value) else None
        for name, value in (("median_steps", score.median_steps), ("p90_steps", score.p90_steps))
    }
    return {
        "runs": score.runs,
        "settled": score.settled.percent,
        "settled_low": score.settled.low,
        "stay": score.stay.percent,
        "overshoot_p95": score.overshoot_p95,
        **steps,
    }
