"""Sections of the parameters that several stages of the deposition loop read: its machine with materials, its
camera, the laws that learn from trials, and how a part is composed.

Methods take values, not sections. The properties here make the values that a method takes, and import the
method's module only then.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal

import pydantic
from pydantic import Field

from pipeline.store.params import Mapped, Section

if TYPE_CHECKING:
    from pipeline.deposition.camera.line import Mounting
    from pipeline.deposition.drive import Drive
    from pipeline.deposition.extruder import Extruder, Routine
    from pipeline.deposition.learning.training import LawSettings, Noise
    from pipeline.deposition.parts.composition import PartSettings


class PrinterMaterial(Section):
    """A material as known before anything is learned: K / (tau s + 1) from the command to flow on the
    printer's nozzle, with K in mm^3/s per mm, or per mm/s of what is pushed."""

    name: str = Field(min_length=1, max_length=40, pattern=r"^[A-Za-z0-9_-]+$")
    tool: int = Field(ge=0, le=99)
    gain_mm3_per_s_per_mm: float = Field(gt=0, le=1e6)
    time_constant_s: float = Field(gt=0, le=1000)

    @property
    def nominal(self) -> Extruder:
        """The extruder as known beforehand."""
        from pipeline.deposition.extruder import Extruder

        return Extruder(self.gain_mm3_per_s_per_mm, self.time_constant_s)


class TrainingRoutine(Section):
    """A training routine: off, on, a pause of the gantry, on, off."""

    speed_mm_per_s: float = Field(gt=0, le=1000)
    pause_s: float = Field(gt=0, le=60)
    off_s: float = Field(gt=0, le=600)
    on_s: float = Field(gt=0, le=600)
    tail_s: float = Field(gt=0, le=600)


class PlungerDrive(Section):
    """The limits of the plunger's drive: largest |command| (its whole travel, if printer.command is a speed
    or a place), largest speed, and backlash."""

    amplitude_mm: float = Field(gt=0, le=1e6)
    speed_mm_per_s: float = Field(gt=0, le=1e6)
    backlash_mm: float = Field(ge=0, le=1000)


class Printer(Section):
    """Section `printer`: nozzle, bead, speed, limits of motion and of
    the plunger, and the materials with their tools."""

    sample_time_s: float = Field(gt=0, le=1)
    nozzle_mm: float = Field(gt=0, le=20)
    nozzle_outer_mm: float = Field(gt=0, le=50)
    bead_area_mm2: float = Field(gt=0, le=100)
    speed_mm_per_s: float = Field(gt=0, le=1000)
    ramp_s: float = Field(gt=0, le=60)
    longest_ramp_s: float | None = Field(default=None, gt=0, le=60)
    drive: PlungerDrive | None
    command: Literal["pressure", "speed", "place"] | None = None
    acceleration_mm_per_s2: float = Field(gt=0, le=1e6)
    junction_deviation_mm: float = Field(ge=0, le=10)
    gantry_speed_limit_mm_per_s: float = Field(gt=0, le=10_000)
    tool_change_s: float = Field(ge=0, le=3600)
    filament_mm: float | None = Field(gt=0, le=200)
    materials: list[PrinterMaterial] = Field(min_length=1, max_length=20)
    reference: TrainingRoutine
    routines: list[TrainingRoutine] = Field(max_length=20)

    @pydantic.model_validator(mode="after")
    def _distinct(self):
        for key in ("name", "tool"):
            values = [getattr(material, key) for material in self.materials]
            twice = sorted({value for value in values if values.count(value) > 1})
            if twice:
                raise ValueError(
                    f"gives {key} {twice[0]} to more than one material; "
                    f"give every material a {key} of its own"
                )
        return self

    @property
    def kind(self) -> Literal["pressure", "speed", "place"]:
        """The quantity that the machine responds to; a pressure if `command` is left out."""
        return self.command or "pressure"

    @pydantic.model_validator(mode="after")
    def _travels(self):
        if self.drive is None or self.kind == "pressure":
            return self
        longest_mm = max(2 * one.on_s * one.speed_mm_per_s for one in (self.reference, *self.routines))
        gain = min(material.gain_mm3_per_s_per_mm for material in self.materials)
        travel_mm = longest_mm * self.bead_area_mm2 / gain
        if travel_mm > self.drive.amplitude_mm:
            raise ValueError(
                f"has a drive with a travel of {self.drive.amplitude_mm:g} mm, but a training routine needs "
                f"{travel_mm:.3g} mm by {self.kind}; raise drive.amplitude_mm, or print shorter routines"
            )
        return self

    @property
    def limits(self) -> Drive:
        """The drive that commands obey; unlimited if none is declared. If the machine conserves volume, the
        command is a speed: only its size is limited, and backlash is learned."""
        from pipeline.deposition import drive

        if self.drive is None:
            return drive.UNLIMITED
        if self.kind != "pressure":
            return drive.Drive(self.drive.speed_mm_per_s, math.inf, 0.0)
        return drive.Drive(**self.drive.model_dump())

    @property
    def steady_flow(self) -> float:
        """Wanted flow of a line at full speed, mm^3/s."""
        return self.bead_area_mm2 * self.speed_mm_per_s

    @property
    def gantry(self) -> dict[str, float]:
        """How the gantry moves: keywords of `motion.plan`."""
        return {
            "acceleration": self.acceleration_mm_per_s2,
            "junction_deviation_mm": self.junction_deviation_mm,
            "speed_limit": self.gantry_speed_limit_mm_per_s,
            "unset_feed": self.speed_mm_per_s,
            "tool_change_s": self.tool_change_s,
        }

    def training_routines(self) -> list[Routine]:
        """Returns the training routines: the reference, on which laws are compared, and those of the library.
        If the drive needs longer ramps of the gantry, the pause is longer by the same time, so that the rest
        between the ramps is as long as before."""
        from pipeline.deposition import reachable
        from pipeline.deposition.extruder import routine

        trainings = [self.reference, *self.routines]
        fastest = max(t.speed_mm_per_s for t in trainings)
        # the pause is longer by this at all speeds, so that these are compared at one pause
        longer_s = 0.0
        if self.longest_ramp_s is not None:
            longer_s = reachable.ramp_of_all(
                [material.nominal for material in self.materials], self.limits,
                steady_flow=self.bead_area_mm2 * fastest, ramp_s=self.ramp_s,
                longest_s=self.longest_ramp_s, sample_time_s=self.sample_time_s,
            )  # fmt: skip
        return [
            routine(
                off_s=t.off_s, on_s=t.on_s, pause_s=round(t.pause_s + longer_s, 9), tail_s=t.tail_s,
                speed=t.speed_mm_per_s, bead_area_mm2=self.bead_area_mm2, ramp_s=self.ramp_s,
                gantry_ramp_s=round(longer_s * t.speed_mm_per_s / fastest, 9),
                sample_time_s=self.sample_time_s,
            )._replace(number=number)
            for number, t in enumerate(trainings)
        ]  # fmt: skip

    def expected_trials(self, routines: Sequence[Routine]) -> dict[str, Any]:
        """The trials that a folder may hold: keywords of `trial_files.group_trials`."""
        return {
            "materials": [material.name for material in self.materials],
            "nozzle": f"{self.nozzle_mm:g}",
            "routines": [routine.plan for routine in routines],
        }


class TrialTopics(Section):
    """Topics of a machine's own recordings of trials: the camera's (empty: the only one), the clock
    (log_time, publish_time, or a field of a stamp), and the mapping of our signals."""

    image: str = Field(max_length=300)
    time: str = Field(max_length=300)
    mapping: dict[str, Mapped]


Pixel = Annotated[float, Field(ge=-100_000, le=100_000)]


class Camera(Section):
    """Section `camera`: where it looks, how it was calibrated, and, for simulated trials, how hard the
    pictures are.

    Before it is measured, a picture is turned by rotation_deg, so that this direction of it runs along the
    columns, and shifted so that tip_px lies on nozzle_column. edge_bias_px is by how much beads of
    known_widths_mm look wider than they are.
    """

    frames_per_s: float = Field(gt=0, le=1000)
    mm_per_px: float = Field(gt=-10, lt=10)
    rotation_deg: float | None = Field(ge=-360, le=360)
    tip_px: list[Pixel] | None = Field(min_length=2, max_length=2)
    nozzle_column: float = Field(ge=-10_000, le=10_000)
    columns: list[Annotated[int, Field(ge=0, le=10_000)]] = Field(min_length=2, max_length=2)
    mask_px: list[Annotated[list[Pixel], Field(min_length=2, max_length=2)]] = Field(max_length=100)
    bead: Literal["light", "dark", ""]
    contact_angle_deg: float = Field(gt=0, lt=180)
    known_widths_mm: list[Annotated[float, Field(gt=0, le=100)]] = Field(min_length=3, max_length=20)
    edge_bias_px: list[Annotated[float, Field(ge=-50, le=50)]] = Field(max_length=20)
    latency_s: float | None = Field(ge=-1, le=1)
    topics: TrialTopics
    width_deviation_mm: float = Field(ge=0, le=10)
    longest_blur_px: float = Field(gt=0, le=50)
    unreadable_share: float = Field(ge=0, le=1)
    scene: Literal["nominal", "hard"]
    encoding: Literal["jpeg", "png", "raw"]

    @pydantic.model_validator(mode="after")
    def _looks(self):
        if abs(self.mm_per_px) < 1e-6:
            raise ValueError(
                f"has mm_per_px {self.mm_per_px:g}; give the size of a pixel on the stage, "
                "negative if the line trails to higher columns"
            )
        if self.columns[1] <= self.columns[0]:
            raise ValueError(
                f"has columns {self.columns[0]} to {self.columns[1]}; give the first and, behind it, "
                "the last that is measured"
            )
        if self.edge_bias_px and len(self.edge_bias_px) != len(self.known_widths_mm):
            raise ValueError(
                f"has {len(self.edge_bias_px)} edge_bias_px for {len(self.known_widths_mm)} known_widths_mm; "
                "give one each, or [] if the camera is not calibrated"
            )
        if any(
            wider <= width
            for width, wider in zip(self.known_widths_mm, self.known_widths_mm[1:], strict=False)
        ):
            raise ValueError("has known_widths_mm that do not grow; sort them, edge_bias_px with them")
        return self

    @property
    def mounting(self) -> Mounting:
        """How the camera is mounted, and which part of its pictures is measured."""
        from pipeline.deposition.camera.line import Mounting

        known_px = [known / abs(self.mm_per_px) for known in self.known_widths_mm]
        return Mounting(
            self.mm_per_px, self.nozzle_column, (self.columns[0], self.columns[1]), self.longest_blur_px,
            {"light": 1, "dark": -1, "": 0}[self.bead], self.rotation_deg,
            None if self.tip_px is None else (self.tip_px[0], self.tip_px[1]), self.mask_px,
            list(zip(known_px, self.edge_bias_px, strict=False)),
        )  # fmt: skip

    def film(self, printer: Printer) -> dict[str, Any]:
        """Returns how a simulated trial is filmed: keywords of `rendering.simulate_trial`."""
        from pipeline.deposition.camera.flow import View

        return {
            "view": View(self.mm_per_px, self.nozzle_column),
            "frame_rate_hz": self.frames_per_s,
            "nozzle_mm": (printer.nozzle_mm / 2, printer.nozzle_outer_mm / 2),
            "contact_angle_deg": self.contact_angle_deg,
        }

    @property
    def recording(self) -> dict[str, Any]:
        """How a recording of a trial is opened: keywords of `trial_files.open_trial`."""
        return {**dict(self.topics), "unreadable_share": self.unreadable_share}

    @property
    def looks(self) -> dict[str, Any]:
        """The settings that decide what is read from a recording."""
        names = {
            "mm_per_px", "nozzle_column", "columns", "rotation_deg", "tip_px", "mask_px", "bead", "topics",
            "longest_blur_px", "unreadable_share",
        }  # fmt: skip
        return self.model_dump(include=names)

    def straight(self) -> Camera:
        """Returns the camera of a simulated machine. It is mounted straight, and its width errors are those
        that its own calibration finds."""
        return self.model_copy(
            update={
                "rotation_deg": 0.0, "tip_px": None, "mask_px": [], "bead": "", "edge_bias_px": [],
                "topics": TrialTopics(image="", time="", mapping={}),
            }
        )  # fmt: skip


def trial_conditions(
    printer: Printer, camera: Camera, material: PrinterMaterial, routine: Routine, trial: int, law: str,
    calibration: tuple[float, float],
) -> dict[str, Any]:  # fmt: skip
    """Returns the conditions stored with the recording of a trial: fields of `trial_files.TrialConditions`.
    calibration is (gain, offset) of widths in mm against px."""
    gain, offset = calibration
    return {
        "material": material.name,
        "nozzle": f"{printer.nozzle_mm:g}",
        "trial": trial,
        "law": law,
        **routine.plan,
        "bead_area_mm2": printer.bead_area_mm2,
        "px_per_mm": 1 / gain,
        "offset_px": -offset / gain,
        "contact_angle_deg": camera.contact_angle_deg,
        "mm_per_px": camera.mm_per_px,
        "nozzle_column": camera.nozzle_column,
    }


class TrialNoise(Section):
    """Disturbances that do not repeat from trial to trial: white noise and drift in percent of the steady
    flow, the gain of a whole trial in percent."""

    white_percent: float = Field(ge=0, le=100)
    drift_percent: float = Field(ge=0, le=100)
    gain_percent: float = Field(ge=0, le=100)


class Hoelzle2009(Section):
    """The paper's law, u <- Q (u + k_p P^-1 e) (Hoelzle 2009, eq. 2)."""

    learning_gain: float = Field(gt=0, le=2)
    fast_zero_s: float = Field(gt=0, le=10)
    order: int = Field(ge=1, le=10)
    cutoff_hz: float = Field(gt=0, le=1000)


class ModelInverse(Section):
    """Settings of the law by the inverse of the model that the first trials identify."""

    identify_trials: int = Field(ge=1, le=100)
    floor: float = Field(gt=0, le=1)
    order: int = Field(ge=1, le=10)
    cutoff_hz: float = Field(gt=0, le=1000)
    rise: float = Field(gt=0, le=10)


class TrainIlc(Section):
    """Section `train_ilc`."""

    source: Literal["simulated", "recordings"]
    seed: int = Field(ge=0, le=2**31)
    trials: int = Field(ge=1, le=1000)
    pixel_trials: int = Field(ge=0, le=1000)
    family_plants: int = Field(ge=1, le=100_000)
    worst_ratio: float = Field(gt=0, le=1)
    noise: TrialNoise
    hoelzle_2009: Hoelzle2009
    model_inverse: ModelInverse

    def laws(self, printer: Printer) -> LawSettings:
        """Returns the settings of both laws on this printer."""
        from pipeline.deposition.learning.ilc import HoelzleSettings, InverseSettings
        from pipeline.deposition.learning.training import LawSettings

        inverse = self.model_inverse.model_dump()
        rise = inverse.pop("rise")
        hoelzle = HoelzleSettings(**self.hoelzle_2009.model_dump())
        return LawSettings(printer.sample_time_s, printer.limits, hoelzle, InverseSettings(**inverse), rise)

    @property
    def shares(self) -> Noise:
        """Disturbances that do not repeat from trial to trial, as shares of the steady flow."""
        from pipeline.deposition.learning.training import Noise

        noise = self.noise
        return Noise(noise.white_percent / 100, noise.drift_percent / 100, noise.gain_percent / 100)


class ComposeParts(Section):
    """Section `compose_parts`."""

    seed: int = Field(ge=0, le=2**31)
    corner_deg: float = Field(gt=0, le=180)
    longest_pause_s: float = Field(ge=0, le=600)
    shortest_s: float = Field(ge=0, le=600)
    largest_error_percent: float = Field(gt=0, le=1000)
    full_part_updates: int = Field(ge=1, le=1000)

    def of_part(self, printer: Printer) -> PartSettings:
        """Returns how a part is printed on this printer."""
        from pipeline.deposition.parts.composition import PartSettings

        return PartSettings(
            printer.nozzle_mm, printer.bead_area_mm2, printer.ramp_s, self.corner_deg,
            self.longest_pause_s, printer.limits, printer.kind,
        )  # fmt: skip
