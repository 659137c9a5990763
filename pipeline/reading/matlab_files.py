"""MATLAB files up to version 7: vectors, matrices and structures of one length as columns."""

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
from scipy.io.matlab import MatReadError, mat_struct

from pipeline.reading.formats import is_time_name, seconds
from pipeline.reading.signals import Note
from pipeline.reading.whole_tables import LARGEST_UNPACKED, WholeTable, check_values, check_width

_COMPRESSED = 15
_DEEPEST = 6
# what scipy raises for damaged files
_DAMAGE = (
    ValueError, TypeError, KeyError, IndexError, OSError, OverflowError, MemoryError, NotImplementedError,
    AttributeError, struct.error, zlib.error, MatReadError,
)  # fmt: skip


def load_matlab(path: Path) -> WholeTable:
    """The numbers of the most common length in the file; the columns of a matrix X are X_1, X_2, ...

    A structure's parts are "log.T1". The clock is the vector with the name of a time, if there is one. Raises
    ValueError for a damaged file and for one without two samples of anything.
    """
    _check_size(path)
    try:
        content = scipy.io.loadmat(path, squeeze_me=True, struct_as_record=False)
    except _DAMAGE as error:
        raise ValueError(
            f"{path} is a MATLAB file that cannot be read ({_first_line(error)}); save it again with "
            "save(..., '-v7')"
        ) from None
    arrays, others, numbers = {}, {}, 0
    for name, value in content.items():
        if not name.startswith("__"):
            for full, part in _leaves(name, value, 0):
                if isinstance(part, np.ndarray):
                    numbers += part.size
                    check_values(path, numbers, 1)
                    arrays[full] = part.astype(float)
                else:
                    others[full] = part
    length = _common_length(arrays)
    if length < 2:
        held = ", ".join([*arrays, *others][:6]) or "nothing"
        raise ValueError(
            f"{path}: expected vectors of one length, at least 2 samples, but found {held}; "
            "save time, inputs and outputs as vectors"
        )
    values: dict[str, np.ndarray] = {}
    for name, array in arrays.items():
        table = array.reshape(length, -1) if array.shape[0] == length else array.T
        if array.ndim > 2 or length not in array.shape:
            others[name] = f"an array of {' x '.join(map(str, array.shape))}"
        elif array.ndim == 1:
            values[name] = array
        else:
            values |= {f"{name}_{j + 1}": table[:, j] for j in range(min(table.shape[1], 3000))}
    check_width(path, len(values))
    return _with_clock(values, others)


def _with_clock(values: dict[str, np.ndarray], others: dict[str, str]) -> WholeTable:
    """The table on the clock of the first vector that has the name of a time and runs forward."""
    notes: list[Note] = []
    forward = [
        name
        for name, column in values.items()
        if is_time_name(name.rpartition(".")[2]) and (np.diff(column) > 0).all()
    ]
    time = None
    if forward:
        name = min(forward, key=len)
        time, remark = seconds(name.rpartition(".")[2], values[name])
        notes.append(Note("clock", "", 1, remark or f"{name} is the clock"))
        values = {other: column for other, column in values.items() if other not in forward}
    return WholeTable(values, {}, time, "UTC", lambda i: f"sample {i + 1}", notes, {}, others, {})


def _check_size(path: Path) -> None:
    """Raises ValueError for variables that unpack to more than LARGEST_UNPACKED bytes, or that cannot be
    unpacked. Each variable is a tag (kind, bytes) and its data; a compressed one is a zlib stream."""
    size, unpacked = path.stat().st_size, 0
    with path.open("rb") as stream:
        order = {b"IM": "<", b"MI": ">"}.get(stream.read(128)[126:128], "<")
        while len(tag := stream.read(8)) == 8:
            kind, length = struct.unpack(order + "II", tag)
            end = stream.tell() + length
            if end > size:
                raise ValueError(
                    f"{path}: the variable at byte {stream.tell() - 8} should have {length} bytes but the "
                    f"file ends after {size - stream.tell() + 8}; copy the recording again"
                )
            unpacked += length if kind != _COMPRESSED else 0
            if kind == _COMPRESSED:
                unpacker = zlib.decompressobj()
                try:
                    while stream.tell() < end and unpacked <= LARGEST_UNPACKED:
                        piece = stream.read(min(1 << 16, end - stream.tell()))
                        while piece and unpacked <= LARGEST_UNPACKED:
                            unpacked += len(unpacker.decompress(piece, 1 << 20))
                            piece = unpacker.unconsumed_tail
                except zlib.error as error:
                    raise ValueError(
                        f"{path}: the variable before byte {end} cannot be unpacked ({error}); "
                        "copy the recording again"
                    ) from None
            if unpacked > LARGEST_UNPACKED:
                raise ValueError(
                    f"{path}: its variables unpack to more than {LARGEST_UNPACKED >> 20} MB; "
                    "save the machine's signals alone"
                )
            stream.seek(end)


def _leaves(name: str, value: Any, depth: int) -> Iterator[tuple[str, Any]]:
    """(dotted name, array of numbers or words on what it is) of a variable and of its parts."""
    if isinstance(value, mat_struct) and depth < _DEEPEST:
        for field in value._fieldnames:
            yield from _leaves(f"{name}.{field}", getattr(value, field), depth + 1)
    elif isinstance(value, np.ndarray) and value.dtype == object and depth < _DEEPEST:
        for i, part in enumerate(value.ravel()[:200]):
            yield from _leaves(f"{name}_{i + 1}", part, depth + 1)
    elif isinstance(value, np.ndarray) and value.dtype.kind in "fiub" and value.ndim:
        yield name, value
    elif isinstance(value, int | float):
        yield name, f"one number, {value:g}"
    elif isinstance(value, str):
        yield name, f"text such as {value[:20]!r}"
    else:
        yield name, type(value).__name__


def _common_length(arrays: dict[str, np.ndarray]) -> int:
    """The length that most arrays have along their longest side; of equally many the longer."""
    lengths = [max(array.shape) for array in arrays.values() if array.ndim <= 2 and array.size]
    return max(lengths, key=lambda length: (lengths.count(length), length), default=0)


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
