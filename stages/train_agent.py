"""Recorded windows -> agents: reads datasets/train_classifier/windows.parquet; writes datasets/train_agent:
weights.safetensors of the paper's agent after each phase and of ours with the filter whose belief it sees,
and agents.parquet, the course of training."""

from pipeline.setpoint.workflow import train_agent
from pipeline.setpoint.workflow.agent_files import store_agents
from pipeline.setpoint.workflow.settings import TrainAgent
from pipeline.setpoint.workflow.tables import AGENT_COURSE, WINDOWS
from pipeline.setpoint.workflow.windows import window_tables
from pipeline.store import artifacts, params


def main() -> None:
    with artifacts.stage("train_agent") as out:
        p = params.load(TrainAgent, "train_agent")
        tables = window_tables(artifacts.read_table("datasets/train_classifier/windows.parquet", WINDOWS))
        done = train_agent.taught(p, tables["learn"])
        store_agents(out / "weights.safetensors", done.agents)
        course = train_agent.course_rows(done)
        artifacts.write_table(out / "agents.parquet", AGENT_COURSE, course)
        artifacts.write_course(out / "live", course, of="agent", step="update", figures=("reward",))
        artifacts.write_metrics("train_agent", train_agent.metrics(p, done, tables["judge"]))


if __name__ == "__main__":
    main()
