"""What probe_machine does: it probes the study's extruder within limits, from measured outputs only."""

from typing import Any, NamedTuple

import numpy as np

from pipeline.temperature.plant import baam
from pipeline.temperature.probing import (
    Excitation,
    InputLimits,
    OperatingPoint,
    Probe,
    excitation,
    multisine,
    prbs,
    probe,
)
from pipeline.temperature.tracking import feasible_target
from pipeline.temperature.workflow.settings import GenerateProbing, Plant

# what stands where there is nothing to simulate
RECORDED = "the record of this machine is what lies in datasets/raw/temperature; nothing is simulated"


class Probed(NamedTuple):
    """The recording of the simulated machine, {name: (values (T,),
    unit, meaning)} at time_s (T,), and metrics."""

    time_s: np.ndarray
    signals: dict[str, tuple[np.ndarray, str, str]]
    metrics: dict[str, Any]


def probed(settings: GenerateProbing, machine: Plant) -> Probed:
    """A run of the study's extruder. Raises ValueError where the machine is another."""
    rng = np.random.default_rng(settings.seed)
    signal = _signal(settings, machine, rng)
    run = _simulated(settings, machine, signal, rng)
    columns = zip([*machine.inputs, *machine.outputs], np.hstack([run.u, run.y]).T, strict=True)
    signals = {
        s.name: (values, s.unit, f"{s.name} of the study's extruder, simulated") for s, values in columns
    }
    time_s = machine.sample_time_s * np.arange(settings.samples)
    return Probed(time_s, signals, _metrics(settings, excitation(run.u, 12), run.limited))


def input_limits(machine: Plant) -> tuple[np.ndarray, np.ndarray]:
    """Low and high (m,) of the inputs in percent."""
    low, high = np.array([(i.low, i.high) for i in machine.inputs]).T
    return low, high


def given_centre(settings: GenerateProbing, machine: Plant) -> np.ndarray | None:
    """The operating point (m,) that the user gives, one number for all inputs or one each; None where it is
    left to the model."""
    if settings.centre_percent is None:
        return None
    given = np.atleast_1d(np.asarray(settings.centre_percent, float))
    if len(given) not in (1, len(machine.inputs)):
        raise ValueError(
            f"generate_probing.centre_percent has {len(given)} values, but plant has {len(machine.inputs)} "
            "inputs; give one for each, or one number for all"
        )
    return np.broadcast_to(given, len(machine.inputs))


def _signal(settings: GenerateProbing, machine: Plant, rng: np.random.Generator) -> np.ndarray:
    samples, inputs, amplitude = settings.samples, len(machine.inputs), settings.amplitude_percent
    if settings.signal == "prbs":
        return prbs(rng, samples, inputs, amplitude=amplitude, shortest=settings.shortest_steps)
    return multisine(rng, samples, inputs, amplitude=amplitude)


def _simulated(
    settings: GenerateProbing, machine: Plant, signal: np.ndarray, rng: np.random.Generator
) -> Probe:
    plant, (low, high) = baam()._replace(sample_time_s=machine.sample_time_s), input_limits(machine)
    if (len(machine.inputs), len(machine.outputs)) != (plant.m, plant.p):
        raise ValueError(
            f"params.yaml: plant names {len(machine.inputs)} inputs and {len(machine.outputs)} outputs, "
            "but generate_probing.source: simulated is the "
            f"study's extruder with {plant.m} and {plant.p}; set generate_probing.source: "
            "recordings for your machine, "
            "or restore the plant section"
        )
    target = feasible_target(plant, np.array([o.reference for o in machine.outputs]), low, high)
    given = given_centre(settings, machine)
    centre = target.u if given is None else given
    feedback = settings.feedback_percent_per_degC * np.eye(plant.m, plant.p)
    limits = InputLimits(
        np.maximum(low, centre - settings.amplitude_percent),
        np.minimum(high, centre + settings.amplitude_percent),
        settings.rate_percent_per_step,
    )
    noise = settings.noise_degC * rng.standard_normal((len(signal), plant.p))
    point = OperatingPoint(target.x, centre, target.y)
    return probe(plant, signal, point, limits, feedback=feedback, noise=noise)


def _metrics(settings: GenerateProbing, excited: Excitation, limited: float) -> dict[str, Any]:
    return {
        "source": settings.source,
        "samples": settings.samples,
        "excitation_order": excited.order,
        "excitation_rank": excited.rank,
        "excitation_full_rank": excited.full,
        "excitation_condition": excited.condition if np.isfinite(excited.condition) else None,
        "limited_share": limited,
        "level_percent_per_band": excited.level,
    }
