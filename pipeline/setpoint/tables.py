"""The tables of the setpoint loop's stages: columns with type, unit, meaning and range, and a version."""

from pipeline.store.tables import BOOL, COUNT, FLOAT, INDEX, NONE, TEXT, Column, Schema

_SHARES = tuple(
    Column(f"p_{name}", FLOAT, NONE, f"share of the class {name}, calibrated", 0, 1)
    for name in ("under", "good", "over")
)
_CLASS = "0 under, 1 good, 2 over"

# parts of the frames: for training, early stopping, calibration and test of the classifier
FRAME_PARTS = ("learned", "held_out", "calibration", "judged")
# parts of the windows: to train and tune controllers, to choose the default, and for one final test; no
# segment is in two of them
WINDOW_PARTS = ("learn", "choose", "judge")

CLASSIFIED = Schema(
    "classified",
    2,
    (
        Column(
            "segment",
            INDEX,
            NONE,
            "segment or print that the frame is of; none of them was learned or calibrated on",
            low=0,
        ),
        Column("flow_percent", FLOAT, "percent", "true flow, of nominal", low=0),
        Column("temperature_degC", FLOAT, "degC", "nozzle temperature"),
        Column("label", INDEX, NONE, f"true class: {_CLASS}", 0, 2),
        *_SHARES,
        Column("named", INDEX, NONE, f"class named by the vision transformer: {_CLASS}", 0, 2),
        Column("distance", FLOAT, NONE, "Mahalanobis distance of the features from what was learned", low=0),
    ),
)

RELIABILITY = Schema(
    "reliability",
    1,
    (
        Column("of", TEXT, NONE, "image, or window of frames of one segment"),
        Column("method", TEXT, NONE, "raw or calibrated (image); hard_counts or flow (window)"),
        Column("low", FLOAT, NONE, "confidence from", 0, 1),
        Column("high", FLOAT, NONE, "confidence to", 0, 1),
        Column("count", COUNT, NONE, "images or windows in this bin", low=0),
        Column("confidence", FLOAT, NONE, "their mean confidence", 0, 1, nullable=True),
        Column("accuracy", FLOAT, NONE, "share of them that is right", 0, 1, nullable=True),
    ),
)

CLASSIFIER_CURVE = Schema(
    "course",
    1,
    (
        Column("learner", TEXT, NONE, "vision transformer"),
        Column("epoch", INDEX, NONE, "epochs done", low=0),
        Column("training_loss", FLOAT, NONE, "mean cross entropy of the epoch's batches"),
        Column("held_out_loss", FLOAT, NONE, "the same on segments that are only watched", nullable=True),
        Column("held_out_accuracy", FLOAT, NONE, "share that is right there", 0, 1, nullable=True),
    ),
)

WINDOWS = Schema(
    "windows",
    2,
    (
        Column(
            "part",
            TEXT,
            NONE,
            "learn: controllers are trained and tuned on these; choose: the default is chosen on these; "
            "judge: read once, for the figures told",
        ),
        Column("flow_percent", FLOAT, "percent", "true flow, of nominal", low=0, nullable=True),
        Column("flow_bin", INDEX, NONE, "bin of the true flow", low=0),
        Column("flow_low_percent", FLOAT, "percent", "its lower edge", low=0),
        Column("flow_high_percent", FLOAT, "percent", "its upper edge", low=0),
        Column("segment", INDEX, NONE, "segment that the window is of", low=0),
        *_SHARES,
        Column("named", INDEX, NONE, f"class of the window: {_CLASS}", 0, 2),
        Column("flow_seen_percent", FLOAT, "percent", "flow that the window shows", low=0, nullable=True),
        Column("spread", FLOAT, NONE, "its relative standard deviation", low=0, nullable=True),
    ),
)

AGENT_CURVE = Schema(
    "agents",
    2,
    (
        Column("agent", TEXT, NONE, "li_2025: as published"),
        Column("phase", INDEX, NONE, "phase of training, from 1", low=1),
        Column("update", COUNT, NONE, "updates done in all phases so far", low=0),
        Column("reward", FLOAT, NONE, "mean reward of a step in the reward of that phase"),
    ),
)


def _share(name: str, meaning: str) -> tuple[Column, ...]:
    """Returns four columns: a share of runs, its interval, and its number of independent runs."""
    return (
        Column(f"{name}_percent", FLOAT, "percent", meaning, 0, 100, nullable=True),
        Column(
            f"{name}_low_percent", FLOAT, "percent", "lower end of its 95 % interval", 0, 100, nullable=True
        ),
        Column(f"{name}_high_percent", FLOAT, "percent", "upper end", 0, 100, nullable=True),
        Column(f"{name}_n_eff", FLOAT, NONE, "as many runs that share nothing", 0, nullable=True),
    )


_WHO = (
    Column("controller", TEXT, NONE, "who sets flow and temperature"),
    Column("kind", TEXT, NONE, "model-based, data-driven or baseline"),
    Column(
        "simulator",
        TEXT,
        NONE,
        "paper: eqs. 6-9; recorded: windows of the trained classifier; harm: the same from good starts; "
        "pixels: rendered frames through the whole chain",
    ),
    Column(
        "case", TEXT, NONE, "what the machine and the camera do: accuracy, clog, gain, persistence, fault"
    ),
    Column("counts", BOOL, NONE, "controllers are ranked by this case"),
    Column("runs", COUNT, NONE, "runs, 21 starts together", low=1),
)
_SETTLED = (
    *_share("settled", "of runs inside 90-110 % and 210 +- 5 degC from some step up to 90 until step 100"),
    *_share("stay", "settled, and never out from step 100 to 200; missing where runs end before"),
    *_share(
        "recovered",
        "inside from some step up to 90 until step 120: after what happens at step 60; missing where nothing "
        "does",
    ),
)
_MEDIAN = (
    Column(
        "median_steps",
        FLOAT,
        NONE,
        "decisions until inside for good, median of settled runs",
        low=0,
        nullable=True,
    ),
    Column("p90_steps", FLOAT, NONE, "the same, 90th percentile", low=0, nullable=True),
)
_ERRORS = (
    Column(
        "overshoot_p95_percent",
        FLOAT,
        "percent",
        "points of flow past 100 % on the far side of the start, 95th percentile",
        low=0,
        nullable=True,
    ),
    Column(
        "flow_error_percent",
        FLOAT,
        "percent",
        "mean distance of the true flow from 100 % when settled",
        low=0,
        nullable=True,
    ),
    Column("worst_start_flow_percent", FLOAT, "percent", "start from which fewest settle", low=0),
    Column("worst_start_temperature_degC", FLOAT, "degC", "the same start's temperature"),
    Column("worst_start_settled_percent", FLOAT, "percent", "of runs from there", 0, 100),
)

SCOREBOARD = Schema(
    "scoreboard",
    3,
    (
        *_WHO,
        *_SETTLED,
        *_share(
            "back", "within +-15 % from some step up to 90 until step 120; missing where nothing happens"
        ),
        *(
            column
            for points in (10, 15, 25)
            for column in _share(
                f"beyond_{points}",
                f"of runs from good starts farther than {points} points from 100 % at some step up to 200; "
                "missing from wrong starts",
            )
        ),
        *_MEDIAN,
        Column(
            "recovery_p95_steps",
            FLOAT,
            NONE,
            "decisions from step 60 until 95 % of the runs are inside for good; missing if fewer ever are",
            nullable=True,
        ),
        *_ERRORS,
    ),
)

PATHS = Schema(
    "paths",
    1,
    (
        Column("controller", TEXT, NONE, "who sets flow and temperature"),
        Column("simulator", TEXT, NONE, "paper, recorded or pixels"),
        Column("case", TEXT, NONE, "as in the scoreboard"),
        Column("start", INDEX, NONE, "which of the 21 starts", low=0),
        Column("step", INDEX, NONE, "decision", low=0),
        Column("flow_percent", FLOAT, "percent", "true flow, of nominal", low=0),
        Column("temperature_degC", FLOAT, "degC", "nozzle temperature"),
    ),
)

DECISIONS = Schema(
    "decisions",
    1,
    (
        Column("episode", TEXT, NONE, "which of the two shown, in words"),
        Column("controller", TEXT, NONE, "who decides"),
        Column("step", INDEX, NONE, "decision", low=0),
        Column("time_s", FLOAT, "s", "since the start", low=0),
        Column("flow_percent", FLOAT, "percent", "true flow, mean over the window", low=0),
        Column("temperature_degC", FLOAT, "degC", "nozzle temperature, mean over the window"),
        Column("flow_setpoint_percent", FLOAT, "percent", "setpoint while the window was seen"),
        Column("target_degC", FLOAT, "degC", "target temperature while the window was seen"),
        *_SHARES,
        Column("frames", COUNT, NONE, "frames of the window that count", low=0),
        Column("distance", FLOAT, NONE, "their median distance from what was learned", low=0, nullable=True),
        Column("flow_move_percent", FLOAT, "percent", "change of the flow setpoint that was sent"),
        Column("temperature_move_degC", FLOAT, "degC", "change of the target that was sent"),
        Column("held", BOOL, NONE, "nothing may be sent after this window"),
        Column("why", TEXT, NONE, "why it acted, or why it held, in words"),
    ),
)
