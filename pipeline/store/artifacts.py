"""Reads and writes Parquet, MCAP, JSON and text. It is the only module that opens an artifact.

Equal inputs give equal bytes: no clock, host, commit or duration is written. Every writer writes a temporary
file beside its target and then renames it. `stage` does the same for everything that a stage writes. If
anything fails, the last good artifacts are kept.
"""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import re
import shutil
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.store import params, tables
from pipeline.store.printable import printable
from pipeline.store.tables import ARRAYS, Column, Schema

# libraries for files are imported in the functions that use them, so a stage that only writes JSON does not
# wait for them
if TYPE_CHECKING:
    import numpy as np
    import pyarrow as pa

DATASETS, REPORTS = Path("datasets"), Path("reports")
WHOLE = ".whole"  # inside a stage: the folder that it lies in will hold nothing else
REFUSALS = (ValueError, OSError, MemoryError)  # LinAlgError is a ValueError
# the words with which XLA, OpenCV and C++ report that memory ran out
OUT_OF_MEMORY = ("RESOURCE_EXHAUSTED", "Insufficient memory", "bad_alloc")
CSV_ROWS = 1 << 15  # written at once: text takes ten times the memory of its numbers

# inside a stage: the folder in which files for reports/ wait until the stage has ended well
_waiting: ContextVar[Path | None] = ContextVar("_waiting", default=None)
# inside a stage: the fresh folder that then becomes datasets/<stage>
_fresh: ContextVar[Path | None] = ContextVar("_fresh", default=None)


# ---- tables


def write_table(
    path: str | Path, schema: Schema, columns: Mapping[str, np.ndarray | list | pa.Array]
) -> None:
    """Writes columns of equal length as Parquet. The file holds name and version of the schema, and unit and
    meaning of each field.

    Missing floats are NaN. Raises ValueError naming the column, and the row of a bad value.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    tables.check_names(path, schema, columns, "give exactly the columns of the schema")
    arrays = [_array(path, column, columns[column.name]) for column in schema.columns]
    lengths = {column.name: len(array) for column, array in zip(schema.columns, arrays, strict=True)}
    if len(set(lengths.values())) > 1:
        raise ValueError(
            f"{path}: columns should have one length but have {lengths}; give one value a row in each"
        )
    table = pa.Table.from_arrays(arrays, schema=tables.arrow(schema))
    tables.check_values(path, schema, table, "the file was not written")
    with beside(path) as temporary:
        pq.write_table(table, temporary, compression="zstd", write_page_checksum=True)


def read_table(path: str | Path, schema: Schema) -> dict[str, np.ndarray]:
    """Returns the columns by name: text as objects, missing floats as NaN, lists as objects.

    Raises ValueError if the file is missing or broken, or the table has another schema.
    """
    import numpy as np
    import pyarrow as pa
    import pyarrow.parquet as pq

    command = remedy(path)
    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            table = file.read()
    except FileNotFoundError:
        raise ValueError(f"{path} is missing; {command}") from None
    except MemoryError:
        raise  # Arrow's is an ArrowException too, and says nothing of the file
    except (OSError, pa.ArrowException) as error:
        raise ValueError(f"{path} is not a whole Parquet file ({reason(error)}); {command}") from None
    tables.check(path, schema, table, command)
    return {
        column.name: np.array(table[column.name].to_numpy(zero_copy_only=False)) for column in schema.columns
    }


def column_names(path: str | Path) -> list[str]:
    """Returns the names of a table's columns; [] if the file does not exist or is broken."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        return pq.read_schema(path).names
    except (OSError, pa.ArrowException):
        return []


def write_arrays(
    path: str | Path, name: str, version: int, arrays: Mapping[str, tuple[np.ndarray, str, str]]
) -> None:
    """Writes named real arrays {name: (array, unit, meaning)} of any shape as one Parquet table. Integers and
    booleans are read back as floats. Raises ValueError if an array is not real or holds an infinite
    number."""
    import numpy as np

    rows = []
    for key, (array, unit, meaning) in arrays.items():
        values = np.asarray(array)
        if values.dtype.kind not in "fiub":
            raise ValueError(
                f"{path}: array {key} is {values.dtype} but should be real numbers; "
                "write real and imaginary part, or a table"
            )
        if np.isinf(values).any():
            raise ValueError(
                f"{path}: array {key} holds an infinite number; write NaN where there is no value"
            )
        rows.append((key, unit, meaning, list(values.shape), np.ravel(values).astype(float)))
    columns = dict(
        zip(
            [column.name for column in ARRAYS.columns],
            map(list, zip(*rows, strict=True)) if rows else [[]] * 5,
            strict=True,
        )
    )
    write_table(path, ARRAYS._replace(name=name, version=version), columns)


def read_arrays(
    path: str | Path, name: str, version: int, *, shapes: Mapping[str, tuple[int | None, ...]] | None = None
) -> dict[str, np.ndarray]:
    """Returns the arrays of `write_arrays`, float64 and in their shapes.

    Raises ValueError if an array does not have the shape that `shapes` gives (None: any length). The file
    then belongs to another machine or to another run than the files read with it.
    """
    import numpy as np

    table = read_table(path, ARRAYS._replace(name=name, version=version))
    arrays = {}
    for key, shape, values in zip(table["name"], table["shape"], table["values"], strict=True):
        if math.prod(shape) != len(values):
            raise ValueError(
                f"{path}: array {key} has {len(values)} values but should have {math.prod(shape)}, "
                f"the shape {_shape(shape)}; {remedy(path)}"
            )
        arrays[key] = np.array(values, float).reshape(shape)
    for key, expected in (shapes or {}).items():
        found = arrays[key].shape if key in arrays else None
        if (
            found is None
            or len(found) != len(expected)
            or any(length not in (None, at) for length, at in zip(expected, found, strict=True))
        ):
            held = f"has the shape {_shape(found)}" if found is not None else "is not there"
            raise ValueError(
                f"{path}: array {key} {held} but {_shape(expected)} is expected of the machine in "
                f"{params.FILE}, so that the file is of another machine or another run; {remedy(path)}"
            )
    return arrays


def _shape(lengths: Sequence[int | None]) -> str:
    return " x ".join("any" if length is None else str(int(length)) for length in lengths) or "of one number"


def _array(path: str | Path, column: Column, values) -> pa.Array:
    """Returns the values in the column's type, NaN as missing. Nothing is rounded."""
    import numpy as np
    import pyarrow as pa

    try:
        if isinstance(values, pa.Array | pa.ChunkedArray):
            values = values.to_numpy(zero_copy_only=False)
        values = values.tolist() if isinstance(values, np.ndarray) and values.dtype.kind in "UO" else values
        return pa.array(values, tables.arrow_type(column.type), from_pandas=True)
    except (pa.ArrowException, TypeError, ValueError, OverflowError) as error:
        raise ValueError(
            f"{path}: column {column.name} does not fit {column.type} ({reason(error)}); "
            "convert it before writing"
        ) from None


# ---- JSON and text


def write_json(path: str | Path, data) -> None:
    """Writes dictionaries in their order, lists, text, numbers (numpy's too), NamedTuples as dictionaries.

    Raises ValueError naming the key if a value is NaN, infinite, or of a type that JSON does not have.
    """
    write_text(path, json.dumps(_plain(path, "", data), indent=2, ensure_ascii=False, allow_nan=False) + "\n")


def read_json(path: str | Path):
    """Returns the data of a file of `write_json`. Raises ValueError if the file is missing or broken."""
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ValueError(f"{path} is missing; {remedy(path)}") from None
    except ValueError as error:
        raise ValueError(f"{path} is not whole JSON ({reason(error)}); {remedy(path)}") from None


def write_metrics(stage: str, figures: Mapping, metrics: Sequence[str] = ("*",)) -> None:
    """Writes all figures to datasets/<stage>/figures.json, which pages and later stages read, and those that
    match `metrics` to reports/metrics/<stage>.json, which git keeps and DVC compares.

    A pattern is a dotted path; * in a key matches any text. It selects a figure, or all figures below a
    section.
    """
    fresh = _fresh.get()
    write_json((fresh if fresh else DATASETS / stage) / "figures.json", figures)
    patterns = [tuple(pattern.split(".")) for pattern in metrics]
    write_json(REPORTS / "metrics" / f"{stage}.json", matching(_plain(stage, "", figures), patterns))


def matching(figures: Mapping | list, patterns: Sequence[Sequence[str]]) -> dict | list:
    """Returns the figures and sections that match a pattern, in their order. The index in a list counts as a
    key."""
    from fnmatch import fnmatchcase

    listed = isinstance(figures, list)
    chosen: dict[Any, Any] = {}
    for key, value in enumerate(figures) if listed else figures.items():
        rests = [rest for first, *rest in patterns if fnmatchcase(str(key), first)]
        if not all(rests):
            chosen[key] = value
        elif isinstance(value, Mapping | list) and (inner := matching(value, rests)):
            chosen[key] = inner
    return list(chosen.values()) if listed else chosen


def read_figures(stage: str) -> dict:
    """Returns all figures that the stage wrote with `write_metrics`."""
    return read_json(DATASETS / stage / "figures.json")


def write_learning_curve(
    folder: str | Path, columns: Mapping[str, Sequence], *, of: str, step: str, figures: Sequence[str]
) -> None:
    """Writes a training's learning curve in DVCLive's files, for `dvc plots` and other readers.

    For every name in column `of`, each figure has a file <folder>/plots/metrics/<name>/<figure>.tsv by
    `step`. A figure that is missing at a step has no line there. (DVCLive itself is not used: it changes git
    and dvc.yaml, and with a token set it sends to the network.)
    """
    lines: dict[tuple[str, str], list[str]] = {}
    for name, at, *values in zip(*(columns[key] for key in (of, step, *figures)), strict=True):
        for figure, value in zip(figures, values, strict=True):
            if value is not None and math.isfinite(value):
                lines.setdefault((name.replace(" ", "_"), figure), []).append(
                    f"{int(at)}\t{float(value)!r}\n"
                )
    for (name, figure), rows in lines.items():
        write_text(
            Path(folder) / "plots/metrics" / name / f"{figure}.tsv", f"step\t{figure}\n{''.join(rows)}"
        )


def write_text(path: str | Path, text: str) -> None:
    """Writes text in UTF-8 with Unix line ends."""
    with beside(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def write_lines(path: str | Path, lines: Iterable[str]) -> None:
    """Writes lines in UTF-8 with Unix line ends, one by one as they arrive."""
    with beside(path) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as stream:
        stream.writelines(f"{line}\n" for line in lines)


def write_bytes(path: str | Path, content: bytes) -> None:
    with beside(path) as temporary:
        temporary.write_bytes(content)


def write_folder(path: str | Path, files: Mapping[str, str | bytes]) -> None:
    """Writes a folder below reports/ that holds exactly these files, texts in UTF-8. Inside a stage this
    happens when the stage ends well. Files of an earlier run are removed. Outside a stage the folder is
    incomplete if a write fails."""
    waiting = _waiting.get()
    folder = waiting / path if waiting else Path(path)
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in {**files, WHOLE: ""}.items():
        (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
    # all files are written before waiting for the first, because a disk handles many at once
    for name in files:
        _on_disk(folder / name)
    if not waiting:
        (folder / WHOLE).unlink()
        _drop_others(files, folder)


def write_jpeg(path: str | Path, picture: np.ndarray) -> None:
    """Writes a picture (h, w, 3) uint8 in RGB as JPEG of quality 80, good enough for a page."""
    import cv2

    done, data = cv2.imencode(
        ".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 80]
    )
    if not done:
        raise OSError(f"{path} cannot be written")
    with beside(path) as temporary:
        temporary.write_bytes(data.tobytes())


def write_csv(path: str | Path, columns: Mapping[str, np.ndarray]) -> None:
    """Writes a CSV file of numbers and plain words for readers without Parquet: a header line of names, then
    one line per sample, floats by repr."""
    import numpy as np

    arrays = [np.asarray(values) for values in columns.values()]
    with beside(path) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as stream:
        stream.write(",".join(columns) + "\n")
        for at in range(0, max(map(len, arrays)), CSV_ROWS):
            rows = zip(*(map(str, array[at : at + CSV_ROWS].tolist()) for array in arrays), strict=True)
            stream.write("".join(",".join(row) + "\n" for row in rows))


def _plain(path: str | Path, place: str, data):
    if isinstance(data, tuple) and hasattr(data, "_asdict"):
        data = data._asdict()
    if type(data).__module__ == "numpy":
        data = data.tolist()
    if isinstance(data, Mapping):
        bad_key = next((key for key in data if not isinstance(key, str)), None)
        if bad_key is not None:
            raise ValueError(
                f"{path}: key {bad_key!r} of {place or 'the whole'} should be text but is "
                f"{type(bad_key).__name__}; write it as text"
            )
        return {key: _plain(path, f"{place}.{key}" if place else key, value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_plain(path, f"{place}[{i}]", value) for i, value in enumerate(data)]
    if isinstance(data, float) and not math.isfinite(data):
        raise ValueError(
            f"{path}: {place} is {data} but must be finite; write null where there is no figure, "
            "and say why beside it"
        )
    if data is None or isinstance(data, str | int | float):
        return data
    raise ValueError(
        f"{path}: {place} is {type(data).__name__}, which JSON does not know; write numbers, text, "
        "lists or dictionaries"
    )


def exists(path: str | Path) -> bool:
    """Returns whether a stage wrote this optional artifact."""
    return Path(path).exists()


# ---- recordings


@contextlib.contextmanager
def about(path: str | Path) -> Iterator[None]:
    """Puts the file's name at the beginning of a ValueError raised in the body, unless the message begins
    with it."""
    try:
        yield
    except ValueError as error:
        sentence = str(error)
        raise ValueError(sentence if sentence.startswith(str(path)) else f"{path}: {sentence}") from None


def write_recording(
    path: str | Path,
    time_s: np.ndarray,
    signals: Mapping[str, tuple[np.ndarray, str, str]],
    *,
    topic: str = "/machine",
) -> None:
    """Writes one MCAP file with a JSON message {signal: value, ...} on `topic` at each of time_s (T,).

    `signals`: {name: (values (T,), unit, meaning)}. log_time is round(1e9 time_s) ns. The channel's metadata
    holds name and version of the schema, and unit and meaning of each signal. Raises ValueError if lengths
    differ, if values are not finite, or if time_s is negative.
    """
    import mcap.writer
    import numpy as np

    time = np.asarray(time_s, float)
    for name, (values, _, _) in {"time_s": (time, "s", ""), **signals}.items():
        if np.shape(values) != time.shape or time.ndim != 1:
            raise ValueError(
                f"{path}: {name} should have one value for each of {time.size} times but has "
                f"shape {np.shape(values)}"
            )
        if not np.isfinite(values).all():
            raise ValueError(
                f"{path}: {name} is not finite at sample {np.flatnonzero(~np.isfinite(values))[0]}; "
                "leave that sample out"
            )
    if time.size and time.min() < 0:
        raise ValueError(f"{path}: time_s begins at {time.min():g} s but MCAP counts from 0; shift the time")
    metadata = {"schema": "recording", "schema_version": "1"}
    properties = {}
    for name, (_, unit, meaning) in signals.items():
        metadata |= {f"{name}.unit": unit, f"{name}.meaning": meaning}
        properties[name] = {"type": "number", "unit": unit, "description": meaning}
    json_schema = json.dumps(
        {"title": "recording", "type": "object", "properties": properties}, ensure_ascii=False
    ).encode()
    # a float's repr is a JSON number, so one formatting makes a message; json.dumps takes six times as long
    message = "{" + ", ".join(json.dumps(name).replace("%", "%%") + ": %r" for name in signals) + "}"
    rows = zip(*(np.asarray(values, float).tolist() for values, _, _ in signals.values()), strict=True)
    with beside(path) as temporary, temporary.open("wb") as stream:
        writer = mcap.writer.Writer(
            stream, compression=mcap.writer.CompressionType.ZSTD, enable_data_crcs=True
        )
        writer.start(profile="", library="beadline")
        channel = writer.register_channel(
            topic, "json", writer.register_schema("recording", "jsonschema", json_schema), metadata
        )
        for sequence, (log_time, row) in enumerate(
            zip(np.rint(time * 1e9).astype(np.int64).tolist(), rows, strict=True)
        ):
            writer.add_message(channel, log_time, (message % row).encode(), log_time, sequence)
        writer.finish()


# ---- digests


def sha256(path: str | Path) -> str:
    """Returns the digest of a file, or of a folder's relative names and contents. Files and folders with a
    dot at the start of their name, and __pycache__, are ignored."""
    import hashlib

    path = Path(path)
    if not path.is_dir():
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    digest = hashlib.sha256()
    for name in sorted(file.relative_to(path).as_posix() for file in path.rglob("*") if file.is_file()):
        if not any(part.startswith(".") or part == "__pycache__" for part in name.split("/")):
            digest.update(f"{name}\0{sha256(path / name)}\n".encode())
    return digest.hexdigest()


# ---- all or nothing


@contextlib.contextmanager
def stage(name: str) -> Iterator[Path]:
    """Runs the body of a stage. When it ends well, a fresh folder becomes datasets/<name>, and the files that
    the body wrote to reports/ take their places.

    Bad input (ValueError, LinAlgError, OSError, Arrow's errors) or lack of memory ends the process with
    status 1 and one line, and changes no file.
    """
    folder, retired, waiting = (DATASETS / f".{name}.{os.getpid()}{end}" for end in ("", ".old", ".reports"))
    tokens = _waiting.set(waiting), _fresh.set(folder)
    try:
        _tidy(name)
        folder.mkdir(parents=True)
        yield folder
        _replace(folder, retired, DATASETS / name)
        for whole in sorted(waiting.rglob(WHOLE)):
            whole.unlink()
            names = [file.name for file in whole.parent.iterdir()]
            _drop_others(names, whole.parent.relative_to(waiting))
        for temporary in sorted(file for file in waiting.rglob("*") if file.is_file()):
            target = temporary.relative_to(waiting)
            target.parent.mkdir(parents=True, exist_ok=True)
            temporary.replace(target)
    except Exception as error:
        if not (isinstance(error, REFUSALS) or _is_of_arrow(error) or _out_of_memory(error)):
            raise
        # the temporary folder's name means nothing to a reader
        sentence = reason(error).replace(str(folder), str(DATASETS / name))
        print(printable(f"{name}: {sentence}"), file=sys.stderr)
        raise SystemExit(1) from None
    finally:
        _waiting.reset(tokens[0])
        _fresh.reset(tokens[1])
        for left in (folder, waiting):
            shutil.rmtree(left, ignore_errors=True)


def _drop_others(names: Iterable[str], folder: Path) -> None:
    """Removes the files of a folder that have none of these names."""
    kept = set(names)
    for file in sorted(folder.glob("*")):
        if file.is_file() and file.name not in kept:
            file.unlink()


def _replace(folder: Path, retired: Path, target: Path) -> None:
    """Moves `folder` to `target`. If the second rename fails, the old `target` is put back. A stage that
    wrote only to reports/ has no folder."""
    filled = any(folder.iterdir())
    if target.exists():
        target.rename(retired)
    try:
        if filled:
            folder.rename(target)
    finally:
        if filled and not target.exists() and retired.exists():
            retired.rename(target)
    shutil.rmtree(retired, ignore_errors=True)


def _tidy(name: str) -> None:
    """Removes what killed runs left behind. Puts back the folder of a run that was killed between its two
    renames."""
    for left in DATASETS.glob(f".{name}.*"):
        ending = re.fullmatch(r"\.(\d+)(\.old|\.reports)?", left.name.removeprefix(f".{name}"))
        if not ending or (_alive(int(ending[1])) and int(ending[1]) != os.getpid()):
            continue
        if ending[2] == ".old" and not (DATASETS / name).exists():
            left.rename(DATASETS / name)
        else:
            shutil.rmtree(left, ignore_errors=True)


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


@contextlib.contextmanager
def beside(path: str | Path) -> Iterator[Path]:
    """Gives a temporary file that replaces the target when the body ends well. Inside a stage, a file in
    reports/ is kept until the stage ends well."""
    target, waiting = Path(path), _waiting.get()
    place = waiting / target if waiting and target.parts[0] == REPORTS.name else target
    temporary = place.with_name(f".{place.name}.{os.getpid()}")
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        _on_disk(temporary)
        temporary.replace(place)
        _on_disk(place.parent)
    except OSError as error:
        raise OSError(
            f"{target} cannot be written ({os.strerror(error.errno or 0)}); {_mend(error, target.parent)}"
        ) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def together(folder: Path) -> Iterator[Path]:
    """Gives a folder inside this one. When the body ends well, its files are moved up into `folder`: all or
    none. Remains of killed calls are removed."""
    for left in folder.glob(".together.*"):
        pid = left.suffix[1:]
        if pid.isdigit() and not _alive(int(pid)):
            shutil.rmtree(left, ignore_errors=True)
    waiting = folder / f".together.{os.getpid()}"
    try:
        waiting.mkdir(parents=True, exist_ok=True)
        yield waiting
        for file in sorted(waiting.iterdir()):
            file.replace(folder / file.name)
    except OSError as error:
        raise OSError(reason(error).replace(str(waiting), str(folder))) from None
    finally:
        shutil.rmtree(waiting, ignore_errors=True)


def _on_disk(path: Path) -> None:
    """Waits until a file, or the names in a folder, would survive a power cut; about 5 ms each."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _mend(error: OSError, folder: Path) -> str:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return "free some space and run it again"
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return f"make {folder} writable"
    return f"look at {folder}"


def remedy(path: str | Path) -> str:
    """Returns the command that makes the artifact again. The path names the stage."""
    parts = Path(path).parts
    if parts[:2] == ("reports", "metrics"):
        return f"make it again with ./run dvc repro {Path(path).stem}"
    if parts[:2] in (("datasets", "kept"), ("datasets", "papers")):
        return f"restore it with git checkout datasets/{parts[1]}"
    if parts[:1] == ("datasets",) and len(parts) > 2 and parts[1] not in ("raw", "published", "memo"):
        stage = re.sub(r"^[.](.+)[.][0-9]+$", r"\1", parts[1])
        return f"make it again with ./run dvc repro {stage}"
    return "restore it, or write it again"


def reason(error: Exception) -> str:
    """Returns the error in one line. Errors of the operating system and lack of memory are explained, with a
    remedy."""
    text = str(error) or type(error).__name__
    if isinstance(error, MemoryError) or _out_of_memory(error):
        text = (
            f"there is not enough memory ({' '.join(text.split())[:200]}); "
            f"end other programs, or lower execution.jobs in {params.FILE}, and run it again"
        )
    if isinstance(error, OSError) and error.filename:
        text = f"{error.filename}: {error.strerror}; {_mend(error, Path(error.filename).parent)}"
    return "; ".join(line.strip() for line in text.splitlines() if line.strip())


def _is_of_arrow(error: Exception) -> bool:
    return any(kind.__module__ == "pyarrow.lib" for kind in type(error).__mro__)


def _out_of_memory(error: Exception) -> bool:
    """Returns whether a library ran out of memory: XLA and C++ report it by RuntimeError, OpenCV by its own
    error."""
    return any(words in str(error) for words in OUT_OF_MEMORY)


def write_weights(
    path: str | Path, name: str, arrays: Mapping[str, np.ndarray], about: Mapping[str, str]
) -> None:
    """Writes arrays of any shape and type without changing a bit, and `about`: what a reader must know to use
    them. Equal arrays give equal bytes."""
    import numpy as np
    from safetensors.numpy import save_file

    metadata = {"schema": name, **about}
    # the library writes metadata in the order of a hash that differs between processes, so a single key holds
    # everything
    packed = {"beadline": "\n".join(f"{key}={metadata[key]}" for key in sorted(metadata))}
    with beside(path) as temporary:
        save_file(
            {key: np.asarray(array, order="C") for key, array in sorted(arrays.items())}, temporary, packed
        )


def read_weights(path: str | Path, name: str) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Returns arrays and `about` of `write_weights`. Raises ValueError if the file is missing, broken, or of
    another schema."""
    import safetensors
    from safetensors.numpy import load_file

    command = remedy(path)
    try:
        arrays = load_file(path)
        with safetensors.safe_open(path, "numpy") as file:
            lines = (file.metadata() or {}).get("beadline", "").splitlines()
    except FileNotFoundError:
        raise ValueError(f"{path} is missing; {command}") from None
    except (OSError, safetensors.SafetensorError, ValueError) as error:
        raise ValueError(f"{path} holds no whole weights ({error}); {command}") from None
    about = dict(line.partition("=")[::2] for line in lines)
    schema = about.pop("schema", "none")
    if schema != name:
        raise ValueError(f"{path} should hold weights of {name} but has schema {schema}; {command}")
    return arrays, about
