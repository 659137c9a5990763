"""Judge every temperature controller on one panel: reads what the temperature stages wrote; writes
datasets/evaluate_temperature: scorecard.parquet, trajectories.parquet and summary.json."""

from pipeline.store import artifacts, params
from pipeline.temperature.workflow import evaluate_temperature, tables
from pipeline.temperature.workflow.settings import EvaluateTemperature, Panel, Plant, Tracking


def main() -> None:
    with artifacts.stage("evaluate_temperature") as out:
        settings, machine = (
            params.load(EvaluateTemperature, "evaluate_temperature"),
            params.load(Plant, "plant"),
        )
        tracking, panel = params.load(Tracking, "tracking"), params.load(Panel, "panel")
        simulated = params.value("generate_probing.source", one_of=("simulated", "recordings")) == "simulated"
        evaluate_temperature.check(settings, panel)
        learned = evaluate_temperature.read_learned(
            "datasets/identify_plant/plant.parquet",
            "datasets/identify_plant/spread.parquet",
            "datasets/tune_weights/weights.json",
            "datasets/learn_kernel",
            "datasets/ingest/printer_pid.json",
            machine,
        )
        judged = evaluate_temperature.judged(settings, machine, tracking, panel, learned, simulated=simulated)
        artifacts.write_table(out / "scorecard.parquet", tables.SCORECARD, judged.scorecard)
        artifacts.write_table(out / "trajectories.parquet", *judged.trajectories)
        artifacts.write_json(out / "summary.json", judged.summary)
        artifacts.write_metrics(
            "evaluate_temperature",
            {
                "controllers": judged.summary["controllers"],
                "refused": judged.refused,
                "without_feed_forward": judged.without_feed_forward,
                "own_integral": judged.own_integral,
            },
        )


if __name__ == "__main__":
    main()
