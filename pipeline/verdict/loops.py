"""Makes the verdict of every loop that is switched on."""

from collections.abc import Callable, Mapping
from typing import Any

from pipeline.verdict import decide, deposition, identification, pairs, setpoint
from pipeline.verdict.evidence import Evidence
from pipeline.verdict.verdict import LOOPS, PairSentence, Verdict

# the stage that says whether a loop learns from recordings
SOURCES = {"temperature": "generate_probing", "deposition": "train_ilc", "setpoint": "train_classifier"}
VERDICTS: dict[str, Callable[[Evidence], Verdict]] = {
    "temperature": decide.verdict,
    "deposition": deposition.verdict,
    "setpoint": setpoint.verdict,
}


# "model-based or data-driven?"
ANSWERS: dict[str, Callable[[Evidence], PairSentence]] = {
    "temperature": lambda evidence: pairs.pair_sentence(evidence.figures),
    "deposition": deposition.pair_sentence,
    "setpoint": lambda evidence: setpoint.pair_sentence(evidence.tables["choice"]),
}


def verdicts(evidence: Evidence) -> dict[str, Verdict]:
    """Returns the verdict of each loop, from the run alone."""
    on = [loop for loop in LOOPS if (evidence.params.get("loops") or {}).get(loop, True)]
    return {loop: _whole(evidence, VERDICTS[loop](evidence)) for loop in on}


def with_model(evidence: Evidence, verdicts: Mapping[str, Verdict]) -> dict[str, Verdict]:
    """Returns the verdicts and, if the temperature loop is on, the one on its model, as the stage writes
    them."""
    model = {identification.LOOP: identification.trust(evidence)} if "temperature" in verdicts else {}
    return {**verdicts, **model}


def temperature(evidence: Evidence, **night: Any) -> Verdict:
    """Returns the verdict on the temperature loop with the additions of a nightly run."""
    return _whole(evidence, decide.verdict(evidence, **night))


def _whole(evidence: Evidence, verdict: Verdict) -> Verdict:
    """Returns the verdict with its subject, whether it is about simulated machines, and the loop's answer."""
    subject, answer = verdict.subject or verdict.winner or "", ANSWERS[verdict.loop](evidence)
    return verdict._replace(
        subject=subject, rehearsal=simulated(evidence, verdict.loop), answer=answer.text,
        short_answer=answer.short or answer.text,
    )  # fmt: skip


def simulated(evidence: Evidence, loop: str) -> bool:
    """Returns whether a loop was judged on simulated machines."""
    return not evidence.recorded(SOURCES[loop])
