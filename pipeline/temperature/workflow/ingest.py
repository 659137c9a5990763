"""What ingest does: it makes one record of a folder of recordings. It decides which files are read, which
were read before and which are broken; `pipeline.reading` reads, resamples and flags a file.

The memo is content-addressed. The hash of the recording, of the parameters and of the code that reads names
the entry, so that one more recording costs one reading. An entry counts where its files have the digests that
were written last; otherwise the recording is read again.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import joblib
import numpy as np

from pipeline.reading import excluded
from pipeline.reading.formats import file_format
from pipeline.reading.isolated import Budget, isolated
from pipeline.reading.klipper_logs import printer_heaters
from pipeline.reading.plain_files import check_plain_files
from pipeline.reading.quality import flag
from pipeline.reading.recordings import Source, Table, nearest_names, read
from pipeline.reading.resampling import resample
from pipeline.reading.signatures import is_bag
from pipeline.store import artifacts
from pipeline.store.execution import run_all
from pipeline.store.params import Execution
from pipeline.temperature.workflow import tables
from pipeline.temperature.workflow.settings import Ingest, Plant

CODE = Path(__file__).parents[2]
# what decides what an entry of the memo holds: changed code reads everything again
READING = (
    "store/artifacts.py",
    "reading/csv_rows.py",
    "store/params.py",
    "store/tables.py",
    "temperature/workflow/ingest.py",
    "temperature/workflow/tables.py",
    "reading/*.py",
)


class IngestSpec(NamedTuple):
    """What to take from every recording: the machine's signals, mapping {signal: (source, unit, scale,
    offset)} (empty: our own names), the clock, the gap limit, the decimal mark of text ("": found)."""

    machine: Plant
    mapping: dict[str, tuple[str, str, float, float]]
    time: str
    max_gap_s: float
    decimal: str = ""

    def sources(self) -> list[Source]:
        signals = [*self.machine.acting, *self.machine.outputs]
        unknown = sorted(set(self.mapping) - {signal.name for signal in signals})
        if unknown:
            raise ValueError(
                f"params.yaml: ingest.mapping.{unknown[0]} is no signal of the plant; "
                f"{nearest_names(unknown[0], [s.name for s in signals])}"
            )
        sources = []
        for signal in signals:
            source, unit, scale, offset = self.mapping.get(signal.name, (signal.name, signal.unit, 1.0, 0.0))
            if unit != signal.unit:
                raise ValueError(
                    f"params.yaml: ingest.mapping.{signal.name}.unit is {unit} but the plant's {signal.name} "
                    f"is in {signal.unit}; "
                    f"convert with scale and offset, and write unit: {signal.unit}"
                )
            sources.append(Source(signal.name, source, unit, scale, offset))
        return sources


def spec_of(settings: Ingest, machine: Plant, source: str) -> IngestSpec:
    """What section `ingest` asks for; what probe_machine wrote has our own names."""
    mapping = settings.mapping if source == "recordings" else {}
    return IngestSpec(
        machine,
        {name: (m.source, m.unit, m.scale, m.offset) for name, m in mapping.items()},
        settings.time,
        settings.max_gap_s,
        settings.decimal,
    )


class Result(NamedTuple):
    """One recording's share of the record and of its findings; `reason` is
    why it was quarantined, empty where it was not."""

    name: str
    record: dict[str, np.ndarray]
    quality: dict[str, np.ndarray]
    reason: str
    reused: bool


class Columns(NamedTuple):
    schema: tables.Schema
    columns: dict[str, np.ndarray]


def process(
    folder: Path, spec: IngestSpec, execution: Execution, *, memo: Path, budget: Budget
) -> list[Result]:
    """Every recording below `folder`, in the order of names, on as many workers as
    `execution` says. A recording that needs more than its budget is quarantined. Raises
    ValueError where there is none."""
    check_plain_files(folder)
    bags = {path.parent for path in folder.rglob("metadata.yaml") if is_bag(path.parent)} - {folder}
    files = sorted(
        path
        for path in folder.rglob("*")
        if (path in bags or (path.is_file() and not bags & set(path.parents)))
        and not path.name.startswith(".")
        and path.suffix.lower() not in {".md", ".yaml", ".dvc"}
        and path.name.lower() not in {"readme.txt", "license.txt", "source.txt", "notes.txt"}
    )
    files = excluded.readable(files, folder)
    if not files:
        raise ValueError(
            f"{folder}: expected at least one recording (CSV, Parquet or MCAP), found none; copy one there, "
            "or set generate_probing.source: simulated"
        )
    spec.sources()
    code = "".join(artifacts.sha256(path) for pattern in READING for path in sorted(CODE.glob(pattern)))
    hashes = [artifacts.sha256(path) for path in files]
    names = [_utf8(path.relative_to(folder).as_posix()) for path in files]
    keys = [
        joblib.hash((content, name, spec.machine.model_dump(), spec[1:], code))
        for content, name in zip(hashes, names, strict=True)
    ]
    twice = _twice(files, hashes) | _without_text(files)
    remembered = [
        None if path in twice else _remembered(memo, key, spec.machine)
        for path, key in zip(files, keys, strict=True)
    ]
    todo = [
        (path, key)
        for path, key, entry in zip(files, keys, remembered, strict=True)
        if entry is None and path not in twice
    ]
    reasons = twice | dict(
        zip([path for path, _ in todo], _run(todo, folder, spec, execution, (memo, budget)), strict=True)
    )
    return [
        _result(
            name,
            entry or _remembered(memo, key, spec.machine),
            _utf8(reasons.get(path, "")),
            entry is not None,
        )
        for path, name, key, entry in zip(files, names, keys, remembered, strict=True)
    ]


def _twice(files: Sequence[Path], hashes: Sequence[str]) -> dict[Path, str]:
    """Why a file is left out that is a copy of another: what is learned from twice is
    trusted twice, and judged by what it was learned from."""
    first: dict[str, Path] = {}
    return {
        path: " ".join(
            f"{path} is {first[content].name} once more, byte for byte; remove one of the two".split()
        )
        for path, content in zip(files, hashes, strict=True)
        if first.setdefault(content, path) != path
    }


def _without_text(files: Sequence[Path]) -> dict[Path, str]:
    """Why a file is left out whose name is no text: no table can hold it."""
    return {
        path: f"{_utf8(str(path))}: its name should be UTF-8 but has other bytes; rename the file"
        for path in files
        if _utf8(str(path)) != str(path)
    }


def _utf8(name: str) -> str:
    """The name with its bytes that are no UTF-8 written out."""
    return name.encode("utf-8", "backslashreplace").decode()


def _run(
    todo: Sequence[tuple[Path, str]],
    folder: Path,
    spec: IngestSpec,
    execution: Execution,
    where: tuple[Path, Budget],
) -> list[str]:
    """The reasons of `_within`, in the order of `todo`; workers of a cluster see the same file
    system under absolute paths. On one machine threads wait for children that do the work."""
    memo, budget = where
    calls = [
        joblib.delayed(_within)(budget, path.resolve(), path, folder, key, spec, memo.resolve())
        for path, key in todo
    ]
    if execution.backend == "loky":
        return joblib.Parallel(n_jobs=execution.jobs, backend="threading")(calls)
    return list(run_all(calls, execution, remains=": what was read is kept"))


def _within(budget: Budget, path: Path, shown: Path, *arguments) -> str:
    """The reason of `_one`, which works in a child; also where it needs more than the budget."""
    try:
        return isolated(_one, path, shown, *arguments, shown=shown, budget=budget)
    except ValueError as reason:
        return str(reason)


def _one(path: Path, shown: Path, folder: Path, key: str, spec: IngestSpec, memo: Path) -> str:
    """Read, resample and flag one recording into the memo, under the path that is
    `shown`; the reason why it cannot be, or an empty text."""
    name = shown.relative_to(folder).as_posix()
    inputs, outputs = [s.name for s in spec.machine.acting], [s.name for s in spec.machine.outputs]
    units, limits = (
        {s.name: s.unit for s in [*spec.machine.acting, *spec.machine.outputs]},
        {s.name: (s.low, s.high) for s in spec.machine.inputs},
    )
    try:
        raw = read(path, spec.sources(), time=spec.time, decimal=spec.decimal)
        table = resample(
            raw,
            sample_time_s=spec.machine.sample_time_s,
            inputs=inputs,
            outputs=outputs,
            max_gap_s=spec.max_gap_s,
        )
        table = flag(table, units=units, limits=limits)
        for flagged in table.flags:
            if flagged.kind == "mixed" and table.masked[flagged.signal].mean() > 0.5:
                raise ValueError(f"{path}: {flagged.message}")
    except ValueError as reason:
        # on a cluster the path is absolute; what is said is the same wherever the work is done
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
    artifacts.write_table(
        memo / f"{key}.record.parquet",
        tables.record(spec.machine.acting, spec.machine.outputs),
        _columns(name, table),
    )
    artifacts.write_table(memo / f"{key}.quality.parquet", tables.QUALITY, quality)
    artifacts.write_json(memo / f"{key}.json", _digests(memo, key))
    return ""


def _digests(memo: Path, key: str) -> dict[str, str]:
    return {part: artifacts.sha256(memo / f"{key}.{part}.parquet") for part in ("record", "quality")}


def _remembered(
    memo: Path, key: str, machine: Plant
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]] | None:
    """Record and quality of an entry whose digests, written last, are those of its files;
    None where it is absent, half written or damaged."""
    try:
        if artifacts.read_json(memo / f"{key}.json") != _digests(memo, key):
            return None
        record = artifacts.read_table(
            memo / f"{key}.record.parquet", tables.record(machine.acting, machine.outputs)
        )
        return record, artifacts.read_table(memo / f"{key}.quality.parquet", tables.QUALITY)
    except (OSError, ValueError):
        return None


def _columns(name: str, table: Table) -> dict[str, np.ndarray | list[str]]:
    columns = {"recording": [name] * len(table.time_s), "segment": table.segment, "time_s": table.time_s}
    for signal, values in table.values.items():
        columns |= {signal: values, f"{signal}_masked": table.masked[signal]}
    return columns


def _result(name: str, entry: tuple[dict, dict] | None, reason: str, reused: bool) -> Result:
    if reason:
        return Result(name, {}, {}, reason, False)
    if entry is None:
        raise ValueError(
            f"{name} was read by a worker but its entry is not in datasets/memo/ingest; "
            "let the workers share this folder, "
            "or set execution.backend: loky"
        )
    return Result(name, *entry, "", reused)


def collect(results: Sequence[Result], machine: Plant, *, strict: bool) -> tuple[Columns, Columns, dict]:
    """One record and one table of findings in the order of names, and the metrics. Raises ValueError where no
    recording is left, or `strict` and one is broken."""
    broken = [result for result in results if result.reason]
    if broken and (strict or len(broken) == len(results)):
        raise ValueError(
            broken[0].reason
            + (f" ({len(broken)} of {len(results)} recordings are broken)" if len(results) > 1 else "")
        )
    good = [result for result in results if not result.reason]
    schema = tables.record(machine.acting, machine.outputs)
    record = {
        column.name: np.concatenate([result.record[column.name] for result in good])
        for column in schema.columns
    }
    quality = {
        column.name: np.concatenate([result.quality[column.name] for result in good])
        for column in tables.QUALITY.columns
    }
    for result in broken:
        row = {
            "recording": result.name,
            "signal": "",
            "kind": "quarantined",
            "start_s": np.nan,
            "end_s": np.nan,
            "count": 1,
            "message": result.reason,
        }
        quality = {
            name: np.append(values, np.array([row[name]], values.dtype)) for name, values in quality.items()
        }
    counts: dict[str, dict[str, int]] = {}
    for signal, kind, count in zip(quality["signal"], quality["kind"], quality["count"], strict=True):
        of = counts.setdefault(str(signal) or "recording", {})
        of[str(kind)] = of.get(str(kind), 0) + int(count)
    metrics = {
        "recordings": len(results),
        "quarantined": len(broken),
        "samples": len(record["time_s"]),
        "segments": int(_segments(record)),
        "findings": counts,
    }
    return Columns(schema, record), Columns(tables.QUALITY, quality), metrics


def work_done(results: Sequence[Result]) -> dict[str, int]:
    """How many recordings were processed and how many the memo gave: of this run alone, so no metric."""
    return {
        "processed": sum(not r.reused and not r.reason for r in results),
        "reused": sum(r.reused for r in results),
    }


def printer_pids(folder: Path, results: Sequence[Result], spec: IngestSpec) -> dict[str, list[dict]]:
    """{"heaters": [...]}: by which PID a printer held the heaters whose duty and temperature are signals of
    ours, in our units; {} where no good recording is a klippy.log. The last log's values count."""
    inputs = {signal.name for signal in spec.machine.inputs}
    of = {source.source: source for source in spec.sources()}
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
