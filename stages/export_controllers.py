"""The controller that the verdict recommends, certified and written: reads what evaluate_temperature read and
wrote, what train_classifier, train_agent and evaluate_setpoint left, and what compose_parts wrote; writes
datasets/export_controllers: temperature/ (controller.json, arrays.safetensors, certificate.json, c/, python/)
setpoint/, and exported.json, which says what there is and why not. Where the certificate is refused it is all
that is written of that loop."""

import stages
from pipeline.runtime.workflow import export_controllers as export
from pipeline.runtime.workflow import export_setpoint
from pipeline.runtime.workflow.settings import ExportControllers
from pipeline.setpoint.workflow import contestants
from pipeline.setpoint.workflow.agent_files import restore_agents
from pipeline.setpoint.workflow.classifier_files import restore_classifier
from pipeline.setpoint.workflow.settings import EvaluateSetpoint
from pipeline.setpoint.workflow.tables import WINDOWS
from pipeline.setpoint.workflow.windows import window_tables
from pipeline.store import artifacts, params
from pipeline.temperature.workflow import evaluate_temperature, learned, tables
from pipeline.temperature.workflow.settings import Panel, Plant, TemperatureRules, Tracking, TuneWeights
from pipeline.verdict.verdict import read


def main() -> None:
    with artifacts.stage("export_controllers") as out:
        settings, machine = (
            params.load(ExportControllers, "export_controllers"),
            params.load(Plant, "plant"),
        )
        tracking, panel = params.load(Tracking, "tracking"), params.load(Panel, "panel")
        tuning, rules = params.load(TuneWeights, "tune_weights"), params.load(TemperatureRules, "report")
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
        summary = artifacts.read_json("datasets/evaluate_temperature/summary.json")
        judged = export.Judged(machine, made, posed.setting, posed.problem, weights, summary, simulated)
        verdict = read("datasets/verdict")["temperature"]
        name, why = export.chosen(verdict.winner, f"{verdict.decision} {verdict.lead}")
        temperature = export.nothing(why)
        if name:
            one = export.exported(judged, name)
            shown = tables.trajectories(machine.inputs, machine.outputs)
            played = artifacts.read_table("datasets/evaluate_temperature/trajectories.parquet", shown)
            difference = export.replayed(one, judged, played)
            export.check_same(one, difference)
            resolved = evaluate_temperature.resolved(rules, panel, posed.rehearsal)
            certificate = export.certified(one, judged, resolved, settings, record)
            within = export.supported(one, judged, panel, settings.seed, record)
            temperature = export.write_temperature(
                out / "temperature", one, certificate, within, {"judged": difference}
            )
        model = restore_classifier(
            "datasets/train_classifier/weights.safetensors", "datasets/train_classifier/calibration.parquet"
        )
        windows = window_tables(artifacts.read_table("datasets/train_classifier/windows.parquet", WINDOWS))
        agents = restore_agents("datasets/train_agent/weights.safetensors")
        baselines = params.load(EvaluateSetpoint, "evaluate_setpoint").baselines
        specs = contestants.controllers(contestants.Problem(baselines, agents, windows["learn"]))
        default = str(artifacts.read_json("datasets/evaluate_setpoint/choice.json")["name"])
        decides = export_setpoint.decider(default, specs, agents)
        setpoint = export_setpoint.write(out / "setpoint", default, model, decides, settings.seed)
        deposition = export.deposition(
            ("datasets/compose_parts/signals.parquet", "datasets/compose_parts/lines.parquet")
        )
        shown = export.metrics({"temperature": temperature, "setpoint": setpoint, "deposition": deposition})
        artifacts.write_json(out / "exported.json", shown)
        artifacts.write_metrics("export_controllers", shown)


if __name__ == "__main__":
    stages.run(main, "export_controllers")
