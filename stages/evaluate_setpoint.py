"""Agents and classifier -> who sets flow and temperature: reads datasets/train_classifier
and datasets/train_agent; writes datasets/evaluate_setpoint: scoreboard.parquet,
paths.parquet of one run from each start, in the case that decides too, decisions.parquet of
two episodes through pixels, and choice.json, the default with its worst case."""

from concurrent.futures import ThreadPoolExecutor

import stages
from pipeline.setpoint.agents import judging
from pipeline.setpoint.workflow import contestants, evaluate_setpoint
from pipeline.setpoint.workflow.agent_files import restore_agents
from pipeline.setpoint.workflow.camera_files import restore_camera
from pipeline.setpoint.workflow.classifier_files import restore_classifier
from pipeline.setpoint.workflow.settings import EvaluateSetpoint, TrainClassifier
from pipeline.setpoint.workflow.tables import DECISIONS, PATHS, SCOREBOARD, WINDOWS
from pipeline.setpoint.workflow.windows import window_tables
from pipeline.store import artifacts, params


def main() -> None:
    with artifacts.stage("evaluate_setpoint") as out:
        settings, view = (
            params.load(EvaluateSetpoint, "evaluate_setpoint"),
            params.load(TrainClassifier, "train_classifier"),
        )
        model = restore_classifier(
            "datasets/train_classifier/weights.safetensors", "datasets/train_classifier/calibration.parquet"
        )
        windows = window_tables(artifacts.read_table("datasets/train_classifier/windows.parquet", WINDOWS))
        agents = restore_agents("datasets/train_agent/weights.safetensors")
        controllers = contestants.controllers(
            contestants.Problem(settings.baselines, agents, windows["learn"])
        )
        room = judging.room([windows["choose"], windows["judge"]])  # one program for both
        choice = evaluate_setpoint.chosen(controllers, windows["choose"], settings, room=room)
        known = restore_camera("datasets/train_classifier/known_camera.parquet")
        with ThreadPoolExecutor(1) as beside:
            through = beside.submit(
                evaluate_setpoint.pixel_rollouts, controllers, choice, model, settings, view, known
            )
            contest = evaluate_setpoint.contest(
                controllers, windows["judge"], settings, choice.name, room=room
            )
        rollouts, choice = through.result(), evaluate_setpoint.told(choice, contest)
        artifacts.write_table(
            out / "scoreboard.parquet",
            SCOREBOARD,
            evaluate_setpoint.scoreboard(controllers, contest, rollouts),
        )
        artifacts.write_table(
            out / "paths.parquet", PATHS, evaluate_setpoint.paths(controllers, contest, choice, rollouts)
        )
        artifacts.write_table(
            out / "decisions.parquet", DECISIONS, evaluate_setpoint.decisions(choice.name, rollouts)
        )
        artifacts.write_json(out / "choice.json", evaluate_setpoint.choice_record(choice))
        artifacts.write_metrics(
            "evaluate_setpoint", evaluate_setpoint.metrics(controllers, contest, choice, rollouts)
        )


if __name__ == "__main__":
    stages.run(main, "evaluate_setpoint", loop="setpoint")
