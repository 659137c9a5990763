"""Scoreboard and classifier's figures -> who sets flow and temperature by default, by how much, and whether
it may steer a printer, in words. No page, no file."""

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from pipeline.report.shared.digits import THIN, band, count, number, quantity
from pipeline.report.shared.sources import Sources, lookup
from pipeline.report.shared.verdict import (
    FAILED,
    OPEN,
    PASSED,
    UNDECIDED,
    Figure,
    Missing,
    Question,
    Rule,
    Verdict,
    count_of,
    deciding,
    overall,
    state,
    words_for,
)
from pipeline.setpoint.agents.criteria import BEYOND, harm_bar
from pipeline.setpoint.agents.criteria import NO_CONTROL as DOES_NOTHING

AGENT, PAPER, BASELINE = "agent", "paper", "baseline"
SIMULATORS = {
    "paper": "The paper’s simulator",
    "recorded": "Recorded windows",
    "harm": "From good starts",
    "pixels": "Through pictures",
}
CLAIM = (
    "The classifier is trained and judged on rendered frames: eight real pictures allow no claim about real "
    "printers."
)
CLAIM_RECORDED = (
    "The classifier is trained and judged on recordings of datasets/raw/setpoint, split by print; "
    "it is known "
    "on these printers only."
)
NOT_APART = (
    " Controllers learn, are chosen and judged on windows of prints that the classifier was calibrated, "
    "chosen and judged on: the folder has too few prints to keep them apart."
)
# what the two columns of its rules are, and the mark of the second
HEADS = ("Data\u2011driven", "Baseline", "baseline")


NO_CLOG = Missing("not applicable", "nothing happens in this case")


class Cell(NamedTuple):
    """One controller in one case: shares of runs in percent with their 95 % intervals, or why one is missing.
    Then steps until inside for good; overshoot and flow error in percent; beyond, of good starts those that
    leave them by each of BEYOND points; back, within +-15 % after a clog, and decisions until inside again.
    redraws of the segments, by which the intervals are clustered."""

    runs: int
    counts: bool
    settled: Figure | Missing
    stay: Figure | Missing
    recovered: Figure | Missing
    median: float
    p90: float
    overshoot: float
    flow_error: float
    worst_start: tuple[float, float, float]
    beyond: tuple[Figure | Missing, ...] = ()
    back: Figure | Missing = NO_CLOG
    recovery_steps: float = math.nan
    redraws: int = 1


# borders of the classes in percent of nominal flow
CLASS_BORDERS = (90.0, 110.0)
Case = tuple[str, str]  # simulator, case


class Board(NamedTuple):
    """Who was judged, the best worst case first, with the kind of each; cases in the table's order; who runs
    by default ("" where nobody chose); who may not, and why. Those who may not stand behind the others."""

    names: list[str]
    kinds: Mapping[str, str]
    cases: list[Case]
    cells: Mapping[tuple[str, Case], Cell]
    default: str
    refused: Mapping[str, str]

    def counting(self, name: str) -> list[tuple[Case, Cell]]:
        """The cases that count for the choice."""
        return [(case, cell) for case in self.cases if (cell := self.cells.get((name, case))) and cell.counts]

    def best(self, *kinds: str) -> str:
        """Of these kinds, the one with the best worst case; "" where there is none."""
        return next((name for name in self.names if self.kinds[name] in kinds), "")

    def baseline(self) -> str:
        """The baseline that is shown: the default where it is one, else the best."""
        mine = self.default and self.kinds[self.default] == BASELINE
        return self.default if mine else self.best(BASELINE)

    def learned(self) -> str:
        """The agent that competes: the default where it is one, else ours, else the paper's."""
        return (
            self.default
            if self.default and self.kinds[self.default] != BASELINE
            else self.best(AGENT) or self.best(PAPER)
        )


def role(board: Board, name: str) -> str:
    """The mark of a controller: circle what learned (hollow: not the one that
    competes), square the Bayes filter, ring the others."""
    if board.kinds[name] != BASELINE:
        return "data_driven" if name == board.learned() else "kernel"
    if "bayes" in name.lower():
        first = next(
            other for other in board.names if board.kinds[other] == BASELINE and "bayes" in other.lower()
        )
        return "model_based" if name == first else "exact_model"
    return "baseline"


def case_text(case: Case, *, whole: bool = False) -> str:
    """ "accuracy 0.7, clog" -> "accuracy 70 %, clog"; `whole`: after the simulator's name."""
    simulator, name = case
    name = re.sub(rf"^{re.escape(simulator)}[, ]*", "", name) or "as it is"
    name = re.sub(r"accuracy (\d\.?\d*)", lambda match: f"accuracy {100 * float(match[1]):g}{THIN}%", name)
    return f"{SIMULATORS.get(simulator, simulator)}, {name}" if whole else name


def within(case: Case) -> str:
    """The same in the middle of a sentence."""
    text = case_text(case, whole=True)
    return text[:1].lower() + text[1:]


def board(sources: Sources) -> Board | Missing:
    table, choice = sources.tables["scoreboard"], sources.tables["choice"]
    if isinstance(table, Missing):
        return table
    if not len(table["controller"]):
        return Missing("not measured", "the scoreboard is empty", "Run ./run dvc repro evaluate_setpoint")
    rows: list[Any] = list(pd.DataFrame(table).itertuples())
    cells = {(row.controller, (row.simulator, row.case)): _cell(row) for row in rows}
    kinds = {row.controller: row.kind for row in rows}
    said = choice if isinstance(choice, Mapping) else {}
    refused = said.get("refused")
    refused = {name: str(why) for name, why in refused.items()} if isinstance(refused, Mapping) else {}
    unranked = Board(list(kinds), kinds, list(dict.fromkeys(case for _, case in cells)), cells, "", refused)
    ranked = sorted(kinds, key=lambda name: (name not in refused, _rank(unranked, name)), reverse=True)
    chosen = str(said.get("name", ""))
    return unranked._replace(names=ranked, default=chosen if chosen in kinds else "")


def _cell(row: Any) -> Cell:
    """A row of the scoreboard."""
    return Cell(
        row.runs,
        row.counts,
        _figure(row.settled_percent, row.settled_low_percent, row.settled_high_percent),
        _figure(row.stay_percent, row.stay_low_percent, row.stay_high_percent),
        _figure(row.recovered_percent, row.recovered_low_percent, row.recovered_high_percent),
        row.median_steps,
        row.p90_steps,
        row.overshoot_p95_percent,
        row.flow_error_percent,
        (row.worst_start_flow_percent, row.worst_start_temperature_degC, row.worst_start_settled_percent),
        tuple(
            _figure(*(getattr(row, f"beyond_{points}_{end}percent") for end in ("", "low_", "high_")))
            for points in BEYOND
        ),
        _figure(row.back_percent, row.back_low_percent, row.back_high_percent),
        row.recovery_steps,
        row.redraws,
    )


def _figure(value: float, low: float, high: float) -> Figure | Missing:
    if math.isnan(value):
        return Missing("not applicable", "runs end before")
    return Figure(value, value if math.isnan(low) else low, value if math.isnan(high) else high)


def lasting(cell: Cell) -> Figure | Missing:
    """The share by which a case is read: settled and staying, or
    settled where runs end before that can be told."""
    return cell.stay if isinstance(cell.stay, Figure) else cell.settled


def _rank(board: Board, name: str) -> tuple[float, float]:
    values = [share.value for _, cell in board.counting(name) if isinstance(share := lasting(cell), Figure)]
    return (min(values), float(np.mean(values))) if values else (-1.0, -1.0)


def worst(board: Board, name: str, what: str) -> tuple[Figure | Missing, Case | None]:
    """The smallest share `what` (settled, stay, lasting) of the cases that count, and where."""
    shares = [
        (figure, case)
        for case, cell in board.counting(name)
        if isinstance(figure := lasting(cell) if what == "lasting" else getattr(cell, what), Figure)
    ]
    if not shares:
        return Missing("not measured", f"no case of {name or 'any controller'}"), None
    return min(shares, key=lambda pair: pair[0].value)


def share_text(figure: Figure | Missing) -> str:
    return figure.state if isinstance(figure, Missing) else quantity(figure.value, "%", 1)


# ---- the rules


# of each a pair: what learned, and the best baseline; a rule of the classifier holds for every controller
Pair = tuple[Rule, Rule]
SEEING = ("vision", "by-flow", "reliability")


def of_classifier(rule: Rule) -> bool:
    """Whether the rule is asked of the classifier, on which every controller rests."""
    return rule.place in SEEING


def rules(sources: Sources, board: Board | None) -> tuple[Pair, ...]:
    asked = sources.declared.rules
    return (
        _does_no_harm(sources, board),
        _control(board, "Settles, worst case", "settled", asked.settled_percent, "settle"),
        _control(board, "Stays, worst case", "stay", asked.stay_percent, "settle and stay"),
        _accurate(
            sources,
            Question(0, "image_accuracy", "Right, an image", "%", 100 * asked.image_accuracy, True, ""),
            ("svc", "cnn", "width"),
            "frames of segments it never saw",
        ),
        _right_by_flow(sources, 100 * asked.window_right_70_150),
        _calibrated(sources, "Calibrated, an image", asked.ece_image, ("ece_image", "ece_image_raw")),
        _calibrated(sources, "Calibrated, a window", asked.ece_window, ("ece_window", "ece_window_counts")),
    )


def _control(board: Board | None, name: str, what: str, limit: float, does: str) -> Pair:
    question = Question(0, what, name, "%", limit, True, "")
    rule = Rule(
        name, question, Missing(OPEN, ""), text=OPEN, limit=f"≥ {limit:g}{THIN}%", place="scoreboard",
        reason="Nothing was judged.",
    )  # fmt: skip
    if board is None:
        return rule, rule
    remedy = "A classifier whose errors persist for fewer decisions."

    def held(controller: str) -> Rule:
        figure, case = worst(board, controller, what)
        shares = case is not None and board.cells[controller, case].redraws > 1
        reason = (
            figure.sentence()
            if isinstance(figure, Missing)
            else f"In its worst case ({within(case)}) {share_text(figure)} of its runs {does}; "
            f"{limit:g}{THIN}% are asked for.{undecided(question, figure, clustered=shares)}"
        )
        return rule._replace(figure=figure, text=share_text(figure), reason=reason, remedy=remedy)

    return held(board.learned()), held(board.baseline())


class Harm(NamedTuple):
    """Of the runs of one controller from good starts those that leave +-25 %, and how many may, in percent;
    its state, and the case."""

    figure: Figure
    limit: float
    state: str
    case: Case


def bars(sources: Sources, board: Board) -> dict[Case, float]:
    """Percent of runs that may leave +-25 % from good starts, by case; {} where nobody declared it."""
    most = sources.declared.everything.get("evaluate_setpoint", {}).get("most_harmed") or {}
    perfect, in_band = most.get("perfect_percent"), most.get("in_band_percent")
    if perfect is None or in_band is None:
        return {}
    harm = [case for case in board.cases if case[0] == "harm"]
    limits = {case: harm_bar(case[1], perfect=perfect, in_band=in_band) for case in harm}
    return {case: limit for case, limit in limits.items() if limit is not None}


def harm_of(board: Board, name: str, limits: Mapping[Case, float]) -> Harm | Missing:
    """The barred case that decides: of the gravest state the one that is most beyond its bar."""
    found = []
    for case, limit in limits.items():
        cell = board.cells.get((name, case))
        if cell and cell.beyond and isinstance(share := cell.beyond[-1], Figure):
            question = Question(0, "harm", "Does no harm", "%", limit, False, "")
            found.append(Harm(share, limit, state(question, share), case))
    order = (PASSED, UNDECIDED, FAILED)
    return max(
        found,
        key=lambda harm: (order.index(harm.state), harm.figure.value - harm.limit),
        default=Missing("not measured", f"no run of {name or 'any controller'} from a good start"),
    )


def _does_no_harm(sources: Sources, board: Board | None) -> Pair:
    """How often a print that was good is spoilt, beside what doing nothing spoils."""
    question = Question(0, "harm", "Does no harm", "%", 0.0, False, "")
    rule = Rule(
        "Does no harm", question, Missing(OPEN, ""), text=OPEN, place="harm",
        reason="Nothing was judged from good starts.",
        remedy="Run ./run dvc repro evaluate_setpoint.",
    )  # fmt: skip
    limits = bars(sources, board) if board else {}
    if board is None or not limits:
        return rule, rule
    idle = harm_of(board, DOES_NOTHING, limits)
    beside = "" if isinstance(idle, Missing) else f" With doing nothing {share_text(idle.figure)} do."
    ends = sorted(set(limits.values()))

    def held(name: str) -> Rule:
        harm = harm_of(board, name, limits)
        if isinstance(harm, Missing):
            return rule._replace(reason=harm.sentence())
        asked = question._replace(limit=harm.limit)
        return rule._replace(
            question=asked,
            figure=harm.figure,
            text=share_text(harm.figure),
            limit=f"≤ {' or '.join(f'{end:g}' for end in ends)}{THIN}%",
            reason=f"{case_text(harm.case, whole=True)}, {share_text(harm.figure)} of its runs leave "
            f"±{BEYOND[-1]}{THIN}%; at most {harm.limit:g}{THIN}% may."
            f"{undecided(asked, harm.figure, clustered=True)}{beside}",
            remedy="A dearer move (evaluate_setpoint.baselines.bayes_robust.move_fixed_cost), or a "
            "classifier with a smaller spread.",
        )

    return held(board.learned()), held(board.baseline())


def share_in(row: Mapping[str, Any] | None) -> Figure | None:
    """A share with its interval as train_classifier.json gives it; None where it counts no window."""
    ends = [None if row is None else row.get(key) for key in ("percent", "low", "high")]
    if any(end is None for end in ends):
        return None
    value, low, high = (float(end) for end in ends if end is not None)
    return Figure(value, low, high)


def _right_by_flow(sources: Sources, limit: float) -> Pair:
    """Windows named rightly were every flow from 70 to 150 % as frequent; yardsticks are not judged so."""
    name, found = f"Right, 70–150{THIN}% of flow", lookup(sources.metrics["train_classifier"], "right_70_150")
    share = found if isinstance(found, Missing) else share_in(found)
    figure = share or Missing(OPEN, "no window lies between 70 and 150 % of flow")
    question = Question(0, "right_70_150", name, "%", limit, True, "")
    mine = Rule(
        name,
        question,
        figure,
        text=share_text(figure),
        limit=f"≥ {limit:g}{THIN}%",
        place="by-flow",
        reason=figure.sentence()
        if isinstance(figure, Missing)
        else f"Were every flow from 70 to 150{THIN}% as frequent, {share_text(figure)} of the windows would "
        f"be named rightly; {limit:g}{THIN}% are asked for.{undecided(question, figure, clustered=True)}",
        remedy="More segments to train on (render_frames.segments), or another view of the nozzle.",
    )
    gap = Missing("not applicable", "the yardsticks are judged on windows of all flows")
    return mine, mine._replace(figure=gap, text="not judged so")


def undecided(question: Question, figure: Figure, *, clustered: bool = False) -> str:
    """What would tell, where the interval straddles the limit: of runs that share nothing
    z^2 p (1 - p) / (p - limit)^2 at 95 %; of clustered ones the segments by which the interval shrinks."""
    if state(question, figure) != UNDECIDED:
        return ""
    p, off = figure.value / 100, abs(figure.value - question.limit) / 100
    if clustered:
        times = ((figure.high - figure.low) / 200 / off) ** 2 if off else math.inf
        more = (
            f"about {number(max(math.ceil(times - 1e-6), 2), 0)} times as many segments would decide"
            if times < 1000
            else "no number of segments would decide"
        )
        return f" Its interval, {band(figure.low, figure.high, 1)}, straddles that; {more}."
    needed = 1.96**2 * p * (1 - p) / off**2 if off else math.inf
    more = (
        f"about {_round(needed):,} runs in all would decide"
        if needed < 1e7
        else "no number of runs would decide"
    )
    return f" Its interval, {band(figure.low, figure.high, 1)}, straddles that; {more}."


def _round(value: float) -> int:
    power = 10 ** max(math.floor(math.log10(max(value, 1))) - 1, 0)
    return math.ceil(value / power) * power


NAMES = {"svc": "support vector machine", "cnn": "convolutional network", "width": "width rule"}
BRIEF = {"svc": "SVC", "cnn": "CNN", "width": "width"}


def _accurate(sources: Sources, question: Question, others: Sequence[str], of: str) -> Pair:
    """The classifier's accuracy, beside the best of its yardsticks."""
    metrics, kind = sources.metrics["train_classifier"], question.key.removesuffix("_accuracy")
    mine = accuracy(metrics, kind)
    beside = [
        (figure, other)
        for other in others
        if isinstance(figure := accuracy(metrics, f"{other}_{kind}"), Figure)
    ]
    best, who = max(
        beside, key=lambda pair: pair[0].value, default=(Missing("not measured", "no yardstick"), "")
    )
    reason = (
        mine.sentence()
        if isinstance(mine, Missing)
        else f"The classifier names {share_text(mine)} of {of} rightly; "
        f"{question.limit:g}{THIN}% are asked for.{undecided(question, mine, clustered=True)}"
    )
    rule = Rule(
        question.title,
        question,
        mine,
        text=share_text(mine),
        limit=f"≥ {question.limit:g}{THIN}%",
        place="vision",
        reason=reason,
        remedy="More segments to train on (render_frames.segments), or another view of the nozzle.",
    )
    return rule, rule._replace(figure=best, text=share_text(best) + (f" {BRIEF[who]}" if who else ""))


def accuracy(metrics: Mapping | Missing, name: str) -> Figure | Missing:
    """In percent, with the interval where the stage gives one."""
    value = lookup(metrics, f"{name}_accuracy")
    if isinstance(value, Missing):
        return value
    ends = lookup(metrics, f"intervals_percent.{name}")
    return Figure(100 * value, *((100 * value,) * 2 if isinstance(ends, Missing) else map(float, ends)))


def _calibrated(sources: Sources, name: str, limit: float, keys: tuple[str, str]) -> Pair:
    mine, raw = (lookup(sources.metrics["train_classifier"], key) for key in keys)
    texts = [OPEN if isinstance(value, Missing) else number(value, 3) for value in (mine, raw)]
    rule = Rule(
        name,
        Question(0, keys[0], name, "", limit, False, ""),
        _plain(mine),
        text=texts[0],
        limit=f"≤ {limit:g}",
        place="reliability",
        reason="It was not measured."
        if isinstance(mine, Missing)
        else (
            f"Stated and true shares of right answers differ by {texts[0]} on average; {limit:g} is allowed."
        ),
        remedy="Calibrate on more segments (render_frames.segments.calibration).",
    )
    return rule, rule._replace(figure=_plain(raw), text=texts[1])


def _plain(value: float | Missing) -> Figure | Missing:
    return value._replace(state=OPEN) if isinstance(value, Missing) else count_of(value)


# ---- the verdict


def verdict(sources: Sources) -> Verdict:
    """Who sets flow and temperature by default: `winner`, "" where nobody chose. `note` says of what printers
    anything is claimed."""
    scores = board(sources)
    recorded = sources.declared.everything.get("train_classifier", {}).get("source") == "recordings"
    claim, words = CLAIM_RECORDED if recorded else CLAIM, words_for(recorded=recorded, quick=sources.quick)
    if recorded and lookup(sources.metrics["train_classifier"], "data.windows_apart") is False:
        claim += NOT_APART
    if isinstance(scores, Missing) or not scores.default:
        gap = scores if isinstance(scores, Missing) else sources.tables["choice"]
        return Verdict(
            loop="setpoint",
            state=OPEN,
            decision=words.undecided,
            lead="No controller was chosen.",
            reason=gap.sentence()
            if isinstance(gap, Missing)
            else "The choice names a controller that was not judged.",
            remedy="",
            rule="",
            winner="",
            note=claim,
            rules=rules(sources, None if isinstance(scores, Missing) else scores),
        )
    lines, name = rules(sources, scores), named(scores, scores.default)
    column = int(scores.kinds[scores.default] == BASELINE)
    asked = [line[0 if of_classifier(line[0]) else column] for line in lines]
    ended, first = overall([rule.state for rule in asked]), deciding(asked)
    settled = Verdict(
        loop="setpoint",
        state=PASSED,
        decision=words.passed.format(name),
        lead=f"All {count(len(asked), 'rule')} passed.",
        reason=summary(sources, scores),
        remedy="",
        rule="",
        winner=scores.default,
        note=claim,
        rules=lines,
    )
    if first is None:
        return settled
    failed = first.state == FAILED
    return settled._replace(
        state=ended,
        decision=words.of(ended),
        lead=f"First {'failed' if failed else 'undecided'} rule: {first.name[:1].lower()}{first.name[1:]}.",
        reason=_closest(name, first),
        remedy=_conditions(asked, claim == CLAIM),
        rule=first.name,
    )


def _conditions(asked: Sequence[Rule], rendered: bool) -> str:
    """What would have to come out before the loop may steer: every rule that
    does not pass with its figure, and what to try."""
    short = [rule for rule in asked if rule.state != PASSED]
    figures = [
        f"{rule.name[:1].lower()}{rule.name[1:]} {rule.limit} (now "
        f"{rule.text}{', undecided' if rule.state == UNDECIDED else ''})"
        for rule in short
    ]
    real = " Recordings of the real printer: none are in (datasets/raw/setpoint)." if rendered else ""
    remedies = dict.fromkeys(rule.remedy for rule in short if rule.remedy)
    return f"Before it may: {', '.join(figures)}.{real} To try: {' '.join(remedies)}"


def _closest(name: str, rule: Rule) -> str:
    """Who comes closest, and how far it is off; a rule of the classifier holds whoever controls."""
    return (
        f"{rule.reason} By runs that settle and stay {name} comes closest."
        if of_classifier(rule)
        else f"Judged is {name}: {rule.reason[:1].lower()}{rule.reason[1:]}"
    )


def named(board: Board, name: str) -> str:
    """ "the agent “ours”", "the baseline “Bayes, robust”"."""
    kind = {AGENT: "the agent", PAPER: "the paper’s agent"}.get(board.kinds[name], "the baseline")
    return (
        kind
        if name.lower() in ("agent", "our agent", "ours", "the paper's agent", "paper", "the paper’s agent")
        else f"{kind} “{name}”"
    )


def _noise(choice: Any, mine: Figure, other: Figure) -> str:
    """The interval of the margin where the choice gives one, and whether it is within noise."""
    ends = [lookup(choice, f"margin_{end}") for end in ("low", "high")]
    if any(isinstance(end, Missing) for end in ends):
        return ", which is within the noise of these runs" if other.high >= mine.low else ""
    low, high = (float(end) for end in ends)
    within_noise = " and within noise" if low <= 0 <= high else ""
    return f" (95{THIN}% interval {band(low, high, 1)} points{within_noise})"


def summary(sources: Sources, board: Board) -> str:
    """The default's worst case, by how much it beats the next of those that may run, and,
    where the agent is neither, how far it came."""
    mine, place = worst(board, board.default, "lasting")
    if place is None:
        return ""
    runs = board.cells[board.default, place].runs
    text = f"In its worst case ({within(place)}) {share_text(mine)} of {runs:,} runs settle and stay"
    judged = [name for name in board.names if name != board.default and worst(board, name, "lasting")[1]]
    others = [name for name in judged if name not in board.refused]
    if not others:
        return f"{text}. {'Nothing else may run' if judged else 'Nothing else was judged'}."
    figure, where = worst(board, others[0], "lasting")
    margin = lookup(sources.tables["choice"], "margin")
    points = mine.value - figure.value if isinstance(margin, Missing) else float(margin)
    noise = _noise(sources.tables["choice"], mine, figure)
    rival = f"the next, {named(board, others[0])}, in its own ({within(where)}: {share_text(figure)})"
    text += (
        f", {number(abs(points), 1)} points {'more' if points > 0 else 'fewer'} than of {rival}{noise}."
        if abs(points) >= 0.05
        else f", as many as of {rival}."
    )
    learned = board.learned()
    if not learned or learned in (board.default, others[0]):
        return text
    figure, where = worst(board, learned, "lasting")
    if where is None:
        return text
    name = named(board, learned)
    if learned in board.refused:
        return f"{text} {name[:1].upper()}{name[1:]} may not run, for its harm."
    return f"{text} {name[:1].upper()}{name[1:]} did not earn it: {share_text(figure)} ({within(where)})."
