"""Scores and rules of the deposition loop -> whose signal to use and
whether the parts will print, in words."""

from collections.abc import Sequence
from typing import NamedTuple

from pipeline.report.deposition.rules import (
    COMPOSERS,
    OURS,
    SAME,
    UNJUDGED,
    USE,
    Rule,
    Structure,
    gamma,
    real,
    rules,
    structures,
    where,
    winner,
    worst,
)
from pipeline.report.shared.digits import THIN, count, number, percent
from pipeline.report.shared.sources import Sources
from pipeline.report.shared.verdict import FAILED, OPEN, PASSED, Missing


class Verdict(NamedTuple):
    """`state`: passed, failed, open; the composer to use ("" where none is known); decision, lead, reason,
    price and caution as the page says them."""

    state: str
    composer: str
    decision: str
    lead: str
    reason: str
    remedy: str
    price: str
    rules: tuple[Rule, ...]
    first: str
    real: bool


def verdict(sources: Sources) -> Verdict:
    """Whose signal to use: the composer with the least worst error; then the rules, for it."""
    found, machine = structures(sources), real(sources)
    if isinstance(found, Missing):
        tested = rules(sources, [])
        return Verdict(
            OPEN,
            "",
            "Do not print by this loop yet.",
            "Nothing was composed.",
            found.sentence(),
            "",
            _price(sources, []),
            tested,
            "",
            machine,
        )
    use, tested = winner(found), rules(sources, found)
    # ours' column for the basis functions, the paper's for the library; the
    # paper's law is not what the library was learned by
    column = 0 if use == OURS else 1
    needed = [rule for rule in tested if use == OURS or rule.name not in ("Convergence test", "Learned to")]
    unjudged = [rule for rule in needed if rule.states[column] == UNJUDGED]
    needed = [rule for rule in needed if rule not in unjudged]
    states = [rule.states[column] for rule in needed]
    state = (
        FAILED if FAILED in states or use == "on_off" else OPEN if OPEN in states and not machine else PASSED
    )
    first = (
        next((rule for wanted in (FAILED, OPEN) for rule in needed if rule.states[column] == wanted), None)
        if state != PASSED
        else None
    )
    if state == PASSED:
        decision = f"{'By forecast, t' if machine else 'T'}his machine prints these parts: use {USE[use]}."
        peak = (
            f", where the drive can give {number(peak, 0)} times the steady command"
            if unjudged and use == OURS and (peak := _peak(sources))
            else ""
        )
        lead = f"All {count(len(needed), 'rule')} {'that can be judged ' if unjudged else ''}passed{peak}."
    else:
        decision = f"{'Do not print these parts yet' if state == FAILED else 'Do not decide yet'}: {USE[use]} {'comes' if use == 'on_off' or use != OURS else 'come'} closest."
        lead = (
            f"First {'failed' if state == FAILED else 'open'} rule: {first.name[:1].lower()}{first.name[1:]}."
            if first
            else "Nothing beats on\u2011off control."
        )
    reason = " ".join(
        part for part in (first.reason if first and column == 0 else "", told(found, use, machine)) if part
    )
    return Verdict(
        state,
        use,
        decision,
        lead,
        reason,
        " ".join(filter(None, [first.remedy if first else "", _unlimited(sources) if unjudged else ""])),
        _price(sources, found),
        tested,
        first.name if first else "",
        machine,
    )


def _unlimited(sources: Sources) -> str:
    """Before the command's limit is declared, how far the command goes is a condition of the verdict."""
    peak = (
        f": the command peaks at {number(peak, 0)} times the steady one" if (peak := _peak(sources)) else ""
    )
    return f"Not judged: time at the command’s limit. Declare the drive’s limit (printer.limit_mm){peak}."


def _peak(sources: Sources) -> float:
    """The largest command of our laws over the steady one; 0 where none was learned."""
    metrics = sources.metrics["train_ilc"]
    learned = (
        []
        if isinstance(metrics, Missing)
        else [one[law] for one in metrics.values() for law in ("ours", "pixels") if law in one]
    )
    return max((law["peak_over_steady"] for law in learned), default=0.0)


def told(found: Sequence[Structure], use: str, machine: bool) -> str:
    """The composer in use with its figure and its yardsticks: on-off control, the
    others, and what learning each structure reaches."""
    error, place = worst(found, use)
    others = [
        f"{_bare(name)} {percent(pair[0], 2)}"
        for name in COMPOSERS
        if name not in (use, "on_off") and (pair := worst(found, name))
    ]
    whole = worst(found, "ilc")
    others += [f"learning each part from scratch {percent(whole[0], 2)}"] if whole else []
    lines = [
        one.scores[use].worst_line
        for one in found
        if use in one.scores and one.scores[use].worst_line is not None
    ]
    volume = (
        f" Worst printed line: {percent(max(lines), 2)} off its volume, "
        f"±{place.asked.line_volume_percent:g}{THIN}% allowed."
        if lines
        else ""
    )
    known = (
        " These figures are forecasts of the identified machine: the true flow of a real one is not known."
        if machine
        else ""
    )
    return (
        f"{_bare(use)[:1].upper()}{_bare(use)[1:]} {'leave' if use == OURS else 'leaves'} at most "
        f"{percent(error, 2)} of on\u2011off control’s flow error "
        f"({place.part}, {place.material}); {', '.join(others)}.{volume}{known}"
    )


def _bare(name: str) -> str:
    return USE[name].removeprefix("the ")


def _price(sources: Sources, found: Sequence[Structure]) -> str:
    """What the signals cost: trials, peak command, what the paper's law would have done,
    and the lines that the priority rule would lose."""
    metrics, parts = sources.metrics["train_ilc"], []
    if not isinstance(metrics, Missing):
        laws = [one[law] for one in metrics.values() for law in ("ours", "pixels") if law in one]
        routines = max((len(one.get("other_routines", [])) for one in metrics.values()), default=0)
        if laws:
            trials, peak = max(law["trials"] for law in laws), _peak(sources)
            of = (
                f"{count(routines, 'routine')} of {trials + 1} trials" if routines else f"{trials + 1} trials"
            )
            parts.append(
                f"Price: {of} for each material, and commands up to {number(peak, 0)} times the steady one."
            )
    before = gamma(sources)
    if before:
        safe = before["gamma_worst"] < 1
        parts.append(
            f"Before anything ran, γ of the paper’s law was {number(before['gamma'], 2)} on the nominal "
            f"plant and {number(before['gamma_worst'], 2)} on the worst of its family, "
            f"above 1 on {percent(before['gamma_above_1_percent'], 2)}: "
            f"{'it may be run' if safe else 'do not run it'} on this machine."
        )
    conformance = sources.tables["conformance"]
    short = (
        {}
        if isinstance(conformance, Missing)
        else {part: report.get("shorter_than_lead", 0) for part, report in conformance.items()}
    )
    parts += [
        f"{count(n, 'line', 'lines').capitalize()} of {part} {'is' if n == 1 else 'are'} shorter than the "
        f"lead: the priority rule would not print {'it' if n == 1 else 'them'}."
        for part, n in short.items()
        if n
    ][:2]
    missed = [
        one
        for one in found
        if one.chosen
        and one.chosen != one.best()
        and one.scores[one.chosen].error > one.scores[one.best()].error + SAME
    ]
    parts += (
        [f"The forecast chose wrongly for {where(missed[0])[:-1]}: {_bare(missed[0].best())} is better."]
        if missed
        else []
    )
    return " ".join(parts)
