"""MATLAB files of versions 5 to 7: vectors, matrices and structures of one length as columns.

scipy reads them in a child process: it ended by SIGSEGV for 2 of 84 garbled files, and for deeply nested
cells.
"""

import math
import tempfile
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pipeline.recordings.formats import Note, WholeTable, check_values, check_width, is_time_name, seconds
from pipeline.recordings.isolated import Budget, isolated
from pipeline.store import artifacts

# of one file; a print log of a day has 100 MB
BUDGET = Budget(longest_s=60.0, largest_mb=2000.0)

# what scipy raises for a file that is damaged
_DAMAGE = (ValueError, TypeError, LookupError, OSError, ArithmeticError, AttributeError, NotImplementedError)


def load_matlab(path: Path) -> WholeTable:
    """The numbers of the most common length in the file; the columns of a matrix X are X_1, X_2, ...

    A structure's parts are "log.T1". The clock is the vector with the name of a time, if there is one. Raises
    ValueError for a damaged file and for one without two samples of anything.
    """
    with tempfile.TemporaryDirectory() as folder:
        unpacked = Path(folder) / "numbers"
        shapes, no_columns = isolated(_unpack, path, unpacked, shown=path, budget=BUDGET)
        numbers = np.fromfile(unpacked)
    ends = np.cumsum([math.prod(shape) for shape in shapes.values()], dtype=int)
    parts = zip(shapes.items(), np.split(numbers, ends)[:-1], strict=True)
    arrays = {name: part.reshape(shape) for (name, shape), part in parts}
    check_values(path, sum(array.size for array in arrays.values()), 1)
    # the length that most arrays have along their longest side; of equally many the longer
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
    """The table on the clock of the first vector that has the name of a time and runs forward."""
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
    """The clock of the innermost structure around `name` that has one, "" for none."""
    around = [clock for clock in clocks if "." in clock and name.startswith(clock.rpartition(".")[0] + ".")]
    return max(around, key=lambda clock: clock.count("."), default="")


# ---- variables, in the child


def _unpack(path: Path, unpacked: Path) -> tuple[dict[str, tuple[int, ...]], dict[str, str]]:
    """Writes the numbers of a file to `unpacked`: {name: shape}, and words on every part that is no array.
    Raises ValueError for a file that cannot be read."""
    # it takes a moment, which only such files cost
    import scipy.io

    try:
        variables = scipy.io.loadmat(path, chars_as_strings=False)
    except (*_DAMAGE, zlib.error, scipy.io.matlab.MatReadError) as error:
        raise ValueError(
            f"{path}: its variables cannot be read ({' '.join(str(error).split())[:200]}); save it again "
            "with save(..., '-v7'), or copy the recording again"
        ) from None
    arrays, no_columns = {}, {}
    for variable in variables:
        for name, part in _parts(variable, variables[variable]) if not variable.startswith("__") else ():
            if isinstance(part, str):
                no_columns[name] = part
            else:
                arrays[name] = part.astype(float).squeeze()
    artifacts.write_bytes(unpacked, b"".join(array.tobytes() for array in arrays.values()))
    return {name: array.shape for name, array in arrays.items()}, no_columns


def _parts(name: str, value: np.ndarray) -> Iterator[tuple[str, np.ndarray | str]]:
    """(name, numbers, or words on what it is) of the parts of a variable. The entries of a cell and of a
    structure have a name each."""
    kind = type(value).__name__
    if kind == "MatlabOpaque":
        yield name, "an object; save its time and data as vectors"
    elif kind == "MatlabFunction":
        yield name, "a function"
    elif not isinstance(value, np.ndarray):
        yield name, "a sparse matrix"
    elif value.dtype.names:
        for i, entry in enumerate(value.ravel(order="F"), 1):
            for field in value.dtype.names:
                yield from _parts(f"{name}{f'_{i}' if value.size > 1 else ''}.{field}", entry[field])
    elif value.dtype.kind == "O":
        for i, entry in enumerate(value.ravel(order="F"), 1):
            yield from _parts(f"{name}_{i}", entry)
    elif value.dtype.kind == "U":
        yield name, f"a text of {value.size} characters"
    elif value.dtype.kind == "c":
        yield name, "complex numbers"
    else:
        yield name, f"one number, {float(value.flat[0]):g}" if value.size == 1 else value
