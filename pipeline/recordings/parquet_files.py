"""Reads Parquet files of other programs, part by part."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from pipeline.recordings.csv_files import Growing, check_one_signal, naming_columns
from pipeline.recordings.formats import (
    FileColumn,
    FileColumns,
    Note,
    clock_seconds,
    column_places,
    every,
    forward,
    is_time_name,
    time_column,
)
from pipeline.recordings.instants import instants

ROWS_AT_ONCE = 50_000
# an index may promise what is not there
MOST_EXPECTED, MOST_IN_ONE_PIECE = 1 << 26, 1 << 22


def _parquet(path: Path) -> pq.ParquetFile:
    try:
        return pq.ParquetFile(path, page_checksum_verification=True, pre_buffer=False, buffer_size=1 << 16)
    except MemoryError:
        raise  # Arrow's is an ArrowException too, and the file may be whole
    except (OSError, pa.ArrowException) as error:
        raise ValueError(
            f"{path} is not a whole Parquet file ({_first_line(error)}); its index is at its end, "
            "so copy the recording again"
        ) from None


def _first_line(error: Exception) -> str:
    """Returns the first line of an error, which may contain a whole value of the file."""
    return str(error).strip().splitlines()[0][:200]


def _flat(table: pa.Table) -> pa.Table:
    while any(pa.types.is_struct(field.type) for field in table.schema):
        table = table.flatten()
    return table


def _plain(kind: pa.DataType) -> pa.DataType:
    """Returns the type of a column's values. For a category it is that of its dictionary."""
    return kind.value_type if pa.types.is_dictionary(kind) else kind


def _is_numeric(kind: pa.DataType) -> bool:
    kind = _plain(kind)
    return (
        pa.types.is_integer(kind)
        or pa.types.is_floating(kind)
        or pa.types.is_boolean(kind)
        or pa.types.is_decimal(kind)
    )


def parquet_columns(path: Path) -> list[FileColumn]:
    """Returns the columns of a Parquet file. The parts of a structure are "a.b"."""
    columns = []
    for name, field in _leaves(_parquet(path).schema_arrow, ""):
        kind = (
            "number"
            if _is_numeric(field.type)
            else "time"
            if _is_stamp(field.type)
            else "duration"
            if pa.types.is_duration(field.type)
            else str(field.type)
        )
        columns.append(
            FileColumn(name, kind, (field.metadata or {}).get(b"unit", b"").decode(errors="replace"))
        )
    return columns


def _is_stamp(kind: pa.DataType) -> bool:
    return pa.types.is_timestamp(kind) or pa.types.is_date(kind)


def _is_text(kind: pa.DataType) -> bool:
    kind = _plain(kind)
    return pa.types.is_string(kind) or pa.types.is_large_string(kind) or pa.types.is_string_view(kind)


def _leaves(fields: pa.Schema | pa.StructType, prefix: str) -> Iterator[tuple[str, pa.Field]]:
    for field in fields:
        if pa.types.is_struct(field.type):
            yield from _leaves(field.type, f"{prefix}{field.name}.")
        else:
            yield prefix + field.name, field


def read_parquet(path: Path, wanted: Sequence[str], time: str) -> tuple[FileColumns, list[Note]]:
    """Returns the wanted columns, NaN for null, and notes. Raises ValueError if a column is missing or holds
    no numbers, or if the file is damaged."""
    file, columns = _parquet(path), parquet_columns(path)
    types = {name: field.type for name, field in _leaves(file.schema_arrow, "")}
    names = [column.name for column in columns]
    units = {column.name: column.unit for column in columns}
    interval = every(time)
    clock = ""
    if not interval:
        stamps = [column.name for column in columns if column.type == "time"]
        clock = (
            stamps[0]
            if not time and stamps and all(not is_time_name(name) or name == "T" for name in names)
            else time_column(path, names, time)
        )
    for name, place in zip(wanted, column_places(path, names, wanted), strict=True):
        column = columns[place]
        if column.type != "number" and not _is_text(types[name]):
            raise ValueError(
                f"{path}: column {name} should hold numbers but is of type {column.type}; write numbers, "
                "or map another column"
            )
    read = list(dict.fromkeys([*wanted, *([clock] if clock else [])]))
    _check_one_signal(path, file, types, [*wanted, clock])
    kinds = {
        name: np.int64 if _is_stamp(kind) or (name == clock and _is_text(kind)) else float
        for name, kind in types.items()
    }
    values = _values(path, file, {name: kinds[name] for name in read}, clock)
    count = len(values[read[0]])
    notes: list[Note] = []
    zoned = clock and kinds[clock] is np.int64 and getattr(types[clock], "tz", None)
    zone = "UTC" if zoned or not clock or kinds[clock] is float else ""
    times = np.arange(count) * interval if interval else values[clock]
    if clock and _is_numeric(types[clock]):
        times = clock_seconds(path, clock, times, units[clock], notes, is_declared=bool(time))
    signals = {name: values[name] for name in wanted}
    return forward(FileColumns("rows", times, signals, lambda i: f"row {i}", zone, units), notes), notes


def _check_one_signal(
    path: Path, file: pq.ParquetFile, types: dict[str, pa.DataType], wanted: Sequence[str]
) -> None:
    """Raises ValueError if a table's rows belong to several signals."""
    for name in naming_columns(list(types), wanted):
        if not _is_text(types[name]):
            continue
        owners: dict[str, str] = {}
        first = 0
        for batch in file.iter_batches(ROWS_AT_ONCE, columns=[name], use_threads=False):
            column = _flat(pa.Table.from_batches([batch]))[name].cast(pa.string())
            for owner in column.unique().drop_null().to_pylist():
                owners.setdefault(owner, f"row {first + pc.index(column, owner).as_py()}")
            if len(owners) > 1:
                break
            first += len(batch)
        check_one_signal(path, name, ((place, owner) for owner, place in owners.items()))


def _values(path: Path, file: pq.ParquetFile, kinds: dict[str, type], clock: str) -> dict[str, np.ndarray]:
    """Returns {name: values (n,)} of the columns `kinds` {name: int64 or float}."""
    columns = sorted({name.split(".")[0] if "." in name else name for name in kinds} | set(kinds))
    try:
        # a table in one piece is not copied
        if file.num_row_groups == 1 and 0 < file.metadata.num_rows <= MOST_IN_ONE_PIECE:
            table = _flat(file.read_row_group(0, columns, use_threads=False))
            if table.num_rows:
                return {name: _array(path, name, _one_chunk(table[name]), clock) for name in kinds}
        parts = Growing(list(kinds.values()), min(file.metadata.num_rows, MOST_EXPECTED))
        for batch in file.iter_batches(ROWS_AT_ONCE, columns=columns, use_threads=False):
            table = _flat(pa.Table.from_batches([batch]))
            parts.append(*(_array(path, name, table[name], clock) for name in kinds))
    except MemoryError:
        raise
    except (OSError, pa.ArrowException) as error:
        raise ValueError(
            f"{path}: a column cannot be read ({_first_line(error)}); the file is damaged, "
            "so copy the recording again"
        ) from None
    if not parts.count:
        raise ValueError(f"{path}: the table should have rows but has none; record it again or remove it")
    return dict(zip(kinds, parts.finished(), strict=True))


def _one_chunk(column: pa.ChunkedArray) -> pa.ChunkedArray:
    return column if column.num_chunks == 1 else pa.chunked_array([column.combine_chunks()])


def _array(path: Path, name: str, column: pa.ChunkedArray, clock: str) -> np.ndarray:
    written = column.type
    if pa.types.is_dictionary(column.type):
        column = column.cast(column.type.value_type)
    if name == clock and _is_text(column.type):
        return _iso_ns(path, name, column)
    if name == clock and (pa.types.is_duration(column.type) or pa.types.is_time(column.type)):
        unit = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}[column.type.unit]
        counts = column.cast(pa.int32() if column.type.bit_width == 32 else pa.int64())
        return counts.cast(pa.float64(), safe=False).chunk(0).to_numpy(zero_copy_only=False) / unit
    if _is_stamp(column.type):
        if column.null_count:
            raise ValueError(f"{path}: time {name} is missing in {column.null_count} rows; remove them")
        stamps = column.cast(pa.timestamp("ns", getattr(column.type, "tz", None))).cast(pa.int64())
        return stamps.chunk(0).to_numpy()
    if name == clock and not _is_numeric(column.type):
        raise ValueError(
            f"{path}: time {name} should be seconds or a timestamp but is of type {column.type}; convert it, "
            "or name another column"
        )
    if pa.types.is_decimal(column.type) or _is_text(column.type):
        # by way of the text, as Arrow rounds decimals twice
        column = column.cast(pa.string())
    if pa.types.is_boolean(column.type):
        column = column.cast(pa.uint8())
    try:
        return column.cast(pa.float64(), safe=False).chunk(0).to_numpy(zero_copy_only=False)
    except pa.ArrowInvalid as error:
        raise ValueError(
            f"{path}: column {name} should hold numbers but is of type {written} ({_first_line(error)}); "
            "write numbers, or map another column"
        ) from None


def _iso_ns(path: Path, name: str, column: pa.ChunkedArray) -> np.ndarray:
    """Returns ns since 1970 for times written as text, which must be dates and times of ISO 8601."""
    texts = column.to_pylist()
    if missing := texts.count(None):
        raise ValueError(f"{path}: time {name} is missing in {missing} rows; remove them")
    return instants(path, name, texts, range(1, len(texts) + 1), month_first=None).ns
