"""A table against its schema: columns with type, unit, meaning and range, and a version;
what does not fit is refused by column and row."""

import math
from pathlib import Path
from typing import NamedTuple

import pyarrow as pa
import pyarrow.compute as pc


class Column(NamedTuple):
    """`low` and `high` are checked whenever the column is written or read; NaN is
    missing, and refused where the column is not nullable."""

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


TEXT, FLOAT, BOOL, COUNT, INDEX = pa.string(), pa.float64(), pa.bool_(), pa.int64(), pa.int32()

# the unit of what has none
NONE = "1"


# `remedy` ends the sentence


def arrow(schema: Schema) -> pa.Schema:
    """Arrow's schema: name and version in its metadata, unit and meaning in each field's."""
    fields = [
        pa.field(name, kind, nullable, {"unit": unit, "meaning": meaning})
        for name, kind, unit, meaning, _, _, nullable in schema.columns
    ]
    return pa.schema(fields, {"schema": schema.name, "schema_version": str(schema.version)})


def check(path: str | Path, schema: Schema, table: pa.Table, remedy: str) -> None:
    """Refuses a table of another schema or version, with other columns or
    types, or with values that its columns do not allow."""
    metadata = {key.decode(): text.decode() for key, text in (table.schema.metadata or {}).items()}
    name, version = metadata.get("schema"), metadata.get("schema_version")
    if (name, version) != (schema.name, str(schema.version)):
        found = f"schema {name} version {version}" if name else "no schema"
        raise ValueError(
            f"{path} holds {found} but {schema.name} version {schema.version} is expected; {remedy}"
        )
    check_names(path, schema, table.column_names, remedy)
    for column in schema.columns:
        found = table.schema.field(column.name).type
        if found != column.type:
            raise ValueError(f"{path}: column {column.name} is {found} but should be {column.type}; {remedy}")
        unit = (table.schema.field(column.name).metadata or {}).get(b"unit", b"").decode()
        if unit != column.unit:
            raise ValueError(
                f"{path}: column {column.name} is in {unit or 'no unit'} but should be in "
                f"{column.unit}; {remedy}"
            )
    check_values(path, schema, table, remedy)


def check_names(path: str | Path, schema: Schema, names, remedy: str) -> None:
    """Refuses a table that lacks columns or has others."""
    expected = [column.name for column in schema.columns]
    missing, extra = (
        [name for name in expected if name not in names],
        [name for name in names if name not in expected],
    )
    if missing or extra:
        parts = [f"lacks {', '.join(missing)}"] * bool(missing) + [f"has {', '.join(extra)} too many"] * bool(
            extra
        )
        raise ValueError(
            f"{path}: table {schema.name} version {schema.version} {' and '.join(parts)}; {remedy}"
        )


def check_values(path: str | Path, schema: Schema, table: pa.Table, remedy: str) -> None:
    """Refuses missing values, infinities and values out of range, with the row."""
    for column in schema.columns:
        values = table[column.name]
        if values.null_count and not column.nullable:
            row = pc.index(pc.is_null(values), True).as_py()
            raise ValueError(
                f"{path}: column {column.name} has no value (NaN) in row {row}, "
                f"the first of {values.null_count}; {remedy}"
            )
        if pa.types.is_floating(column.type) or pa.types.is_integer(column.type):
            _check_range(path, column, values, remedy)


def _check_range(path: str | Path, column: Column, values: pa.ChunkedArray, remedy: str) -> None:
    extremes = pc.min_max(values).as_py()
    smallest, largest = extremes["min"], extremes["max"]
    if smallest is None:
        return
    unit = "" if column.unit == "1" else f" {column.unit}"
    low, high = (
        (-math.inf if column.low is None else column.low),
        (math.inf if column.high is None else column.high),
    )
    for found, inside, bound in [
        (
            smallest,
            smallest >= low and smallest != -math.inf,
            f"at least {low:g}{unit}" if column.low is not None else "finite",
        ),
        (
            largest,
            largest <= high and largest != math.inf,
            f"at most {high:g}{unit}" if column.high is not None else "finite",
        ),
    ]:
        if not inside:
            row = pc.index(values, pa.scalar(found, values.type)).as_py()
            raise ValueError(
                f"{path}: column {column.name} is {found:g}{unit} in row {row} but must be {bound}; {remedy}"
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
