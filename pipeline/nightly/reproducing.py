"""Runs `dvc repro` by loop, in the copy. A stage that fails stops the stages that depend on it, but no other
loop."""

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from pipeline.nightly.processes import TooLongError, dvc, git
from pipeline.nightly.settings import NightlyLoop
from pipeline.store import artifacts


def reproduce(
    loops: Mapping[str, NightlyLoop], log: Path, *, limit_s: float
) -> tuple[dict[str, str], list[str]]:
    """Runs the stages. Returns {loop: why it failed}, and notes. The outputs of a failed loop are restored to
    those before the run, and pages of several loops are made from these. Raises ValueError if no loop
    succeeded, or a stage of all of them failed, and TooLongError if the stages take longer than `limit_s`."""
    try:
        dvc("repro", "--keep-going", log=log, limit_s=limit_s)
        return {}, []
    except TooLongError:
        raise
    except ValueError as error:
        failure = error
    upstream = read_upstream()
    loops_of = _find_loops(loops, upstream)
    lost: dict[str, str] = {}
    for name in loops:
        stages = [stage for stage, several in loops_of.items() if name in several and several != {*loops}]
        try:
            if stages:  # stages already made take no time, and a failed one gives its reason
                dvc("repro", *stages, log=log.with_suffix(f".{name}.log"), limit_s=limit_s)
        except ValueError as error:
            lost[name] = str(error)
    if not lost or len(lost) == len(loops):
        raise failure
    own = {stage for stage, several in loops_of.items() if several and several <= lost.keys()}
    _undo(own)
    shared = [stage for stage in upstream if stage not in own and upstream[stage] & own]
    try:
        if shared:
            dvc("repro", "--single-item", "--keep-going", *shared, log=log.with_suffix(".shared.log"))
        return lost, []
    except ValueError as error:
        return lost, [f"{', '.join(shared)} could not be made, and are those of the last good run: {error}"]


def read_stages(path: str) -> dict[str, Any]:
    """Returns the stages of dvc.yaml or dvc.lock; none if there is no such file. Raises ValueError if it is
    broken."""
    try:
        text = Path(path).read_text(encoding="utf-8") if Path(path).exists() else ""
        stages = (yaml.safe_load(text) or {}).get("stages") or {}
        return {name: dict(stage) for name, stage in stages.items()}
    except (ValueError, yaml.YAMLError, AttributeError, TypeError) as error:
        why = " ".join(str(error).split())
        raise ValueError(
            f"{path}: expected stages with keys below them, found none ({why}); mend it, or take the last "
            f"whole version (git log {path})"
        ) from None


def outs_of(stage: Mapping[str, Any]) -> list[str]:
    entries = [entry for kind in ("outs", "metrics", "plots") for entry in stage.get(kind, [])]
    return [name for entry in entries for name in (entry if isinstance(entry, dict) else [entry])]


def read_upstream() -> dict[str, set[str]]:
    """Returns for each stage of dvc.yaml all stages on which it depends, directly or not, including
    itself."""
    stages = read_stages("dvc.yaml")
    reads = {name: _find_makers(stages, stage.get("deps", [])) for name, stage in stages.items()}
    upstream = {name: {name} for name in stages}
    for _ in stages:  # no chain is longer
        upstream = {name: {name}.union(*(upstream[maker] for maker in reads[name])) for name in stages}
    return upstream


def _find_makers(stages: Mapping[str, Any], paths: Sequence[str]) -> set[str]:
    """Returns the stages with an output at, below or above one of these paths."""
    return {
        name
        for name, stage in stages.items()
        for out in outs_of(stage)
        for path in paths
        if f"{path}/".startswith(f"{out}/") or f"{out}/".startswith(f"{path}/")
    }


def _find_loops(loops: Mapping[str, NightlyLoop], upstream: Mapping[str, set[str]]) -> dict[str, set[str]]:
    """Returns {stage: its loops}: those whose artifacts depend on it, or on whose artifacts it depends. A
    page of all loops belongs to every loop."""
    stages = read_stages("dvc.yaml")
    needed = {
        name: set().union(*(upstream[maker] for maker in _find_makers(stages, loop.artifacts)))
        for name, loop in loops.items()
    }
    return {
        stage: {name for name, makers in needed.items() if stage in makers or makers & upstream[stage]}
        for stage in upstream
    }


def _undo(stages: set[str]) -> None:
    """Restores what these stages wrote to the state before the run: dvc.lock, files that git keeps, and
    outputs."""
    before = (yaml.safe_load(git("show", "HEAD:dvc.lock", check=False)) or {}).get("stages", {})
    entries = {name: entry for name, entry in read_stages("dvc.lock").items() if name not in stages}
    entries |= {name: before[name] for name in stages if name in before}
    text = yaml.safe_dump({"schema": "2.0", "stages": entries}, sort_keys=False, allow_unicode=True)
    artifacts.write_text("dvc.lock", text)
    wired = read_stages("dvc.yaml")
    for out in (out for name in stages for out in outs_of(wired[name])):
        git("checkout", "-q", "HEAD", "--", out, check=False)
    if known := [name for name in stages if name in before]:
        with contextlib.suppress(ValueError):  # outputs in no cache are made by the next repro
            dvc("checkout", "--quiet", "--force", *known)
