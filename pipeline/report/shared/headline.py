"""What page one says first: one sentence for the machine, and a row for each loop with its
decision, the rule that decided it and what to do."""

import math
import re
from collections.abc import Sequence
from typing import NamedTuple

from pipeline.report.deposition import verdict as deposition_verdict
from pipeline.report.setpoint import verdict as setpoint_verdict
from pipeline.report.shared.sources import Sources
from pipeline.report.shared.verdict import Verdict
from pipeline.report.temperature.judgement import Judgement

NAMES = ("temperature", "deposition", "setpoint")
MOVES = ("heaters to barrel", "plunger to flow", "camera to setpoints")
ABSENT = "not measured"
# what the first screen has room for beside the answers: lines in all,
# and letters in a line of the widest font
LINES, LINE = 11, 72


class Loop(NamedTuple):
    """One loop: its state (passed, failed, open, not measured), and whole sentences; `lead` is bold and
    vermillion where it failed. `recorded`: judged from recordings of the machine, not on simulated ones."""

    name: str
    moves: str
    state: str
    decision: str
    lead: str
    reason: str
    remedy: str
    recorded: bool = False


def verdicts(sources: Sources, judged: Judgement) -> dict[str, Verdict]:
    """The verdict of each loop, which the pages show and the nightly job obeys."""
    each = (judged.verdict, deposition_verdict.verdict(sources), setpoint_verdict.verdict(sources))
    return {
        verdict.loop: verdict._replace(
            subject=verdict.subject or verdict.winner or "", rehearsal=simulated(sources, verdict.loop)
        )
        for verdict in each
    }


def loops(sources: Sources, judged: Judgement) -> list[Loop]:
    """Temperature, deposition, setpoint, each as short as page one has
    room for; the loop's own page has the whole."""
    mine, parts, camera = verdicts(sources, judged).values()
    return _fitted(
        [
            Loop(
                "temperature",
                MOVES[0],
                mine.word,
                mine.decision,
                mine.lead,
                mine.reason,
                mine.remedy,
                sources.recorded,
            ),
            *(
                Loop(
                    verdict.loop,
                    moves,
                    verdict.word if verdict.winner else ABSENT,
                    verdict.decision,
                    verdict.lead,
                    _first(verdict.reason),
                    verdict.remedy,
                    not simulated(sources, verdict.loop),
                )
                for verdict, moves in zip((parts, camera), MOVES[1:], strict=True)
            ),
        ]
    )


def _first(text: str) -> str:
    """The first sentence, up to its first semicolon where that is long."""
    sentence = re.split(_SENTENCES, text, maxsplit=1)[0]
    return (
        sentence
        if len(sentence) <= 2 * LINE + 20
        else re.split(r"; ", sentence, maxsplit=1)[0].rstrip(".") + "."
    )


_SENTENCES = r"(?<=[.!?]) (?=[A-Z])"


def _fitted(loops: Sequence[Loop]) -> list[Loop]:
    """Where there is no room for all reasons, those that take more than a third of it are cut at their end;
    then remedies by whole sentences, those of a loop that did not pass first.
    """
    fitted = [loop._replace(remedy="") for loop in loops]
    if sum(map(_lines, fitted)) > LINES:
        fitted = [
            loop._replace(
                reason=_cut(loop.reason, LINES // 3 * LINE - len(loop.decision) - len(loop.lead) - 2)
            )
            for loop in fitted
        ]
    for i in sorted(range(len(loops)), key=lambda i: loops[i].state == "passed"):
        for sentence in filter(None, re.split(_SENTENCES, loops[i].remedy)):
            longer = fitted[i]._replace(remedy=f"{fitted[i].remedy} {sentence}".strip())
            if sum(_lines(loop) for loop in [*fitted[:i], longer, *fitted[i + 1 :]]) > LINES:
                break
            fitted[i] = longer
    return fitted


def _cut(text: str, room: int) -> str:
    room = max(room, LINE)
    return text if len(text) <= room else text[: room - 1].rstrip() + "…"


def _lines(loop: Loop) -> int:
    return math.ceil(len(f"{loop.decision} {loop.lead} {loop.reason} {loop.remedy}".rstrip()) / LINE)


SOURCES = {"temperature": "generate_probing", "deposition": "train_ilc", "setpoint": "train_classifier"}
RECORDED = {
    "temperature": "judged on models of the recorded machine",
    "deposition": "forecast by the model of the recorded machine",
    "setpoint": "judged on recorded frames",
}


def simulated(sources: Sources, name: str) -> bool:
    return sources.declared.everything.get(SOURCES[name], {}).get("source") != "recordings"


def claim(sources: Sources, names: Sequence[str] = NAMES) -> str:
    """What was judged on what, and so what may be claimed of a real printer."""
    made = [name for name in names if simulated(sources, name)]
    claims = [f"{name} {RECORDED[name]}" for name in names if name not in made]
    if made:
        which = "" if len(names) == len(made) else f"{_listed(made, 'and')} "
        claims.append(
            f"{which}judged on simulated machines only: nothing is claimed about a real printer".strip()
        )
    text = "; ".join(claims)
    return f"{text[:1].upper()}{text[1:]}."


# what is claimed of loops, by whether their machine was recorded and by state
CLAIMS = (
    (True, ("passed",), "ready for a supervised trial"),
    (True, ("failed", "open"), "not ready"),
    (False, ("passed",), "rehearsal passed"),
    (False, ("failed",), "rehearsal failed"),
    (False, ("open",), "rehearsal open"),
)
# of a quick look, whatever it was made of
QUICK_CLAIMS = tuple(
    (recorded, (state,), f"quick look {state}")
    for state in ("passed", "failed", "open")
    for recorded in (True, False)
)


def decision(loops: Sequence[Loop], *, quick: bool = False) -> str:
    """ "Rehearsal passed: temperature and deposition; failed: setpoint." """
    parts: list[str] = []
    for recorded, states, words in QUICK_CLAIMS if quick else CLAIMS:
        names = [loop.name for loop in loops if loop.recorded == recorded and loop.state in states]
        if names:
            kind = next((kind for kind in ("rehearsal", "quick look") if words.startswith(kind)), "")
            again = bool(kind) and any(kind in part for part in parts)
            listed = "all three loops" if len(names) == len(NAMES) else _listed(names, "and")
            parts.append(f"{words.removeprefix(f'{kind} ') if again else words}: {listed}")
    absent = [loop.name for loop in loops if loop.state == ABSENT]
    parts += [f"not measured: {_listed(absent, 'and')}"] if absent else []
    text = "; ".join(parts)
    return f"{text[:1].upper()}{text[1:]}."


def _listed(names: Sequence[str], word: str) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} {word} {names[-1]}"


def state(loops: Sequence[Loop]) -> str:
    """The worst of the loops that were measured: failed before open before passed."""
    states = {loop.state for loop in loops}
    return next((state for state in ("failed", "open", "passed") if state in states), "open")
