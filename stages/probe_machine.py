"""Probe the study's extruder: writes datasets/probe_machine/probing.mcap (simulated), in the very format that
a user's recordings come in. With recordings it probes nothing, and nothing.json says so."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import stages
from pipeline.store import artifacts, params
from pipeline.temperature.settings import GenerateProbing, Plant, check_output_limits, given_centre

if TYPE_CHECKING:
    import numpy as np

    from pipeline.temperature.probing import Probe

# what stands where there is nothing to simulate
RECORDED = "the record of this machine is what lies in datasets/raw/temperature; nothing is simulated"

# figures of control that git keeps and that runs are compared by
METRICS = ("samples", "excitation_*", "limited_share")


def main() -> None:
    with artifacts.stage("probe_machine") as out:
        settings, machine = params.load(GenerateProbing, "generate_probing"), params.load(Plant, "plant")
        check_output_limits(machine, settings.source)
        if settings.source == "recordings":
            metrics = {"source": settings.source, "reason": RECORDED}
            artifacts.write_json(out / "nothing.json", metrics)
        else:
            run, metrics = probe_study(settings, machine)
            time_s, signals = recorded_signals(machine, run)
            artifacts.write_recording(out / "probing.mcap", time_s, signals)
        artifacts.write_metrics("probe_machine", metrics, METRICS)


def probe_study(settings: GenerateProbing, machine: Plant) -> tuple[Probe, dict[str, Any]]:
    """A run of the study's extruder within its limits, from measured outputs only, and its figures. Raises
    ValueError if the machine is another."""
    import numpy as np

    from pipeline.temperature.controllers.law import feasible_target
    from pipeline.temperature.plant import baam
    from pipeline.temperature.probing import excitation, multisine, prbs, probe

    rng = np.random.default_rng(settings.seed)
    count, amplitude = len(machine.inputs), settings.amplitude_percent
    if settings.signal == "prbs":
        signal = prbs(rng, settings.samples, count, amplitude=amplitude, shortest=settings.shortest_steps)
    else:
        signal = multisine(rng, settings.samples, count, amplitude=amplitude)
    plant = baam()._replace(sample_time_s=machine.sample_time_s)
    low, high = np.array([(i.low, i.high) for i in machine.inputs]).T
    if (count, len(machine.outputs)) != (plant.m, plant.p):
        raise ValueError(
            f"params.yaml: plant names {count} inputs and {len(machine.outputs)} outputs, but "
            f"generate_probing.source: simulated is the study's extruder with {plant.m} and {plant.p}; set "
            "generate_probing.source: recordings for your machine, or restore the plant section"
        )
    target = feasible_target(plant, np.array([o.reference for o in machine.outputs]), low, high)
    given = given_centre(settings, machine)
    centre = target.u if given is None else np.array(given)
    limits = (
        np.maximum(low, centre - amplitude),
        np.minimum(high, centre + amplitude),
        settings.rate_percent_per_step,
    )
    noise = settings.noise_degC * rng.standard_normal((len(signal), plant.p))
    point = target.x, centre, target.y
    feedback = settings.feedback_percent_per_degC * np.eye(plant.m, plant.p)
    run = probe(plant, signal, point, limits, feedback=feedback, noise=noise)
    excited = excitation(run.u, 12)
    return run, {
        "source": settings.source,
        "samples": settings.samples,
        "excitation_order": excited.order,
        "excitation_rank": excited.rank,
        "excitation_full_rank": excited.full,
        "excitation_condition": excited.condition if np.isfinite(excited.condition) else None,
        "limited_share": run.limited,
        "level_percent_per_band": excited.level,
    }


def recorded_signals(machine: Plant, run: Probe) -> tuple[np.ndarray, dict[str, tuple[np.ndarray, str, str]]]:
    """time_s (T,) and {name: (values (T,), unit, meaning)} of a run."""
    import numpy as np

    columns = zip([*machine.inputs, *machine.outputs], np.hstack([run.u, run.y]).T, strict=True)
    signals = {
        s.name: (values, s.unit, f"{s.name} of the study's extruder, simulated") for s, values in columns
    }
    return machine.sample_time_s * np.arange(len(run.u)), signals


if __name__ == "__main__":
    stages.run(main, "probe_machine", loop="temperature")
