"""`dvc repro` by loop: a stage that fails stops what follows from it, and no other loop."""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from pipeline.nightly import guarding
from pipeline.nightly.processes import STATE, TooLongError, dvc, sentence
from pipeline.nightly.settings import NightlyLoop


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


def wiring(loops: Mapping[str, NightlyLoop]) -> Wiring:
    """Read off dvc.yaml."""
    stages = yaml.safe_load(Path("dvc.yaml").read_text(encoding="utf-8")).get("stages", {})
    made = {out: name for name, stage in stages.items() for out in _outs(stage)}
    reads = {
        name: {maker for dep in stage.get("deps", []) for out, maker in made.items() if _within(dep, out)}
        for name, stage in stages.items()
    }
    upstream = {name: _upstream(name, reads) for name in stages}
    of_loop = {
        name: frozenset().union(
            *(upstream[made[out]] for path in loop.artifacts for out in made if _within(path, out))
        )
        for name, loop in loops.items()
    }
    return Wiring(upstream, of_loop)


def _outs(stage: Mapping[str, Any]) -> list[str]:
    entries = [entry for kind in ("outs", "metrics", "plots") for entry in stage.get(kind, [])]
    return [name for entry in entries for name in (entry if isinstance(entry, dict) else [entry])]


def _within(path: str, out: str) -> bool:
    """Whether one of the two paths lies in the other, or is it."""
    return f"{path}/".startswith(f"{out}/") or f"{out}/".startswith(f"{path}/")


def _upstream(stage: str, reads: Mapping[str, set[str]]) -> frozenset[str]:
    found, waiting = set(), [stage]
    while waiting:
        name = waiting.pop()
        if name not in found:
            found.add(name)
            waiting += reads[name]
    return frozenset(found)


# ---- the run


def reproduce(
    loops: Mapping[str, NightlyLoop], run: str, *, limit_s: float
) -> tuple[dict[str, str], tuple[str, ...]]:
    """{loop: why its stages failed}, and notes. The files of a loop whose stages failed are as they were
    before the night. Raises ValueError if every loop failed, a stage of no loop, or dvc itself, and if the
    stages take longer than `limit_s`."""
    log = STATE / "logs" / f"{run}.log"
    try:
        dvc("repro", "--keep-going", log=log, limit_s=limit_s)
        return {}, ()
    except TooLongError:
        raise  # no stage is to blame by what it printed
    except ValueError:
        if not (failed := _failed(wires := wiring(loops))):
            raise
    text = log.read_text(encoding="utf-8", errors="replace")
    lost: dict[str, str] = {}
    for stage in failed:
        why = f"dvc repro failed: {_why(text, stage)}"
        if not (touched := wires.loops(stage)) or touched == set(loops):
            raise ValueError(why) from None
        lost |= dict.fromkeys(sorted(touched - lost.keys()), why)
    if len(lost) == len(loops):
        raise ValueError("; ".join(dict.fromkeys(lost.values()))) from None
    theirs = [stage for stage in wires.upstream if wires.loops(stage) and wires.loops(stage) <= lost.keys()]
    notes = guarding.back_to_before(only=theirs)
    shared = [
        stage
        for stage in wires.upstream
        if stage not in theirs and wires.loops(stage) & lost.keys() and wires.upstream[stage] & {*failed}
    ]
    return lost, (*notes, *_once_more(shared, run, limit_s))


def _failed(wires: Wiring) -> list[str]:
    """The stages that failed: not up to date, though all that they depend on is."""
    told = dvc("status", "--json", *wires.upstream, log=STATE / "status.log")
    stale = json.loads(next(line for line in reversed(told.splitlines()) if line.startswith("{")))
    return [
        name for name in wires.upstream if name in stale and not stale.keys() & wires.upstream[name] - {name}
    ]


def _once_more(stages: Iterable[str], run: str, limit_s: float) -> list[str]:
    """What belongs to several loops, such as the pages: made of the loops that went well, and of the others
    as they were before the night."""
    if not (names := list(stages)):
        return []
    try:
        log = STATE / "logs" / f"{run}-{names[0]}.log"
        dvc("repro", "--single-item", "--keep-going", *names, log=log, limit_s=limit_s)
        return []
    except ValueError as error:
        return [f"{', '.join(names)} could not be made, and are those of the last good run: {error}"]


def _why(text: str, stage: str) -> str:
    """What was printed of a stage's failure; the stage's own sentence where it has one."""
    parts = text.replace("\r", "\n").split("Running stage '")
    own = next((part for part in parts if part.startswith(f"{stage}'")), "")
    if not own:  # it was not even begun: an input is missing
        lines = [line for line in text.splitlines() if line.startswith("WARNING: ") and "skipped" not in line]
        return f"{stage}: {lines[-1].removeprefix('WARNING: ')}" if lines else sentence(text)
    lines = own.splitlines()
    end = next((k for k, line in enumerate(lines) if line.startswith("WARNING: failed to run")), len(lines))
    said = [line.replace("WARNING: failed", "ERROR: failed") for line in lines[1 : end + 1]]
    return sentence("\n".join([f"Running stage '{stage}':", *said]))
