"""Sections of the params files that the setpoint loop's stages read."""

from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, model_validator

from pipeline.store.params import Mapped, Section

if TYPE_CHECKING:
    from pipeline.setpoint.material import PrintedMaterial

# how far pixels.py searches for the nozzle's tip, in px; repeated here, since that module imports much
REACH_PX = 30


Degrees = Annotated[float, Field(ge=100, le=500)]
Percent = Annotated[float, Field(ge=1, le=1000)]


class SetpointMaterial(Section):
    """Section `setpoint_material`: the printed material (material.PrintedMaterial)."""

    best_temperature_degC: float = Field(ge=100, le=500)
    temperature_range_degC: tuple[Degrees, Degrees]
    good_flow_percent: tuple[Percent, Percent]
    flow_limits_percent: tuple[Percent, Percent]

    @model_validator(mode="after")
    def _in_order(self):
        low, high = self.temperature_range_degC
        if not low < self.best_temperature_degC < high:
            raise ValueError(
                f"has best_temperature_degC {self.best_temperature_degC:g} but temperature_range_degC "
                f"[{low:g}, {high:g}]; the best lies between the two"
            )
        ends = (self.flow_limits_percent[0], *self.good_flow_percent, self.flow_limits_percent[1])
        if not ends[0] < ends[1] < 100 < ends[2] < ends[3]:
            raise ValueError(
                f"has good_flow_percent [{ends[1]:g}, {ends[2]:g}] and flow_limits_percent [{ends[0]:g}, "
                f"{ends[3]:g}]; 100 lies between the first two, and they between the limits"
            )
        return self

    def material(self) -> "PrintedMaterial":
        from pipeline.setpoint.material import PrintedMaterial

        return PrintedMaterial(**self.model_dump())


class Counts(Section):
    """A number for each of the four parts of the classifier's frames."""

    learned: int = Field(ge=1, le=10_000)
    held_out: int = Field(ge=1, le=10_000)
    calibration: int = Field(ge=1, le=10_000)
    judged: int = Field(ge=1, le=10_000)


class Recipe(Section):
    """Training settings for a network of one size."""

    epochs: int = Field(ge=1, le=10_000)
    cycle_epochs: int = Field(ge=1, le=10_000)
    warmup_epochs: float = Field(ge=0, le=1000)
    batch: int = Field(ge=1, le=100_000)
    learning_rate: float = Field(gt=0, le=1)
    weight_decay: float = Field(ge=0, le=1)
    smoothing: float = Field(ge=0, lt=1)
    averaging: float = Field(ge=0, lt=1)
    patience: int = Field(ge=1, le=10_000)


class RecordedTopics(Section):
    """Topics of a user's MCAP recordings, as in nozzle_frames.Topics."""

    image: str = Field(max_length=300)
    time: str = Field(max_length=300)
    mapping: dict[str, Mapped]


class Constants(Section):
    """Values missing in a folder's CSV files because they never changed: the nozzle's temperature in degC."""

    hotend: float | None = Field(ge=0, le=600)


class TrainClassifier(Section):
    """Section `train_classifier`."""

    source: Literal["simulated", "recordings"]
    seed: int = Field(ge=0, le=2**31)
    size: Literal["small", "paper"]
    augmentation: Literal["along_bead", "adr"]
    prints: Counts
    window: int = Field(ge=1, le=1000)
    least_score: float = Field(ge=0, le=255)
    tip_px: tuple[Annotated[float, Field(ge=0, le=100_000)], Annotated[float, Field(ge=0, le=100_000)]] | None
    constants: Constants
    topics: RecordedTopics
    small: Recipe
    paper: Recipe
    least_right: float = Field(gt=1 / 3, lt=1)
    false_alarms: float = Field(gt=0, lt=0.5)


class FlowFilterSettings(Section):
    """Parameters of agents/flow_filter.py: probabilities for one decision, costs in percent of flow error."""

    gains: list[Annotated[float, Field(gt=0, le=10)]] = Field(min_length=1, max_length=20)
    biases: int = Field(ge=1, le=51)
    accuracy: float = Field(gt=0.34, lt=1)
    ends: float = Field(gt=0, le=1)
    hazard: float = Field(ge=0, lt=1)
    move_cost: float = Field(ge=0, le=10)
    move_fixed_cost: float = Field(ge=0, le=100)
    outside_cost: float = Field(ge=0, le=1000)
    border_std: float = Field(gt=0, le=100)
    known_start_share: float = Field(ge=0, lt=1)
    known_start_std: float = Field(gt=0, le=1)


class SequentialTestSettings(Section):
    accuracy: float = Field(gt=0.34, lt=1)
    threshold: float = Field(gt=0, le=100)
    cap: float = Field(gt=0, le=100)


class Baselines(Section):
    """Settings of the controllers without learning. They are declared, or tuned on segments that are not used
    in tests."""

    sequential_test: SequentialTestSettings
    flow_filter: FlowFilterSettings


class Pixels(Section):
    """The closed loop through rendered frames; it is not simulated if `starts` is 0."""

    starts: int = Field(ge=0, le=21)
    runs: int = Field(ge=1, le=1000)
    decisions: int = Field(ge=20, le=1000)
    frame_rate_hz: float = Field(gt=0, le=1000)
    wait_s: float = Field(ge=0, le=600)
    idle_wait_s: float = Field(ge=0, le=600)
    tip_tolerance_px: float = Field(ge=8, le=REACH_PX)
    per_action: tuple[Annotated[float, Field(gt=0, le=1000)], Annotated[float, Field(gt=0, le=1000)]]
    per_minute: tuple[Annotated[float, Field(gt=0, le=10_000)], Annotated[float, Field(gt=0, le=10_000)]]
    segment_mean_s: float = Field(gt=0, le=1e6)
    least_frames: int = Field(ge=1, le=1000)
    heater_s: float = Field(gt=0, le=1000)
    heater_delay_s: float = Field(ge=0, le=1000)
    melt_s: float = Field(gt=0, le=1000)
    softening_per_degC: float = Field(ge=0, le=1)


class MostHarmed(Section):
    """Percentages of runs from good starts that may leave +-25 %: from 100 %, and from 92.5 to 107.5 %. A
    controller above a limit is no candidate."""

    perfect_percent: float = Field(ge=0, le=100)
    in_band_percent: float = Field(ge=0, le=100)


class EvaluateSetpoint(Section):
    """Section `evaluate_setpoint`: `runs` from each of 21 starts in every case, on each pool of `pool`
    recorded segments; pools share no segment."""

    seed: int = Field(ge=0, le=2**31)
    runs: int = Field(ge=1, le=10_000)
    pool: int = Field(ge=1, le=10_000)
    most_harmed: MostHarmed
    segment_mean_decisions: float = Field(ge=1, le=10_000)
    baselines: Baselines
    pixels: Pixels
