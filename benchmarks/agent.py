"""The agents over training seeds, each judged on windows that nothing was fitted to, and the speed of training beside stable-baselines3's.

`./run python -m benchmarks.agent 5 100` trains with seeds 0 .. 4 by the numbers of params.yaml, judges 21 starts x 100 runs in every case, prints every seed and the
worst, and writes benchmarks/results/agent.json. A third argument is the python of an environment with stable-baselines3 and a CPU build of torch, which then trains
a DQN of the same sizes in the same run. Recorded windows are synthetic ones: drawn with one generator to learn from, with another to judge on.
"""

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

from pipeline import params, teaching
from pipeline.setpoint import agent, belief_agent, judging
from pipeline.setpoint.recorded import recorded_windows, synthetic_table
from pipeline.setpoint.simulator import paper_windows, rollout

RESULTS, PEER = Path(__file__).parent / "results" / "agent.json", Path(__file__).parent / "agent_peer.py"
UPDATES = 500  # of each timing


def figures(score: judging.Score) -> dict[str, float]:
    shares = {name: round(getattr(score, name).percent, 2) for name in ("settled", "stay", "recovered")}
    return shares | {name: round(getattr(score, name), 2) for name in ("median_steps", "p90_steps", "overshoot_p95", "flow_error")}


def one_seed(p: teaching.TrainAgent, runs: int, segment: float) -> dict[str, Any]:
    """Figures of the paper's agent after phases 3 and 4 and of ours in every case, ours from 30 %, 190 °C too, and the seconds and CPU seconds of training both."""
    learn, judge = (synthetic_table(np.random.default_rng(seed), segments=40, windows=10) for seed in (1, 99))
    wall, cpu = time.perf_counter(), time.process_time()
    done = teaching.taught(p, learn)
    row: dict[str, Any] = {
        "train_s": round(time.perf_counter() - wall, 1),
        "train_cpu_s": round(time.process_time() - cpu, 1),
        "kept_round": done.kept,
    }
    paper, ours = agent.greedy(agent.paper_sight()), agent.greedy(belief_agent.belief_sight(done.belief))
    before = belief_agent.BeliefNetwork(done.belief.filter.evidence.shape[0], jax.random.key(0))
    seats = {
        "phases 1-3": (paper, done.paper[2]),
        "four phases": (paper, done.paper[-1]),
        "ours": (ours, done.ours),
        "ours before training": (ours, before),
    }
    cases = judging.cases(recorded_windows(judge), runs=runs, segment=segment)
    for name, (controller, network) in seats.items():
        row[name] = {case: figures(judging.evaluate(controller, network, *of, jax.random.key(1000 + p.seed))) for case, of in cases.items()}
    windows, conditions = cases["accuracy 0.7"]
    coldest = jax.tree.map(lambda leaf: leaf[(conditions.flow == 30.0) & (conditions.temperature == 190.0)], conditions)
    row["ours from 30 %, 190 °C"] = figures(judging.evaluate(ours, done.ours, windows, coldest, jax.random.key(2000 + p.seed)))
    return row


def speeds(p: teaching.Paper) -> dict[str, float]:
    """Updates of the whole loop, rollout steps a second with 1,024 environments, and milliseconds of one action, each the median of 3; compiling is not counted."""
    network, optimiser, sight = agent.QNetwork(jax.random.key(0)), optax.adam(1e-4), agent.paper_sight()
    a, b = (jnp.asarray(x) for x in (40.0, 20.0))
    world = agent.World(
        paper_windows(), jax.tree_util.Partial(agent.anywhere, jnp.asarray(1.0)), jax.tree_util.Partial(agent.ellipse, a, b)
    )
    learner, controller = agent.Learner(network, network, optimiser.init(network)), agent.greedy(sight)
    conditions = jax.tree.map(lambda leaf: leaf[:1024], judging.starts(49, accuracy=1.0))

    def train():
        keywords = {"sight": sight, "world": world, "optimiser": optimiser, "bootstrap": agent.greatest, "setting": p.setting()}
        return agent.phase(learner, jax.random.key(0), updates=UPDATES, epsilon=(1.0, 0.05), **keywords)

    act = eqx.filter_jit(controller.act)
    seen = agent.begin(paper_windows(), jax.tree.map(lambda leaf: leaf[0], conditions), jax.random.key(0))[1]

    def acting():
        memory = sight.start()
        for _ in range(UPDATES):
            memory, action = act(network, memory, seen, jax.random.key(0))
        return action

    updates = UPDATES / seconds(train)
    steps = 1024 * 200 / seconds(lambda: rollout(controller, network, paper_windows(), conditions, jax.random.key(0), steps=200).flow)
    return {
        "updates_per_s": updates,
        "environment_steps_per_s": updates * p.environments,
        "rollout_steps_per_s": steps,
        "action_ms": 1e3 * seconds(acting) / UPDATES,
    }


def seconds(work) -> float:
    """Median of 3 after one to compile."""
    taken = []
    for _ in range(4):
        start = time.perf_counter()
        jax.block_until_ready(work())
        taken.append(time.perf_counter() - start)
    return float(np.median(taken[1:]))


def peer(python: str | None, updates_per_s: float) -> dict[str, Any]:
    if python is None or not Path(python).exists():
        return {"skipped": "no python of an environment with stable-baselines3 and a CPU build of torch was named"}
    done = subprocess.run([python, str(PEER), str(UPDATES)], capture_output=True, text=True, check=True)
    found = {name: float(np.median(values)) for name, values in json.loads(done.stdout.splitlines()[-1]).items()}
    return found | {
        "ratio_whole_loop": updates_per_s / found["whole_loop"],
        "ratio_to_updates_alone": updates_per_s / found["updates_alone"],
    }


if __name__ == "__main__":
    seeds, runs, python = [*sys.argv[1:], *["5", "100", None][len(sys.argv) - 1 :]]
    p = params.load(teaching.TrainAgent, "train_agent")
    found: dict[str, Any] = {"speed": speeds(p.paper)}
    found["peer"] = peer(python, found["speed"]["updates_per_s"])
    print(json.dumps(found, indent=2))
    for seed in range(int(seeds)):
        found[f"seed {seed}"] = one_seed(p.model_copy(update={"seed": seed}), int(runs), 10.0)
        print(seed, json.dumps(found[f"seed {seed}"], indent=2, ensure_ascii=False), flush=True)
        RESULTS.write_text(json.dumps(found, indent=2, ensure_ascii=False) + "\n")
