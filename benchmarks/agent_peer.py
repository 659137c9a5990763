"""Updates a second of stable-baselines3's DQN of the paper's sizes on the paper's simulator, for
benchmarks/agent.py: `PYTHON benchmarks/agent_peer.py UPDATES`.

PYTHON is of an environment with stable-baselines3 and a CPU build of torch. As here: 32 episodes at once, an
update of a batch of 512 after each step of them all. The peer knows one head, so its 25 actions are the
pairs; its hidden layers are 288 and 128. The simulator is vectorised in numpy, to the peer's favour.
"""

import json
import sys
import time

import gymnasium
import numpy as np
import torch
from stable_baselines3 import DQN
from stable_baselines3.common.vec_env import VecEnv

EPISODES, LENGTH = 32, 100


class Printer(VecEnv):
    """The paper's simulator with classes that are always right: flow and temperature in percent and °C."""

    def __init__(self):
        super().__init__(
            EPISODES, gymnasium.spaces.Box(-10.0, 10.0, (35,), np.float32), gymnasium.spaces.Discrete(25)
        )
        self.rng = np.random.default_rng(0)
        self.flow, self.heat, self.target, self.step_count = np.zeros((4, EPISODES))
        self.history = np.zeros((EPISODES, 30), np.float32)

    def restart(self, over):
        n = over.sum()
        self.flow[over], self.heat[over], self.step_count[over] = (
            self.rng.uniform(20, 310, n),
            self.rng.uniform(180, 240, n),
            0,
        )
        self.target[over], self.history[over] = self.heat[over], 1 / 3

    def observe(self):
        named = (self.flow >= 90).astype(int) + (self.flow > 110)
        distance = np.abs(np.arange(3) - named[:, None])
        p = np.where(
            distance == 0,
            1.0,
            np.clip(np.exp(-1.5 * distance) + self.rng.normal(0, 0.15, distance.shape), 0, 1),
        )
        x = np.column_stack([self.history, p, (self.heat - 210) / 30, (self.target - 210) / 30]).astype(
            np.float32
        )
        self.history = np.column_stack([self.history[:, 1:], named / 3]).astype(np.float32)
        return x

    def reset(self):
        self.restart(np.ones(EPISODES, bool))
        return self.observe()

    def step_async(self, actions):
        self.actions = actions

    def step_wait(self):
        self.flow = np.clip(self.flow + 5.0 * (self.actions // 5 - 2), 20, 310)
        self.target = np.where(
            self.step_count % 10 == 0,
            np.clip(self.target + 10.0 * (self.actions % 5 - 2), 180, 240),
            self.target,
        )
        self.heat, self.step_count = self.heat + (self.target - self.heat) / 5, self.step_count + 1
        dq, du, theta = self.flow - 100, self.heat - 210, np.deg2rad(70)
        q, u = dq * np.cos(theta) - du * np.sin(theta), dq * np.sin(theta) + du * np.cos(theta)
        rewards, over = (
            (2 / (1 + np.sqrt((q / 40) ** 2 + (u / 20) ** 2)) - 1).astype(np.float32),
            self.step_count >= LENGTH,
        )
        x, infos = self.observe(), [{} for _ in range(EPISODES)]
        if over.any():
            for i in np.flatnonzero(over):
                infos[i] = {"terminal_observation": x[i], "TimeLimit.truncated": True}
            self.restart(over)
            x = self.observe()
        return x, rewards, over, infos

    def close(self):
        pass

    def get_attr(self, attr_name, indices=None):
        return [None] * EPISODES

    def set_attr(self, attr_name, value, indices=None):
        pass

    def env_method(self, method_name, *args, indices=None, **kwargs):
        return [None] * EPISODES

    def env_is_wrapped(self, wrapper_class, indices=None):
        return [False] * EPISODES

    def seed(self, seed=None):
        return [None] * EPISODES


if __name__ == "__main__":
    updates = int(sys.argv[1])
    torch.set_num_threads(2)
    model = DQN(
        "MlpPolicy", Printer(), learning_rate=1e-4, buffer_size=2**17, learning_starts=EPISODES,
        batch_size=512, tau=0.005, gamma=0.99, train_freq=1,
        gradient_steps=1, target_update_interval=1, policy_kwargs={"net_arch": [288, 128]}, device="cpu",
        seed=0,
    )  # fmt: skip
    model.learn(EPISODES * 20)

    def rates(work):
        """(updates a second, updates a CPU second)."""
        start = time.perf_counter(), time.process_time()
        work()
        return updates / (time.perf_counter() - start[0]), updates / (time.process_time() - start[1])

    whole, alone = [], []
    for _ in range(3):
        whole.append(rates(lambda: model.learn(EPISODES * updates, reset_num_timesteps=False)))
        alone.append(rates(lambda: model.train(gradient_steps=updates, batch_size=512)))
    print(json.dumps({"whole_loop": whole, "updates_alone": alone}))
