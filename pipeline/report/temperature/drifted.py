"""Answer 11: whether the machine has drifted, as the nightly job measured it last;
reports/metrics/nightly.json -> a figure, or why there is none."""

from collections.abc import Mapping
from typing import NamedTuple

from pipeline.nightly.records import NightDrift, RecordingFigures
from pipeline.report.shared.digits import beyond_meaning, number
from pipeline.report.shared.sources import Sources
from pipeline.report.shared.verdict import FAILED, OPEN, UNDECIDED, Figure, Missing
from pipeline.report.temperature.verdict import NEVER

LOOP = "temperature"  # whose alarms are read: those of another loop's camera say nothing of this machine
AGAIN = "Look at the machine; where the change is meant to stay, record it anew and learn again"


class Drift(NamedTuple):
    """Answer 11 as it is read: what the rule is judged by, the word before the sentence,
    and which night it is from ("" before the first)."""

    answer: Figure | Missing
    word: str
    text: str
    night: str


def drift(sources: Sources) -> Drift:
    """Alarm: failed. Watched: undecided. No alarm on a new recording: passed, with the parameter that moved
    most, in percent with its 90 % band."""
    nightly = sources.nightly
    if nightly is None:
        return Drift(NEVER, "Not measured.", NEVER.sentence(), "")
    if isinstance(nightly, Missing):
        return Drift(nightly, f"{nightly.state.capitalize()}.", nightly.sentence(), "")
    when = f"{nightly.get('run', 'last night')}, {str(nightly.get('when', ''))[:10]}".strip(", ")
    drifted = NightDrift.read(nightly.get("drift")).of(LOOP)
    for alarms, state, word in (
        (drifted.alarms, FAILED, "Drifted."),
        (drifted.watched, UNDECIDED, "Perhaps."),
    ):
        causes = "; ".join(alarm.cause for alarm in alarms)
        if causes:
            text = causes if state == FAILED else f"{causes}; an alarm where the next night finds it again"
            answer = Missing(
                state,
                f"The machine has changed: {text}" if state == FAILED else f"{text[:1].upper()}{text[1:]}",
                AGAIN if state == FAILED else "",
            )
            return Drift(answer, word, f"{text[:1].upper()}{text[1:]}.", when)
    most = _most(drifted.figures)
    if most is None:
        answer = Missing(OPEN, "The last night had no new recording of the machine to measure it on")
        return Drift(answer, "Not measured.", answer.sentence(), when)
    name, percent, half = most
    size, band = beyond_meaning(percent, "%") or f"{number(percent, 1)} %", beyond_meaning(half, "%")
    text = f"Largest change of the machine: {name}, {size} ± {band or number(half, 1)}."
    return Drift(Figure(percent, percent - half, percent + half, note=text), "None found.", text, when)


def _most(figures: Mapping[str, RecordingFigures]) -> tuple[str, float, float] | None:
    """The parameter of the plant that moved most of all recordings of the night, against its own noise: name,
    change and half of its 90 % band in percent."""
    changes = [
        (abs(change.sigmas), name, float(change.percent), float(change.band_percent))
        for recording in figures.values()
        for name, change in recording.parameters.items()
    ]
    return max(changes)[1:] if changes else None
