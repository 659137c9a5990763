"""What generate_probing does: the study's extruder, probed within limits from measured outputs
only; or what to play on a user's machine next."""

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


class Planned(NamedTuple):
    """Columns of the commands to play, and metrics."""

    columns: dict[str, np.ndarray]
    metrics: dict[str, Any]


class Probed(NamedTuple):
    """The recording of the simulated machine, {name: (values (T,),
    unit, meaning)} at time_s (T,), and metrics."""

    time_s: np.ndarray
    signals: dict[str, tuple[np.ndarray, str, str]]
    metrics: dict[str, Any]


def planned(settings: GenerateProbing, machine: Plant) -> Planned:
    """The probing signal about a centre that the user gives, or the
    middle of the limits, clipped to these."""
    low, high = _limits(machine)
    signal = _signal(settings, machine, np.random.default_rng(settings.seed))
    centre = (low + high) / 2 if settings.centre_percent is None else _centre(settings, machine)
    u = np.clip(centre + signal, low, high)
    columns = {
        "time_s": _time_s(settings, machine),
        **{i.name: u[:, k] for k, i in enumerate(machine.inputs)},
    }
    return Planned(columns, _metrics(settings, excitation(u, 2), float((u != centre + signal).mean())))


def probed(settings: GenerateProbing, machine: Plant) -> Probed:
    """A run of the study's extruder. Raises ValueError where the machine is another."""
    rng = np.random.default_rng(settings.seed)
    signal = _signal(settings, machine, rng)
    run = _simulated(settings, machine, signal, rng)
    columns = zip([*machine.inputs, *machine.outputs], np.hstack([run.u, run.y]).T, strict=True)
    signals = {
        s.name: (values, s.unit, f"{s.name} of the study's extruder, simulated") for s, values in columns
    }
    return Probed(_time_s(settings, machine), signals, _metrics(settings, excitation(run.u, 12), run.limited))


def _limits(machine: Plant) -> tuple[np.ndarray, np.ndarray]:
    low, high = np.array([(i.low, i.high) for i in machine.inputs]).T
    return low, high


def _centre(settings: GenerateProbing, machine: Plant) -> np.ndarray:
    """The operating point (m,) that the user gives: one number for all inputs, or one each."""
    given = np.atleast_1d(np.asarray(settings.centre_percent, float))
    if len(given) not in (1, len(machine.inputs)):
        raise ValueError(
            f"generate_probing.centre_percent has {len(given)} values, but plant has {len(machine.inputs)} "
            "inputs; give one for each, or one number for all"
        )
    return np.broadcast_to(given, len(machine.inputs))


def _signal(settings: GenerateProbing, machine: Plant, rng: np.random.Generator) -> np.ndarray:
    shape = {
        "amplitude": settings.amplitude_percent,
        **({"shortest": settings.shortest_steps} if settings.signal == "prbs" else {}),
    }
    return {"multisine": multisine, "prbs": prbs}[settings.signal](
        rng, settings.samples, len(machine.inputs), **shape
    )


def _time_s(settings: GenerateProbing, machine: Plant) -> np.ndarray:
    return machine.sample_time_s * np.arange(settings.samples)


def _simulated(
    settings: GenerateProbing, machine: Plant, signal: np.ndarray, rng: np.random.Generator
) -> Probe:
    plant, (low, high) = baam()._replace(sample_time_s=machine.sample_time_s), _limits(machine)
    if (len(machine.inputs), len(machine.outputs)) != (plant.m, plant.p):
        raise ValueError(
            f"params.yaml: plant names {len(machine.inputs)} inputs and {len(machine.outputs)} outputs, "
            "but generate_probing.source: simulated is the "
            f"study's extruder with {plant.m} and {plant.p}; set generate_probing.source: "
            "recordings for your machine, "
            "or restore the plant section"
        )
    target = feasible_target(plant, np.array([o.reference for o in machine.outputs]), low, high)
    centre = target.u if settings.centre_percent is None else _centre(settings, machine)
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
