"""The findings of the temperature page in plain words, each with its figure."""

from typing import Any

from pipeline.report.identification.model import flagged_sentence
from pipeline.report.shared.digits import THIN, number, percent, short
from pipeline.report.shared.sources import Sources, lookup
from pipeline.report.shared.verdict import Missing


def findings(sources: Sources) -> list[tuple[str, str]]:
    """What a reader should take away, each with its figure; a figure
    that was not measured is said to be so."""
    evaluated, tuned = sources.metrics["evaluate_temperature"], sources.metrics["tune_weights"]
    claims = [_flagged(sources)]
    if not sources.recorded:
        # of the study's machine, which a user's page is not about
        claims += [_claim(sources), _scaled(tuned), _algorithm_1(evaluated), _start(evaluated)]
    claims.append(_printer(sources))
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


def _flagged(sources: Sources) -> tuple[str, str] | None:
    """A word where controllers are designed from a model with gains that physics forbids."""
    gains = lookup(sources.metrics["identify_plant"], "forbidden_gains")
    if isinstance(gains, Missing) or not gains:
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


def _printer(sources: Sources) -> tuple[str, str] | None:
    """The printer's own PID, where a recording tells it, and where it stands beside the others."""
    own = lookup(sources.tables["printer_pid"], "heaters")
    if isinstance(own, Missing):
        return None
    gains = [
        f"{pid['input']} by Kp {short(pid['Kp'])}, Ki {short(pid['Ki'])}, Kd {short(pid['Kd'])}"
        for pid in own
    ]
    holds = f"The printer holds {'; '.join(gains)}, in % of duty, °C and s."
    simc = "The page of the identification sets it beside one by SIMC."
    evaluated = sources.metrics["evaluate_temperature"]
    if isinstance(lookup(evaluated, "contestants.printer_pid"), Missing):
        reason = lookup(evaluated, "refused.printer_pid")
        why = "It was not judged." if isinstance(reason, Missing) else f"It was refused: {reason}."
        return "The printer’s own PID is not among these contestants.", f"{holds} {why} {simc}"
    return (
        "The printer’s own PID is among these contestants, as it is.",
        f"{holds} It runs once in {sources.declared.machine.sample_time_s:g}{THIN}s here, as often as the "
        f"others, and in Klipper every 0.3{THIN}s. It is told no model and is not tuned. "
        f"{_held_stable(evaluated)}{simc}",
    )


def _held_stable(evaluated: Any) -> str:
    """A sentence where the printer's own PID does not hold every plant stable."""
    plants = lookup(evaluated, "contestants.printer_pid.stable")
    if isinstance(plants, Missing) or plants["count"] == plants["of"]:
        return ""
    return (
        f"It holds {plants['count']} of {plants['of']} plants stable: look whether the recorded duty swings "
        "between its limits. At Klipper’s own rate a loop near the edge may hold. "
    )


def _claim(sources: Sources) -> tuple[str, str] | None:
    printed = lookup(sources.metrics["evaluate_temperature"], "printed")
    if isinstance(printed, Missing):
        return "“Better after tuning”.", f"Not measured. {printed.sentence()}"
    model = 100 * (1 - printed["model_based_tuned"]["J100"] / printed["model_based"]["J100"])
    data = 100 * (1 - printed["data_driven_tuned"]["J100"] / printed["data_driven"]["J100"])
    return (
        f"“{number(model, 1)} % and {number(data, 1)} % better after tuning” compares two currencies.",
        (
            "The cost before tuning is counted with Q = R = I, the cost after it with the tuned, smaller "
            "weights. The objective that was tuned is the cost at Q = R = I, whose optimum is Q = R = I: no "
            "weights can be better."
        ),
    )


def _scaled(tuned: Any) -> tuple[str, str]:
    change, apart = (
        lookup(tuned, "parity.scaled_weights.change_percent"),
        lookup(tuned, "parity.scaled_weights.gain_difference"),
    )
    if isinstance(change, Missing) or isinstance(apart, Missing):
        return "The same controller, “improved”.", "Not measured: tune_weights did not try Q = R = 0.4 I."
    return (
        f"Q = R = 0.4 I “improves” the cost by {number(abs(change), 1)} % without changing the controller.",
        f"Its gain differs from that of Q = R = I by {short(apart, 1)}, which is rounding; "
        "every temperature and every input is the same.",
    )


def _algorithm_1(evaluated: Any) -> tuple[str, str]:
    failed, of = lookup(evaluated, "algorithm_1.failures"), lookup(evaluated, "algorithm_1.of")
    if isinstance(failed, Missing) or isinstance(of, Missing):
        return "Algorithm 1 from random starts.", "Not measured."
    return (
        f"Algorithm 1 as published misses the stabilising gain in {failed} of {of} random starts.",
        (
            "It has no guard against a start that does not stabilise. The controllers here take the Riccati "
            "equation’s solution instead, which needs no start."
        ),
    )


def _start(evaluated: Any) -> tuple[str, str]:
    best, late = lookup(evaluated, "optimal.J1000"), lookup(evaluated, "observer.J1000_from_50_degC")
    if isinstance(best, Missing) or isinstance(late, Missing):
        return "Where the observer starts.", "Not measured."
    return (
        f"Starting the observer at 50 °C costs {percent(100 * (late / best - 1), 2)} for nothing.",
        "Starting it from the first measurement costs next to nothing, "
        "and asks for nothing that is not known.",
    )
