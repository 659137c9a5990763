"""Sections of the params files that the setpoint loop's stages read."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from pipeline.setpoint.material import Material
from pipeline.store.params import Mapped, Section

# as far as pixels.py looks for the nozzle's tip, in px: a number of its own, since that module imports much
REACH_PX = 30


Degrees = Annotated[float, Field(ge=100, le=500)]
Percent = Annotated[float, Field(ge=1, le=1000)]


class SetpointMaterial(Section):
    """Section `setpoint_material`: what is printed (material.Material)."""

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

    def material(self) -> Material:
        return Material(**self.model_dump())


class Counts(Section):
    """A number for each of the four parts of the classifier's frames."""

    learned: int = Field(ge=1, le=10_000)
    held_out: int = Field(ge=1, le=10_000)
    calibration: int = Field(ge=1, le=10_000)
    judged: int = Field(ge=1, le=10_000)


class Sweeps(Section):
    """Segments whose windows over the whole range of flows stand for the camera in the simulator: those that
    controllers are trained and tuned on, that the default is chosen on, and that are judged on. Many
    segments, as what a segment adds stays with its windows."""

    learn: int = Field(ge=1, le=10_000)
    choose: int = Field(ge=1, le=10_000)
    judge: int = Field(ge=1, le=10_000)


class SweepWindows(Section):
    """Windows of each of these segments in a bin of the flow, on average."""

    learn: float = Field(gt=0, le=100)
    choose: float = Field(gt=0, le=100)
    judge: float = Field(gt=0, le=100)


class RenderFrames(Section):
    """Section `render_frames`: segments are counted in fifteens, three at each of the five temperatures."""

    seed: int = Field(ge=0, le=2**31)
    segments: Counts
    frames: Counts
    sweeps: Sweeps
    sweep_windows: SweepWindows
    camera_segments: int = Field(ge=240, le=10_000)


class Recipe(Section):
    """How a network of one size is trained."""

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
    """Topics of a user's MCAP recordings, as frame_mcap.Topics says."""

    image: str = Field(max_length=300)
    time: str = Field(max_length=300)
    mapping: dict[str, Mapped]


class Constants(Section):
    """What a folder's CSV files do not say because it never changed: the nozzle's temperature in degC."""

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
    cnn: Recipe
    coverage: float = Field(gt=0.5, lt=1)
    confidence: float = Field(gt=0.5, lt=1)
    coverage_by_flow: float = Field(gt=0.5, lt=1)
    false_alarms: float = Field(gt=0, lt=0.5)


class Learning(Section):
    """Deep Q-learning: environments stepped together, batch, transitions remembered, steps of an episode,
    Adam's rate, discount, the target network's step, and how much is explored."""

    environments: int = Field(ge=1, le=100_000)
    batch: int = Field(ge=1, le=100_000)
    capacity: int = Field(ge=1000, le=10_000_000)
    episode: int = Field(ge=10, le=10_000)
    learning_rate: float = Field(gt=0, le=1)
    gamma: float = Field(ge=0, lt=1)
    tau: float = Field(gt=0, le=1)
    explore: float = Field(ge=0, le=1)
    least: float = Field(ge=0, le=1)


class Li2025(Learning):
    """The agent of Li and Pattinson (2025): updates of its phases, exploration again from the second on,
    accuracy of the last; classes of its history, eta, and flow actions to one of temperature, lambda."""

    history: int = Field(ge=1, le=1000)
    flow_actions: int = Field(ge=1, le=50)

    updates: list[Annotated[int, Field(ge=1, le=10_000_000)]] = Field(min_length=3, max_length=4)
    explore_again: float = Field(ge=0, le=1)
    accuracy: float = Field(gt=0.34, le=1)


class RobustFilter(Section):
    """The section of bayes.CameraErrorModel."""

    accuracies: list[Annotated[float, Field(gt=0.34, lt=1)]] = Field(min_length=1, max_length=20)
    gains: list[Annotated[float, Field(gt=0, le=10)]] = Field(min_length=1, max_length=20)
    width_bias_levels: int = Field(ge=1, le=51)
    width_bias_std: float = Field(gt=0, le=1)
    floor: float = Field(gt=0, lt=1)
    smoothing: float = Field(gt=0, le=100)
    segment_mean_decisions: float = Field(ge=1, le=10_000)
    mode_switch_probability: float = Field(gt=0, lt=1)
    window_repeat_probability: float = Field(ge=0, lt=1)
    hazard: float = Field(ge=0, lt=1)
    move_cost: float = Field(ge=0, le=10)
    outside_cost: float = Field(ge=0, le=1000)
    move_fixed_cost: float = Field(ge=0, le=100)
    known_start_share: float = Field(ge=0, lt=1)
    known_start_std: float = Field(gt=0, le=1)
    border_std: float = Field(ge=0, le=100)

    def hypotheses(self) -> int:
        return len(self.gains) * (len(self.accuracies) + self.width_bias_levels)


class Costs(Section):
    """Of a step, belief_agent.Costs."""

    scale: float = Field(gt=0, le=1000)
    outside: float = Field(ge=0, le=1000)
    move: float = Field(ge=0, le=10)


class Disturbances(Section):
    """What training episodes meet, belief_agent.Disturbances."""

    recorded_share: float = Field(ge=0, le=1)
    longest_segment: float = Field(ge=1, le=10_000)
    accuracy: float = Field(gt=0.34, le=1)
    gain: float = Field(gt=0, le=1)
    clog: float = Field(gt=0, le=1)
    clog_share: float = Field(ge=0, le=1)
    drift: float = Field(ge=0, le=0.1)


class BeliefDqn(Learning):
    """Belief DQN: the filter whose belief the network reads, what a step costs, what episodes meet,
    and rounds of updates, the best of which is kept."""

    filter: RobustFilter
    costs: Costs
    disturbances: Disturbances
    updates: int = Field(ge=1, le=10_000_000)
    rounds: int = Field(ge=1, le=1000)


class TrainAgent(Section):
    """Section `train_agent`."""

    seed: int = Field(ge=0, le=2**31)
    runs: int = Field(ge=1, le=10_000)
    li_2025: Li2025
    belief_dqn: BeliefDqn


class Proportional(Section):
    gain: float = Field(gt=0, le=1000)
    time_constant: float = Field(ge=1, le=1000)


class SequentialTest(Section):
    accuracy: float = Field(gt=0.34, lt=1)
    threshold: float = Field(gt=0, le=100)
    cap: float = Field(gt=0, le=100)


class ClassFilter(Section):
    accuracy: float = Field(gt=0.34, lt=1)
    hazard: float = Field(ge=0, lt=1)
    move_cost: float = Field(ge=0, le=10)
    outside_cost: float = Field(ge=0, le=1000)
    move_fixed_cost: float = Field(ge=0, le=100)
    known_start_share: float = Field(ge=0, lt=1)
    known_start_std: float = Field(gt=0, le=1)


class Baselines(Section):
    """Settings of the controllers without learning, tuned on windows and seeds that nothing is judged on."""

    proportional: Proportional
    filtered_proportional: Proportional
    sequential_test: SequentialTest
    bayes_exact: ClassFilter
    bayes_leak: ClassFilter
    bayes_robust: RobustFilter


class Pixels(Section):
    """The closed loop through rendered frames; none with 0 starts."""

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
    """Of runs from good starts those that may leave +-25 %, or a controller is no candidate: from 100 %, and
    from 92.5 to 107.5 % with a camera that is right, stuck or blind for a while."""

    perfect_percent: float = Field(ge=0, le=100)
    in_band_percent: float = Field(ge=0, le=100)


class EvaluateSetpoint(Section):
    """Section `evaluate_setpoint`. Segments are redrawn `redraws` times a round, in each of which whoever may
    still become the default runs `runs` times from each of 21 starts, in every case."""

    seed: int = Field(ge=0, le=2**31)
    runs: int = Field(ge=1, le=10_000)
    redraws: int = Field(ge=2, le=1000)
    rounds: int = Field(ge=1, le=100)
    most_harmed: MostHarmed
    segment_mean_decisions: float = Field(ge=1, le=10_000)
    baselines: Baselines
    pixels: Pixels
