"""Recorded windows -> agents: reads datasets/train_classifier/windows.parquet; writes datasets/train_agent: weights.safetensors of the paper's agent after each phase and of ours
with the filter whose belief it sees, and agents.parquet, the course of training."""

from pipeline import artifacts, params, seeing, setpoint_schemas, teaching
from pipeline.teaching import TrainAgent


def main() -> None:
    with artifacts.stage("train_agent") as out:
        p = params.load(TrainAgent, "train_agent")
        tables = seeing.window_tables(artifacts.read_table("datasets/train_classifier/windows.parquet", setpoint_schemas.WINDOWS))
        done = teaching.taught(p, tables["learn"])
        teaching.store(out / "weights.safetensors", done)
        course = teaching.course_rows(done)
        artifacts.write_table(out / "agents.parquet", setpoint_schemas.AGENT_COURSE, course)
        artifacts.write_course(out / "live", course, of="agent", step="update", figures=("reward",))
        artifacts.write_metrics("train_agent", teaching.metrics(p, done, tables["judge"]))


if __name__ == "__main__":
    main()
