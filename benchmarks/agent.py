"""The paper's agent over training seeds, and the speed of
training.

`./run python -m benchmarks.agent` trains with seeds 0 .. 4 by the numbers of the kept agent, judges 21 starts
x 100 runs on the paper's simulator, and writes its part of benchmarks/results.json.
"""

import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from benchmarks import results
from benchmarks.results import Row
from pipeline.papers.search_agent import TrainAgent, first_key, training
from pipeline.setpoint.agents import agent, trials
from pipeline.setpoint.agents.score import RunScore, judge
from pipeline.setpoint.simulation.simulator import paper_windows, rollout
from pipeline.store import artifacts, params

UPDATES = 500  # of each timing


def figures(score: RunScore) -> dict[str, float]:
    shares = {name: round(getattr(score, name).percent, 2) for name in ("settled", "stay", "recovered")}
    return shares | {
        name: round(getattr(score, name), 2)
        for name in ("median_steps", "p90_steps", "overshoot_p95", "flow_error")
    }


def one_seed(how: agent.PublishedTraining, seed: int) -> dict[str, Any]:
    """Figures of the paper's agent after phases 3 and 4 by the accuracy of the windows, and the seconds and
    CPU seconds of training."""
    wall, cpu = time.perf_counter(), time.process_time()
    networks = agent.train_published(first_key(seed), how).networks
    row: dict[str, Any] = {
        "train_s": round(time.perf_counter() - wall, 1),
        "train_cpu_s": round(time.process_time() - cpu, 1),
    }
    for name, network in {"phases 1-3": networks[2], "four phases": networks[-1]}.items():
        paths = {accuracy: agent.run_starts(network, accuracy=accuracy) for accuracy in (1.0, 0.7)}
        row[name] = {
            f"accuracy {accuracy:g}": figures(judge(np.asarray(path.flow), np.asarray(path.temperature)))
            for accuracy, path in paths.items()
        }
    return row


def speeds(settings: agent.DqnSettings) -> dict[str, Any]:
    """Updates of the whole loop, rollout steps with 1,024 environments, and milliseconds of one action;
    compiling is not counted. Beside them the matrix products that an update cannot do without, alone: on a
    machine that others use too, the ratio is what can be compared."""
    network, optimiser = agent.QNetwork(jax.random.key(0)), optax.adam(1e-4)
    encoder = agent.paper_encoder()
    a, b = (jnp.asarray(x) for x in (40.0, 20.0))
    env = agent.EnvSpec(
        paper_windows(),
        jax.tree_util.Partial(agent.anywhere, jnp.asarray(1.0)),
        jax.tree_util.Partial(agent.ellipse, a, b),
    )
    train_state = agent.DqnState(network, network, optimiser.init(network))
    controller = agent.greedy(encoder)
    problem = agent.DqnProblem(encoder, env, optimiser, agent.dqn_target, settings)
    conditions = jax.tree.map(lambda leaf: leaf[:1024], trials.starts(49, accuracy=1.0))
    act = jax.jit(lambda memory, observation: controller.act(network, memory, observation, None))
    observation = agent.begin(
        paper_windows(), jax.tree.map(lambda leaf: leaf[0], conditions), jax.random.key(0)
    )[1]
    products, flop = update_products(settings.batch)

    def acting():
        memory = encoder.start()
        for _ in range(UPDATES):
            memory, action = act(memory, observation)
        return action

    def updating():
        key, epsilon = jax.random.key(0), (1.0, 0.05)
        return agent.phase(train_state, key, problem, updates=UPDATES, longest=UPDATES, epsilon=epsilon)

    work = {
        "update": (updating, UPDATES),
        "products": (products, UPDATES),
        "rollout_step": (lambda: rollout(controller, network, paper_windows(), conditions, jax.random.key(0),
        steps=200).flow, 1024 * 200),
        "action": (acting, UPDATES),
    }  # fmt: skip
    taken = {name: seconds(f) / n for name, (f, n) in work.items()}
    wall, cpu = ({name: both[i] for name, both in taken.items()} for i in (0, 1))
    return {
        "updates_per_s": 1 / wall["update"], "updates_per_cpu_s": 1 / cpu["update"],
        "environment_steps_per_s": settings.environments / wall["update"],
        "update_gflop": flop / 1e9, "products_alone_per_s": 1 / wall["products"],
        "products_alone_per_cpu_s": 1 / cpu["products"],
        "update_by_products_wall": wall["update"] / wall["products"],
        "update_by_products_cpu": cpu["update"] / cpu["products"],
        "share_of_products": wall["products"] / wall["update"],
        "rollout_steps_per_s": 1 / wall["rollout_step"], "rollout_steps_per_cpu_s": 1 / cpu["rollout_step"],
        "action_ms": 1e3 * wall["action"], "action_cpu_ms": 1e3 * cpu["action"],
    }  # fmt: skip


def update_products(batch: int):
    """The products of one update with nothing between them, UPDATES times: two networks forward, one backward
    without the inputs' share -> (work, floating point operations of one update)."""
    sizes, rng = ((35, 288), (288, 128), (128, 10)), np.random.default_rng(0)
    made = [
        [jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in ((batch, m), (m, n), (batch, n))]
        for m, n in sizes
    ]

    def one(c, _):
        total = 0.0
        for i, (x, W, y) in enumerate(made):
            W = W + 1e-20 * c  # so that no step can be left out
            total += (
                (x @ W)[0, 0]
                + ((x + c) @ W)[0, 0]
                + (x.T @ (y + c))[0, 0]
                + (((y - c) @ W.T)[0, 0] if i else 0.0)
            )
        return 1e-20 * total, None

    loop = jax.jit(lambda: jax.lax.scan(one, jnp.float32(0.0), None, length=UPDATES)[0])
    return loop, 2 * batch * sum((4 if i else 3) * m * n for i, (m, n) in enumerate(sizes))


def seconds(work) -> np.ndarray:
    """(2,): median of 3 in wall and in CPU seconds, after one to compile."""
    taken = []
    for _ in range(4):
        start = np.array([time.perf_counter(), time.process_time()])
        jax.block_until_ready(work())
        taken.append(np.array([time.perf_counter(), time.process_time()]) - start)
    return np.median(taken[1:], axis=0)


SEEDS = 5
# its program needs torch: git show 23e84ac:benchmarks/agent_peer.py
BASELINES3 = "2.85 times stable-baselines3's whole loop on another day, commit 23e84ac"


def rows(speed: dict[str, Any], seeds: list[dict[str, Any]]) -> list[Row]:
    """Updates a second, and what each agent settles and keeps over the training seeds."""
    out = [
        Row(
            "updates of the DQN, whole loop",
            f"{speed['updates_per_s']:,.0f} updates/s",
            f"{speed['products_alone_per_s']:,.0f} updates/s (its bare matrix products)",
            BASELINES3,
        ),
        Row("one action", f"{speed['action_ms']:.3f} ms"),
    ]
    settled, stay = (
        [seed["four phases"]["accuracy 0.7"][key] for seed in seeds] for key in ("settled", "stay")
    )
    out.append(
        Row(
            "the paper's agent, four phases, accuracy 0.7: runs that reach the target",
            f"{min(settled):g} to {max(settled):g} %",
            "",
            f"{len(seeds)} training seeds; keep it: {min(stay):g} to {max(stay):g} %",
        )
    )
    return out


def main() -> None:
    best = artifacts.read_json("datasets/papers/search_agent.json")["best"]
    how = training(params.load(TrainAgent, "train_agent", params.PAPERS), best)
    results.write("agent", rows(speeds(how.dqn), [one_seed(how, seed) for seed in range(SEEDS)]))


if __name__ == "__main__":
    main()
