"""What page one says first: one sentence for the machine, and a row for each loop with its
decision, the rule that decided it and what to do."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pipeline.report.shared.sources import Sources
from pipeline.verdict import loops as verdict_loops
from pipeline.verdict.digits import count, listed, shortened
from pipeline.verdict.evidence import known

NAMES = ("temperature", "deposition", "setpoint")
ABSENT = "not measured"


class Loop(NamedTuple):
    """One loop: its state (passed, failed, open, not measured); `recorded`: judged from recordings of the
    machine, not on simulated ones."""

    name: str
    state: str
    recorded: bool = False


def loops(sources: Sources) -> list[Loop]:
    """The loops that are on: the verdict of each as the head of page one counts it."""
    return [
        Loop(
            name, verdict.word if name == "temperature" or verdict.subject else ABSENT, not verdict.rehearsal
        )
        for name, verdict in sources.verdicts.items()
    ]


RECORDED = {
    "temperature": "judged on models of the recorded machine",
    "deposition": "forecast by the model of the recorded machine",
    "setpoint": "judged on recorded frames",
}


def simulated(sources: Sources, name: str) -> bool:
    """Whether a loop was judged on simulated machines."""
    return verdict_loops.simulated(sources.evidence, name)


def claim(sources: Sources, names: Sequence[str] = NAMES) -> str:
    """What was judged on what, and so what may be claimed of a real printer."""
    made = [name for name in names if simulated(sources, name)]
    claims = [f"{name} {RECORDED[name]}" for name in names if name not in made]
    if made:
        which = "" if len(names) == len(made) else f"{listed(made)} "
        claims.append(
            f"{which}judged on simulated machines only: nothing is claimed about a real printer".strip()
        )
    text = "; ".join(claims)
    return f"{text[:1].upper()}{text[1:]}."


def data(sources: Sources, names: Sequence[str]) -> str:
    """On whose data these loops were judged: simulated machines, or which recordings."""
    made = [name for name in names if simulated(sources, name)]
    if len(made) == len(names):
        return "Simulated machines; no recording was read."
    table = known(sources.tables["record"], None) if sources.recorded else None
    read = list(np.unique(table["recording"])) if table else []
    first = ", ".join(shortened(str(name), 40) for name in read[:2])
    more = f" and {len(read) - 2} more" if len(read) > 2 else ""
    told = {"temperature": f"temperature {count(len(read), 'recording')} ({first}{more})" if read else ""}
    theirs = [
        told.get(name) or f"{name} recordings of datasets/raw/{name}" for name in names if name not in made
    ]
    others = [f"{' and '.join(made)} simulated"] if made else []
    text = "; ".join([*theirs, *others])
    return f"{text[:1].upper()}{text[1:]}."


# the claim about loops, by whether their machine was recorded and by state
CLAIMS = (
    (True, ("passed",), "ready for a supervised trial"),
    (True, ("failed", "open"), "not ready for a supervised trial"),
    (False, ("passed",), "pass (simulation)"),
    (False, ("failed",), "fail (simulation)"),
    (False, ("open",), "undecided (simulation)"),
)
# the claim of a quick look, whether its machine was recorded or not
QUICK_CLAIMS = tuple(
    (recorded, (state,), f"quick look {word}")
    for state, word in (("passed", "passed"), ("failed", "failed"), ("open", "undecided"))
    for recorded in (True, False)
)
# the part of a claim that stands once in a sentence
KINDS = (" for a supervised trial", " (simulation)", "quick look ")


def decision(loops: Sequence[Loop], *, quick: bool = False) -> str:
    """ "Pass (simulation): temperature and deposition; fail: setpoint." """
    parts: list[str] = []
    for recorded, states, words in QUICK_CLAIMS if quick else CLAIMS:
        names = [loop.name for loop in loops if loop.recorded == recorded and loop.state in states]
        if names:
            kind = next(kind for kind in KINDS if kind in words)
            again = any(kind in part for part in parts)
            which = "all three loops" if len(names) == len(NAMES) else listed(names)
            parts.append(f"{words.replace(kind, '') if again else words}: {which}")
    absent = [loop.name for loop in loops if loop.state == ABSENT]
    parts += [f"not measured: {listed(absent)}"] if absent else []
    text = "; ".join(parts)
    return f"{text[:1].upper()}{text[1:]}."


def state(loops: Sequence[Loop]) -> str:
    """The worst of the loops that were measured: failed before open before passed."""
    states = {loop.state for loop in loops}
    return next((state for state in ("failed", "open", "passed") if state in states), "open")
