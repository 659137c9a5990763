"""Makes the verdict on the temperature loop from figures, rules and certificates: which controller should
run, the first rule that failed or is undecided, and what to do."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from pipeline.verdict import identification
from pipeline.verdict.controllers import YARDSTICKS, heading, in_a_sentence
from pipeline.verdict.digits import with_unit
from pipeline.verdict.evidence import Evidence, Figures, entry, gap_of
from pipeline.verdict.pairs import pair_names, pair_sentence, reference_of
from pipeline.verdict.rules import judge, rows
from pipeline.verdict.settings import ReportRules
from pipeline.verdict.temperature import LOOP, comparison, finite, names, of_controller, unstable
from pipeline.verdict.verdict import (
    CERTIFICATE,
    FAILED,
    FAILED_FIRST,
    OPEN,
    PASSED,
    TRIAL,
    UNDECIDED,
    UNJUDGED,
    Answers,
    Figure,
    Missing,
    Question,
    Rule,
    Verdict,
    Words,
    count_of,
    deciding,
    share,
    words_for,
)
from pipeline.verdict.wording import name_first, places_of, straddling, worded, words_of

NEVER = Missing(OPEN, "The nightly job measures it and has not run")
# limits that the comparison sets for the machine: declared ones, or those from a recorded machine's own speed
RESOLVED = ("settled_error_degC", "settling_s", "heating_s", "overshoot_degC")
# judged at the value below which a tenth of all plants lie
MARGINS = ("disk", "delay_s")
# rules that no row holds: only the machine shows drift, once the controller runs; the stage `certify` refuses
DRIFT = "drift"


# ---- the rules


def questions(rules: ReportRules, compared: Mapping[str, Any]) -> list[Question]:
    """Returns the questions for every controller, in their fixed order, with the limits that `compared`
    gives."""

    def limit(row) -> float:
        key = row.at_most if row.at_most in RESOLVED else ""
        own = finite(entry(compared, "limits", key))
        return own if math.isfinite(own) and own > 0 else row.limit(rules)

    return [row.question(key, limit(row)) for key, row in rows(LOOP).items()]


def groups() -> dict[str, tuple[list[str], str]]:
    """Returns the lines at the head of a page: the rules in each, and the answers of page one that show
    them."""
    lines: dict[str, tuple[list[str], list[int]]] = {}
    for row in rows(LOOP).values():
        names, answers = lines.setdefault(row.line or row.name, ([], []))
        names.append(row.name)
        answers.append(row.answer)
    shown = {
        name: (of, sorted({answer for answer in answers if answer})) for name, (of, answers) in lines.items()
    }
    return {
        name: (of, "\u2013".join(dict.fromkeys(str(answer) for answer in (*answers[:1], *answers[-1:]))))
        for name, (of, answers) in shown.items()
    } | {DRIFT: ([DRIFT], "11"), CERTIFICATE: ([CERTIFICATE], "")}


def rules_of(
    asked: Sequence[Question], answers: Answers, drift: Figure | Missing, name: str = "", refusal: str = ""
) -> list[Rule]:
    """Returns every rule for one controller, drift last; `name` is used in the sentences. If its certificate
    is refused for the reason `refusal`, this is one more rule."""
    judged = [_rule(question, answers[question.key], name) for question in asked]
    refused = [Rule(CERTIFICATE, None, Missing(UNDECIDED, refusal), reason=refusal)] if refusal else []
    return [*judged, *refused, Rule(DRIFT, None, drift)]


def _rule(question: Question, figure: Figure | Missing, name: str) -> Rule:
    row = rows(LOOP)[question.key]
    if isinstance(figure, Missing):
        if figure.state == UNJUDGED:
            return Rule(row.name, None, count_of(math.inf), text=figure.reason)
        return Rule(row.name, question, figure, place=row.place, reason=figure.sentence())
    words = words_of(question, figure, name)
    rule = judge(row, question, lambda: (figure, words), straddling)
    return rule._replace(reason="" if rule.state == PASSED else rule.reason)


def passes(rules: Sequence[Rule]) -> bool:
    """Returns whether a controller may run. Drift that is not measured or undecided does not stop it, and
    neither does a rule that no use needs (rules.toml)."""
    return all(rule.state == PASSED or not _binding(rule) for rule in rules)


def _binding(rule: Rule) -> bool:
    if rule.name == DRIFT:
        return rule.state == FAILED
    row = next((row for row in rows(LOOP).values() if row.name == rule.name), None)
    return row is None or bool(row.needed_for)


def first_in(rules: Sequence[Rule]) -> Rule | None:
    """Returns the rule to name: the first that failed, otherwise the first that is open; None if the
    controller passes."""
    return deciding(filter(_binding, rules), FAILED_FIRST)


def grouped(rules: Sequence[Rule]) -> list[Rule]:
    """Returns one rule per line of `groups`: the one that decides in it, or its first if all passed."""
    lines = []
    for group, (of, _) in groups().items():
        own = [rule for rule in rules if rule.name in of]
        lines += [(deciding(own, FAILED_FIRST) or own[0])._replace(name=group)] if own else []
    return lines


# ---- who is judged


class Standing(NamedTuple):
    """One controller: its answers and its rules."""

    name: str
    answers: Answers
    rules: list[Rule]

    @property
    def passes(self) -> bool:
        return passes(self.rules)


def standings(evidence: Evidence, drift: Figure | Missing = NEVER) -> dict[str, Standing]:
    """Returns every controller that was judged, in the order of simplicity, the reference last."""
    return {name: _standing(evidence, name, drift) for name in names(evidence.figures)}


def _standing(evidence: Evidence, name: str, drift: Figure | Missing) -> Standing:
    asked = questions(evidence.rules, comparison(evidence.figures))
    answers = of_controller(evidence.figures, name, undeclared_outputs(evidence))
    unstable = _unstable_sentence(evidence.figures, name)
    rules = [
        rule._replace(reason=unstable or rule.reason)
        if rule.state == FAILED and rule.name in ("settled error", "disk margin", "delay margin")
        else rule
        for rule in rules_of(asked, answers, drift, name, evidence.refusal(LOOP, name))
    ]
    return Standing(name, answers, rules)


def undeclared_outputs(evidence: Evidence) -> list[str]:
    """Returns the outputs without a declared lowest or highest allowed temperature."""
    return [output.name for output in evidence.machine.outputs if output.low is None or output.high is None]


def _unstable_sentence(figures: Figures, name: str) -> str:
    lost, of = unstable(entry(comparison(figures), "contestants", name))
    return f"{name_first(name)} is unstable on {lost} of {of} plants." if lost else ""


def choose(figures: Figures, held: Mapping[str, Standing], incumbent: str = "") -> str | None:
    """Returns the controller that should run: the best that passes, the simpler one if several tie. The
    incumbent is kept if none is better beyond the bands of the cost. If the best of the comparison does not
    pass, the weaker of two with one structure is left out. None if no controller passes."""
    fit = [name for name, standing in held.items() if standing.passes and name not in YARDSTICKS]
    if not fit:
        return None
    best = entry(comparison(figures), "best")
    if best not in fit:
        bears_less = entry(comparison(figures), "bears_less") or {}
        fit = [name for name in fit if bears_less.get(name) not in fit]
        cheapest = min(fit, key=lambda name: _cost(held[name]).value)
        best = next(name for name in fit if _cost(held[name]).low <= _cost(held[cheapest]).high)
    if incumbent in fit and _cost(held[incumbent]).low <= _cost(held[best]).high:
        return incumbent
    return best


def _cost(standing: Standing) -> Figure:
    cost = standing.answers["cost"]
    return cost if isinstance(cost, Figure) else Figure(math.inf, math.inf, math.inf)


def closest(held: Mapping[str, Standing]) -> str:
    """Returns, of the controllers that do not pass, the one with the fewest rules against it, then with the
    lowest cost."""

    def against(name: str) -> tuple[int, int, float]:
        states = [rule.state for rule in held[name].rules if rule.name != DRIFT]
        return states.count(FAILED), len(states) - states.count(PASSED), _cost(held[name]).value

    competing = [name for name in held if name not in YARDSTICKS and name != "hold"]
    return min(competing or held, key=against)


def rival(figures: Figures, subject: str) -> str:
    """Returns the controller to show beside the verdict's subject: the other one of the pair, or the pair's
    model-based one if the subject is not in the pair."""
    a, b = pair_names(figures)
    return b if subject == a else a


# ---- the verdict


def verdict(
    evidence: Evidence, *, drift: Figure | Missing = NEVER, incumbent: str = "", named: str = ""
) -> Verdict:
    """Returns the verdict on the temperature loop. A nightly run adds its drift and, as `incumbent`, the
    controller that runs today. If a person has `named` the controller that runs, the verdict is about that
    one only.

    `rules` of the verdict has a line for each of `groups`, with the controller it is about and its rival. For
    a recorded machine, its model is judged before any rule of a controller.
    """
    judged = decide(evidence, drift, incumbent, named)
    if not evidence.recorded("generate_probing"):
        return judged
    return trust_first(judged, identification.trust(evidence))


def decide(
    evidence: Evidence, drift: Figure | Missing = NEVER, incumbent: str = "", named: str = ""
) -> Verdict:
    """Returns the verdict without asking whether the model can be trusted."""
    figures, recorded = evidence.figures, evidence.recorded("generate_probing")
    words = words_for(recorded=recorded, quick=evidence.quick)
    held = standings(evidence, drift)
    if not held or set(held) <= set(YARDSTICKS) or (named and named not in held):
        return _nothing(evidence, words, drift, named)
    if named:
        best = named if held[named].passes else None
    else:
        best = choose(figures, held, incumbent)
    subject = best or named or closest(held)
    beside = rival(figures, subject)
    theirs = held[beside].rules if beside in held else _standing(evidence, beside, drift).rules
    lines = _lines(held[subject].rules, theirs)
    if best:
        lost = "" if named else _beaten(figures, held)
        passed = _passed(figures, held[best], words, lines, "" if lost else incumbent, recorded=recorded)
        return passed._replace(reason=" ".join(filter(None, [lost, passed.reason])))
    return _not_passed(figures, held[subject], words, lines, named=bool(named))


def _lines(rules: Sequence[Rule], theirs: Sequence[Rule]) -> tuple[tuple[Rule, ...], ...]:
    """Returns a line for each group of the subject's rules, with the rival's rule beside it."""
    beside = {rule.name: rule for rule in grouped(theirs)}
    absent = Missing(OPEN, "It is asked of the controller that would be named")
    return tuple((rule, beside.get(rule.name, Rule(rule.name, None, absent))) for rule in grouped(rules))


def _beaten(figures: Figures, held: Mapping[str, Standing]) -> str:
    """Returns why the best controller of this record is not named, if it does not pass; otherwise ""."""
    best = entry(comparison(figures), "best")
    first = first_in(held[best].rules) if best in held else None
    if first is None:
        return ""
    return f"{name_first(best)} is the best of this record and does not pass: {first.name} is {first.state}."


def _nothing(evidence: Evidence, words: Words, drift: Figure | Missing, named: str) -> Verdict:
    a, b = pair_names(evidence.figures)
    lines = _lines(*(_standing(evidence, name, drift).rules for name in (a, b)))
    nobody = f"{name_first(named)} was not judged" if named else "No contestant was judged"
    why = gap_of(evidence.figures.get("evaluate_temperature")) or Missing(OPEN, nobody)
    first = next(iter(groups()))
    return Verdict(
        LOOP,
        OPEN,
        words.undecided,
        f"First undecided rule: {first}.",
        why.sentence(),
        "",
        first,
        None,
        rules=lines,
        subject=named or a,
    )


def _passed(
    figures: Figures,
    winner: Standing,
    words: Words,
    lines: tuple[tuple[Rule, ...], ...],
    incumbent: str,
    *,
    recorded: bool,
) -> Verdict:
    compared = comparison(figures)
    everything = all(rule.state == PASSED for rule in winner.rules)
    plants = f"{entry(compared, 'plants')} {'plants' if recorded else 'simulated plants'}"
    lead = f"{'All rules' if everything else 'Every rule measured so far'} passed on {plants}."
    drift = winner.rules[-1]
    best = entry(compared, "best")
    stays = (
        f"It was named before, and {in_a_sentence(best)} is not better beyond the bands."
        if winner.name == incumbent != best and best
        else ""
    )
    later = "" if everything else _drift_sentence(drift)
    next_step = (
        "Next: a supervised trial, somebody at the machine throughout."
        if recorded
        else "Next: record your own machine."
    )
    return Verdict(
        LOOP,
        PASSED,
        words.passed.format(heading(winner.name)),
        lead,
        " ".join(filter(None, [_closest_limit(winner), _worst_margins(compared, winner), stays])),
        " ".join(filter(None, [later, next_step])),
        "",
        winner.name,
        note=pair_sentence(figures).text,
        rules=lines,
        subject=winner.name,
    )


def _not_passed(
    figures: Figures, subject: Standing, words: Words, lines: tuple[tuple[Rule, ...], ...], *, named: bool
) -> Verdict:
    first = first_in(subject.rules) or subject.rules[-1]
    failed = first.state == FAILED
    comes = (
        f"{name_first(subject.name)} is named to run, and does not pass."
        if named
        else f"No contestant passes; {in_a_sentence(subject.name)} comes closest."
    )
    # drift concerns the machine, not a controller
    who = "" if first.name == "drift" else comes
    why = first.reason or _drift_sentence(first)
    open_too = [rule.name for rule in subject.rules if rule.state == OPEN and rule.name != DRIFT]
    also = f"Undecided too: {', '.join(open_too)}." if failed and open_too else ""
    where = _worst_case(figures, subject.name, first) if failed else ""
    return Verdict(
        LOOP,
        FAILED if failed else OPEN,
        words.failed if failed else words.undecided,
        f"First {'failed' if failed else 'undecided'} rule: {first.name}.",
        " ".join(filter(None, [why, who])),
        " ".join(
            filter(
                None,
                [first.remedy, where, also, "Keep what runs on the machine now." if words is TRIAL else ""],
            )
        ),
        next((group for group, (names, _) in groups().items() if first.name in names), first.name),
        None,
        note=pair_sentence(figures).text,
        rules=lines,
        subject=subject.name,
    )


def _worst_case(figures: Figures, name: str, rule: Rule) -> str:
    """Returns a sentence such as "Its worst case: plant 48, a ramp.", "" if the case is not known."""
    key = rule.question.key if rule.question else ""
    case = entry(comparison(figures), "contestants", name, key, "worst_case")
    if not isinstance(case, Mapping) or case.get("plant") is None:
        return ""
    parts = [f"plant {case['plant']}", reference_of(case)]
    return f"Its worst case: {', '.join(filter(None, parts))}."


def _drift_sentence(rule: Rule) -> str:
    gap = gap_of(rule.figure)
    told = gap.sentence() if gap else ""
    return told if not gap or rule.state == FAILED else f"Drift is {rule.state}. {told}"


def _closest_limit(standing: Standing) -> str:
    """Returns a sentence on the figure that is closest to its limit."""
    asked = [
        (rule.question, rule.figure)
        for rule in standing.rules
        if rule.question is not None
        and rule.question.limit
        and rule.question.key != "data"
        and isinstance(rule.figure, Figure)
        and rule.state == PASSED
    ]
    if not asked:
        return ""
    question, figure = max(
        asked, key=lambda pair: share(pair[0], pair[1].low if pair[0].at_least else pair[1].high)
    )
    places = places_of(question, [figure])
    whose = " of the weakest tenth of plants" if question.key in MARGINS else ""
    return (
        f"Closest to its limit: {question.rule}{whose}, {worded(question, figure.value, places)} "
        f"(at {'least' if question.at_least else 'most'} {with_unit(question.limit, question.unit, places)})."
    )


def _worst_margins(compared: Mapping[str, Any], winner: Standing) -> str:
    """Returns a sentence on the worst plant's margins that are below the limits, which a tenth of plants may
    miss."""
    parts = []
    for rule in winner.rules:
        question = rule.question
        if question is None or question.key not in MARGINS:
            continue
        worst = finite(entry(compared, "contestants", winner.name, "margins", question.key, "worst"))
        if worst < question.limit:
            least = with_unit(question.limit, question.unit, 2)
            parts.append(f"{question.rule} {with_unit(worst, question.unit, 2)} (limit {least})")
    return f"Below the limit on the worst plant: {', '.join(parts)}." if parts else ""


# ---- the model first


def trust_first(verdict: Verdict, model: Verdict) -> Verdict:
    """Returns the verdict on controllers that were judged on an identified model. If that model is good for
    no use, this is stated before every rule, passed or failed, and no controller is ready."""
    if not model.decision.startswith(identification.UNTRUSTED):
        return verdict
    first = verdict._replace(lead=model.decision, reason=f"{model.lead} {model.reason}", rule="trust")
    if verdict.state == PASSED:
        return first._replace(state=OPEN, decision="Not ready.", remedy=_remedy(model, ""), winner=None)
    return first._replace(remedy=_remedy(model, f"On that model: {verdict.lead} {verdict.reason}"))


def _remedy(model: Verdict, then: str) -> str:
    return f"{model.remedy} {then}".strip()
