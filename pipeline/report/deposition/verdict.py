"""Scores and rules of the deposition loop -> whose signal to use and
whether the parts will print, in words."""

from collections.abc import Sequence

from pipeline.report.deposition.rules import (
    COMPOSERS,
    DRIVE,
    FORECAST,
    OURS,
    SAME,
    USE,
    Structure,
    gamma,
    real,
    rules,
    structures,
    where,
    winner,
    worst,
)
from pipeline.report.shared.sources import Sources
from pipeline.verdict.digits import THIN, count, number, percent
from pipeline.verdict.verdict import (
    FAILED,
    OPEN,
    PASSED,
    UNJUDGED,
    Missing,
    Rule,
    Verdict,
    Words,
    deciding,
    overall,
    words_for,
)

# what the library by its priority rule is not held against: the paper's law is not what it was learned by
OF_THE_LAW = ("Convergence test", "Learned to")
# what no composer changes, and what each machine can settle: declare its drive, judge the forecast by a trial
SHARED = (DRIVE, FORECAST)


def verdict(sources: Sources) -> Verdict:
    """Whose signal to use: the composer with the least worst error; then the rules, for it. `winner` is the
    composer, "" where nothing was composed; `note` is the price of the signals."""
    parts = structures(sources)
    if isinstance(parts, Missing):
        return Verdict(
            loop="deposition",
            state=OPEN,
            decision=words_for(recorded=real(sources), quick=sources.quick).undecided,
            lead="Nothing was composed.",
            reason=parts.sentence(),
            remedy="",
            rule="",
            winner="",
            note=_price(sources, []),
            rules=rules(sources, []),
        )
    use, machine, lines = winner(parts), real(sources), rules(sources, parts)
    # ours' column for the basis functions, the paper's for the library
    column = 0 if use == OURS else 1
    asked = [line[column] for line in lines if use == OURS or line[column].name not in OF_THE_LAW]
    unjudged = [rule for rule in asked if rule.state == UNJUDGED]
    judged = [rule for rule in asked if rule.state != UNJUDGED]
    # what cannot be measured on a machine's own trials does not hold them up; a drive can be declared, and a
    # forecast that is not judged has a trial that judges it
    state = overall(
        [rule.state for rule in judged if not machine or rule.state != OPEN or rule.name in SHARED]
    )
    state = FAILED if use == "on_off" else state
    first = None if state == PASSED else deciding(judged)
    told = first is not None and first.reason and (column == 0 or first.name in SHARED)
    summary = _summary(parts, use, machine)
    return Verdict(
        loop="deposition",
        state=state,
        decision=_decision(
            state, use if worst(_known(parts), use) else "", words_for(recorded=machine, quick=sources.quick)
        ),
        lead=_lead(state, first, len(judged), condition=bool(unjudged)),
        reason=f"{first.reason} {summary}" if told else summary,
        remedy=first.remedy if first else "",
        rule=first.name if first else "",
        winner=use,
        note=_price(sources, parts),
        rules=lines,
    )


def _known(parts: Sequence[Structure]) -> list[Structure]:
    """The parts of which it is known what they come to."""
    return [part for part in parts if not part.unknown()]


def _decision(state: str, use: str, words: Words) -> str:
    """The decision; which composer comes closest only where that is known of any part."""
    if not use:
        return words.of(state)
    if state == PASSED:
        return words.passed.format(USE[use])
    return f"{words.of(state).rstrip('.')}: {USE[use]} {'come' if use == OURS else 'comes'} closest."


def _lead(state: str, first: Rule | None, judged: int, *, condition: bool) -> str:
    """How many rules passed, and on what condition; or the first that did not."""
    if state != PASSED:
        if first is None:
            return "Nothing beats on\u2011off control."
        word = "failed" if state == FAILED else "undecided"
        return f"First {word} rule: {first.name[:1].lower()}{first.name[1:]}."
    return f"All {count(judged, 'rule')} {'that can be judged ' if condition else ''}passed."


def _peak(sources: Sources) -> float:
    """The largest command of our laws over the steady one; 0 where none was learned."""
    metrics = sources.metrics["train_ilc"]
    learned = (
        []
        if isinstance(metrics, Missing)
        else [laws[law] for laws in metrics.values() for law in ("model_inverse", "pixels") if law in laws]
    )
    return max((law["peak_over_steady"] for law in learned), default=0.0)


def _summary(parts: Sequence[Structure], use: str, machine: bool) -> str:
    """The composer in use with its figure and its yardsticks: on-off control, the
    others, and what learning each structure reaches."""
    parts = _known(parts)
    found = worst(parts, use)
    if found is None:
        return "What the parts come to is not known."
    error, place = found
    others = [
        f"{_bare(name)} {percent(pair[0], 2)}"
        for name in COMPOSERS
        if name not in (use, "on_off") and (pair := worst(parts, name))
    ]
    full = worst(parts, "ilc")
    others += [f"learning each part from scratch {percent(full[0], 2)}"] if full else []
    lines = [
        part.scores[use].worst_line
        for part in parts
        if use in part.scores and part.scores[use].worst_line is not None
    ]
    volume = (
        f" Worst printed line: {percent(max(lines), 2)} off its volume, "
        f"±{place.asked.line_volume_percent:g}{THIN}% allowed."
        if lines
        else ""
    )
    forecast = (
        " These figures are forecasts of the identified machine: the true flow of a real one is not known."
        if machine
        else ""
    )
    return (
        f"{_bare(use)[:1].upper()}{_bare(use)[1:]} {'leave' if use == OURS else 'leaves'} at most "
        f"{percent(error, 2)} of on\u2011off control’s flow error "
        f"({place.part}, {place.material}); {', '.join(others)}.{volume}{forecast}"
    )


def _bare(name: str) -> str:
    return USE[name].removeprefix("the ")


def _price(sources: Sources, parts: Sequence[Structure]) -> str:
    """What the signals cost: trials, peak command, what the paper's law would have done,
    and the lines that the priority rule would lose."""
    metrics, sentences = sources.metrics["train_ilc"], []
    if not isinstance(metrics, Missing):
        learned = [
            laws[law] for laws in metrics.values() for law in ("model_inverse", "pixels") if law in laws
        ]
        routines = max((len(laws.get("other_routines", [])) for laws in metrics.values()), default=0)
        if learned:
            trials, peak = max(law["trials"] for law in learned), _peak(sources)
            of = (
                f"{count(routines, 'routine')} of {trials + 1} trials" if routines else f"{trials + 1} trials"
            )
            sentences.append(
                f"Price: {of} for each material, and commands up to {number(peak, 0)} times the steady one."
            )
    before = gamma(sources)
    if before:
        safe = before["gamma_worst"] < 1
        sentences.append(
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
    sentences += [
        f"{count(n, 'line', 'lines').capitalize()} of {part} {'is' if n == 1 else 'are'} shorter than the "
        f"lead: the priority rule would not print {'it' if n == 1 else 'them'}."
        for part, n in short.items()
        if n
    ][:2]
    missed = [
        part
        for part in parts
        if part.chosen
        and part.chosen != part.best()
        and part.scores[part.chosen].error > part.scores[part.best()].error + SAME
    ]
    sentences += (
        [f"The forecast chose wrongly for {where(missed[0])[:-1]}: {_bare(missed[0].best())} is better."]
        if missed
        else []
    )
    return " ".join(sentences)
