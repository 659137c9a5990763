"""Reads a folder of recordings into a table for each, and decides which files are read, which were read
before and which are broken.

The memo is content-addressed. The hash of the recording, of the wish and of the code that reads names the
entry, so a new recording costs only its own reading. An entry is used if its files have the digests that were
written last; otherwise the recording is read again.
"""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import joblib
import numpy as np

from pipeline.recordings import excluded, plain_files, printed_gcode
from pipeline.recordings.formats import file_format, is_bag
from pipeline.recordings.isolated import Budget, isolated
from pipeline.recordings.klipper_logs import printer_heaters
from pipeline.recordings.quality import flag
from pipeline.recordings.recordings import Flag, Raw, Source, Table, read
from pipeline.recordings.resampling import cut_flags, hold, resample
from pipeline.store import artifacts
from pipeline.store.execution import run_all
from pipeline.store.params import Execution
from pipeline.store.tables import Schema

_PARTIAL = "is a copy that is not complete, or a system's own file, and was passed over"
_GROWING = "is still being written; wait until its copy is complete and run it again"
# notes of rows that a reader left out
_LEFT_OUT = ("truncated", "trailing", "damage")
CODE = Path(__file__).parents[1]
# the code that decides the content of a memo entry; if it changes, everything is read again
READING = ("store/artifacts.py", "store/params.py", "store/tables.py", "recordings/*.py")


class RecordingWish(NamedTuple):
    """What to read from every recording: the sources of all signals; {input: limits}; the sample time; the
    clock; the gap limit; the decimal mark of text ("": find it); and the schemas of the record, of its
    findings, and of the recorded set-points (None: not recorded)."""

    sources: tuple[Source, ...]
    limits: dict[str, tuple[float, float]]
    held: tuple[str, ...]  # inputs and disturbances: between two samples they keep their value
    sample_time_s: float
    time: str
    max_gap_s: float
    decimal: str
    record: Schema
    quality: Schema
    set_points: Schema | None = None

    @property
    def whole(self) -> Schema:
        """The schema of record and set-points in one table."""
        beside = self.set_points.columns if self.set_points else ()
        return self.record._replace(columns=(*self.record.columns, *beside))


class RecordingTable(NamedTuple):
    """One recording's share of the record and of its findings. `reason`: why it was quarantined or passed
    over, otherwise ""."""

    name: str
    record: dict[str, np.ndarray]
    quality: dict[str, np.ndarray]
    reason: str
    reused: bool
    passed_over: bool = False  # a copy that is not complete: neither read nor quarantined


def read_folder(
    folder: Path,
    wish: RecordingWish,
    execution: Execution,
    *,
    memo: Path,
    budget: Budget,
    ignored: Collection[str] = (),
    waits: bool = False,
) -> list[RecordingTable]:
    """Returns every recording below `folder`, except files named `ignored`, in the order of names. As many
    workers as `execution` says read them. A recording that needs more than its budget is quarantined.

    Incomplete copies, recognised by their names, are passed over. If `waits`, a file that changed a moment
    ago is waited for, ten seconds at most, and passed over if it changes meanwhile. Raises ValueError if
    there is no recording.
    """
    files, passed = _recordings_below(folder, ignored, waits=waits)
    if not files:
        reason = f" but {next(iter(passed.values()))}" if passed else ""
        raise ValueError(
            f"{folder}: expected at least one recording (CSV, Parquet or MCAP), found none{reason}; "
            "copy one there, or set generate_probing.source: simulated"
        )
    code = "".join(artifacts.sha256(path) for pattern in READING for path in sorted(CODE.glob(pattern)))
    hashes = [artifacts.sha256(path) for path in files]
    names = [_utf8(path.relative_to(folder).as_posix()) for path in files]
    printed = _printed_beside(files)
    keys = [
        joblib.hash((content, name, wish, code, *printed[path]))
        for path, content, name in zip(files, hashes, names, strict=True)
    ]
    left_out = _copies(files, hashes) | _without_text(files)
    remembered = [
        None if path in left_out else _remembered(memo, key, wish)
        for path, key in zip(files, keys, strict=True)
    ]
    todo = [
        (path, key)
        for path, key, entry in zip(files, keys, remembered, strict=True)
        if entry is None and path not in left_out
    ]
    reasons = left_out | dict(
        zip([path for path, _ in todo], _run(todo, folder, wish, execution, (memo, budget)), strict=True)
    )
    results = [
        _result(name, entry or _remembered(memo, key, wish), _utf8(reasons.get(path, "")), entry is not None)
        for path, name, key, entry in zip(files, names, keys, remembered, strict=True)
    ]
    return results + [
        RecordingTable(_utf8(path.relative_to(folder).as_posix()), {}, {}, _utf8(reason), False, True)
        for path, reason in passed.items()
    ]


def _growing(files: Sequence[Path]) -> list[Path]:
    """Returns the recordings that are changing, or whose printed files are."""
    beside = {path: printed_gcode.companions(path) if _is_klippy(path) else [] for path in files}
    watched = dict.fromkeys([*files, *(other for others in beside.values() for other in others)])
    changing = set(plain_files.wait_until_still(list(watched)))
    return [path for path in files if changing.intersection([path, *beside[path]])]


def _printed_beside(files: Sequence[Path]) -> dict[Path, list[tuple[str, str]]]:
    """Returns (name, hash) of each G-code file and history beside a klippy.log, because its fan and feed come
    from them; none for other recordings."""
    beside: dict[Path, list[tuple[str, str]]] = {}
    for path in files:
        if path.parent not in beside and _is_klippy(path):
            companions = printed_gcode.companions(path)
            beside[path.parent] = [(str(other), artifacts.sha256(other)) for other in companions]
    return {path: beside.get(path.parent, []) if _is_klippy(path) else [] for path in files}


def _is_klippy(path: Path) -> bool:
    try:
        return file_format(path) == "klippy.log"
    except ValueError:
        return False


def _recordings_below(
    folder: Path, ignored: Collection[str], *, waits: bool
) -> tuple[list[Path], dict[Path, str]]:
    """Returns the recordings below a folder, and {path: reason} of incomplete copies."""
    plain_files.check_plain_files(folder)
    bags = {path.parent for path in folder.rglob("metadata.yaml") if is_bag(path.parent)} - {folder}
    files = sorted(
        path
        for path in folder.rglob("*")
        if (path in bags or (path.is_file() and not bags & set(path.parents)))
        and not path.name.startswith(".")
        and path.suffix.lower() not in {".md", ".yaml", ".dvc"}
        and path.name not in ignored
        and path.suffix.lower() not in printed_gcode.SUFFIXES
        and not printed_gcode.is_history(path)
        and path.name.lower() not in {"readme.txt", "license.txt", "source.txt", "notes.txt"}
    )
    files = excluded.readable(files, folder)
    passed = {path: f"{path} {_PARTIAL}" for path in files if plain_files.is_partial(path.name)}
    files = [path for path in files if path not in passed]
    growing = _growing(files) if waits else []
    passed |= {path: f"{path} {_GROWING}" for path in growing}
    return [path for path in files if path not in passed], passed


def _copies(files: Sequence[Path], hashes: Sequence[str]) -> dict[Path, str]:
    """Returns why a file is left out that is a copy of another. A copy would count twice in learning, and
    could be tested with data that was learned from."""
    first: dict[str, Path] = {}
    return {
        path: " ".join(
            f"{path} is {first[content].name} once more, byte for byte; remove one of the two".split()
        )
        for path, content in zip(files, hashes, strict=True)
        if first.setdefault(content, path) != path
    }


def _without_text(files: Sequence[Path]) -> dict[Path, str]:
    """Returns why a file is left out whose name is not text, so that no table can hold it."""
    return {
        path: f"{_utf8(str(path))}: its name should be UTF-8 but has other bytes; rename the file"
        for path in files
        if _utf8(str(path)) != str(path)
    }


def _utf8(name: str) -> str:
    """Returns the name, with its bytes that are not UTF-8 written out."""
    return name.encode("utf-8", "backslashreplace").decode()


def _run(
    todo: Sequence[tuple[Path, str]],
    folder: Path,
    wish: RecordingWish,
    execution: Execution,
    where: tuple[Path, Budget],
) -> list[str]:
    """Returns the reasons from `_within`, in the order of `todo`. Workers of a cluster see the same file
    system under absolute paths. On one machine, threads wait for child processes that do the work."""
    memo, budget = where
    calls = [
        joblib.delayed(_within)(budget, path.resolve(), path, folder, key, wish, memo.resolve())
        for path, key in todo
    ]
    if execution.backend == "loky":
        return joblib.Parallel(n_jobs=execution.jobs, backend="threading")(calls)
    return list(run_all(calls, execution, remains=": what was read is kept"))


def _within(budget: Budget, path: Path, shown: Path, *arguments) -> str:
    """Returns the reason from `_one`, which runs in a child process, or the reason that it needs more than
    the budget."""
    try:
        return isolated(_one, path, shown, *arguments, shown=shown, budget=budget)
    except ValueError as reason:
        return str(reason)


def _one(path: Path, shown: Path, folder: Path, key: str, wish: RecordingWish, memo: Path) -> str:
    """Reads, resamples and flags one recording and writes it to the memo, under the path `shown`. Returns the
    reason why it cannot be read, or an empty text."""
    name = shown.relative_to(folder).as_posix()
    beside = [column.name for column in wish.set_points.columns] if wish.set_points else []
    units = {source.signal: source.unit for source in wish.sources if source.signal not in beside}
    computed = [source.signal for source in wish.sources if source.source in printed_gcode.UNITS]
    try:
        raw = read(path, wish.sources, time=wish.time, decimal=wish.decimal)
        nothing = np.empty(0), np.empty(0)
        set_points = {signal: raw.signals.pop(signal, nothing) for signal in beside}
        table = resample(
            raw,
            sample_time_s=wish.sample_time_s,
            inputs=list(wish.held),
            outputs=[name for name in units if name not in wish.held],
            max_gap_s=wish.max_gap_s,
            averaged=computed,
        )
        table = flag(table, units=units, limits=wish.limits, computed=computed)
        table = table._replace(flags=[*table.flags, *_cut_rows(raw)])
        for flagged in table.flags:
            if flagged.kind == "mixed" and table.masked[flagged.signal].mean() > 0.5:
                raise ValueError(f"{path}: {flagged.message}")
    except ValueError as reason:
        # on a cluster the path is absolute; the message must be the same wherever the work is done
        return " ".join(str(reason).split()).replace(str(path), str(shown))
    findings = [(f.kind, f.signal, f.start_s, f.end_s, f.count, f.message) for f in table.flags]
    findings += [
        (n.kind, n.signal, np.nan, np.nan, n.count, n.message.replace(str(path), str(shown)))
        for n in raw.notes
    ]
    kinds, signals, starts, ends, counts, messages = (
        [list(column) for column in zip(*findings, strict=True)] if findings else [[]] * 6
    )
    quality = {
        "recording": [name] * len(findings),
        "signal": signals,
        "kind": kinds,
        "start_s": starts,
        "end_s": ends,
        "count": counts,
        "message": messages,
    }
    columns = _columns(name, table)
    columns |= {signal: hold(*samples, table.time_s) for signal, samples in set_points.items()}
    artifacts.write_table(memo / f"{key}.record.parquet", wish.whole, columns)
    artifacts.write_table(memo / f"{key}.quality.parquet", wish.quality, quality)
    artifacts.write_json(memo / f"{key}.json", _digests(memo, key))
    return ""


def _cut_rows(raw: Raw) -> list[Flag]:
    """Returns a flag if the recording's reader left out many rows. (Damage in MCAP is counted in chunks.)"""
    if file_format(Path(raw.path)) in ("mcap", "bag"):
        return []
    left_out = sum(note.count for note in raw.notes if note.kind in _LEFT_OUT)
    times = [time_s for time_s, _ in raw.signals.values()]
    start, end = min(time_s[0] for time_s in times), max(time_s[-1] for time_s in times)
    count = sum(raw.messages.values()) + left_out
    return cut_flags(left_out, count, "rows are damaged or no data", float(start), float(end))


def _digests(memo: Path, key: str) -> dict[str, str]:
    return {part: artifacts.sha256(memo / f"{key}.{part}.parquet") for part in ("record", "quality")}


def _remembered(
    memo: Path, key: str, wish: RecordingWish
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]] | None:
    """Returns record and quality of an entry with files that have the digests written last; None if it is
    absent, incomplete or damaged."""
    try:
        if artifacts.read_json(memo / f"{key}.json") != _digests(memo, key):
            return None
        record = artifacts.read_table(memo / f"{key}.record.parquet", wish.whole)
        return record, artifacts.read_table(memo / f"{key}.quality.parquet", wish.quality)
    except (OSError, ValueError):
        return None


def _columns(name: str, table: Table) -> dict[str, np.ndarray | list[str]]:
    columns = {"recording": [name] * len(table.time_s), "segment": table.segment, "time_s": table.time_s}
    for signal, values in table.values.items():
        columns |= {signal: values, f"{signal}_masked": table.masked[signal]}
    return columns


def _result(name: str, entry: tuple[dict, dict] | None, reason: str, reused: bool) -> RecordingTable:
    if reason:
        return RecordingTable(name, {}, {}, reason, False)
    if entry is None:
        raise ValueError(
            f"{name} was read by a worker but its entry is not in datasets/memo/ingest; "
            "let the workers share this folder, "
            "or set execution.backend: loky"
        )
    return RecordingTable(name, *entry, "", reused)


def join(
    results: Sequence[RecordingTable], wish: RecordingWish, *, strict: bool
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], dict]:
    """Returns the columns of one record and of one table of findings, in the order of names, and figures.
    Raises ValueError if no recording is left, or if `strict` and one is broken."""
    passed = [result for result in results if result.passed_over]
    results = [result for result in results if not result.passed_over]
    broken = [result for result in results if result.reason]
    if broken and (strict or len(broken) == len(results)):
        raise ValueError(
            broken[0].reason
            + (f" ({len(broken)} of {len(results)} recordings are broken)" if len(results) > 1 else "")
        )
    good = [result for result in results if not result.reason]
    record = {
        column.name: np.concatenate([result.record[column.name] for result in good])
        for column in wish.whole.columns
    }
    quality = {
        column.name: np.concatenate([result.quality[column.name] for result in good])
        for column in wish.quality.columns
    }
    for result in [*broken, *passed]:
        kind = "passed_over" if result.passed_over else "quarantined"
        quality = with_finding(quality, "", kind, result.reason, recording=result.name)
    counts: dict[str, dict[str, int]] = {}
    for signal, kind, count in zip(quality["signal"], quality["kind"], quality["count"], strict=True):
        of = counts.setdefault(str(signal) or "recording", {})
        of[str(kind)] = of.get(str(kind), 0) + int(count)
    figures = {
        "recordings": len(results),
        "quarantined": len(broken),
        "samples": len(record["time_s"]),
        "segments": int(_segments(record)),
        "findings": counts,
    }
    is_cut = quality["kind"] == "cut"
    if is_cut.any():
        shares = [float(message.partition(" %")[0]) for message in quality["message"][is_cut]]
        names = [str(name) for name in quality["recording"][is_cut]]
        figures["cut_percent"] = {
            name: max(share for other, share in zip(names, shares, strict=True) if other == name)
            for name in dict.fromkeys(names)
        }
    return record, quality, figures


def with_finding(
    quality: Mapping[str, np.ndarray], signal: str, kind: str, message: str, *, recording: str = ""
) -> dict[str, np.ndarray]:
    """Returns the columns of findings with one more row, which has no place in time."""
    row = {
        "recording": recording,
        "signal": signal,
        "kind": kind,
        "start_s": np.nan,
        "end_s": np.nan,
        "count": 1,
        "message": message,
    }
    return {name: np.append(values, np.array([row[name]], values.dtype)) for name, values in quality.items()}


def count_work(results: Sequence[RecordingTable]) -> dict[str, int]:
    """Returns how many recordings were processed and how many came from the memo. This concerns one run only,
    so it is not a metric."""
    return {
        "processed": sum(not r.reused and not r.reason for r in results),
        "reused": sum(r.reused for r in results),
    }


def printer_pids(
    folder: Path, results: Sequence[RecordingTable], sources: Sequence[Source], inputs: Collection[str]
) -> dict[str, list[dict]]:
    """Returns {"heaters": [...]}: in our units, the printer's own PIDs of heaters with duty and temperature
    among our signals; {} if no good recording is a klippy.log. The last log's values are used."""
    of = {source.source: source for source in sources}
    pids: dict[str, dict] = {}
    logs = [r.name for r in results if not r.reason and file_format(folder / r.name) == "klippy.log"]
    for name in logs:
        for pid in [heater.pid for heater in printer_heaters(folder / name) if heater.pid]:
            u, y = of.get(f"{pid.heater}.pwm"), of.get(f"{pid.heater}.temp")
            if u is None or y is None or u.signal not in inputs:
                continue
            gains = [gain * u.scale / y.scale for gain in pid[1:4]]
            pids[u.signal] = {
                "recording": name,
                "input": u.signal,
                "output": y.signal,
                **dict(zip(("Kp", "Ki", "Kd"), gains, strict=True)),
                "most_percent": pid.most_percent * u.scale,
                "smooth_s": pid.smooth_s,
            }
    return {"heaters": list(pids.values())} if pids else {}


def _segments(record: dict[str, np.ndarray]) -> int:
    return (
        1
        + (
            (record["recording"][1:] != record["recording"][:-1])
            | (record["segment"][1:] != record["segment"][:-1])
        ).sum()
    )
