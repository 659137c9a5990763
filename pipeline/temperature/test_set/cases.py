"""The cases on which controllers are tuned and compared: the declared panel on the study's machine; on
somebody's records what follows from them by stated defaults (scenario_defaults.py)."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from pipeline.temperature import plant, tracking
from pipeline.temperature.controllers import controller, governor
from pipeline.temperature.controllers.problem import Design, DesignProblem
from pipeline.temperature.settings import Half, Panel, Tracking, TuneWeights
from pipeline.temperature.settings import Plant as Machine
from pipeline.temperature.test_set import panel, scenario_defaults


class Rehearsal(NamedTuple):
    """The two halves of the panel, and what counts on this machine: the band and the settling limit that
    follow from its record (None: as declared), the shortest time from cold to the first reference, noise (p,)
    in °C, references out of reach, and in words where it comes from."""

    judging: panel.Cases
    training: panel.Cases
    band_degC: float
    settling_s: float | None
    heat_up_s: float
    noise: np.ndarray
    infeasible: list[dict[str, Any]]
    source: str


class CaseConditions(NamedTuple):
    """What all controllers share, tuned and judged: the rehearsal, limits of inputs and outputs (low, high
    (p,) in °C), the governor, the integrator's limit in °C, the settled window in steps, what the cost counts
    as one, the discount, the sample time, and the share of the declared delay margins that is asked here
    (`faster`)."""

    rehearsal: Rehearsal
    limits: governor.ActuatorLimits
    output_limits: tuple[np.ndarray, np.ndarray]
    governor: governor.Governor
    integral_limit: float
    settled: int
    allowance: panel.Allowance
    gamma: float
    sample_time_s: float
    faster: float


def faster(settings: Panel, rehearsal: Rehearsal) -> float:
    """Share of a declared delay margin that is asked of a machine: below 1 for one that must settle sooner
    than the panel's. The whole answer of a hair dryer is over within 1 s."""
    return min((rehearsal.settling_s or settings.settling_s) / settings.settling_s, 1.0)


def conditions(
    tuning: TuneWeights,
    machine: Machine,
    tracking: Tracking,
    settings: Panel,
    rehearsal: Rehearsal,
    family: Sequence[plant.Plant],
) -> CaseConditions:
    """`family`: the identified plant first, then its spread."""
    band = rehearsal.band_degC / settings.band_degC
    late = (rehearsal.settling_s or settings.settling_s) / settings.settling_s
    # a slow machine is allowed its time, a small one its degrees
    allowance = panel.Allowance(
        outside=tuning.allow_settling_s * late / machine.sample_time_s,
        overshoot=tuning.allow_overshoot_degC * band,
        settled_error=tuning.allow_settled_error_degC * band,
        at_limits=tuning.allow_at_limits_percent,
        energy=tuning.allow_effort_percent,
        travel=tuning.allow_travel_percent,
        rms=tuning.allow_overshoot_degC * band,
    )
    # nearer to a reference than its noise no forecast can tell an overshoot
    overshoot = max(tracking.governor_overshoot_degC * band, 3 * float(rehearsal.noise.max()))
    return CaseConditions(
        rehearsal,
        input_limits(machine),
        output_limits(machine),
        watchdog(machine, settings, family, rehearsal.noise, overshoot),
        tracking.integral_limit_degC * band,
        round(settings.settled_steps * rehearsal.judging.steps / settings.steps),
        allowance,
        tracking.gamma,
        machine.sample_time_s,
        faster(settings, rehearsal),
    )


def design_problem(
    models: Mapping[str, Any], tracking: Tracking, setting: CaseConditions, truth: plant.Plant | None
) -> DesignProblem:
    """What controllers are designed from: the same for tuning and for judging, whatever the length of their
    cases. `models` has plant, family, window, kernel and printer_pid."""
    return DesignProblem(
        **models,
        truth=truth,
        limits=setting.limits,
        gamma=tracking.gamma,
        exact_tau=tracking.observer_tau,
        horizon=setting.rehearsal.judging.steps,
        noise=setting.rehearsal.noise,
    )


def deploy(design: Design, setting: CaseConditions) -> controller.Deployed:
    """A controller with what all of them run under."""
    return controller.deployed(
        design.law,
        setting.limits,
        integral_limit=setting.integral_limit,
        governor=setting.governor if design.governed else None,
        holds=design.holds,
    )


def play(
    design: Design, rests: Sequence[controller.Rest], half: panel.Cases, setting: CaseConditions
) -> tuple[panel.Rollout, panel.Figures]:
    """A controller over one half of the panel, as deployed; `rests` from panel.rests of its model."""
    rollout = panel.rolled_out(deploy(design, setting), half, panel.aims(design.law, rests, half))
    low, high = setting.output_limits
    figures = panel.figures(
        rollout,
        half,
        limits=setting.limits,
        low=low,
        high=high,
        band=setting.rehearsal.band_degC,
        settled=setting.settled,
    )
    return rollout, figures


def input_limits(machine: Machine) -> governor.ActuatorLimits:
    low, high = np.array([(i.low, i.high) for i in machine.inputs], float).T
    rate = np.array([i.rate_percent_per_s or np.inf for i in machine.inputs]) * machine.sample_time_s
    return governor.ActuatorLimits(low, high, rate)


def output_limits(machine: Machine) -> tuple[np.ndarray, np.ndarray]:
    """low, high (p,) in °C; -inf and inf where none is declared."""
    low = [-np.inf if o.low is None else o.low for o in machine.outputs]
    high = [np.inf if o.high is None else o.high for o in machine.outputs]
    return np.array(low), np.array(high)


def watchdog(
    machine: Machine, settings: Panel, family: Sequence[plant.Plant], noise: np.ndarray, overshoot: float
) -> governor.Governor:
    """The governor of all controllers: the identified plant, in time and a sample late, with inputs that act
    as the panel's spread has them; what it keeps from a limit is three deviations of the sensors' noise."""
    low, high = output_limits(machine)
    guarded, strength = panel.corners(family[:1], spread_of(settings))
    limits = governor.OutputLimits(low, high, 3 * noise, overshoot)
    return governor.governor(guarded, input_limits(machine), limits, strength)


def spread_of(settings: Panel) -> panel.PlantSpread:
    return panel.PlantSpread(
        settings.input_gain,
        settings.slower,
        settings.extra_heat_loss_per_step,
        settings.delayed,
        settings.ambient_degC,
    )


def spread_around(settings: Panel, identified: plant.Plant) -> panel.PlantSpread:
    """The declared spread, with no more heat lost than is little beside what somebody's machine loses."""
    spread, slowest = spread_of(settings), 1 - np.abs(np.linalg.eigvals(identified.A)).max()
    return spread._replace(extra_heat_loss=float(np.clip(0.2 * slowest, 0.0, spread.extra_heat_loss)))


def from_declaration(
    settings: Panel, machine: Machine, truth: plant.Plant, family: Sequence[plant.Plant]
) -> Rehearsal:
    """The study's machine: judged around the truth, tuned around the identified family, so that no controller
    may lean on what one identification got wrong."""
    reference = np.array([o.reference for o in machine.outputs])
    noise = np.full(len(reference), settings.noise_degC)
    judging, training = (
        _half(
            settings,
            half,
            around,
            _questions(half, reference, settings.steps),
            noise,
            cells=cells,
            steps=settings.steps,
            declared=spread_of(settings),
        )
        for half, around, cells in ((settings.judging, [truth], True), (settings.training, family, False))
    )
    limits = input_limits(machine)
    missed = scenario_defaults.unreachable(
        truth, (limits.low, limits.high), reference, *output_limits(machine)
    )
    cold = settings.judging.starts_degC[0] * np.ones_like(reference)
    return Rehearsal(
        judging,
        training,
        settings.band_degC,
        None,
        scenario_defaults.heat_up_s(family[0], cold, reference, limits.high),
        noise,
        _infeasible(machine, missed),
        "declared",
    )


def _questions(half: Half, reference: np.ndarray, steps: int) -> panel.Questions:
    def by_offset(offsets: Sequence[float]) -> np.ndarray:
        return np.array([reference + offset for offset in offsets])

    ones, slope = np.ones_like(reference), half.ramp_degC_per_step
    return panel.Questions(
        np.array([start * ones for start in half.starts_degC]),
        by_offset(half.reference_offsets_degC),
        (reference - slope * steps, slope * ones) if slope else None,
        (reference - 3 * half.sinusoid_degC, half.sinusoid_degC * ones, float(half.sinusoid_steps))
        if half.sinusoid_degC
        else None,
        by_offset(half.sequence_offsets_degC) if half.sequence_offsets_degC else None,
    )


def _half(
    settings: Panel,
    half: Half,
    around: Sequence[plant.Plant],
    questions: panel.Questions,
    noise: np.ndarray,
    *,
    cells: bool,
    steps: int,
    declared: panel.PlantSpread,
    limits: governor.ActuatorLimits | None = None,
) -> panel.Cases:
    """One half of the panel: cases of `steps` at most, on plants that lie around those of `around` as
    `declared` says; starts are held within `limits`."""
    rng = np.random.default_rng(half.seed)
    scaled = panel.PlantSpread(*(half.spread * value for value in declared))._replace(
        delayed=min(half.spread * declared.delayed, 1.0)
    )
    plants = panel.drawn(panel.padded(around), half.plants, scaled, cells=cells, rng=rng)
    return panel.asked(
        plants,
        questions,
        noise=noise,
        seed=half.seed,
        steps=round(half.length * steps),
        hold=settings.hold_steps,
        cells=cells,
        limits=limits,
    )


# of the recorded span, by which the ambient is varied at most where recordings do not differ by more: what
# spans 12 °C was not recorded in a room that may be 8 °C warmer
AMBIENT_SHARE = 0.25
HOLDABLE = (1.0, 0.75, 0.5, 0.25, 0.1)  # shares of it that are tried


def _ambient(
    spread: panel.PlantSpread,
    scale: scenario_defaults.MachineScale,
    identified: plant.Plant,
    limits: governor.ActuatorLimits,
    references: np.ndarray,
) -> float:
    """By how many °C the ambient of a plant may differ: as the panel says, at most AMBIENT_SHARE of the
    recorded span, and no further than the references (j, p) can still be held, which no controller could
    mend; but by as much as recordings of the same machine were found to differ."""

    def missed(warmer: float) -> float:
        moved = identified._replace(d=identified.d + warmer)
        at = [tracking.feasible_target(moved, r, limits.low, limits.high) for r in references]
        return max(float(np.abs(target.miss).max()) for target in at)

    most = min(spread.ambient_degC, AMBIENT_SHARE * float(np.min(scale.high_degC - scale.low_degC)))
    tolerated = missed(0.0) + scenario_defaults.REACHED_DEGC
    held = [
        share * most for share in HOLDABLE if max(map(missed, (share * most, -share * most))) <= tolerated
    ]
    return max(max(held, default=0.0), float(np.max(scale.ambient_degC_spread)))


def from_record(
    settings: Panel,
    machine: Machine,
    family: Sequence[plant.Plant],
    u: Sequence[np.ndarray],
    y: Sequence[np.ndarray],
    recordings: Sequence[int],
) -> Rehearsal:
    """Somebody's machine: both halves are drawn around plants of the identified family, and starts,
    references, band, settling limit and length follow from the record: segments u (T, m and more:
    disturbances follow the inputs) in percent and y (T, p) in °C, as segments.without_gaps returns them.

    What a plant may differ by: the spread is a bootstrap of the record, every second member for each half,
    and around each the panel's input gains, pace and delay. The ambient differs by `_ambient`. More heat is
    lost by a fifth of what the slowest mode loses at most.
    """
    identified = family[0]
    u = [a[:, : len(machine.inputs)] for a in u]
    (low, high), limits = output_limits(machine), input_limits(machine)
    scale = scenario_defaults.machine_scale(u, y, identified, machine.sample_time_s, recordings)
    asked = scenario_defaults.defaults(
        scale,
        identified,
        (limits.low, limits.high),
        np.array([o.reference for o in machine.outputs]),
        low,
        high,
        machine.sample_time_s,
    )
    spread = spread_around(settings, identified)
    spread = spread._replace(ambient_degC=_ambient(spread, scale, identified, limits, asked.references))
    lower = asked.references[-1]
    amplitude_degC, period_steps = asked.sinusoid
    swing = asked.references.mean(axis=0), amplitude_degC, float(period_steps)
    questions = panel.Questions(
        asked.starts, asked.references, (lower, asked.ramp_degC_per_step), swing, asked.sequence
    )
    training = panel.Questions(asked.starts, asked.references[:1], None, None, asked.sequence)
    judging, trained = (
        _half(
            settings,
            half,
            around,
            question,
            scale.noise_degC,
            cells=False,
            steps=asked.steps,
            declared=spread,
            limits=limits,
        )
        for half, around, question in (
            (settings.judging, family[1::2], questions),
            (settings.training, family[::2], training),
        )
    )
    return Rehearsal(
        judging,
        trained,
        asked.band_degC,
        asked.settling_s,
        scenario_defaults.heat_up_s(identified, asked.starts[0], asked.references[0], limits.high),
        scale.noise_degC,
        _infeasible(machine, asked.infeasible),
        "from the record",
    )


def _infeasible(machine: Machine, missed: list[scenario_defaults.Infeasible]) -> list[dict[str, Any]]:
    """References out of reach, and what binds."""
    return [
        {
            "output": machine.outputs[one.output].name,
            "asked_degC": one.asked_degC,
            "reachable_degC": one.reachable_degC,
            "binding": _binding(machine, one),
        }
        for one in missed
    ]


def _binding(machine: Machine, one: scenario_defaults.Infeasible) -> str:
    """What keeps a reference out of reach, in words."""
    if one.input is None:
        return {"inputs": "fewer inputs than references"}.get(one.limit, f"the declared {one.limit} limit")
    signal = machine.inputs[one.input]
    limit = signal.low if one.limit == "low" else signal.high
    return f"{signal.name} at {limit:g} {signal.unit}"
