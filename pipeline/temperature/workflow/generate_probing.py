"""What generate_probing does: what to play on the machine next."""

from typing import Any, NamedTuple

import numpy as np

from pipeline.temperature.probing import Excitation, excitation, multisine, prbs
from pipeline.temperature.workflow.settings import GenerateProbing, Plant


class Planned(NamedTuple):
    """Columns of the commands to play, and metrics."""

    columns: dict[str, np.ndarray]
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
