"""Tables with one row for each value of each signal, as historians and home automation export them: a column
says whose value stands beside it. Read as one signal they would be a mixture without a word."""

from collections.abc import Iterable, Sequence
from pathlib import Path

# columns that name the signal of a row: Home Assistant, InfluxDB, WinCC, historians
_NAMING = (
    "entity_id",
    "_field",
    "_measurement",
    "varname",
    "tagname",
    "tag_name",
    "tag",
    "tag_id",
    "metric",
    "metric_name",
    "series",
    "variable",
    "signal",
    "signal_name",
    "sensor_id",
    "point_name",
    "device_id",
    "topic",
)


def naming_columns(names: Sequence[str], wanted: Sequence[str]) -> list[str]:
    """The columns that may say whose value a row holds; not those that are wanted as signals themselves."""
    lower = [name.strip().casefold() for name in names]
    # InfluxDB counts its series in a column of its own
    naming = (*_NAMING, "table") if "_value" in lower else _NAMING
    return [name for name, plain in zip(names, lower, strict=True) if plain in naming and name not in wanted]


def check_one_signal(path: Path, name: str, owners: Iterable[tuple[str, str]]) -> None:
    """Raises ValueError if column `name`, of (place, owner), names more than one owner."""
    first = ""
    for place, owner in owners:
        owner = owner.strip()
        if first and owner and owner != first:
            raise ValueError(
                f"{path}: {place}, column {name} names {owner[:40]!r} but the rows before {first[:40]!r}: "
                "values of several signals stand in one column; write a column for each (a pivot table), "
                "or a file for each"
            )
        first = first or owner
