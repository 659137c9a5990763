"""The findings of the temperature page in plain words, each with its figure."""

from typing import Any

from pipeline.report.shared.sources import Sources
from pipeline.verdict.digits import THIN, short
from pipeline.verdict.evidence import entry, need, need_figure, or_empty, or_none
from pipeline.verdict.identification import flagged_sentence


def findings(sources: Sources) -> list[tuple[str, str]]:
    """What a reader should take away, each with its figure; a figure
    that was not measured is said to be so."""
    claims = [*_still(sources), _flagged(sources), _printer(sources)]
    units = sources.declared.machine.sample_time_s
    if sources.declared.everything.get("generate_probing", {}).get("source") == "simulated":
        claims += [
            (
                "Units are our convention.",
                "The study names no unit of time and none of duty. "
                f"Here a step is {units:g}{THIN}s and inputs are in per cent; read seconds as steps.",
            ),
            (
                "The probing is simulated, the judging is separate.",
                "The record comes from the study’s machine, simulated within limits; every contestant is "
                "judged on plants that nothing was fitted to. Nothing here is a claim about a real printer.",
            ),
        ]
    return [item for item in claims if item]


@or_empty
def _still(sources: Sources) -> list[tuple[str, str]]:
    """The zones that ingest left out of the design, and what would let them be judged."""
    quality = need(sources.tables["quality"])
    messages = quality["message"][quality["kind"] == "still"]
    return [(f"{message.partition(':')[0]} is not judged.", f"{message}.") for message in messages]


def _flagged(sources: Sources) -> tuple[str, str] | None:
    """A word where controllers are designed from a model with gains that physics forbids."""
    gains = entry(sources.metrics["identify_plant"], "forbidden_gains")
    if not gains:
        return None
    certain = any(gain["certain"] for gain in gains)
    return (
        f"The controllers are designed from a model that physics {'forbids' if certain else 'may forbid'}.",
        f"{flagged_sentence(gains)} "
        + (
            "Put none of them to the machine before that is explained."
            if certain
            else "Watch that effect when one of them takes over."
        ),
    )


@or_none
def _printer(sources: Sources) -> tuple[str, str] | None:
    """The printer's own PID, where a recording tells it, and where it stands beside the others."""
    own = need_figure(sources.tables["printer_pid"], "heaters")
    gains = [
        f"{pid['input']} by Kp {short(pid['Kp'])}, Ki {short(pid['Ki'])}, Kd {short(pid['Kd'])}"
        for pid in own
    ]
    holds = f"The printer holds {'; '.join(gains)}, in % of duty, °C and s."
    simc = "The page of the identification sets it beside one by SIMC."
    evaluated = sources.metrics["evaluate_temperature"]
    if entry(evaluated, "contestants", "printer_pid") is None:
        reason = entry(evaluated, "refused", "printer_pid")
        why = f"It was refused: {reason}." if reason else "It was not judged."
        return "The printer’s own PID is not among these contestants.", f"{holds} {why} {simc}"
    return (
        "The printer’s own PID is among these contestants, as it is.",
        f"{holds} It runs once in {sources.declared.machine.sample_time_s:g}{THIN}s here, as often as the "
        f"others, and in Klipper every 0.3{THIN}s. It is told no model and is not tuned. "
        f"{_held_stable(evaluated)}{simc}",
    )


def _held_stable(evaluated: Any) -> str:
    """A sentence where the printer's own PID does not hold every plant stable."""
    plants = entry(evaluated, "contestants", "printer_pid", "stable")
    if not plants or plants["count"] == plants["of"]:
        return ""
    return (
        f"It holds {plants['count']} of {plants['of']} plants stable: look whether the recorded duty swings "
        "between its limits. At Klipper’s own rate a loop near the edge may hold. "
    )
