"""Curves of a run out of DVC's cache, by the hashes of its dvc.lock: the deciding case of the temperature
loop, learning of the deposition loop, the flow of the setpoint loop. Each is small enough for a page."""

import functools
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow.parquet as parquet
from pyarrow import ArrowException

from pipeline.report.runs.collected import Run
from pipeline.report.shared import charts
from pipeline.report.viewer.packed import column_file

CACHE = Path(".dvc/cache/files/md5")
# of one run's curves together, in samples; of all files, in bytes
SAMPLES, LARGEST = 240, 12_000_000


class Curve(NamedTuple):
    """A curve: what it is (the same name in every run), whose it is, its axes, its samples."""

    name: str
    who: str
    across: str
    up: str
    x: np.ndarray
    y: np.ndarray


class Found(NamedTuple):
    """The curves of a run, and why others are not there."""

    curves: list[Curve]
    why: str


class Packed(NamedTuple):
    """The files of the folder beside the page; [name of the file, curves in it] of each run; why a run has
    none."""

    files: dict[str, str]
    places: list[tuple[str, list[tuple[str, str, str, str]]]]
    why: list[str]


def packed(runs: Sequence[Run], now: Mapping[str, str]) -> Packed:
    """The curves of these runs, the newest first into the room that there is. `now`: the md5 of
    each stage's folder as it lies in datasets/."""
    files: dict[str, str] = {}
    known: dict[str, tuple[str, list]] = {}
    places, reasons, room = [], [], LARGEST
    for run in reversed(runs):
        key = _key(run)
        if key not in known:
            found = curves(run, now)
            text = "".join(
                column_file(f"{key}.{k}.x", [curve.x.astype("<f8")])
                + column_file(f"{key}.{k}", [curve.y.astype("<f4")])
                for k, curve in enumerate(found.curves)
            )
            known[key] = (found.why, [curve[:4] for curve in found.curves])
            if len(text) > room:
                known[key] = ("there is no room for more curves beside this page", [])
            elif text:
                files[f"{key}.js"] = text
                room -= len(text)
        why, listed = known[key]
        places.append((key if listed else "", listed))
        reasons.append(why)
    return Packed(files, places[::-1], reasons[::-1])


# whose curves are those of the controller that the loop's figures are of
LOOP = {"evaluate_temperature": "temperature", "evaluate_setpoint": "setpoint"}
STAGES = ("evaluate_temperature", "train_ilc", "evaluate_setpoint")


def _key(run: Run) -> str:
    """Runs of the same artifacts under the same controllers have the same curves."""
    made = [run.made.get(stage, "") for stage in STAGES]
    told = json.dumps([made, dict(run.measured.controllers)], sort_keys=True)
    return hashlib.sha256(told.encode()).hexdigest()[:16]


def curves(run: Run, now: Mapping[str, str]) -> Found:
    """The curves of a run as far as its artifacts are here."""
    if not run.made:
        return Found([], "this run has no dvc.lock")
    found: list[Curve] = []
    reasons = []
    readers = (
        ("evaluate_temperature", "trajectories.parquet", _temperature),
        ("train_ilc", "trials.parquet", _deposition),
        ("evaluate_setpoint", "paths.parquet", _setpoint),
    )
    for stage, name, read in readers:
        if (loop := LOOP.get(stage)) and not run.measured.controllers.get(loop):
            reasons.append(f"no controller of the {loop} loop has figures in this run")
            continue
        path = place(stage, name, run.made.get(stage, ""), now)
        if path is None:
            reasons.append(f"{stage}/{name} is not in DVC’s cache here")
            continue
        try:
            mine = read(path, run.measured.controllers)
        except (ArrowException, OSError, KeyError, ValueError):
            mine = []
        if not mine:
            reasons.append(f"{stage}/{name} is damaged, or of another version")
        found += mine
    why = "; ".join(reasons)
    return Found(
        found, f"{why}; git checkout {run.commit[:8] or 'it'} and ./run dvc pull get it" if why else ""
    )


def place(stage: str, name: str, md5: str, now: Mapping[str, str]) -> Path | None:
    """Where a file of a stage's folder lies: in datasets/ where the folder has that md5 now, else in DVC's
    cache."""
    here = Path("datasets", stage, name)
    if md5 and now.get(stage) == md5 and here.is_file():
        return here
    entry = next((each for each in _listed(md5) if each[0] == name), None)
    found = _cached(entry[1]) if entry else None
    return found if found and found.is_file() else None


@functools.lru_cache(maxsize=256)
def _listed(md5: str) -> tuple[tuple[str, str], ...]:
    """(name, md5) of each file of a folder in the cache; none where it is not there, or damaged."""
    path = _cached(md5)
    try:
        rows = json.loads(path.read_bytes()) if path else []
        return tuple((str(row["relpath"]), str(row["md5"])) for row in rows)
    except (OSError, ValueError, TypeError, KeyError):
        return ()


def _cached(md5: str) -> Path | None:
    plain = md5.removesuffix(".dir")
    whole = len(plain) == 32 and all(letter in "0123456789abcdef" for letter in plain)
    return CACHE / md5[:2] / md5[2:] if whole else None


# ---- the tables


def _temperature(path: Path, who: Mapping[str, str]) -> list[Curve]:
    """Every output in the deciding case under the run's controller."""
    winner = who.get("temperature", "")
    wanted = [("contestant", "==", winner), ("case_name", "==", "deciding")]
    table = parquet.read_table(path, filters=wanted).to_pydict()
    time = np.asarray(table["time_s"], float)
    names = [name for name in table if f"{name}_reference" in table]
    return [
        _curve(f"Temperature of {name}, deciding case", winner, "Time, s", "°C", time, table[name])
        for name in names[:24]
        if len(time)
    ]


def _deposition(path: Path, _: Mapping[str, str]) -> list[Curve]:
    """Error that is left by trial, of the law in use, the mean of its routines."""
    table = parquet.read_table(path, columns=["material", "law", "trial", "ratio"]).to_pandas()
    found = []
    for material, rows in table.groupby("material", sort=True):
        law = next((law for law in ("model_inverse", "pixels") if (rows["law"] == law).any()), "")
        mine = rows[rows["law"] == law].groupby("trial")["ratio"].mean()
        if len(mine):
            name = f"Flow error left by trial, material {material}"
            found.append(_curve(name, law, "Trial", "% of trial 0", mine.index, 100 * mine.to_numpy()))
    return found


def _setpoint(path: Path, who: Mapping[str, str]) -> list[Curve]:
    """How far the flow is from 100 % by decision, of the default on recorded windows: the median start and
    the worst."""
    name = who.get("setpoint", "")
    wanted = [("controller", "==", name), ("simulator", "==", "recorded")]
    rows = parquet.read_table(path, filters=wanted).to_pandas()
    rows = rows[rows["case"] == rows["case"].min()] if len(rows) else rows
    away = (rows["flow_percent"] - 100).abs().groupby(rows["step"])
    return [
        _curve(f"Flow off 100 %, {word} start", name, "Decision", "%", found.index, found.to_numpy())
        for word, found in (("median", away.median()), ("worst", away.max()))
        if len(found)
    ]


def _curve(name: str, who: str, across: str, up: str, x, y) -> Curve:
    """At most 3 x SAMPLES samples, so that no peak is lost."""
    x, y = charts.decimated(np.asarray(x, float), np.asarray(y, float), SAMPLES)
    if not len(x) or not math.isfinite(float(x[0])):
        raise ValueError(name)
    return Curve(name, who, across, up, x, y)
