"""Judge every temperature controller as it would be deployed: reads what the temperature stages wrote; writes
datasets/evaluate_temperature: cases.parquet, trajectories.parquet and summary.json."""

import stages
from pipeline.store import artifacts, params
from pipeline.temperature.workflow import evaluate_temperature, learned, tables
from pipeline.temperature.workflow.settings import (
    EvaluateTemperature,
    Panel,
    Plant,
    TemperatureRules,
    Tracking,
    TuneWeights,
)


def main() -> None:
    with artifacts.stage("evaluate_temperature") as out:
        settings, machine = (
            params.load(EvaluateTemperature, "evaluate_temperature"),
            params.load(Plant, "plant"),
        )
        tracking, panel = params.load(Tracking, "tracking"), params.load(Panel, "panel")
        tuning, execution = (
            params.load(TuneWeights, "tune_weights"),
            params.load(params.Execution, "execution"),
        )
        simulated = params.value("generate_probing.source", one_of=("simulated", "recordings")) == "simulated"
        made = learned.read_learned(
            "datasets/identify_plant/plant.parquet",
            "datasets/identify_plant/spread.parquet",
            "datasets/learn_kernel",
            "datasets/ingest/printer_pid.json",
            machine,
        )
        weights = evaluate_temperature.read_weights("datasets/tune_weights/weights.json", machine)
        record = "datasets/ingest/record.parquet"
        posed = learned.posed(made, machine, panel, tracking, tuning, record, simulated=simulated)
        rules = evaluate_temperature.resolved(params.load(TemperatureRules, "report"), panel, posed.rehearsal)
        judged = evaluate_temperature.judged(
            settings, machine, posed.setting, posed.problem, weights, rules, execution
        )
        artifacts.write_table(out / "cases.parquet", tables.CASES, judged.cases)
        artifacts.write_table(
            out / "trajectories.parquet",
            tables.trajectories(machine.inputs, machine.outputs),
            judged.trajectories,
        )
        artifacts.write_json(out / "summary.json", judged.summary)
        artifacts.write_metrics("evaluate_temperature", judged.summary)


if __name__ == "__main__":
    stages.run(main, "evaluate_temperature", loop="temperature")
