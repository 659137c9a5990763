"""Section `report`: the limits of the rules by which a verdict is made."""

from pydantic import Field

from pipeline.store import params

# what `beadline quick` writes before the verdict: what is smaller than in a full run
QUICK_LOOK = "reports/quick_look.json"


class ReportRules(params.Section):
    """Section `report`: what a controller must hold to be ready; of the temperature loop at the 90 %
    quantile of all cases, margins on the plant that a tenth of all plants lie below. The comparison
    resolves settling_s and heating_s where they are null."""

    settled_error_degC: float = Field(gt=0, le=1000)
    peak_error_degC: float = Field(gt=0, le=1000)
    settling_s: float | None = Field(gt=0, le=1e6)
    heating_s: float | None = Field(None, gt=0, le=1e6)
    overshoot_degC: float = Field(gt=0, le=1000)
    at_limits_percent: float = Field(gt=0, le=100)
    disk_margin: float = Field(gt=0, le=2)
    delay_margin_s: float = Field(gt=0, le=1e6)
    flow_error_percent: float = Field(gt=0, le=1e6)
    line_volume_percent: float = Field(gt=0, le=1e6)
    above_whole_points: float = Field(ge=0, le=1e6)
    learned_percent: float = Field(gt=0, le=1e6)
    settled_percent: float = Field(gt=0, le=100)
    stay_percent: float = Field(gt=0, le=100)
    image_accuracy: float = Field(gt=0, le=1)
    window_right_70_150: float = Field(gt=0, le=1)
    ece_image: float = Field(gt=0, le=1)
    ece_window: float = Field(gt=0, le=1)
