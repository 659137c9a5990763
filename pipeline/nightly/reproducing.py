"""`dvc repro` by loop, in the copy: a stage that fails stops what follows from it, and no other loop."""

import contextlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from pipeline.nightly.processes import TooLongError, dvc, find_sentence, git
from pipeline.nightly.settings import NightlyLoop
from pipeline.store import artifacts


class Wiring(NamedTuple):
    """What dvc.yaml says: of each stage all that it depends on, near and far, itself among it; and of each
    loop the stages that its artifacts depend on."""

    upstream: Mapping[str, frozenset[str]]
    of_loop: Mapping[str, frozenset[str]]

    def loops(self, stage: str) -> set[str]:
        """The loops that a stage belongs to: whose artifacts depend on it, or on which it depends itself. A
        page of all belongs to every loop."""
        return {
            name
            for name, stages in self.of_loop.items()
            if stage in stages or stages & self.upstream.get(stage, frozenset())
        }


def read_wiring(loops: Mapping[str, NightlyLoop]) -> Wiring:
    """Read off dvc.yaml."""
    stages = read_stages("dvc.yaml")
    made = {out: name for name, stage in stages.items() for out in outs_of(stage)}
    reads = {
        name: {maker for dep in stage.get("deps", []) for out, maker in made.items() if _overlap(dep, out)}
        for name, stage in stages.items()
    }
    upstream = {name: _upstream(name, reads) for name in stages}
    of_loop = {
        name: frozenset().union(
            *(upstream[made[out]] for path in loop.artifacts for out in made if _overlap(path, out))
        )
        for name, loop in loops.items()
    }
    return Wiring(upstream, of_loop)


def read_stages(path: str) -> dict[str, Any]:
    """The stages of dvc.yaml or dvc.lock; none without such a file. Raises ValueError if it is broken."""
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


def _overlap(path: str, out: str) -> bool:
    """Whether one of the two paths lies in the other, or is it."""
    return f"{path}/".startswith(f"{out}/") or f"{out}/".startswith(f"{path}/")


def _upstream(stage: str, reads: Mapping[str, set[str]]) -> frozenset[str]:
    stages, waiting = set(), [stage]
    while waiting:
        name = waiting.pop()
        if name not in stages:
            stages.add(name)
            waiting += reads[name]
    return frozenset(stages)


# ---- the run


def reproduce(loops: Mapping[str, NightlyLoop], log: Path, *, limit_s: float) -> tuple[dict[str, str], list]:
    """{loop: why its stages failed}, and notes. The files of a loop whose stages failed are as they were
    before the night. Raises ValueError if every loop failed, a stage of no loop, or dvc itself, and if the
    stages take longer than `limit_s`."""
    try:
        dvc("repro", "--keep-going", log=log, limit_s=limit_s)
        return {}, []
    except TooLongError:
        raise  # no stage is to blame by what it printed
    except ValueError:
        if not (failed := _failed(wiring := read_wiring(loops))):
            raise
    text = log.read_text(encoding="utf-8", errors="replace")
    lost: dict[str, str] = {}
    for stage in failed:
        why = f"dvc repro failed: {_why(text, stage)}"
        touched = wiring.loops(stage)
        if not touched or touched == set(loops):
            raise ValueError(why)
        lost |= dict.fromkeys(sorted(touched - lost.keys()), why)
    if len(lost) == len(loops):
        raise ValueError("; ".join(dict.fromkeys(lost.values())))
    own = [stage for stage in wiring.upstream if wiring.loops(stage) and wiring.loops(stage) <= lost.keys()]
    _undo(own)
    # what belongs to several loops, such as the pages: of the loops that went well, and the others as before
    shared = [
        stage
        for stage in wiring.upstream
        if stage not in own and wiring.loops(stage) & lost.keys() and wiring.upstream[stage] & {*failed}
    ]
    try:
        if shared:
            dvc("repro", "--single-item", "--keep-going", *shared, log=log.with_suffix(".shared.log"))
        return lost, []
    except ValueError as error:
        return lost, [f"{', '.join(shared)} could not be made, and are those of the last good run: {error}"]


def _failed(wiring: Wiring) -> list[str]:
    """The stages that failed: not up to date, though all that they depend on is."""
    printed = dvc("status", "--json", *wiring.upstream)
    stale = json.loads(next(line for line in reversed(printed.splitlines()) if line.startswith("{")))
    return [
        name
        for name in wiring.upstream
        if name in stale and not stale.keys() & wiring.upstream[name] - {name}
    ]


def _undo(stages: Sequence[str]) -> None:
    """What these stages wrote is as it was before the night: dvc.lock, the files that git keeps, outs."""
    lock = git("show", "HEAD:dvc.lock", check=False)
    before = (yaml.safe_load(lock) or {}).get("stages", {}) if lock else {}
    entries = {name: entry for name, entry in read_stages("dvc.lock").items() if name not in stages}
    entries |= {name: before[name] for name in stages if name in before}
    text = yaml.safe_dump({"schema": "2.0", "stages": entries}, sort_keys=False, allow_unicode=True)
    artifacts.write_text("dvc.lock", text)
    wired = read_stages("dvc.yaml")
    for out in (out for name in stages for out in outs_of(wired[name])):
        git("checkout", "-q", "HEAD", "--", out, check=False)
    if known := [name for name in stages if name in before]:
        with contextlib.suppress(ValueError):  # what is in no cache is made by the next repro
            dvc("checkout", "--quiet", "--force", *known)


def _why(text: str, stage: str) -> str:
    """What was printed of a stage's failure; the stage's own sentence if it has one."""
    parts = text.replace("\r", "\n").split("Running stage '")
    own = next((part for part in parts if part.startswith(f"{stage}'")), "")
    if not own:  # it was not even begun: an input is missing
        lines = [line for line in text.splitlines() if line.startswith("WARNING: ") and "skipped" not in line]
        return f"{stage}: {lines[-1].removeprefix('WARNING: ')}" if lines else find_sentence(text)
    lines = own.splitlines()
    end = next((k for k, line in enumerate(lines) if line.startswith("WARNING: failed to run")), len(lines))
    said = [line.replace("WARNING: failed", "ERROR: failed") for line in lines[1 : end + 1]]
    return find_sentence("\n".join([f"Running stage '{stage}':", *said]))
