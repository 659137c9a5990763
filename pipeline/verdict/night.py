"""Adds a nightly run to the verdicts of a run: the drift of the machine, the controller that runs today, and
the one that a person named to run."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from pipeline.verdict import loops
from pipeline.verdict.decide import NEVER
from pipeline.verdict.digits import beyond_meaning, number
from pipeline.verdict.evidence import Evidence, entry
from pipeline.verdict.verdict import FAILED, OPEN, UNDECIDED, Figure, Missing, Verdict

LOOP = "temperature"  # whose alarms are read: those of another loop's camera say nothing of this machine
AGAIN = "Look at the machine; where the change is meant to stay, record it anew and learn again"


class Drift(NamedTuple):
    """The figure that the rule is judged by, the word before the sentence, the sentence, and the night it
    comes from ("" before the first)."""

    answer: Figure | Missing
    word: str
    text: str
    night: str


def verdicts(
    evidence: Evidence, stored: Mapping[str, Verdict], nightly: Any, *, named: str = ""
) -> dict[str, Verdict]:
    """Returns the verdicts of a run with the measurements of the last night, `nightly`
    (reports/metrics/nightly.json). Before the first night, and if no controller is named, they are the stored
    ones."""
    if LOOP not in stored or (nightly is None and not named):
        return dict(stored)
    temperature = loops.temperature(
        evidence, drift=drift(nightly).answer, incumbent=in_production(nightly), named=named
    )
    return {**stored, LOOP: temperature}


def in_production(nightly: Any) -> str:
    """Returns the controller that runs, as the nightly job wrote it; "" if no night has promoted one."""
    runs = entry(nightly, "champion", LOOP, "contestant")
    return runs if isinstance(runs, str) else ""


def drift(nightly: Any) -> Drift:
    """Returns the drift. Alarm: failed. Watched: undecided. No alarm on a new recording: passed, with the
    parameter that changed most, in percent with its 90 % band."""
    if nightly is None:
        return Drift(NEVER, "Not measured.", NEVER.sentence(), "")
    if isinstance(nightly, Missing):
        return Drift(nightly, f"{nightly.state.capitalize()}.", nightly.sentence(), "")
    when = f"{nightly.get('run', 'last night')}, {str(nightly.get('when', ''))[:10]}".strip(", ")
    measured = nightly.get("drift") or {}
    for key, state, word in (("alarms", FAILED, "Drifted."), ("watched", UNDECIDED, "Perhaps.")):
        alarms = [alarm for alarm in measured.get(key) or [] if alarm.get("loop") == LOOP]
        causes = "; ".join(str(alarm.get("cause", "")) for alarm in alarms)
        if causes:
            text = causes if state == FAILED else f"{causes}; an alarm where the next night finds it again"
            first = f"{text[:1].upper()}{text[1:]}"
            if alarms[0].get("kind") == "sensor":
                return Drift(
                    Missing(FAILED, first, "Mend the sensor first"), "A sensor is dead.", first, when
                )
            reason = f"The machine has changed: {text}" if state == FAILED else first
            answer = Missing(state, reason, AGAIN if state == FAILED else "")
            return Drift(answer, word, f"{first}.", when)
    changes = [
        (abs(change["sigmas"]), name, float(change["percent"]), float(change["band_percent"]))
        for recording in (measured.get("figures") or {}).values()
        for name, change in (recording.get("parameters") or {}).items()
    ]
    if not changes:
        answer = Missing(OPEN, "The last night had no new recording of the machine to measure it on")
        return Drift(answer, "Not measured.", answer.sentence(), when)
    # of all recordings, the parameter that changed most relative to its own noise
    _, name, percent, half = max(changes)
    size, band = beyond_meaning(percent, "%") or f"{number(percent, 1)} %", beyond_meaning(half, "%")
    text = f"Largest change of the machine: {name}, {size} ± {band or number(half, 1)}."
    return Drift(Figure(percent, percent - half, percent + half, note=text), "None found.", text, when)
