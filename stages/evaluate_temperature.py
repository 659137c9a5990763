"""Judge every temperature controller as it would be deployed: reads what the temperature stages wrote; writes
datasets/evaluate_temperature: cases.parquet, trajectories.parquet and summary.json."""

from pipeline.store import artifacts, params
from pipeline.temperature import plant
from pipeline.temperature.workflow import cases, evaluate_temperature, learned, tables
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
        truth = plant.baam()._replace(sample_time_s=machine.sample_time_s) if simulated else None
        family = [made.model, *made.spread]
        rehearsal = cases.rehearsed(panel, machine, truth, family, "datasets/ingest/record.parquet")
        setting = cases.shared(tuning, machine, tracking, panel, rehearsal, family)
        problem = learned.problem(made, tracking, setting, truth)
        rules = evaluate_temperature.resolved(params.load(TemperatureRules, "report"), panel, rehearsal)
        judged = evaluate_temperature.judged(settings, machine, setting, problem, weights, rules, execution)
        artifacts.write_table(out / "cases.parquet", tables.CASES, judged.cases)
        artifacts.write_table(
            out / "trajectories.parquet",
            tables.trajectories(machine.inputs, machine.outputs),
            judged.trajectories,
        )
        artifacts.write_json(out / "summary.json", judged.summary)
        artifacts.write_metrics("evaluate_temperature", judged.summary)


if __name__ == "__main__":
    main()
