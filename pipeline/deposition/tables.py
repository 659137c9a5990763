"""The tables of the deposition loop's stages: columns with type, unit, meaning and range, and a version.

If the columns change, raise the version number.
"""

from pipeline.deposition.controllers import COMPOSERS
from pipeline.store.tables import BOOL, COUNT, FLOAT, INDEX, NONE, TEXT, Column, Schema, list_of

TRIALS = Schema(
    "trials",
    2,
    (
        Column("material", TEXT, NONE, "material"),
        Column(
            "law",
            TEXT,
            NONE,
            "hoelzle_2009: law (2) of the study; hoelzle_2009_nominal: the same on its own nominal model; "
            "model_inverse: inverse of the identified model; pixels: the same, the flow measured from camera "
            "frames",
        ),
        Column("routine", INDEX, NONE, "which training routine, counted from 0", low=0),
        Column("speed_mm_per_s", FLOAT, "mm/s", "printing speed of the routine", low=0),
        Column("pause_s", FLOAT, "s", "its pause", low=0),
        Column("trial", INDEX, NONE, "updates before this trial", low=0),
        Column(
            "rms_true",
            FLOAT,
            "mm^3/s",
            "root mean square error of the true flow; missing on a real machine",
            low=0,
            nullable=True,
        ),
        Column("rms_measured", FLOAT, "mm^3/s", "root mean square error of the measured flow", low=0),
        Column(
            "ratio",
            FLOAT,
            NONE,
            "error as share of trial 0's: of the true flow where known, of the measured one elsewhere",
            low=0,
        ),
        Column("peak_over_steady", FLOAT, NONE, "largest command as multiple of the steady one", low=0),
        Column("saturated", FLOAT, NONE, "share of time at a limit of the drive", 0, 1),
        Column("rolled_back", BOOL, NONE, "the error rose, and the next command went back to the best trial"),
    ),
)
LESSONS = Schema(
    "lessons",
    2,
    (
        Column("material", TEXT, NONE, "material"),
        Column("law", TEXT, NONE, "hoelzle_2009, hoelzle_2009_nominal, model_inverse or pixels"),
        Column("routine", INDEX, NONE, "which training routine, counted from 0", low=0),
        Column("trial", INDEX, NONE, "updates before this trial", low=0),
        Column("time_s", FLOAT, "s", "time since the trial began"),
        Column("wanted_mm3_per_s", FLOAT, "mm^3/s", "wanted flow"),
        Column("command_mm", FLOAT, "mm", "plunger command as the drive applied it"),
        Column(
            "measured_mm3_per_s",
            FLOAT,
            "mm^3/s",
            "measured flow; missing where it could not be observed",
            nullable=True,
        ),
        Column("true_mm3_per_s", FLOAT, "mm^3/s", "true flow; missing on a real machine", nullable=True),
    ),
)
LIBRARY = Schema(
    "library",
    1,
    (
        Column("task", TEXT, NONE, "Stop, Start, Corner, Steady-State or No-Flow"),
        Column("material", TEXT, NONE, "material"),
        Column("nozzle_mm", FLOAT, "mm", "inner diameter of the nozzle", low=0),
        Column("speed_mm_per_s", FLOAT, "mm/s", "printing speed that it was learned at", low=0),
        Column("pause_s", FLOAT, "s", "pause that it was learned with; 0 but for a Corner", low=0),
        Column("lead", COUNT, NONE, "samples that it begins ahead of its event", low=0),
        Column("length", COUNT, NONE, "samples that follow", low=0),
        Column("signal_mm", list_of(FLOAT), "mm", "the basis signal"),
    ),
)
FILMED = Schema(
    "filmed",
    1,
    (
        Column("material", TEXT, NONE, "material"),
        Column("routine", INDEX, NONE, "which training routine, counted from 0", low=0),
        Column("trial", INDEX, NONE, "updates before this trial", low=0),
        Column("frames", COUNT, NONE, "frames read", low=0),
        Column("rejected", COUNT, NONE, "frames without a usable bead", low=0),
        Column("reasons", TEXT, NONE, "why, with counts"),
        Column(
            "deviation_mm3_per_s", FLOAT, "mm^3/s", "median standard deviation of the measured flow", low=0
        ),
        Column("observable", FLOAT, NONE, "share of the time in which the flow could be observed", 0, 1),
        Column("outliers", COUNT, NONE, "places that disagreed with their neighbours and count less", low=0),
    ),
)
SIGNALS = Schema(
    "signals",
    2,
    (
        Column("part", TEXT, NONE, "part program"),
        Column("tool", INDEX, NONE, "tool", low=0),
        Column("material", TEXT, NONE, "its material"),
        Column("time_s", FLOAT, "s", "time since the plunger may move first"),
        Column("x_mm", FLOAT, "mm", "gantry"),
        Column("y_mm", FLOAT, "mm", "gantry"),
        Column("wanted_mm3_per_s", FLOAT, "mm^3/s", "wanted flow"),
        Column("command_mm", FLOAT, "mm", "plunger command of the composer that was chosen"),
        Column("predicted_mm3_per_s", FLOAT, "mm^3/s", "flow that the identified chain predicts for it"),
        *(
            Column(f"{one.name}_mm3_per_s", FLOAT, "mm^3/s", one.flow, nullable=one.kind == "reference")
            for one in COMPOSERS
        ),
    ),
)
SCORES = Schema(
    "scores",
    1,
    (
        Column("part", TEXT, NONE, "part program"),
        Column("material", TEXT, NONE, "material"),
        Column("composer", TEXT, NONE, "name in the table of controllers; ilc: full-part ILC"),
        Column("chosen", BOOL, NONE, "predicted to do best, and taken"),
        Column(
            "rms_percent_of_on_off",
            FLOAT,
            "percent",
            "root mean square error of the true flow, as share of on-off control's; "
            "predicted on a real machine",
            low=0,
        ),
        Column(
            "predicted_percent",
            FLOAT,
            "percent",
            "the same as predicted beforehand; missing where nothing predicts it",
            low=0,
            nullable=True,
        ),
        Column(
            "worst_line_volume_percent",
            FLOAT,
            "percent",
            "largest error of a printed line's volume, of lines long enough to be judged; "
            "missing where there is none",
            nullable=True,
        ),
    ),
)
PRINTS = Schema(
    "prints",
    1,
    (
        Column("part", TEXT, NONE, "part program"),
        Column("material", TEXT, NONE, "material"),
        Column("composer", TEXT, NONE, "name in the table of controllers; ilc: full-part ILC"),
        Column(
            "prints", COUNT, NONE, "prints that it had learned from: of training routines, or of the part"
        ),
        Column(
            "rms_percent_of_on_off",
            FLOAT,
            "percent",
            "root mean square error of the true flow, as share of on-off control's",
            low=0,
        ),
    ),
)
TASKS = Schema(
    "tasks",
    1,
    (
        Column("part", TEXT, NONE, "part program"),
        Column("task", TEXT, NONE, "No-Flow, Start, Steady-State, Corner, Stop or Dwell"),
        Column("tool", INDEX, NONE, "tool", low=0),
        Column("line", COUNT, NONE, "line of the program that calls for it", low=0),
        Column("begin_s", FLOAT, "s", "its event"),
        Column("end_s", FLOAT, "s", "its end"),
        Column("speed_mm_per_s", FLOAT, "mm/s", "printing speed", low=0),
        Column("pause_s", FLOAT, "s", "time lost at a Corner", low=0),
        Column(
            "error_percent",
            FLOAT,
            "percent",
            "predicted error of the library's signal; missing where nothing tells it",
            nullable=True,
        ),
    ),
)
LINES = Schema(
    "lines",
    2,
    (
        Column("part", TEXT, NONE, "part program"),
        Column("line", COUNT, NONE, "line of the program", low=0),
        Column("tool", INDEX, NONE, "tool", low=0),
        Column("begin_s", FLOAT, "s", "begin"),
        Column("duration_s", FLOAT, "s", "duration", low=0),
        Column("length_mm", FLOAT, "mm", "length", low=0),
        Column("planned_mm3", FLOAT, "mm^3", "planned volume: by E, else bead area x length", low=0),
        Column("predicted_mm3", FLOAT, "mm^3", "predicted volume"),
        Column("on_off_mm3", FLOAT, "mm^3", "predicted volume of on-off control"),
        Column("error_percent", FLOAT, "percent", "predicted less planned; missing for dots", nullable=True),
        Column("shorter_than_lead", BOOL, NONE, "its whole run is shorter than the lead of Stop"),
        Column("low_percent", FLOAT, "percent", "lower end of the error's 90 % interval", nullable=True),
        Column("high_percent", FLOAT, "percent", "upper end of the error's 90 % interval", nullable=True),
    ),
)
