"""Sections of the params files that several stages of the temperature loop read. The section of a single
stage is in the file of that stage."""

import re
from typing import Annotated, Literal

import pydantic
from pydantic import AfterValidator, Field

from pipeline.store import artifacts
from pipeline.store.params import Section

_TABLE_COLUMNS = ("recording", "segment", "time_s")


def _signal_name(name: str) -> str:
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", name):
        raise ValueError("but must consist of letters, digits and _ and not begin with a digit")
    if name in _TABLE_COLUMNS or name.endswith("_masked"):
        raise ValueError(
            f"but that is taken by the table of the record ({', '.join(_TABLE_COLUMNS)}, "
            "..._masked); rename the signal"
        )
    return name


class PlantSignal(Section):
    """A signal of the machine. Figures label their axes with its name and unit."""

    name: Annotated[str, AfterValidator(_signal_name)]
    unit: str = Field(min_length=1, max_length=20)


class Input(PlantSignal):
    """A heater or the motor. low and high are the limits of the machine in percent; rate_percent_per_s is how
    fast it may change (none: no limit). `heats`: raising it cannot lower any output in the steady state."""

    low: float = Field(ge=-100, le=100)
    high: float = Field(ge=-100, le=100)
    rate_percent_per_s: float | None = Field(default=None, gt=0, le=1e6)
    heats: bool = False

    @pydantic.model_validator(mode="after")
    def _ordered(self):
        if not self.low < self.high:
            raise ValueError(f"has low {self.low:g} but high {self.high:g}; low must be less than high")
        return self


class Output(PlantSignal):
    """A barrel temperature: its reference, and low and high, the temperatures between which the machine must
    stay, in °C. A simulated machine needs no limits."""

    reference: float = Field(ge=-273.15, le=1000)
    low: float | None = Field(default=None, ge=-273.15, le=2000)
    high: float | None = Field(default=None, ge=-273.15, le=2000)

    @pydantic.model_validator(mode="after")
    def _ordered(self):
        low, high = self.low, self.high
        if low is not None and high is not None and not low < high:
            raise ValueError(f"has low {low:g} but high {high:g}; low must be less than high")
        if not (-300 if low is None else low) <= self.reference <= (2000 if high is None else high):
            raise ValueError(
                f"has reference {self.reference:g} outside its low {low} and high {high}; mend one"
            )
        return self


class Plant(Section):
    """Section `plant`: the machine's signals and its sample time. `disturbances` are recorded signals that
    act on the outputs but that no controller sets: fan, feed, a sensor of the room."""

    inputs: list[Input] = Field(min_length=1, max_length=32)
    disturbances: list[PlantSignal] = Field(default=[], max_length=16)
    outputs: list[Output] = Field(min_length=1, max_length=32)
    sample_time_s: float = Field(gt=0, le=3600)

    @pydantic.model_validator(mode="after")
    def _unique(self):
        names = [signal.name for signal in [*self.acting, *self.outputs]]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(
                f"names {', '.join(twice)} more than once; give every input and output a name of its own"
            )
        return self

    @property
    def acting(self) -> list[PlantSignal]:
        """The signals that act on the outputs: inputs, then disturbances."""
        return [*self.inputs, *self.disturbances]


def recorded(machine: Plant, record: str) -> Plant:
    """Returns the machine without the zones that ingest left out of the table `record`. Controllers are
    designed and judged for this machine. If the table is missing or belongs to another machine, returns the
    machine as declared."""
    names = artifacts.column_names(record)
    sides = {
        side: [signal for signal in getattr(machine, side) if signal.name in names]
        for side in ("inputs", "disturbances", "outputs")
    }
    return machine.model_copy(update=sides) if sides["inputs"] and sides["outputs"] else machine


def check_output_limits(machine: Plant, source: str) -> None:
    """Raises ValueError if the source is recordings and an output has no limits, because only the owner knows
    how hot the machine may get."""
    lacking = [output.name for output in machine.outputs if output.low is None or output.high is None]
    if source == "recordings" and lacking:
        raise ValueError(
            f"params.yaml: plant.outputs: {', '.join(lacking)} should have low and high, the temperatures in "
            "degC between which the machine must stay, as generate_probing.source is recordings; add them, "
            f"as in {{name: {lacking[0]}, ..., low: 0, high: 280}}"
        )


class Tracking(Section):
    """Section `tracking`: what every controller and every comparison shares. Q = yardstick_q I and R =
    yardstick_r I are the weights of the common cost."""

    gamma: float = Field(gt=0, le=1)
    yardstick_q: float = Field(gt=0, le=1e6)
    yardstick_r: float = Field(gt=0, le=1e6)
    integral_limit_degC: float = Field(gt=0, le=1000)
    governor_overshoot_degC: float = Field(gt=0, le=1000)
    observer_tau: float = Field(gt=0, le=1000)


Degrees = Annotated[float, Field(ge=-273.15, le=1000)]
Offsets = Annotated[list[Annotated[float, Field(ge=-500, le=500)]], Field(max_length=20)]


class Half(Section):
    """One half of the panel: number of plants and their seed; `length` of a case as a share of panel.steps;
    `spread` of the plants as a share of the declared spread; temperatures at which they start; and references
    as offsets from plant.outputs: constant ones, a sequence, a ramp that ends at the reference, and a
    sinusoid about it."""

    seed: int = Field(ge=0, le=2**31)
    plants: int = Field(ge=2, le=100_000)
    length: float = Field(gt=0, le=1)
    spread: float = Field(ge=0, le=4)
    starts_degC: list[Degrees] = Field(min_length=1, max_length=20)
    reference_offsets_degC: Offsets = Field(min_length=1)
    sequence_offsets_degC: Offsets
    ramp_degC_per_step: float = Field(ge=0, le=100)
    sinusoid_degC: float = Field(ge=0, le=100)
    sinusoid_steps: int = Field(ge=4, le=1_000_000)


class Panel(Section):
    """Section `panel`: the plants and cases on which controllers are compared; the judging half is not used
    for learning or tuning. Plants vary around the machine: input gains 1 +- input_gain each, its speed
    divided by 1 +- slower, up to extra_heat_loss_per_step more heat loss, a share `delayed` of them with
    inputs one sample late, the ambient +- ambient_degC."""

    noise_degC: float = Field(ge=0, le=50)
    input_gain: float = Field(gt=0, lt=1)
    slower: float = Field(ge=0, lt=1)
    extra_heat_loss_per_step: float = Field(ge=0, lt=1)
    delayed: float = Field(ge=0, le=1)
    ambient_degC: float = Field(ge=0, le=200)
    steps: int = Field(ge=60, le=20000)
    settled_steps: int = Field(ge=10, le=5000)
    hold_steps: int = Field(ge=1, le=2000)
    band_degC: float = Field(gt=0, le=100)
    settling_s: float = Field(gt=0, le=1e6)
    training: Half
    judging: Half

    @pydantic.model_validator(mode="after")
    def _halves_differ(self):
        if self.training.seed == self.judging.seed:
            raise ValueError(
                f"uses seed {self.training.seed} in the training and in the judging half; "
                "give each half a seed of its own"
            )
        return self


# ---- sections of more than one stage


class GenerateProbing(Section):
    """Section `generate_probing`: how the study's machine is probed, and what the next experiment must do.
    `doubt_...` is the uncertainty that the identified family does not cover."""

    source: Literal["simulated", "recordings"]
    seed: int = Field(ge=0, le=2**31)
    signal: Literal["multisine", "prbs"]
    samples: int = Field(ge=50, le=1_000_000)
    amplitude_percent: float = Field(gt=0, le=100)
    rate_percent_per_step: float = Field(gt=0, le=200)
    shortest_steps: int = Field(ge=1, le=10_000)
    noise_degC: float = Field(ge=0, le=50)
    feedback_percent_per_degC: float = Field(ge=0, le=100)
    centre_percent: (
        Annotated[float, Field(ge=-100, le=100)]
        | Annotated[list[Annotated[float, Field(ge=-100, le=100)]], Field(min_length=1, max_length=32)]
        | None
    )
    doubt_input_gain: float = Field(ge=0, lt=1)
    doubt_ambient_degC: float = Field(ge=0, le=200)
    doubt_delay_steps: int = Field(ge=0, le=1000)


def given_centre(settings: GenerateProbing, machine: Plant) -> list[float] | None:
    """Returns the operating point (m,) that the user gives, as one number for all inputs or one each. Returns
    None if it is left to the model. Raises ValueError for another number of values."""
    given, count = settings.centre_percent, len(machine.inputs)
    if given is None:
        return None
    values = [float(value) for value in (given if isinstance(given, list) else [given])]
    if len(values) not in (1, count):
        raise ValueError(
            f"generate_probing.centre_percent has {len(values)} values, but plant has {count} "
            "inputs; give one for each, or one number for all"
        )
    return values if len(values) == count else values * count


class TuneWeights(Section):
    """Section `tune_weights`."""

    seed: int = Field(ge=0, le=2**31)
    practical_initial: int = Field(ge=4, le=5000)
    practical_evaluations: int = Field(ge=8, le=5000)
    allow_settling_s: float = Field(gt=0, le=1e6)
    allow_overshoot_degC: float = Field(gt=0, le=1000)
    allow_settled_error_degC: float = Field(gt=0, le=1000)
    allow_at_limits_percent: float = Field(gt=0, le=100)
    allow_effort_percent: float = Field(gt=0, le=100)
    allow_travel_percent: float = Field(gt=0, le=100)
    worst_case: float = Field(ge=0, le=1000)
    least_disk_margin: float = Field(ge=0, le=2)
    least_delay_margin_s: float = Field(ge=0, le=1e6)


class TemperatureRules(Section, extra="ignore"):
    """The limits of section `report` that a simulation of the temperature loop can check. settling_s null:
    panel.settling_s on the study's machine, a limit from the record on another. heating_s null: the settling
    limit plus the shortest time from cold."""

    settled_error_degC: float = Field(gt=0, le=1000)
    peak_error_degC: float = Field(gt=0, le=1000)
    settling_s: float | None = Field(gt=0, le=1e6)
    heating_s: float | None = Field(gt=0, le=1e6)
    overshoot_degC: float = Field(gt=0, le=1000)
    at_limits_percent: float = Field(gt=0, le=100)
    disk_margin: float = Field(gt=0, le=2)
    delay_margin_s: float = Field(gt=0, le=1e6)
