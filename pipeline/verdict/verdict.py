"""What the verdicts of all loops are made of: a figure, the rule that limits it, the choice of the rule that
decides, and the verdict. It reads no page. Its only files are those of the stage `verdict`."""

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from pipeline.store import artifacts

PASSED, FAILED, UNDECIDED, OPEN = "passed", "failed", "undecided", "not measured"
# state of a rule that cannot be judged until its subject is declared
UNJUDGED = "not applicable"
# the rule for a controller with a refused certificate; it has no row in rules.toml
CERTIFICATE = "certificate"


class Figure(NamedTuple):
    """A median and its 90 % band; infinite if a run never settles, or no delay makes a loop unstable. `runs`:
    the repetitions behind them, if known."""

    value: float
    low: float
    high: float
    runs: tuple[float, ...] = ()
    note: str = ""


class Missing(NamedTuple):
    """Takes the place of a figure: its state (not measured, failed, not applicable, stale), why, and what to
    do."""

    state: str
    reason: str
    remedy: str = ""

    def sentence(self) -> str:
        return " ".join(part for part in (_ended(self.reason), _ended(self.remedy)) if part)


def _ended(text: str) -> str:
    text = text.strip()
    return text if not text or text.endswith((".", "!", "?")) else text + "."


class Question(NamedTuple):
    """One row of page one: the answer's number, the figure's key, its title, unit and limit, and the rule
    that it belongs to."""

    answer: int
    key: str
    title: str
    unit: str
    limit: float
    at_least: bool
    rule: str
    beyond: str = "never"


Answers = Mapping[str, Figure | Missing]


def state(question: Question, figure: Figure | Missing) -> str:
    """Returns passed if the whole band is inside the limit, failed if the whole band is outside, undecided if
    the limit lies within the band. A Missing is failed or not measured."""
    if isinstance(figure, Missing):
        return FAILED if figure.state == FAILED else OPEN
    best, worst = (figure.high, figure.low) if question.at_least else (figure.low, figure.high)
    inside = (lambda end: end >= question.limit) if question.at_least else (lambda end: end <= question.limit)
    return PASSED if inside(worst) else UNDECIDED if inside(best) else FAILED


def share(question: Question, value: float) -> float:
    """Returns the share of the allowance that is used: value / limit, or required / actual if more is better.
    If the limit is 0: 0 or infinite."""
    if not question.limit:
        return math.inf if value > 0 else 0.0
    if question.at_least:
        return math.inf if value <= 0 else 0.0 if math.isinf(value) else question.limit / value
    return math.inf if math.isinf(value) else value / question.limit


# ---- rules


def count_of(number: float) -> Figure:
    """Returns a figure that was counted or computed once. Its band is the value itself."""
    return Figure(number, number, number)


class Rule(NamedTuple):
    """One rule applied to one controller: the question, and the figure with its band.

    `text` and `limit` are figure and limit as the page shows them; `place`: id of the picture that shows it;
    `reason`: a sentence on why the rule does not pass; `remedy`: what to do then. A rule without a question,
    such as drift, has the state of its Missing, and passes if nothing is missing.
    """

    name: str
    question: Question | None
    figure: Figure | Missing
    text: str = ""
    limit: str = ""
    place: str = ""
    reason: str = ""
    remedy: str = ""

    @property
    def state(self) -> str:
        """Passed, failed, undecided (the limit lies within the band) or not measured."""
        if self.question is None:
            return self.figure.state if isinstance(self.figure, Missing) else PASSED
        return state(self.question, self.figure)


# order in which the deciding rule is chosen: by gravity, or failed rules before all that are open
BY_SEVERITY = ((FAILED,), (UNDECIDED,), (OPEN,))
FAILED_FIRST = ((FAILED,), (UNDECIDED, OPEN))


def deciding(rules: Iterable[Rule], order: Sequence[Sequence[str]] = BY_SEVERITY) -> Rule | None:
    """Returns the rule that decides: the first one in the gravest state; None if no rule failed or is
    open."""
    rules = list(rules)
    return next((rule for states in order for rule in rules if rule.state in states), None)


def worst_state(states: Sequence[str]) -> str:
    """Returns the gravest of these states: failed, undecided, not measured, passed."""
    return next((wanted for group in BY_SEVERITY for wanted in group if wanted in states), PASSED)


def overall(states: Sequence[str]) -> str:
    """Returns the state of a verdict with rules in these states: failed, open or passed."""
    return {FAILED: FAILED, PASSED: PASSED}.get(worst_state(states), OPEN)


# ---- the verdict


class Words(NamedTuple):
    """The wording of a verdict. A verdict on simulated machines says that it is one."""

    passed: str
    failed: str
    undecided: str

    def of(self, state: str) -> str:
        """Returns the words for a verdict in this state. `passed` has a placeholder for the controller."""
        return {PASSED: self.passed, FAILED: self.failed}.get(state, self.undecided)


SIMULATION = Words("Pass (simulation): {}.", "Fail (simulation).", "Undecided (simulation).")
NOT_READY = "Not ready for a supervised trial."
TRIAL = Words("Ready for a supervised trial: {}.", NOT_READY, NOT_READY)
# a quick look has few plants and short searches, which is not enough to pass a simulation or a trial
QUICK = Words("Quick look passed: {}.", "Quick look failed.", "Quick look undecided.")


def words_for(*, recorded: bool, quick: bool) -> Words:
    """Returns the words for a run on recordings or on simulated machines. A quick look says that it is
    one."""
    return QUICK if quick else TRIAL if recorded else SIMULATION


class PairSentence(NamedTuple):
    """Model-based against data-driven: the answer in words, the better one (None if undecided), the answer in
    short, and a remark."""

    text: str
    winner: str | None
    short: str = ""
    note: str = ""


class Verdict(NamedTuple):
    """The decision on one loop, and the rule that decides it.

    `state`: passed, failed or not measured. Decision, lead, reason, remedy and note are whole sentences.
    `rule`: name of the rule that decides, "" if all passed; `winner`: the controller that should run;
    `rules`: a line for each rule, and in it an entry for each controller shown; `subject`: the controller
    that the verdict is about, passed or not; `rehearsal`: it was judged on simulated data; `answer`: says
    which is better, model-based or data-driven, in a sentence; `short_answer`: the same in few words.
    """

    loop: str
    state: str
    decision: str
    lead: str
    reason: str
    remedy: str
    rule: str
    winner: str | None
    note: str = ""
    rules: tuple[tuple[Rule, ...], ...] = ()
    subject: str = ""
    rehearsal: bool = False
    answer: str = ""
    short_answer: str = ""

    @property
    def word(self) -> str:
        """The class of the verdict on a page: passed, failed or open."""
        return {PASSED: "passed", FAILED: "failed"}.get(self.state, "open")

    @property
    def sentence(self) -> str:
        """The decision, and the rule that decided it: "Fail (simulation). First failed rule: settling." """
        return f"{self.decision} {self.lead}".strip()

    def metrics(self) -> dict[str, str | bool | None]:
        """Returns what datasets/report/figures.json keeps of it."""
        return {name: getattr(self, name) for name in WRITTEN}


WRITTEN = (
    "state", "decision", "lead", "reason", "remedy", "rule", "winner", "subject", "rehearsal", "answer",
    "short_answer",
)  # fmt: skip


# ---- the files of the stage `verdict`

LOOPS = ("temperature", "deposition", "setpoint")
CERTIFICATES = "certificates.json"


def write(verdicts: Mapping[str, Verdict], folder: str | Path) -> None:
    """Writes each verdict to `folder`/<loop>.json. Equal verdicts give equal bytes."""
    for loop, verdict in verdicts.items():
        lines = [[_encode(rule) for rule in line] for line in verdict.rules]
        # the controller that the rules would name but whose certificate is refused; the certificate is still
        # exported
        refused = verdict.subject if verdict.rule == CERTIFICATE else None
        fields = {**verdict._asdict(), "rules": lines, "refused": refused}
        artifacts.write_json(Path(folder) / f"{loop}.json", fields)


def read(folder: str | Path, names: Sequence[str] = LOOPS) -> dict[str, Verdict]:
    """Returns the verdicts that `write` wrote, by loop. A loop that is switched off has no file and is left
    out."""
    files = {loop: Path(folder) / f"{loop}.json" for loop in names}
    return {
        loop: _decode(artifacts.read_json(path)) for loop, path in files.items() if artifacts.exists(path)
    }


def read_certificates(folder: str | Path) -> dict[str, dict[str, dict[str, Any]]]:
    """Returns {loop: {controller: {"passed", "why"}}} by the limits of the run, as the stage wrote it in the
    folder of the verdicts; {} if it has not run."""
    path = Path(folder) / CERTIFICATES
    return artifacts.read_json(path) if artifacts.exists(path) else {}


def _encode(rule: Rule) -> dict[str, Any]:
    """Returns a rule for JSON. JSON has no infinity, so a number that is not finite is text."""
    figure, question = rule.figure, rule.question
    return rule._asdict() | {
        "figure": {name: _text(value) for name, value in figure._asdict().items()},
        "question": question and {name: _text(value) for name, value in question._asdict().items()},
        "state": rule.state,
    }


def _text(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_text(item) for item in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _decode(fields: Mapping[str, Any]) -> Verdict:
    return Verdict(**{name: fields[name] for name in Verdict._fields})._replace(
        rules=tuple(tuple(_rule(rule) for rule in line) for line in fields["rules"])
    )


def _rule(fields: Mapping[str, Any]) -> Rule:
    figure, question = fields["figure"], fields["question"]
    values = {name: value for name, value in fields.items() if name != "state"}
    return Rule(**values)._replace(
        figure=Missing(**figure)
        if "state" in figure
        else Figure(
            *(float(figure[end]) for end in ("value", "low", "high")),
            runs=tuple(map(float, figure["runs"])),
            note=figure["note"],
        ),
        question=question and Question(**question)._replace(limit=float(question["limit"])),
    )
