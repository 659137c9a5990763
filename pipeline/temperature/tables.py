"""Every table that a stage writes: columns with type, unit, meaning and range, and a version.

If the columns change, raise the version.
"""

from collections.abc import Sequence

from pipeline.store.tables import BOOL, COUNT, FLOAT, INDEX, NONE, TEXT, Column, Schema
from pipeline.temperature.settings import PlantSignal


def record(inputs: Sequence[PlantSignal], outputs: Sequence[PlantSignal]) -> Schema:
    """Returns the schema of the table that ingest writes: one row per sample. A masked value stays as
    recorded; the flag beside it marks it as not usable."""
    faulty = "is not to be used here: missing, or found faulty"
    columns = [
        Column("recording", TEXT, NONE, "file below datasets/raw that the sample is from"),
        Column("segment", INDEX, NONE, "stretch of that recording without a gap, counted from 0", low=0),
        Column("time_s", FLOAT, "s", "time since the recording began"),
        *(
            column
            for role, signals in (("input", inputs), ("output", outputs))
            for signal in signals
            for column in (
                Column(signal.name, FLOAT, signal.unit, f"{role} {signal.name}", nullable=True),
                Column(f"{signal.name}_masked", BOOL, NONE, f"{signal.name} {faulty}"),
            )
        ),
    ]
    return Schema("record", 1, tuple(columns))


def set_points(outputs: Sequence[PlantSignal]) -> Schema:
    """Returns the schema of the table that ingest writes beside the record, row by row, if the mapping has
    a set-point: the recorded set-point of each output. NaN before the first value, and if it was not
    recorded."""
    columns = [
        Column(set_point_of(signal.name), FLOAT, signal.unit, f"set-point of {signal.name}", nullable=True)
        for signal in outputs
    ]
    return Schema("set_points", 1, tuple(columns))


def set_point_of(output: str) -> str:
    """Returns the column name of an output's set-point."""
    return f"{output}_set_point"


QUALITY = Schema(
    "quality",
    1,
    (
        Column("recording", TEXT, NONE, "file below datasets/raw"),
        Column(
            "signal",
            TEXT,
            NONE,
            "signal that the finding is about; empty where it is about the whole recording",
        ),
        Column("kind", TEXT, NONE, "what was found: gap, spike, frozen, saturated, ..."),
        Column("start_s", FLOAT, "s", "where it begins", nullable=True),
        Column("end_s", FLOAT, "s", "where it ends", nullable=True),
        Column("count", COUNT, NONE, "samples concerned", low=0),
        Column("message", TEXT, NONE, "the finding in one sentence"),
    ),
)


def trajectories(inputs: Sequence[PlantSignal], outputs: Sequence[PlantSignal]) -> Schema:
    """Returns the schema of two cases of the comparison under every controller, as deployed: true outputs
    with their references, commands, and applied inputs."""
    columns = [
        Column("contestant", TEXT, NONE, "which contestant"),
        Column(
            "case_name", TEXT, NONE, "typical: of median cost; deciding: the case that the verdict rests on"
        ),
        Column("time_s", FLOAT, "s", "time since the contestant took over", low=0),
    ]
    for signal in outputs:
        columns += [
            Column(signal.name, FLOAT, signal.unit, f"true output {signal.name}", nullable=True),
            Column(f"{signal.name}_reference", FLOAT, signal.unit, f"what {signal.name} is to be"),
        ]
    for signal in inputs:
        columns += [
            Column(f"{signal.name}_command", FLOAT, signal.unit, f"{signal.name} as asked", nullable=True),
            Column(f"{signal.name}_applied", FLOAT, signal.unit, f"{signal.name} as given", nullable=True),
        ]
    return Schema("trajectories", 3, tuple(columns))


# every case of every controller, as deployed, on true outputs
CASES = Schema(
    "cases",
    1,
    (
        Column("contestant", TEXT, NONE, "which contestant"),
        Column("case", INDEX, NONE, "number of the case, the same for every contestant", low=0),
        Column("plant", INDEX, NONE, "plant of the panel", low=0),
        Column("kind", TEXT, NONE, "reference: constant, ramp, sinusoid, sequence; or held and disturbed"),
        Column("start_degC", FLOAT, "degC", "temperature that the plant was held at"),
        Column(
            "settled_error_degC",
            FLOAT,
            "degC",
            "mean of the last 100 steps from the reference, worst output; missing where unstable",
            low=0,
            nullable=True,
        ),
        Column("settled_zone", TEXT, NONE, "that output"),
        Column(
            "peak_degC",
            FLOAT,
            "degC",
            "largest error of the last 50 steps, worst output; missing where unstable",
            low=0,
            nullable=True,
        ),
        Column(
            "settling_s",
            FLOAT,
            "s",
            "last time outside the band about the reached reference; missing where it never settles, and "
            "from the coldest start",
            low=0,
            nullable=True,
        ),
        Column("heating_s", FLOAT, "s", "the same from the coldest start", low=0, nullable=True),
        Column("overshoot_degC", FLOAT, "degC", "largest way past a reference", low=0, nullable=True),
        Column(
            "at_limits_percent",
            FLOAT,
            "percent",
            "share of the time at a limit of an input; missing from the coldest start",
            0,
            100,
            nullable=True,
        ),
        Column("energy_percent", FLOAT, "percent", "mean input given, over all inputs", nullable=True),
        Column(
            "travel_percent", FLOAT, "percent", "mean change of the input that moves most, a sample", low=0
        ),
        Column(
            "dip_degC",
            FLOAT,
            "degC",
            "largest error, worst output, where a door, a fan and another room disturb; missing elsewhere",
            low=0,
            nullable=True,
        ),
        Column("rms_degC", FLOAT, "degC", "root mean square error, over all outputs", low=0, nullable=True),
        Column("cost", FLOAT, NONE, "the declared engineering cost, as deployed", low=0, nullable=True),
        Column(
            "crossing_degC",
            FLOAT,
            "degC",
            "furthest that an output went beyond plant.outputs.low or high; 0: never; missing: none declared",
            low=0,
            nullable=True,
        ),
    ),
)

TUNING = Schema(
    "tuning",
    3,
    (
        Column("contestant", TEXT, NONE, "whose search"),
        Column("evaluation", COUNT, NONE, "counted from 1, the declared start", low=1),
        Column("cost", FLOAT, NONE, "cost of this candidate; missing where it failed", nullable=True),
        Column(
            "incumbent", FLOAT, NONE, "lowest cost so far; missing before the first success", nullable=True
        ),
        Column("values", TEXT, NONE, "its parameters"),
        Column("chosen", BOOL, NONE, "whether the search recommends this candidate"),
        Column("failure", TEXT, NONE, "why the candidate failed; empty where it did not"),
    ),
)

ORDER = Schema(
    "order",
    1,
    (
        Column("order", INDEX, NONE, "states of the candidate", low=1),
        Column("singular_value", FLOAT, NONE, "that this order keeps last", low=0),
        Column("noise_edge", FLOAT, NONE, "what noise alone puts into the singular values", low=0),
        Column("parameters", COUNT, NONE, "free numbers of the candidate", low=0),
        Column(
            "error",
            FLOAT,
            NONE,
            "error on left-out blocks, as a share of the outputs' variation; "
            "missing where only the rank decided",
            nullable=True,
        ),
        Column("chosen", BOOL, NONE, "the candidate that was taken"),
    ),
)


def holdout(outputs: Sequence[PlantSignal]) -> Schema:
    """Returns the schema of the part of the record that judged the model: measured, simulated from its inputs
    alone, and predicted from outputs identify_plant.ahead_steps samples before."""
    kinds = {
        "measured": "as recorded",
        "simulated": "by the model, from the inputs alone",
        "ahead": "by the model, identify_plant.ahead_steps before",
    }
    columns = [
        Column("segment", INDEX, NONE, "stretch of the record", low=0),
        Column("time_s", FLOAT, "s", "time since the hold-out began"),
        *(
            Column(f"{one.name}_{kind}", FLOAT, one.unit, f"{one.name} {meaning}", nullable=True)
            for one in outputs
            for kind, meaning in kinds.items()
        ),
    ]
    return Schema("holdout", 2, tuple(columns))


RESIDUALS = Schema(
    "residuals",
    1,
    (
        Column("output", TEXT, NONE, "output whose one-step errors on the hold-out these are"),
        Column("against", TEXT, NONE, "the same output, or the input that they are correlated with"),
        Column("lag", INDEX, NONE, "samples by which the error comes later"),
        Column(
            "correlation",
            FLOAT,
            NONE,
            "both about zero mean and of unit power; missing where one of them never moves",
            nullable=True,
        ),
        Column(
            "band", FLOAT, NONE, "what 99 % of such correlations stay under where nothing is left over", low=0
        ),
        Column("passed", BOOL, NONE, "the test over all lags, at 99 %"),
    ),
)

STEPS = Schema(
    "steps",
    1,
    (
        Column("output", TEXT, NONE, "output that answers"),
        Column("input", TEXT, NONE, "input that steps by one percent"),
        Column("time_s", FLOAT, "s", "time since the step", low=0),
        Column("response", FLOAT, "degC per percent", "of the model, from rest"),
        Column("low", FLOAT, "degC per percent", "lower end of the 90 % band over the plants of the spread"),
        Column("high", FLOAT, "degC per percent", "upper end of that band"),
    ),
)

DYNAMICS = Schema(
    "dynamics",
    1,
    (
        Column("output", TEXT, NONE, "output that answers"),
        Column("input", TEXT, NONE, "input that steps"),
        Column("seen", BOOL, NONE, "the band of the response's largest excursion does not hold zero"),
        *(
            Column(f"{name}{end}", FLOAT, unit, meaning + of, low, nullable=unit == "s")
            for name, unit, meaning, low in (
                ("gain", "degC per percent", "steady value, or at the end if the record shows none", None),
                ("peak", "degC per percent", "its largest excursion", None),
                ("time_constant_s", "s", "1.5 times the way from 28.3 to 63.2 % of the largest excursion", 0),
                ("delay_s", "s", "what is left of the time to 63.2 % without one time constant", 0),
            )
            for end, of in (
                ("", ""),
                ("_low", ", lower end of its 90 % band"),
                ("_high", ", upper end of its 90 % band"),
            )
        ),
    ),
)

FIRST_ORDER = Schema(
    "first_order",
    1,
    (
        Column("output", TEXT, NONE, "output that answers"),
        Column("input", TEXT, NONE, "input that steps"),
        Column("seen", BOOL, NONE, "not even the sign of the effect is known where this is false"),
        *(
            Column(f"{name}{end}", FLOAT, unit, meaning + of, low, nullable=unit == "s")
            for name, unit, meaning, low in (
                ("gain", "degC per percent", "K of K e^(-theta s) / (tau s + 1)", None),
                ("time_constant_s", "s", "tau", 0),
                ("delay_s", "s", "theta", 0),
            )
            for end, of in (
                ("", ""),
                ("_low", ", lower end of its 90 % band"),
                ("_high", ", upper end of its 90 % band"),
            )
        ),
        Column(
            "fit_percent", FLOAT, "percent", "of this model's step response to the model's", nullable=True
        ),
        Column("Kp", FLOAT, "percent per degC", "PID by SIMC: proportional gain", nullable=True),
        Column("Ki", FLOAT, "percent per degC s", "PID by SIMC: integral gain", nullable=True),
        Column("Kd", FLOAT, "percent s per degC", "PID by SIMC: derivative gain", nullable=True),
    ),
)

POLES = Schema(
    "poles",
    1,
    (
        Column("member", INDEX, NONE, "0 the model, from 1 the plants of the spread", low=0),
        Column(
            "pole",
            INDEX,
            NONE,
            "number of the model's pole that it belongs to, the largest 0; "
            "-1 for one that the model does not have",
            low=-1,
        ),
        Column("real", FLOAT, NONE, "real part"),
        Column("imag", FLOAT, NONE, "imaginary part"),
    ),
)

LEVELS = Schema(
    "levels",
    1,
    (
        Column("input", TEXT, NONE, "input"),
        Column("low_rad", FLOAT, "rad per sample", "lower edge of the band of frequencies", low=0),
        Column("high_rad", FLOAT, "rad per sample", "upper edge of that band"),
        Column("level", FLOAT, "percent", "root mean square of the input within the band", low=0),
    ),
)
