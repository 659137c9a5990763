"""Section `nightly` of the parameters: when to promote, what counts as drift, and who is notified."""

import re
from typing import Annotated, Literal

import pydantic
from pydantic import AfterValidator, Field

from pipeline.store.params import Section


def _in_the_project(path: str) -> str:
    """Returns a path that a run copies or moves. Raises ValueError if it lies outside the project."""
    if path.startswith(("/", "~")) or ".." in path.split("/"):
        raise ValueError("but must lie in the project's folder")
    return path


Inside = AfterValidator(_in_the_project)
Path = Annotated[str, Field(min_length=1, max_length=300), Inside]


class NightlyLoop(Section):
    """One control loop: the files of its controller (`artifacts`), and the source of the judge's evidence.
    This is a test set of its own (temperature), what its stage scored on cases that nothing was trained on
    (deposition, setpoint), or a file of costs by case."""

    artifacts: list[Path] = Field(min_length=1, max_length=50)
    judge: Literal["temperature", "deposition", "setpoint", "cases"]
    cases: str = Field(max_length=300)
    recordings: Annotated[str, Field(max_length=300), Inside]

    @pydantic.model_validator(mode="after")
    def _cases_have_a_file(self):
        if (self.judge == "cases") != bool(self.cases):
            raise ValueError(
                f'has judge {self.judge} but cases "{self.cases}"; '
                "name the file of costs if judge is cases, and only there"
            )
        if self.cases and self.cases not in self.artifacts:
            raise ValueError(
                f"has cases {self.cases} that are not among its artifacts; add them there, "
                "so that the champion keeps its own"
            )
        return self


class PromotionRule(Section):
    """A challenger must be better beyond noise, by a margin worth a change, and no guard may be worse by more
    than allowed."""

    level: float = Field(gt=0, le=0.2)
    least_improvement_percent: float = Field(ge=0, le=100)
    worst_case_percent: float = Field(ge=0, le=1000)
    settled_error_degC: float = Field(ge=0, le=100)
    least_disk_margin: float = Field(ge=0, le=2)
    holdout_error_percent: float = Field(ge=0, le=1000)


class HoldOut(Section):
    """The temperature loop's hold-out test: `controller` that runs on the machine (`page`: the one that the
    page names); on how many `plants`; from which starts to which references; `seed`, which no stage uses. The
    plants are made from the recordings in `recordings`."""

    controller: Literal[
        "page",
        "printer_pid",
        "pi_simc",
        "pi",
        "subspace_lqg",
        "varx_riccati",
        "learned_kernel",
        "predictive_control",
    ]
    recordings: Path
    starts_degC: list[Annotated[float, Field(ge=-273.15, le=1000)]] = Field(min_length=1, max_length=20)
    reference_offsets_degC: list[Annotated[float, Field(ge=-500, le=500)]] = Field(
        min_length=1, max_length=20
    )
    noise_degC: float = Field(ge=0, le=50)
    seed: int = Field(ge=0, le=2**31)
    plants: int = Field(ge=2, le=100_000)
    steps: int = Field(ge=60, le=20000)


class DriftLimits(Section):
    """Limits of each figure, and the required certainty. A change of the machine is an alarm if its estimate,
    pooled over nights, is past its limit by `limit_sigmas`. A change of a picture or of the closed loop is an
    alarm if it leaves its band by `alarm_sigmas` at once, or by `watch_sigmas` in two successive runs."""

    limit_sigmas: float = Field(ge=0, le=100)
    alarm_sigmas: float = Field(gt=1, le=100)
    watch_sigmas: float = Field(gt=1, le=100)
    parameter_percent: float = Field(gt=0, le=1000)
    time_constant_percent: float = Field(gt=0, le=1000)
    delay_s: float = Field(gt=0, le=10000)
    offset_degC: float = Field(gt=0, le=1000)
    ambient_degC: float = Field(gt=0, le=1000)
    noise_percent: float = Field(gt=0, le=1000)
    effort_percent: float = Field(gt=0, le=100)
    at_limits_points: float = Field(gt=0, le=100)
    camera_px: float = Field(gt=0, le=1000)
    contrast_percent: float = Field(gt=0, le=1000)
    balance_points: float = Field(gt=0, le=100)


class Nightly(Section):
    """Section `nightly`."""

    promotion: Literal["at_once", "branch"]
    branch: str = Field(min_length=1, max_length=100)
    remote: str = Field(max_length=100)
    longest_h: float = Field(gt=0, le=168)
    least_free_mb: float = Field(ge=0, le=1e7)
    watch_h: float = Field(gt=0, le=10000)
    alarm: str = Field(max_length=1000)
    webhook: str = Field(max_length=1000)
    heartbeat: str = Field(max_length=1000)
    loops: dict[Annotated[str, Field(min_length=1, max_length=40)], NightlyLoop]
    rule: PromotionRule
    holdout: HoldOut
    drift: DriftLimits

    @pydantic.model_validator(mode="after")
    def _loop(self):
        if not self.loops:
            raise ValueError("has no loops; name at least one, with its artifacts and judge")
        for name, loop in self.loops.items():
            if not re.fullmatch(r"\w[\w-]*", name):
                raise ValueError(
                    f"has loop {name!r}, which cannot be the name of a folder in champion/; "
                    "name it by letters, digits, _ and -"
                )
            # pages and alarms go by the name: a loop's drift must not be read as another's
            if loop.judge != "cases" and loop.judge != name:
                raise ValueError(
                    f"has loop {name} with judge {loop.judge}; name the loop {loop.judge}, "
                    "or let it be judged by cases"
                )
        return self
