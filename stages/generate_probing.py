"""Probe the machine: reads params.yaml; writes datasets/generate_probing/probing.mcap (simulated) or next_experiment.csv (recordings).

Simulated, the study's extruder is probed within limits, from measured outputs only, and the recording has the very format that a user's come in. With recordings,
this stage writes what to play on the machine next.
"""

from typing import Literal

import numpy as np
from pydantic import Field

from pipeline import artifacts, params
from pipeline.temperature.plant import baam
from pipeline.temperature.probing import excitation, multisine, prbs, probe
from pipeline.temperature.tracking import feasible_target


class GenerateProbing(params.Section):
    source: Literal["simulated", "recordings"]
    seed: int = Field(ge=0, le=2**31)
    signal: Literal["multisine", "prbs"]
    samples: int = Field(ge=50, le=1_000_000)
    amplitude_percent: float = Field(gt=0, le=100)
    rate_percent_per_step: float = Field(gt=0, le=200)
    shortest_steps: int = Field(ge=1, le=10_000)
    noise_degC: float = Field(ge=0, le=50)
    feedback_percent_per_degC: float = Field(ge=0, le=100)
    centre_percent: float | None = Field(ge=-100, le=100)


def main() -> None:
    with artifacts.stage("generate_probing") as out:
        p, machine = params.load(GenerateProbing, "generate_probing"), params.load(params.Plant, "plant")
        low, high = np.array([(i.low, i.high) for i in machine.inputs]).T
        rng = np.random.default_rng(p.seed)
        shape = {"amplitude": p.amplitude_percent, **({"shortest": p.shortest_steps} if p.signal == "prbs" else {})}
        signal = {"multisine": multisine, "prbs": prbs}[p.signal](rng, p.samples, len(machine.inputs), **shape)
        time_s = machine.sample_time_s * np.arange(p.samples)
        if p.source == "recordings":
            centre = np.full(len(low), p.centre_percent) if p.centre_percent is not None else (low + high) / 2
            u = np.clip(centre + signal, low, high)
            artifacts.write_csv(out / "next_experiment.csv", {"time_s": time_s, **{i.name: u[:, k] for k, i in enumerate(machine.inputs)}})
            found, limited = excitation(u, 2), float((u != centre + signal).mean())
        else:
            run = _simulated(p, machine, signal, low, high, rng)
            columns = zip([*machine.inputs, *machine.outputs], np.hstack([run.u, run.y]).T, strict=True)
            artifacts.write_recording(
                out / "probing.mcap",
                time_s,
                {s.name: (values, s.unit, f"{s.name} of the study's extruder, simulated") for s, values in columns},
            )
            found, limited = excitation(run.u, 12), run.limited
        artifacts.write_metrics(
            "generate_probing",
            {
                "source": p.source, "samples": p.samples, "excitation_order": found.order, "excitation_rank": found.rank, "excitation_full_rank": found.full,
                "excitation_condition": found.condition if np.isfinite(found.condition) else None, "limited_share": limited,
                "level_percent_per_band": found.level,
            },
        )  # fmt: skip


def _simulated(p, machine, signal, low, high, rng):
    plant = baam()._replace(sample_time_s=machine.sample_time_s)
    if (len(machine.inputs), len(machine.outputs)) != (plant.m, plant.p):
        raise ValueError(
            f"params.yaml: plant names {len(machine.inputs)} inputs and {len(machine.outputs)} outputs, but generate_probing.source: simulated is the study's extruder "
            f"with {plant.m} and {plant.p}; set generate_probing.source: recordings for your machine, or restore the plant section"
        )
    target = feasible_target(plant, np.array([o.reference for o in machine.outputs]), low, high)
    centre = target.u if p.centre_percent is None else np.full(plant.m, p.centre_percent)
    feedback = p.feedback_percent_per_degC * np.eye(plant.m, plant.p)
    limits = {
        "low": np.maximum(low, centre - p.amplitude_percent),
        "high": np.minimum(high, centre + p.amplitude_percent),
        "rate": p.rate_percent_per_step,
    }
    noise = p.noise_degC * rng.standard_normal((len(signal), plant.p))
    return probe(plant, signal, x0=target.x, u_centre=centre, y_centre=target.y, feedback=feedback, noise=noise, **limits)


if __name__ == "__main__":
    main()
