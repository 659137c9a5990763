"""Parquet, MCAP, JSON and text: the only module that opens an artifact.

Equal inputs give equal bytes: no clock, host, commit or duration is written. Every writer
writes beside its target and renames, and `stage` does so for all that a stage writes:
whatever goes wrong, the last good artifacts stay.
"""

import contextlib
import errno
import hashlib
import json
import os
import re
import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextvars import ContextVar
from pathlib import Path

import cv2
import mcap.writer
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import safetensors
from safetensors.numpy import load_file, save_file

from pipeline.store import tables
from pipeline.store.tables import ARRAYS, Column, Schema

DATASETS, REPORTS = Path("datasets"), Path("reports")

# inside a stage: the folder where what goes to reports/ waits until the stage has ended well
_waiting: ContextVar[Path | None] = ContextVar("_waiting", default=None)


# ---- tables


def write_table(
    path: str | Path, schema: Schema, columns: Mapping[str, np.ndarray | list | pa.Array]
) -> None:
    """Columns of equal length as Parquet; name and version of the
    schema in the file, unit and meaning in each field.

    Missing floats are NaN. Raises ValueError naming the column and the row.
    """
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
    """Columns by name: text as objects, missing floats as NaN, lists as
    objects. Raises ValueError where it is not `schema`."""
    wanted = remedy(path)
    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            table = file.read()
    except FileNotFoundError:
        raise ValueError(f"{path} is missing; {wanted}") from None
    except (OSError, pa.ArrowException) as error:
        raise ValueError(f"{path} is not a whole Parquet file ({reason(error)}); {wanted}") from None
    tables.check(path, schema, table, wanted)
    return {
        column.name: np.array(table[column.name].to_numpy(zero_copy_only=False)) for column in schema.columns
    }


def write_arrays(
    path: str | Path, name: str, version: int, arrays: Mapping[str, tuple[np.ndarray, str, str]]
) -> None:
    """Named real arrays {name: (array, unit, meaning)} of any shape as one Parquet
    table; integers and booleans come back as floats."""
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


def read_arrays(path: str | Path, name: str, version: int) -> dict[str, np.ndarray]:
    """The arrays of `write_arrays`, float64 and in their shapes."""
    table = read_table(path, ARRAYS._replace(name=name, version=version))
    return {
        key: np.array(values, float).reshape(shape)
        for key, shape, values in zip(table["name"], table["shape"], table["values"], strict=True)
    }


def _array(path: str | Path, column: Column, values) -> pa.Array:
    """Values in the column's type, NaN as missing; nothing is rounded on the way."""
    try:
        if isinstance(values, pa.Array | pa.ChunkedArray):
            values = values.to_numpy(zero_copy_only=False)
        values = values.tolist() if isinstance(values, np.ndarray) and values.dtype.kind in "UO" else values
        return pa.array(values, column.type, from_pandas=True)
    except (pa.ArrowException, TypeError, ValueError, OverflowError) as error:
        raise ValueError(
            f"{path}: column {column.name} does not fit {column.type} ({reason(error)}); "
            "convert it before writing"
        ) from None


# ---- JSON and text


def write_json(path: str | Path, data) -> None:
    """Dictionaries in their order, lists, text, numbers (numpy's too), NamedTuples as dictionaries.

    Raises ValueError naming the key of NaN, infinity, or of what JSON does not know.
    """
    write_text(path, json.dumps(_plain(path, "", data), indent=2, ensure_ascii=False, allow_nan=False) + "\n")


def read_json(path: str | Path):
    """What `write_json` wrote. Raises ValueError where the file is missing or broken."""
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ValueError(f"{path} is missing; {remedy(path)}") from None
    except ValueError as error:
        raise ValueError(f"{path} is not whole JSON ({reason(error)}); {remedy(path)}") from None


def write_metrics(stage: str, data: Mapping) -> None:
    """reports/metrics/<stage>.json; inside the frame of a stage it is
    put in place when the stage has ended well."""
    write_json(REPORTS / "metrics" / f"{stage}.json", data)


def read_metrics(stage: str) -> dict:
    """What the stage wrote with `write_metrics`."""
    return read_json(REPORTS / "metrics" / f"{stage}.json")


def write_course(
    folder: str | Path, columns: Mapping[str, Sequence], *, of: str, step: str, figures: Sequence[str]
) -> None:
    """The course of a training in DVCLive's files, for `dvc plots` and whatever else reads them:
    <folder>/plots/metrics/<name>/<figure>.tsv by `step`, for every name in column `of`.

    A figure that is missing at a step has no line there. (The library itself takes hold of git, of dvc.yaml
    and, where a token is set, of the network.)
    """
    lines: dict[tuple[str, str], list[str]] = {}
    for name, at, *values in zip(*(columns[key] for key in (of, step, *figures)), strict=True):
        for figure, value in zip(figures, values, strict=True):
            if value is not None and np.isfinite(value):
                lines.setdefault((name.replace(" ", "_"), figure), []).append(
                    f"{int(at)}\t{float(value)!r}\n"
                )
    for (name, figure), rows in lines.items():
        write_text(
            Path(folder) / "plots/metrics" / name / f"{figure}.tsv", f"step\t{figure}\n{''.join(rows)}"
        )


def write_text(path: str | Path, text: str) -> None:
    """UTF-8 with Unix line ends."""
    with beside(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def write_jpeg(path: str | Path, picture: np.ndarray) -> None:
    """A picture (h, w, 3) uint8 in RGB, at the quality of a page."""
    done, data = cv2.imencode(
        ".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 80]
    )
    if not done:
        raise OSError(f"{path} cannot be written")
    with beside(path) as temporary:
        temporary.write_bytes(data.tobytes())


def write_csv(path: str | Path, columns: Mapping[str, np.ndarray]) -> None:
    """Numbers and plain words for people and machines that read no Parquet: a header line
    of names, then one line a sample, floats by repr."""
    rows = zip(*(map(str, np.asarray(values).tolist()) for values in columns.values()), strict=True)
    write_text(path, ",".join(columns) + "\n" + "".join(",".join(row) + "\n" for row in rows))


def _plain(path: str | Path, place: str, data):
    if isinstance(data, tuple) and hasattr(data, "_asdict"):
        data = data._asdict()
    if isinstance(data, np.ndarray | np.generic):
        data = data.tolist()
    if isinstance(data, Mapping):
        wrong = next((key for key in data if not isinstance(key, str)), None)
        if wrong is not None:
            raise ValueError(
                f"{path}: key {wrong!r} of {place or 'the whole'} should be text but is "
                f"{type(wrong).__name__}; write it as text"
            )
        return {key: _plain(path, f"{place}.{key}" if place else key, value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_plain(path, f"{place}[{i}]", value) for i, value in enumerate(data)]
    if isinstance(data, float) and not np.isfinite(data):
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
    """Whether a stage wrote this optional artifact."""
    return Path(path).exists()


# ---- recordings


@contextlib.contextmanager
def about(path: str | Path) -> Iterator[None]:
    """What the body refuses is said of this file."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def write_recording(
    path: str | Path,
    time_s: np.ndarray,
    signals: Mapping[str, tuple[np.ndarray, str, str]],
    *,
    topic: str = "/machine",
) -> None:
    """One MCAP file: at each of time_s (T,) a JSON message {signal: value, ...} on
    `topic`; signals {name: (values (T,), unit, meaning)}.

    log_time is round(1e9 time_s) ns. The channel's metadata has name and version of the schema, and unit and
    meaning of each signal. Raises ValueError for lengths that differ and for values that are not finite.
    """
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
    # a float's repr is a JSON number, so a message is one formatting
    # of a row; json.dumps takes six times as long
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
    """Digest of a file, or of a folder by relative names and contents;
    dot files and __pycache__ do not count."""
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
    """The frame around a stage: a fresh folder that becomes datasets/<name> when the
    body ends well, and what it wrote to reports/ with it.

    Bad input (ValueError, LinAlgError, OSError, Arrow's errors) ends the
    process with status 1 and one line; nothing was touched.
    """
    folder, aside, waiting = (DATASETS / f".{name}.{os.getpid()}{end}" for end in ("", ".old", ".reports"))
    token = _waiting.set(waiting)
    try:
        _tidy(name)
        folder.mkdir(parents=True)
        yield folder
        _replace(folder, aside, DATASETS / name)
        for temporary in sorted(file for file in waiting.rglob("*") if file.is_file()):
            target = temporary.relative_to(waiting)
            target.parent.mkdir(parents=True, exist_ok=True)
            temporary.replace(target)
    except (ValueError, OSError, np.linalg.LinAlgError, pa.ArrowException) as error:
        # a temporary folder's name says nothing to a reader
        print(f"{name}: {reason(error).replace(str(folder), str(DATASETS / name))}", file=sys.stderr)
        raise SystemExit(1) from None
    finally:
        _waiting.reset(token)
        for left in (folder, waiting):
            shutil.rmtree(left, ignore_errors=True)


def _replace(folder: Path, aside: Path, target: Path) -> None:
    """Target is `folder` afterwards, or, should the second rename fail, what it was. A
    stage that wrote only to reports/ has no folder."""
    filled = any(folder.iterdir())
    if target.exists():
        target.rename(aside)
    try:
        if filled:
            folder.rename(target)
    finally:
        if filled and not target.exists() and aside.exists():
            aside.rename(target)
    shutil.rmtree(aside, ignore_errors=True)


def _tidy(name: str) -> None:
    """Removes what killed runs left, and puts back the folder of one
    that was killed between its two renames."""
    for left in DATASETS.glob(f".{name}.*"):
        found = re.fullmatch(r"\.(\d+)(\.old|\.reports)?", left.name.removeprefix(f".{name}"))
        if not found or (_alive(int(found[1])) and int(found[1]) != os.getpid()):
            continue
        if found[2] == ".old" and not (DATASETS / name).exists():
            left.rename(DATASETS / name)
        else:
            shutil.rmtree(left)


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
    """A temporary file that takes the target's place when the body ends well;
    inside a stage, one in reports/ waits for its end."""
    target, waiting = Path(path), _waiting.get()
    place = waiting / target if waiting and target.parts[0] == REPORTS.name else target
    temporary = place.with_name(f".{place.name}.{os.getpid()}")
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        temporary.replace(place)
    except OSError as error:
        raise OSError(
            f"{target} cannot be written ({os.strerror(error.errno or 0)}); {_mend(error, target.parent)}"
        ) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def _mend(error: OSError, folder: Path) -> str:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return "free some space and run it again"
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return f"make {folder} writable"
    return f"look at {folder}"


def remedy(path: str | Path) -> str:
    """The command that makes the artifact again; the stage is in its path."""
    parts = Path(path).parts
    if parts[:2] == ("reports", "metrics"):
        return f"make it again with ./run dvc repro {Path(path).stem}"
    if parts[:1] == ("datasets",) and len(parts) > 2 and parts[1] not in ("raw", "published", "memo"):
        stage = re.sub(r"^[.](.+)[.][0-9]+$", r"\1", parts[1])
        return f"make it again with ./run dvc repro {stage}"
    return "restore it, or write it again"


def reason(error: Exception) -> str:
    """The error in one line; of an operating system's error the file, the words and the remedy."""
    text = str(error) or type(error).__name__
    if isinstance(error, OSError) and error.filename:
        text = f"{error.filename}: {error.strerror}; {_mend(error, Path(error.filename).parent)}"
    return "; ".join(line.strip() for line in text.splitlines() if line.strip())


def write_weights(
    path: str | Path, name: str, arrays: Mapping[str, np.ndarray], about: Mapping[str, str]
) -> None:
    """Arrays of any shape and kind, each with its bits as they are; `about` is what a reader must know to use
    them. Equal arrays give equal bytes."""
    metadata = {"schema": name, **about}
    # the library writes metadata in the order of a hash that differs
    # from process to process; one key holds all
    packed = {"beadline": "\n".join(f"{key}={metadata[key]}" for key in sorted(metadata))}
    with beside(path) as temporary:
        save_file(
            {key: np.asarray(array, order="C") for key, array in sorted(arrays.items())}, temporary, packed
        )


def read_weights(path: str | Path, name: str) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Arrays and `about` of `write_weights`. Raises ValueError where
    the file is missing, broken, or of another schema."""
    mend = remedy(path)
    try:
        arrays = load_file(path)
        with safetensors.safe_open(path, "numpy") as file:
            lines = (file.metadata() or {}).get("beadline", "").splitlines()
    except FileNotFoundError:
        raise ValueError(f"{path} is missing; {mend}") from None
    except (OSError, safetensors.SafetensorError, ValueError) as error:
        raise ValueError(f"{path} holds no whole weights ({error}); {mend}") from None
    about = dict(line.partition("=")[::2] for line in lines)
    found = about.pop("schema", "none")
    if found != name:
        raise ValueError(f"{path} should hold weights of {name} but has schema {found}; {mend}")
    return arrays, about
