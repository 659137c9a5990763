"""Makes the verdict on the setpoint loop from the scoreboard and the classifier's figures: which controller
sets flow and temperature, and whether it may steer."""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import pandas as pd

from pipeline.setpoint.agents.criteria import BEYOND, harm_bar
from pipeline.setpoint.controllers import NO_CONTROL as DOES_NOTHING
from pipeline.verdict.digits import THIN, band, count, number, quantity
from pipeline.verdict.evidence import (
    Absent,
    Evidence,
    entry,
    gap_of,
    instead,
    known,
    lookup,
    need,
    need_figure,
    or_gap,
)
from pipeline.verdict.rules import Reading, ask, rows
from pipeline.verdict.verdict import (
    CERTIFICATE,
    FAILED,
    OPEN,
    PASSED,
    UNDECIDED,
    Figure,
    Missing,
    PairSentence,
    Question,
    Rule,
    Verdict,
    count_of,
    deciding,
    overall,
    state,
    words_for,
)

LOOP = "setpoint"
MODEL_BASED, DATA_DRIVEN, BASELINE = "model-based", "data-driven", "baseline"
SIMULATORS = {
    "paper": "The paper’s simulator",
    "recorded": "Classified windows",
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
NO_CLOG = Missing("not applicable", "nothing happens in this case")


class Cell(NamedTuple):
    """One controller in one case: shares of runs in percent with their 95 % intervals, or why one is missing.
    `median`, `p90`: steps until a run is inside for good; `overshoot`, `flow_error`: percent; `beyond`:
    shares of runs from good starts with a flow off by more than each of BEYOND points; `back`: share within
    +-15 % after a clog; `recovery_p95`: decisions until 95 % of the runs are inside again; `n_eff`: number of
    independent runs that a share is worth, by the share's name."""

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
    recovery_p95: float = math.nan
    n_eff: Mapping[str, float] = {}


# borders of the classes in percent of nominal flow
CLASS_BORDERS = (90.0, 110.0)
Case = tuple[str, str]  # simulator, case


class Board(NamedTuple):
    """The controllers that were judged, the best worst case first, with the kind of each; the cases in the
    table's order; the default controller ("" if none was chosen); the refused controllers, and why. Refused
    ones come after the others."""

    names: list[str]
    kinds: Mapping[str, str]
    cases: list[Case]
    cells: Mapping[tuple[str, Case], Cell]
    default: str
    refused: Mapping[str, str]

    def counting(self, name: str) -> list[tuple[Case, Cell]]:
        """Returns the cases that count for the choice."""
        return [(case, cell) for case in self.cases if (cell := self.cells.get((name, case))) and cell.counts]

    def baseline(self) -> str:
        """Returns the controller of the second column: the default unless it learned from data, otherwise the
        model-based one; "" if it was not judged."""
        if self.default and self.kinds[self.default] != DATA_DRIVEN:
            return self.default
        return self._judged(MODEL_BASED)

    def learned(self) -> str:
        """Returns the data-driven controller that competes: the default if it is data-driven, otherwise the
        best one."""
        mine = self.default and self.kinds[self.default] == DATA_DRIVEN
        return self.default if mine else self._judged(DATA_DRIVEN)

    def _judged(self, kind: Literal["model-based", "data-driven"]) -> str:
        return next((name for name in self.names if self.kinds[name] == kind), "")


def role(board: Board, name: str) -> str:
    """Returns the controller's mark by its kind: circle for data-driven, square for model-based, ring for
    baselines."""
    return {DATA_DRIVEN: "data_driven", MODEL_BASED: "model_based"}.get(board.kinds[name], "baseline")


def case_text(case: Case, *, whole: bool = False) -> str:
    """Returns the case in words: "accuracy 0.7, clog" -> "accuracy 70 %, clog"; `whole`: with the simulator's
    name before it."""
    simulator, name = case
    name = re.sub(rf"^{re.escape(simulator)}[, ]*", "", name) or "as it is"
    name = re.sub(r"accuracy (\d\.?\d*)", lambda match: f"accuracy {100 * float(match[1]):g}{THIN}%", name)
    return f"{SIMULATORS.get(simulator, simulator)}, {name}" if whole else name


def within(case: Case) -> str:
    """Returns the case in words, for the middle of a sentence."""
    text = case_text(case, whole=True)
    return text[:1].lower() + text[1:]


@or_gap
def board(evidence: Evidence, subject: str = "") -> Board | Missing:
    """Returns the board of all controllers that were judged. The default is the chosen one, or the `subject`
    of a verdict."""
    table, said = need(evidence.tables["scoreboard"]), known(evidence.tables["choice"], {})
    if not len(table["controller"]):
        remedy = "Run ./run dvc repro evaluate_setpoint"
        raise Absent(Missing("not measured", "the scoreboard is empty", remedy))
    rows: list[Any] = list(pd.DataFrame(table).itertuples())
    cells = {(row.controller, (row.simulator, row.case)): _cell(row) for row in rows}
    kinds = {row.controller: row.kind for row in rows}
    refused = {name: str(why) for name, why in (entry(said, "refused") or {}).items()}
    unranked = Board(list(kinds), kinds, list(dict.fromkeys(case for _, case in cells)), cells, "", refused)
    ranked = sorted(kinds, key=lambda name: (name not in refused, _rank(unranked, name)), reverse=True)
    chosen = subject or str(entry(said, "name") or "")
    return unranked._replace(names=ranked, default=chosen if chosen in kinds else "")


def _cell(row: Any) -> Cell:
    """Returns the cell of a row of the scoreboard."""
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
        row.recovery_p95_steps,
        {name: getattr(row, f"{name}_n_eff") for name in ("settled", "stay", f"beyond_{BEYOND[-1]}")},
    )


def _figure(value: float, low: float, high: float) -> Figure | Missing:
    if math.isnan(value):
        return Missing("not applicable", "runs end before")
    return Figure(value, value if math.isnan(low) else low, value if math.isnan(high) else high)


def lasting(cell: Cell) -> Figure | Missing:
    """Returns the share by which a case is judged: runs that reach and keep the target, or only reach it if
    runs end too early to tell."""
    return cell.stay if isinstance(cell.stay, Figure) else cell.settled


def _rank(board: Board, name: str) -> tuple[float, float]:
    values = [share.value for _, cell in board.counting(name) if isinstance(share := lasting(cell), Figure)]
    return (min(values), float(np.mean(values))) if values else (-1.0, -1.0)


def worst(board: Board, name: str, what: str) -> tuple[Figure | Missing, Case | None]:
    """Returns the smallest share `what` (settled, stay, lasting) of the cases that count, and its case."""
    shares = [
        (figure, case)
        for case, cell in board.counting(name)
        if isinstance(figure := lasting(cell) if what == "lasting" else getattr(cell, what), Figure)
    ]
    if not shares:
        return Missing("not measured", f"no case of {name or 'any controller'}"), None
    return min(shares, key=lambda pair: pair[0].value)


def share_text(figure: Figure | Missing) -> str:
    return quantity(figure.value, "%", 1) if isinstance(figure, Figure) else figure.state


# ---- the rules


# a pair for each rule: the data-driven controller's, and the best baseline's. A rule of the classifier
# applies to every controller
Pair = tuple[Rule, Rule]


def of_classifier(rule: Rule) -> bool:
    """Returns whether the rule is about the classifier, which every controller needs."""
    return any("see" in row.needed_for for row in rows(LOOP).values() if row.name == rule.name)


def rules(evidence: Evidence, board: Board | None) -> tuple[Pair, ...]:
    names = (board.learned(), board.baseline()) if board else ("", "")
    return tuple(
        (_rule(evidence, board, key, names[0], 0), _rule(evidence, board, key, names[1], 1))
        for key in rows(LOOP)
    )


def _rule(evidence: Evidence, board: Board | None, key: str, name: str, column: int) -> Rule:
    if control := CONTROL.get(key):
        return ask(LOOP, key, evidence, lambda question: control(evidence, board, name), name, undecided)
    own = (lambda question: SEEING[key](evidence, column)) if key in SEEING else None
    return ask(LOOP, key, evidence, own, name, undecided)


class Harm(NamedTuple):
    """The share of one controller's runs from good starts that leave +-25 %, and its limit, both in percent;
    its state, and the case."""

    figure: Figure
    limit: float
    state: str
    case: Case


def bars(evidence: Evidence, board: Board) -> dict[Case, float]:
    """Returns the percentage of runs from good starts that may leave +-25 %, by case; {} if it was not
    declared."""
    most = evidence.params.get("evaluate_setpoint", {}).get("most_harmed") or {}
    perfect, in_band = most.get("perfect_percent"), most.get("in_band_percent")
    if perfect is None or in_band is None:
        return {}
    harm = [case for case in board.cases if case[0] == "harm"]
    limits = {case: harm_bar(case[1], perfect=perfect, in_band=in_band) for case in harm}
    return {case: limit for case, limit in limits.items() if limit is not None}


def harm_of(board: Board, name: str, limits: Mapping[Case, float]) -> Harm | Missing:
    """Returns the case with a limit that decides: of those in the gravest state, the one furthest beyond its
    limit."""
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


def _share(what: str) -> Callable[[Evidence, Board | None, str], Reading]:
    """Returns a function that reads the smallest share `what` of the cases that count."""

    def read(evidence: Evidence, board: Board | None, name: str) -> Reading:
        if board is None:
            return Missing(OPEN, ""), {"reason": "Nothing was judged.", "remedy": ""}
        figure, case = worst(board, name, what)
        if case is None or not isinstance(figure, Figure):
            return figure, {"text": share_text(figure)}
        limit = float(getattr(evidence.rules, f"{what}_percent"))
        held, words = threshold(figure, board.cells[name, case].n_eff[what], limit, at_least=True)
        return held, words | {"segments": _segments(evidence), "within": within(case)}

    return read


# if a rule allows L percent of runs to be lost, controllers that lose L / 3 pass, and those that lose 2 L
# fail, in 19 of 20 repetitions. This needs at least so many independent runs that this many of them may be
# lost (binomial)
MAY_BE_LOST, LEAST_RUNS = 5.7, 190.0


def threshold(figure: Figure, n_eff: float, limit: float, *, at_least: bool) -> tuple[Figure, dict[str, Any]]:
    """Returns the figure for a rule, and words. The estimate itself is compared with the limit if it is worth
    enough independent runs. Otherwise its band is 0 to 100 and the rule is undecided. A limit of 97 % needs
    190 runs, harm of at most 1 % needs 570."""
    lost = 100 - limit if at_least else limit
    needed = max(LEAST_RUNS, 100 * MAY_BE_LOST / lost) if lost else math.inf
    words = {"text": share_text(figure), "limit": limit, "n_eff": n_eff, "needed": needed}
    return count_of(figure.value) if n_eff >= needed else Figure(figure.value, 0.0, 100.0), words


def _segments(evidence: Evidence) -> float:
    """Returns the number of recorded segments on which the controllers were judged."""
    return float(known(lookup(evidence.tables["choice"], "pair.segments"), math.nan))


def _harm(evidence: Evidence, board: Board | None, name: str) -> Reading:
    """Returns the reading of how often a good print is spoilt, with the same figure for no control."""
    limits = bars(evidence, board) if board else {}
    absent = {
        "reason": "Nothing was judged from good starts.",
        "remedy": "Run ./run dvc repro evaluate_setpoint.",
        "allowed": "",
    }
    if board is None or not limits:
        return Missing(OPEN, ""), absent
    harm = harm_of(board, name, limits)
    if not isinstance(harm, Harm):
        return Missing(OPEN, ""), absent | {"reason": harm.sentence()}
    idle = harm_of(board, DOES_NOTHING, limits)
    ends = sorted(set(limits.values()))
    n_eff = board.cells[name, harm.case].n_eff[f"beyond_{BEYOND[-1]}"]
    held, words = threshold(harm.figure, n_eff, harm.limit, at_least=False)
    return held, words | {
        "segments": _segments(evidence),
        "allowed": f"≤ {' or '.join(f'{end:g}' for end in ends)}{THIN}%",
        "case_text": case_text(harm.case, whole=True),
        "idle": f" With doing nothing {share_text(idle.figure)} do." if isinstance(idle, Harm) else "",
    }


def _seen(figure: Figure | Missing, text: str = "") -> Reading:
    """Returns the reading of a share of frames or windows."""
    return figure, {"text": text or share_text(figure)}


def share_in(row: Mapping[str, Any] | None) -> Figure | None:
    """Returns a share with its interval from train_classifier.json; None if no window was counted."""
    ends = [None if row is None else row.get(key) for key in ("percent", "low", "high")]
    if any(end is None for end in ends):
        return None
    value, low, high = (float(end) for end in ends if end is not None)
    return Figure(value, low, high)


@instead(lambda gap: _seen(gap))
def _right_by_flow(evidence: Evidence, column: int) -> Reading:
    """Returns the reading of the share of windows that would be classified correctly if every flow from 70 to
    150 % were equally frequent. References are not judged by it."""
    if column:
        return _seen(
            Missing("not applicable", "the yardsticks are judged on windows of all flows"), "not judged so"
        )
    row = need_figure(evidence.figures["train_classifier"], "right_70_150")
    return _seen(share_in(row) or Missing(OPEN, "no window lies between 70 and 150 % of flow"))


def _accuracy(evidence: Evidence, column: int) -> Reading:
    """Returns the reading of the classifier's accuracy or, in the second column, of the best of its
    references."""
    classifier = evidence.figures["train_classifier"]
    if not column:
        return _seen(accuracy(classifier, "image"))
    others = {name: accuracy(classifier, f"{name}_image") for name in BRIEF}
    known = {name: figure for name, figure in others.items() if isinstance(figure, Figure)}
    if not known:
        return _seen(Missing("not measured", "no yardstick"))
    best = max(known, key=lambda name: known[name].value)
    return _seen(known[best], f"{share_text(known[best])} {BRIEF[best]}")


@or_gap
def accuracy(metrics: Mapping | Missing, name: str) -> Figure | Missing:
    """Returns the accuracy in percent, with its interval if the stage gives one."""
    percent = 100 * need_figure(metrics, f"{name}_accuracy")
    low, high = known(lookup(metrics, f"intervals_percent.{name}"), (percent, percent))
    return Figure(percent, float(low), float(high))


def _calibration(*keys: str) -> Callable[[Evidence, int], Reading]:
    """Returns a function that reads the calibration error: of the classifier or, in the second column,
    without its calibration."""

    @instead(lambda gap: (gap._replace(state=OPEN), {"reason": "It was not measured."}))
    def read(evidence: Evidence, column: int) -> Reading:
        error = need_figure(evidence.figures["train_classifier"], keys[column])
        return count_of(error), {"text": number(error, 3)}

    return read


CONTROL = {"harm": _harm, "settled": _share("settled"), "stay": _share("stay")}
SEEING = {
    "image_accuracy": _accuracy,
    "right_70_150": _right_by_flow,
    "ece_image": _calibration("ece_image", "ece_image_raw"),
    "ece_window": _calibration("ece_window", "ece_window_counts"),
}


def undecided(question: Question, figure: Figure, words: Mapping[str, Any]) -> str:
    """Returns what would decide an undecided rule: for a share of runs, how many more segments; for a share
    of frames or windows with an interval across the limit, how many times as many."""
    if state(question, figure) != UNDECIDED:
        return ""
    if "n_eff" in words:
        more = words["segments"] * (words["needed"] / max(words["n_eff"], 1.0) - 1) - 1e-6
        told = f"about {math.ceil(more):,} more segments" if math.isfinite(more) else "more segments"
        return (
            f" Undecided: these runs are worth {number(words['n_eff'], 0)} that share nothing, of "
            f"{number(words['needed'], 0)}; {told} would decide."
        )
    off = abs(figure.value - question.limit)
    times = ((figure.high - figure.low) / 2 / off) ** 2 if off else math.inf
    more = (
        f"about {number(max(math.ceil(times - 1e-6), 2), 0)} times as many segments would decide"
        if times < 1000
        else "no number of segments would decide"
    )
    return f" Its interval, {band(figure.low, figure.high, 1)}, straddles that; {more}."


# references for the classifier
BRIEF = {"svc": "SVC", "width": "width"}


# ---- the verdict


def verdict(evidence: Evidence) -> Verdict:
    """Returns the verdict on who sets flow and temperature by default. `winner`: that controller, "" if none
    was chosen; `note`: for which printers the claim holds."""
    scores, recorded = board(evidence), evidence.recorded("train_classifier")
    claim, words = CLAIM_RECORDED if recorded else CLAIM, words_for(recorded=recorded, quick=evidence.quick)
    if isinstance(scores, Missing) or not scores.default:
        gap = gap_of(scores) or gap_of(evidence.tables["choice"])
        return Verdict(
            loop=LOOP,
            state=OPEN,
            decision=words.undecided,
            lead="No controller was chosen.",
            reason=gap.sentence() if gap else "The choice names a controller that was not judged.",
            remedy="",
            rule="",
            winner="",
            note=claim,
            rules=rules(evidence, known(scores, None)),
        )
    scores = _certified(evidence, scores)
    lines, refusal = rules(evidence, scores), evidence.refusal(LOOP, scores.default)
    asked = _asked(lines, scores)
    if refusal:
        gap = Missing(UNDECIDED, refusal)
        asked.append(Rule(CERTIFICATE, None, gap, text="refused", limit="passed", reason=refusal))
    name = named(scores, scores.default)
    ended, first = (
        overall([rule.state for rule in asked if _binding(rule)]),
        deciding(filter(_binding, asked)),
    )
    settled = Verdict(
        loop=LOOP,
        state=PASSED,
        decision=words.passed.format(name),
        lead=f"All {count(len(asked), 'rule')} passed.",
        reason=summary(evidence, scores),
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
        winner=None if refusal else scores.default,
        subject=scores.default,
        state=ended,
        decision=words.of(ended),
        lead=f"First {'failed' if failed else 'undecided'} rule: {first.name[:1].lower()}{first.name[1:]}.",
        reason=_closest(name, first),
        remedy=_conditions(asked, claim == CLAIM),
        rule=first.name,
    )


def _certified(evidence: Evidence, board: Board) -> Board:
    """Returns the board with its default. If the default's certificate is refused, the next controller that
    passes and is not refused becomes the default, if there is one."""
    if not evidence.refusal(LOOP, board.default):
        return board
    names = [name for name in board.names if name not in board.refused and not evidence.refusal(LOOP, name)]
    others = (board._replace(default=name) for name in names)
    passing = (
        other
        for other in others
        if all(rule.state == PASSED for rule in _asked(rules(evidence, other), other) if _binding(rule))
    )
    return next(passing, board)


def _asked(lines: Sequence[Pair], board: Board) -> list[Rule]:
    """Returns the rules for the default: those of the classifier, and those of its column."""
    column = int(board.kinds[board.default] != DATA_DRIVEN)
    return [line[0 if of_classifier(line[0]) else column] for line in lines]


def _binding(rule: Rule) -> bool:
    """Returns whether the loop cannot steer unless the rule passes."""
    row = next((row for row in rows(LOOP).values() if row.name == rule.name), None)
    return row is None or bool(row.needed_for)


def _conditions(asked: Sequence[Rule], rendered: bool) -> str:
    """Returns what is missing before the loop may steer: every rule that does not pass, with its figure and
    what to try."""
    short = [rule for rule in asked if rule.state != PASSED]
    figures = [
        f"{rule.name[:1].lower()}{rule.name[1:]} {rule.limit} (now "
        f"{rule.text}{', undecided' if rule.state == UNDECIDED else ''})"
        for rule in short
    ]
    real = " Recordings of the real printer: none yet; they go to datasets/raw/setpoint." if rendered else ""
    remedies = dict.fromkeys(rule.remedy for rule in short if rule.remedy)
    return f"Missing before it may run: {', '.join(figures)}.{real} To try: {' '.join(remedies)}"


def _closest(name: str, rule: Rule) -> str:
    """Returns who comes closest, and how far it is off. A rule of the classifier is the same for all
    controllers."""
    return (
        f"{rule.reason} By runs that settle and stay {name} comes closest."
        if of_classifier(rule)
        else f"Judged is {name}: {rule.reason[:1].lower()}{rule.reason[1:]}"
    )


def named(board: Board, name: str) -> str:
    """Returns the kind and the name: "the model-based controller “Bayes filter”", "the baseline “do
    nothing”"."""
    return f"the {board.kinds[name]}{'' if board.kinds[name] == BASELINE else ' controller'} “{name}”"


@instead(lambda gap: PairSentence("Model-based against data-driven: not measured.", None))
def pair_sentence(choice: Any) -> PairSentence:
    """Returns the comparison in words, on the same segments: "the Bayes filter brings 41.0 points more of its
    runs to the target and keeps them there than the paper's agent", or that more segments are needed."""
    head, pair = "Model-based against data-driven:", need_figure(choice, "pair")
    gap = need_figure(pair, "difference")
    a, b, winner = str(pair["a"]), str(pair["b"]), pair.get("winner")
    same = f"on the same {pair['segments']:,} segments, {count(pair['cases'], 'case')}"
    if winner not in (a, b):
        needed = pair.get("needed")
        more = (
            "no number of segments would tell" if needed is None else f"{needed:,} more segments would tell"
        )
        ends = band(pair["low"], pair["high"], 1)
        text = f"undecided between {_the(a)} and {_the(b)} {same} (90{THIN}% interval {ends} points); {more}"
        return PairSentence(f"{head} {text}.", None, f"{head} undecided; {more}.")
    other, sign = (b, 1) if winner == a else (a, -1)
    ends = band(*sorted(sign * pair[end] for end in ("low", "high")), 1)
    text = (
        f"{_the(winner)} brings {number(abs(gap), 1)} points more of its runs to the target and keeps them "
        f"there than {_the(other)} {same} (90{THIN}% interval {ends} points)"
    )
    short = f"{head} {winner}, {number(abs(gap), 1)} points more runs settle and stay than by "
    short = f"{short}{_the(other)} ({ends})."
    return PairSentence(f"{head} {text}.", winner, short)


def _the(name: str) -> str:
    return name if name.startswith("the ") else f"the {name}"


def summary(evidence: Evidence, board: Board) -> str:
    """Returns a sentence on the default's worst case."""
    mine, place = worst(board, board.default, "lasting")
    if place is None or not isinstance(mine, Figure):
        return ""
    cell = board.cells[board.default, place]
    worth = f", worth {number(cell.n_eff['stay'], 0)} that share nothing," if "stay" in cell.n_eff else ""
    runs = f"{share_text(mine)} of {cell.runs:,} runs{worth} settle and stay"
    return f"In its worst case ({within(place)}) {runs}."
