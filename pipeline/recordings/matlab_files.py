"""Reads MATLAB files of versions 5 to 7: vectors, matrices and structures of one length as columns.

Layout: MathWorks, "MAT-File Format", level 5. (scipy.io.loadmat 1.17 ended the child process by SIGSEGV for 2
of 84 garbled files and for deeply nested cells, and read a matrix of negative size. This reader checks every
length against the bytes that exist, and ended no child process.)
"""

import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from pipeline.recordings.formats import (
    LARGEST_UNPACKED,
    MOST_VALUES,
    Note,
    WholeTable,
    check_values,
    check_width,
    is_time_name,
    seconds,
)

_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_MATRIX, _COMPRESSED = 14, 15
_CELL, _STRUCTURE, _OBJECT, _TEXT, _SPARSE, _NUMBERS = 1, 2, 3, 4, 5, range(6, 16)
_COMPLEX = 0x0800
_CLASSES = {_SPARSE: "a sparse matrix", 16: "a function", 17: "an object; save its time and data as vectors"}
_DEEPEST, MOST_PARTS = 8, 20_000
# numpy has 64
_MOST_DIMENSIONS = 32


# a variable or a part of one: its name, its numbers, and words on what it is
_MatlabPart = tuple[str, np.ndarray | None, str]
# the kind and the data of an element
_Element = tuple[int, memoryview]


class _Broken(ValueError):
    """The reason why a variable cannot be read."""


def load_matlab(path: Path) -> WholeTable:
    """Returns the arrays of the most common length in the file. The columns of a matrix X are X_1, X_2, ...

    A structure's parts are "log.T1". The clock is a vector with the name of a time, if there is one. Raises
    ValueError if the file is damaged, or if nothing in it has two samples.
    """
    arrays, no_columns, count = {}, {}, 0
    with path.open("rb") as stream:
        for name, numbers, words in _parts(path, stream):
            if numbers is None or numbers.size == 1:
                no_columns[name] = words
                continue
            count += numbers.size
            check_values(path, count, 1)
            arrays[name] = numbers.squeeze()
    # the length that most arrays have along their longest side; the longer one if equally many have it
    lengths = [max(array.shape) for array in arrays.values() if array.ndim in (1, 2) and array.size]
    length = max(lengths, key=lambda length: (lengths.count(length), length), default=0)
    if length < 2:
        content = ", ".join([*arrays, *no_columns][:6]) or "nothing"
        raise ValueError(
            f"{path}: expected vectors of one length, at least 2 samples, but found {content}; "
            "save time, inputs and outputs as vectors"
        )
    values: dict[str, np.ndarray] = {}
    for name, array in arrays.items():
        if array.ndim > 2 or length not in array.shape:
            no_columns[name] = f"an array of {' x '.join(map(str, array.shape))}"
        elif array.ndim == 1:
            values[name] = array
        else:
            table = array if array.shape[0] == length else array.T
            check_width(path, len(values) + table.shape[1])
            values |= {f"{name}_{j + 1}": table[:, j] for j in range(table.shape[1])}
    check_width(path, len(values))
    return _with_clock(values, no_columns)


def _with_clock(values: dict[str, np.ndarray], no_columns: dict[str, str]) -> WholeTable:
    """Returns the table on the clock of a vector that has the name of a time and runs forward. Of several,
    the shortest name is used."""
    notes: list[Note] = []
    forward = [
        name
        for name, column in values.items()
        # a T is more often a temperature
        if is_time_name(last := name.rpartition(".")[2]) and last != "T" and (np.diff(column) > 0).all()
    ]
    time = None
    if forward:
        name = min(forward, key=len)
        time, remark = seconds(name.rpartition(".")[2], values[name])
        notes.append(Note("clock", "", 1, remark or f"{name} is the clock"))
        for column in sorted(set(values) - set(forward)):
            own = _own_clock(column, forward)
            if own and not np.array_equal(values[own], values[name]):
                no_columns[column] = f"numbers on a clock of its own, {own}; save it with its clock alone"
        values = {
            column: numbers
            for column, numbers in values.items()
            if column not in forward and column not in no_columns
        }
    return WholeTable(values, {}, time, "UTC", lambda i: f"sample {i + 1}", notes, {}, no_columns, {})


def _own_clock(name: str, clocks: list[str]) -> str:
    """Returns the clock of the innermost structure around `name` that has one, "" for none."""
    around = [clock for clock in clocks if "." in clock and name.startswith(clock.rpartition(".")[0] + ".")]
    return max(around, key=lambda clock: clock.count("."), default="")


# ---- variables


def _parts(path: Path, stream: BinaryIO) -> Iterator[_MatlabPart]:
    """Yields the parts of every variable. Raises ValueError with the place of a variable that cannot be
    read."""
    size, unpacked, count = path.stat().st_size, 0, 0
    order = {b"IM": "<", b"MI": ">"}.get(stream.read(128)[126:128], "<")
    while len(tag := stream.read(8)) == 8:
        place = stream.tell() - 8
        kind, length = struct.unpack(order + "II", tag)
        try:
            if place + 8 + length > size:
                raise _Broken(f"it should have {length} bytes but the file ends after {size - place - 8}")
            if kind == _MATRIX:
                content = memoryview(stream.read(length))
            elif kind == _COMPRESSED:
                content = _unpack(stream.read(length), LARGEST_UNPACKED - unpacked, order)
            else:
                stream.seek(length, 1)
                continue
            unpacked += len(content)
            for part in _variable(content, order, "", 0):
                count += 1
                if count > MOST_PARTS:
                    raise _Broken(f"the file has more than {MOST_PARTS} parts")
                yield part
        except (_Broken, struct.error, zlib.error) as error:
            raise ValueError(
                f"{path}: the variable at byte {place} cannot be read ({error}); save it again with "
                "save(..., '-v7'), or copy the recording again"
            ) from None


def _unpack(packed: bytes, room: int, order: str) -> memoryview:
    """Returns the matrix in a compressed variable."""
    unpacker = zlib.decompressobj()
    content = unpacker.decompress(packed, room + 9)
    if len(content) > room:
        raise _Broken(f"the file unpacks to more than {LARGEST_UNPACKED >> 20} MB")
    if not unpacker.eof:
        raise _Broken(f"it breaks off after {len(content)} unpacked bytes")
    kind, data = next(_elements(memoryview(content), order), (0, memoryview(b"")))
    if kind != _MATRIX:
        raise _Broken("no matrix is in it")
    return data


def _elements(data: memoryview, order: str) -> Iterator[_Element]:
    """Yields the elements one after the other. A short element has its data in its tag."""
    pos = 0
    while pos + 8 <= len(data):
        kind, length = struct.unpack_from(order + "II", data, pos)
        start = pos + 8
        if kind >> 16:
            kind, length, start = kind & 0xFFFF, kind >> 16, pos + 4
            if length > 4:
                raise _Broken(f"a short element of {length} bytes")
        if start + length > len(data):
            raise _Broken(f"an element of {length} bytes where {len(data) - start} are left")
        yield kind, data[start : start + length]
        pos = pos + 8 if start == pos + 4 else start + length + (-length) % 8


def _next_numbers(elements: Iterator[_Element], order: str) -> np.ndarray:
    kind, data = next(elements, (0, memoryview(b"")))
    if kind not in _KINDS:
        raise _Broken("an element that should hold numbers holds none")
    dtype = np.dtype(order + _KINDS[kind])
    if len(data) % dtype.itemsize:
        raise _Broken(f"an element of {len(data)} bytes, no multiple of {dtype.itemsize}")
    return np.frombuffer(data, dtype)


def _variable(data: memoryview, order: str, above: str, depth: int) -> Iterator[_MatlabPart]:
    """Yields the parts of a matrix. `above`: its full name if a structure or a cell array contains it,
    otherwise ""."""
    elements = _elements(data, order)
    flags, dims = _next_numbers(elements, order), _next_numbers(elements, order)
    _, own = next(elements, (0, b""))
    name = above or _text(own)
    if not len(flags) or (dims < 0).any():
        raise _Broken("its flags or dimensions are none")
    kind, shape = int(flags[0]) & 0xFF, tuple(int(size) for size in dims)
    if kind in _NUMBERS:
        yield _numeric(name, _next_numbers(elements, order), shape, bool(int(flags[0]) & _COMPLEX))
    elif kind in (_CELL, _STRUCTURE, _OBJECT) and depth < _DEEPEST:
        yield from _inner(elements, order, name, kind, depth)
    elif kind == _TEXT:
        yield name, None, f"a text of {np.prod(shape, dtype=float):.0f} characters"
    else:
        yield name, None, _CLASSES.get(kind, f"of class {kind}")


def _numeric(name: str, numbers: np.ndarray, shape: tuple[int, ...], is_complex: bool) -> _MatlabPart:
    count = math.prod(shape)
    if count != len(numbers):
        raise _Broken(f"{name} should have {count} numbers but has {len(numbers)}")
    if count > MOST_VALUES:
        raise _Broken(f"{name} has {count} numbers, more than the {MOST_VALUES} that are read")
    if len(shape) > _MOST_DIMENSIONS:
        return name, None, f"an array of {len(shape)} dimensions"
    if is_complex:
        return name, None, "complex numbers"
    words = f"one number, {float(numbers[0]):g}" if count == 1 else f"{count} numbers"
    return name, numbers.astype(float).reshape(shape, order="F"), words


def _inner(
    elements: Iterator[_Element], order: str, name: str, kind: int, depth: int
) -> Iterator[_MatlabPart]:
    """Yields the parts of a cell array or of a structure. In a structure the fields follow each other in
    every entry."""
    fields: list[str] = []
    if kind != _CELL:
        if kind == _OBJECT:
            next(elements, None)
        width = int((_next_numbers(elements, order)[:1].tolist() or [0])[0])
        kind_of_names, names = next(elements, (0, b""))
        if width < 1 or not kind_of_names:
            raise _Broken("its fields have no names")
        fields = [_text(names[i : i + width]) for i in range(0, len(names), width)]
        if not fields:
            return
    parts = [data for element_kind, data in elements if element_kind == _MATRIX]
    for i, data in enumerate(parts[:MOST_PARTS]):
        if kind == _CELL:
            full = f"{name}_{i + 1}"
        else:
            entry = f"_{i // len(fields) + 1}" if len(parts) > len(fields) else ""
            full = f"{name}{entry}.{fields[i % len(fields)]}"
        if len(data):
            yield from _variable(data, order, full, depth + 1)


def _text(name: bytes | memoryview) -> str:
    return bytes(name).split(b"\0")[0].decode("ascii", errors="replace")
