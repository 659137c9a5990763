"""Checks a table against its schema: columns with type, unit, meaning and range, and a version.

Errors name the column and, for a value, the row.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    import pyarrow as pa

# types of columns, by Arrow's names; a list is list<double>, bytes of one length are binary[768]
TEXT, FLOAT, BOOL, COUNT, INDEX, BYTES = "string", "double", "bool", "int64", "int32", "binary"

# the unit of a quantity without unit
NONE = "1"


class Column(NamedTuple):
    """`low` and `high` are checked whenever the column is written or read.

    NaN stands for a missing value; only a nullable column may have one.
    """

    name: str
    type: str
    unit: str
    meaning: str
    low: float | None = None
    high: float | None = None
    nullable: bool = False


class Schema(NamedTuple):
    name: str
    version: int
    columns: tuple[Column, ...]


def list_of(kind: str) -> str:
    return f"list<{kind}>"


def bytes_of(length: int) -> str:
    return f"{BYTES}[{length}]"


def arrow_type(kind: str) -> pa.DataType:
    """Returns Arrow's type of this name."""
    import pyarrow as pa

    name, _, length = kind.rstrip(">]").partition("<" if kind.startswith("list<") else "[")
    if name == "list":
        return pa.list_(arrow_type(length))
    return pa.binary(int(length)) if length else pa.type_for_alias(name)


def arrow(schema: Schema) -> pa.Schema:
    """Returns Arrow's schema: name and version in its metadata, unit and meaning in each field's."""
    import pyarrow as pa

    fields = [
        pa.field(name, arrow_type(kind), nullable, {"unit": unit, "meaning": meaning})
        for name, kind, unit, meaning, _, _, nullable in schema.columns
    ]
    return pa.schema(fields, {"schema": schema.name, "schema_version": str(schema.version)})


def check(path: str | Path, schema: Schema, table: pa.Table, remedy: str) -> None:
    """Raises ValueError if a table has another schema or version, other columns or types, or values that its
    columns do not allow. `remedy` ends the sentence."""
    metadata = {key.decode(): text.decode() for key, text in (table.schema.metadata or {}).items()}
    name, version = metadata.get("schema"), metadata.get("schema_version")
    if (name, version) != (schema.name, str(schema.version)):
        held = f"schema {name} version {version}" if name else "no schema"
        raise ValueError(
            f"{path} holds {held} but {schema.name} version {schema.version} is expected; {remedy}"
        )
    check_names(path, schema, table.column_names, remedy)
    for column in schema.columns:
        kind = table.schema.field(column.name).type
        if kind != arrow_type(column.type):
            raise ValueError(f"{path}: column {column.name} is {kind} but should be {column.type}; {remedy}")
        unit = (table.schema.field(column.name).metadata or {}).get(b"unit", b"").decode()
        if unit != column.unit:
            raise ValueError(
                f"{path}: column {column.name} is in {unit or 'no unit'} but should be in "
                f"{column.unit}; {remedy}"
            )
    check_values(path, schema, table, remedy)


def check_names(path: str | Path, schema: Schema, names: Collection[str], remedy: str) -> None:
    """Raises ValueError if a table lacks columns or has others."""
    expected = [column.name for column in schema.columns]
    missing = [name for name in expected if name not in names]
    extra = [name for name in names if name not in expected]
    parts = [f"lacks {', '.join(missing)}"] if missing else []
    if extra:
        parts.append(f"has {', '.join(extra)} too many")
    if parts:
        raise ValueError(
            f"{path}: table {schema.name} version {schema.version} {' and '.join(parts)}; {remedy}"
        )


def check_values(path: str | Path, schema: Schema, table: pa.Table, remedy: str) -> None:
    """Raises ValueError with the row if a value is missing, infinite or out of range."""
    import pyarrow.compute as pc

    for column in schema.columns:
        values = table[column.name]
        if values.null_count and not column.nullable:
            row = pc.index(pc.is_null(values), True).as_py()
            raise ValueError(
                f"{path}: column {column.name} has no value (NaN) in row {row}, "
                f"the first of {values.null_count}; {remedy}"
            )
        if column.type in (FLOAT, COUNT, INDEX):
            _check_range(path, column, values, remedy)


def _check_range(path: str | Path, column: Column, values: pa.ChunkedArray, remedy: str) -> None:
    import pyarrow as pa
    import pyarrow.compute as pc

    extremes = pc.min_max(values).as_py()
    smallest, largest = extremes["min"], extremes["max"]
    if smallest is None:
        return
    unit = "" if column.unit == "1" else f" {column.unit}"
    low = -math.inf if column.low is None else column.low
    high = math.inf if column.high is None else column.high
    at_least = "finite" if column.low is None else f"at least {low:g}{unit}"
    at_most = "finite" if column.high is None else f"at most {high:g}{unit}"
    for extreme, inside, bound in [
        (smallest, smallest >= low and smallest != -math.inf, at_least),
        (largest, largest <= high and largest != math.inf, at_most),
    ]:
        if not inside:
            row = pc.index(values, pa.scalar(extreme, values.type)).as_py()
            raise ValueError(
                f"{path}: column {column.name} is {extreme:g}{unit} in row {row} but must be {bound}; "
                f"{remedy}"
            )


# named arrays of any shape, row-major; name and version are those of what is stored (artifacts.write_arrays)
ARRAYS = Schema(
    "arrays",
    1,
    (
        Column("name", TEXT, NONE, "name of the array"),
        Column("unit", TEXT, NONE, "unit of its values"),
        Column("meaning", TEXT, NONE, "what it is"),
        Column("shape", list_of(COUNT), NONE, "lengths of its axes"),
        Column("values", list_of(FLOAT), NONE, "its values in row-major order"),
    ),
)
