"""Recorded windows -> agents: reads datasets/train_classifier/windows.parquet; writes datasets/train_agent:
weights.safetensors of the agent of Li and Pattinson (2025) after each phase and of the belief DQN with its
filter, and agents.parquet, the learning curves."""

from pathlib import Path

import stages
from pipeline.setpoint.workflow import train_agent
from pipeline.setpoint.workflow.agent_files import store_agents
from pipeline.setpoint.workflow.settings import TrainAgent
from pipeline.setpoint.workflow.tables import AGENT_CURVE, WINDOWS
from pipeline.setpoint.workflow.windows import window_tables
from pipeline.store import artifacts, params


def main() -> None:
    with artifacts.stage("train_agent") as out:
        settings = params.load(TrainAgent, "train_agent")
        windows = window_tables(artifacts.read_table("datasets/train_classifier/windows.parquet", WINDOWS))
        memo = Path("datasets/memo/train_agent")
        trained = train_agent.train_agents(settings, windows["learn"], memo=memo)
        store_agents(out / "weights.safetensors", trained.agents)
        curve = train_agent.curve_rows(trained)
        artifacts.write_table(out / "agents.parquet", AGENT_CURVE, curve)
        artifacts.write_learning_curve(out / "live", curve, of="agent", step="update", figures=("reward",))
        artifacts.write_metrics("train_agent", train_agent.metrics(settings, trained))


if __name__ == "__main__":
    stages.run(main, "train_agent", loop="setpoint")
