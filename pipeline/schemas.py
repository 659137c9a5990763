"""Every table that a stage writes: columns with type, unit, meaning and range, and a version; and the check of a table against them.

Other columns are another version: raise the number with them.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

import pyarrow as pa
import pyarrow.compute as pc


class Column(NamedTuple):
    """`low` and `high` are checked whenever the column is written or read; NaN is missing, and refused where the column is not nullable."""

    name: str
    type: pa.DataType
    unit: str
    meaning: str
    low: float | None = None
    high: float | None = None
    nullable: bool = False


class Schema(NamedTuple):
    name: str
    version: int
    columns: tuple[Column, ...]


class _Signal(Protocol):
    name: str
    unit: str


TEXT, FLOAT, BOOL, COUNT, INDEX = pa.string(), pa.float64(), pa.bool_(), pa.int64(), pa.int32()

# the unit of what has none
NONE = "1"


def record(inputs: Sequence[_Signal], outputs: Sequence[_Signal]) -> Schema:
    """The table that ingest writes: one row a sample. A masked value stays as recorded; the flag beside it says not to use it."""
    columns = [
        Column("recording", TEXT, NONE, "file below datasets/raw that the sample is from"),
        Column("segment", INDEX, NONE, "stretch of that recording without a gap, counted from 0", low=0),
        Column("time_s", FLOAT, "s", "time since the recording began"),
    ]
    for role, signals in (("input", inputs), ("output", outputs)):
        for signal in signals:
            columns.append(Column(signal.name, FLOAT, signal.unit, f"{role} {signal.name}", nullable=True))
            columns.append(Column(f"{signal.name}_masked", BOOL, NONE, f"{signal.name} is not to be used here: missing, or found faulty"))
    return Schema("record", 1, tuple(columns))


QUALITY = Schema(
    "quality",
    1,
    (
        Column("recording", TEXT, NONE, "file below datasets/raw"),
        Column("signal", TEXT, NONE, "signal that the finding is about; empty where it is about the whole recording"),
        Column("kind", TEXT, NONE, "what was found: gap, spike, frozen, saturated, ..."),
        Column("start_s", FLOAT, "s", "where it begins", nullable=True),
        Column("end_s", FLOAT, "s", "where it ends", nullable=True),
        Column("count", COUNT, NONE, "samples concerned", low=0),
        Column("message", TEXT, NONE, "the finding in one sentence"),
    ),
)

# named arrays of any shape, row-major; name and version are those of what is stored (artifacts.write_arrays)
ARRAYS = Schema(
    "arrays",
    1,
    (
        Column("name", TEXT, NONE, "name of the array"),
        Column("unit", TEXT, NONE, "unit of its values"),
        Column("meaning", TEXT, NONE, "what it is"),
        Column("shape", pa.list_(COUNT), NONE, "lengths of its axes"),
        Column("values", pa.list_(FLOAT), NONE, "its values in row-major order"),
    ),
)


# ---- a table against its schema; `remedy` ends the sentence


def arrow(schema: Schema) -> pa.Schema:
    """Arrow's schema: name and version in its metadata, unit and meaning in each field's."""
    fields = [
        pa.field(name, kind, nullable, {"unit": unit, "meaning": meaning}) for name, kind, unit, meaning, _, _, nullable in schema.columns
    ]
    return pa.schema(fields, {"schema": schema.name, "schema_version": str(schema.version)})


def check(path: str | Path, schema: Schema, table: pa.Table, remedy: str) -> None:
    """Refuses a table of another schema or version, with other columns or types, or with values that its columns do not allow."""
    metadata = {key.decode(): text.decode() for key, text in (table.schema.metadata or {}).items()}
    name, version = metadata.get("schema"), metadata.get("schema_version")
    if (name, version) != (schema.name, str(schema.version)):
        found = f"schema {name} version {version}" if name else "no schema"
        raise ValueError(f"{path} holds {found} but {schema.name} version {schema.version} is expected; {remedy}")
    check_names(path, schema, table.column_names, remedy)
    for column in schema.columns:
        found = table.schema.field(column.name).type
        if found != column.type:
            raise ValueError(f"{path}: column {column.name} is {found} but should be {column.type}; {remedy}")
        unit = (table.schema.field(column.name).metadata or {}).get(b"unit", b"").decode()
        if unit != column.unit:
            raise ValueError(f"{path}: column {column.name} is in {unit or 'no unit'} but should be in {column.unit}; {remedy}")
    check_values(path, schema, table, remedy)


def check_names(path: str | Path, schema: Schema, names, remedy: str) -> None:
    """Refuses a table that lacks columns or has others."""
    expected = [column.name for column in schema.columns]
    missing, extra = [name for name in expected if name not in names], [name for name in names if name not in expected]
    if missing or extra:
        parts = [f"lacks {', '.join(missing)}"] * bool(missing) + [f"has {', '.join(extra)} too many"] * bool(extra)
        raise ValueError(f"{path}: table {schema.name} version {schema.version} {' and '.join(parts)}; {remedy}")


def check_values(path: str | Path, schema: Schema, table: pa.Table, remedy: str) -> None:
    """Refuses missing values, infinities and values out of range, with the row."""
    for column in schema.columns:
        values = table[column.name]
        if values.null_count and not column.nullable:
            row = pc.index(pc.is_null(values), True).as_py()
            raise ValueError(f"{path}: column {column.name} has no value (NaN) in row {row}, the first of {values.null_count}; {remedy}")
        if pa.types.is_floating(column.type) or pa.types.is_integer(column.type):
            _check_range(path, column, values, remedy)


def _check_range(path: str | Path, column: Column, values: pa.ChunkedArray, remedy: str) -> None:
    extremes = pc.min_max(values).as_py()
    smallest, largest = extremes["min"], extremes["max"]
    if smallest is None:
        return
    unit = "" if column.unit == "1" else f" {column.unit}"
    low, high = (-math.inf if column.low is None else column.low), (math.inf if column.high is None else column.high)
    for found, inside, bound in [
        (smallest, smallest >= low and smallest != -math.inf, f"at least {low:g}{unit}" if column.low is not None else "finite"),
        (largest, largest <= high and largest != math.inf, f"at most {high:g}{unit}" if column.high is not None else "finite"),
    ]:
        if not inside:
            row = pc.index(values, pa.scalar(found, values.type)).as_py()
            raise ValueError(f"{path}: column {column.name} is {found:g}{unit} in row {row} but must be {bound}; {remedy}")


def trajectories(inputs: Sequence[_Signal], outputs: Sequence[_Signal]) -> Schema:
    """One featured scenario of the panel under every controller, unclipped at the yardstick's weights and as deployed: true outputs, commands, applied inputs."""
    columns = [
        Column("controller", TEXT, NONE, "which controller"),
        Column("mode", TEXT, NONE, "unclipped, or deployed: clipped to the limits, aimed at a feasible target"),
        Column("time_s", FLOAT, "s", "time since the controller took over"),
        Column("cost", FLOAT, NONE, "discounted cost so far, at the yardstick's weights", nullable=True),
    ]
    columns += [Column(signal.name, FLOAT, signal.unit, f"true output {signal.name}", nullable=True) for signal in outputs]
    for signal in inputs:
        columns.append(Column(f"{signal.name}_command", FLOAT, signal.unit, f"{signal.name} as the controller asked", nullable=True))
        columns.append(Column(f"{signal.name}_applied", FLOAT, signal.unit, f"{signal.name} as it was given", nullable=True))
    return Schema("trajectories", 1, tuple(columns))


SCORECARD = Schema(
    "scorecard",
    1,
    (
        Column("controller", TEXT, NONE, "which controller"),
        Column("plant", INDEX, NONE, "plant of the spread, 0 the nominal one", low=0),
        Column("start_degC", FLOAT, "degC", "temperature that the plant was held at"),
        Column("reference_degC", FLOAT, "degC", "reference of the first output"),
        Column("noise_degC", FLOAT, "degC", "standard deviation of the noise that the controller saw", low=0),
        Column("seed", COUNT, NONE, "seed of that noise", low=0),
        Column("regret", FLOAT, NONE, "J / J* - 1 at the yardstick's weights, unclipped", nullable=True),
        Column("outside_percent", FLOAT, "percent", "unclipped commands outside the limits", 0, 100),
        Column("tracking_degC", FLOAT, "degC", "root mean square error as deployed", low=0),
        Column("effort_percent", FLOAT, "percent", "root mean square input as deployed", low=0),
        Column("settled_error_degC", FLOAT, "degC", "mean error over the last third, worst zone", low=0),
        Column("settled_zone", TEXT, NONE, "that zone"),
        Column("settling_s", FLOAT, "s", "time until every zone stays within the band; missing where one never does", nullable=True),
        Column("overshoot_degC", FLOAT, "degC", "largest way past a reference", low=0),
        Column("at_limits_percent", FLOAT, "percent", "commands beyond the limits as deployed", 0, 100),
        Column("input_low_percent", FLOAT, "percent", "lowest input given"),
        Column("input_high_percent", FLOAT, "percent", "highest input given"),
    ),
)

STUDY = Schema(
    "study",
    1,
    (
        Column("route", TEXT, NONE, "window, kernel or kernel_predicted_state"),
        Column("noise_degC", FLOAT, "degC", "noise in the data and under the controller", low=0),
        Column("data_set", COUNT, NONE, "which data set of 15,000 samples", low=0),
        Column("gap", FLOAT, NONE, "J / J* - 1 over 1,000 steps", nullable=True),
        Column("error_degC", FLOAT, "degC", "root mean square error over steps 500-1000", nullable=True),
    ),
)

TUNING = Schema(
    "tuning",
    1,
    (
        Column("mode", TEXT, NONE, "parity: the paper's (37); practical: the declared engineering cost"),
        Column("evaluation", COUNT, NONE, "counted from 1", low=1),
        Column("cost", FLOAT, NONE, "cost of this candidate; missing where it failed", nullable=True),
        Column("incumbent", FLOAT, NONE, "lowest cost so far; missing before the first success", nullable=True),
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
        Column("error", FLOAT, NONE, "error on left-out blocks, as a share of the outputs' variation; missing where only the rank decided", nullable=True),
        Column("chosen", BOOL, NONE, "the candidate that was taken"),
    ),
)


def holdout(outputs: Sequence[_Signal]) -> Schema:
    """The part of the record that judged the model: measured, and simulated from its inputs alone."""
    columns = [Column("segment", INDEX, NONE, "stretch of the record", low=0), Column("time_s", FLOAT, "s", "time since the hold-out began")]
    for signal in outputs:
        columns.append(Column(f"{signal.name}_measured", FLOAT, signal.unit, f"{signal.name} as recorded", nullable=True))
        columns.append(Column(f"{signal.name}_simulated", FLOAT, signal.unit, f"{signal.name} by the model, from the inputs alone", nullable=True))
    return Schema("holdout", 1, tuple(columns))
