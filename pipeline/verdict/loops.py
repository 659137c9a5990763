"""The verdict of every loop that is switched on."""

from collections.abc import Callable, Mapping
from typing import Any

from pipeline.verdict import decide, deposition, identification, setpoint
from pipeline.verdict.evidence import Evidence
from pipeline.verdict.verdict import LOOPS, Verdict

# the stage that says whether a loop learns from recordings
SOURCES = {"temperature": "generate_probing", "deposition": "train_ilc", "setpoint": "train_classifier"}
VERDICTS: dict[str, Callable[[Evidence], Verdict]] = {
    "temperature": decide.verdict,
    "deposition": deposition.verdict,
    "setpoint": setpoint.verdict,
}


def verdicts(evidence: Evidence) -> dict[str, Verdict]:
    """The verdict of each loop, by the run alone."""
    on = [loop for loop in LOOPS if (evidence.params.get("loops") or {}).get(loop, True)]
    return {loop: _whole(evidence, VERDICTS[loop](evidence)) for loop in on}


def with_model(evidence: Evidence, verdicts: Mapping[str, Verdict]) -> dict[str, Verdict]:
    """The verdicts, and if the temperature loop is on the one on its model, as the stage writes them."""
    model = {identification.LOOP: identification.trust(evidence)} if "temperature" in verdicts else {}
    return {**verdicts, **model}


def temperature(evidence: Evidence, **night: Any) -> Verdict:
    """The verdict on the temperature loop with what a night adds."""
    return _whole(evidence, decide.verdict(evidence, **night))


def _whole(evidence: Evidence, verdict: Verdict) -> Verdict:
    """The verdict with its subject, and whether it is one on simulated machines."""
    subject = verdict.subject or verdict.winner or ""
    return verdict._replace(subject=subject, rehearsal=simulated(evidence, verdict.loop))


def simulated(evidence: Evidence, loop: str) -> bool:
    """Whether a loop was judged on simulated machines."""
    return not evidence.recorded(SOURCES[loop])
