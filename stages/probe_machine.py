"""Probe the study's extruder: writes datasets/probe_machine/probing.mcap (simulated), in the very format that
a user's recordings come in. With recordings it probes nothing, and nothing.json says so."""

import stages
from pipeline.store import artifacts, params
from pipeline.temperature.workflow import probe_machine
from pipeline.temperature.workflow.settings import GenerateProbing, Plant, check_output_limits


def main() -> None:
    with artifacts.stage("probe_machine") as out:
        settings, machine = params.load(GenerateProbing, "generate_probing"), params.load(Plant, "plant")
        check_output_limits(machine, settings.source)
        if settings.source == "recordings":
            metrics = {"source": settings.source, "reason": probe_machine.RECORDED}
            artifacts.write_json(out / "nothing.json", metrics)
        else:
            result = probe_machine.probed(settings, machine)
            metrics = result.metrics
            artifacts.write_recording(out / "probing.mcap", result.time_s, result.signals)
        artifacts.write_metrics("probe_machine", metrics)


if __name__ == "__main__":
    stages.run(main, "probe_machine", loop="temperature")
