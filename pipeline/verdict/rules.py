"""Applies a row of rules.toml to a figure and makes a rule with its state and its sentences."""

import functools
import math
import tomllib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pydantic
from pydantic import Field

from pipeline.store import params
from pipeline.verdict.digits import THIN
from pipeline.verdict.evidence import Absent, Evidence, Figures
from pipeline.verdict.settings import ReportRules
from pipeline.verdict.verdict import OPEN, PASSED, UNDECIDED, Figure, Missing, Question, Rule, count_of

PATH = Path(__file__).with_name("rules.toml")
# a figure, and the words for the placeholders in its row's sentences
Reading = tuple[Figure | Missing, Mapping[str, Any]]
Limit = float | str


class Row(params.Section):
    """A rule. `figure`: a dotted path into the figures of a stage (datasets/<stage>/figures.json), with * for
    the worst of several and {controller} for a controller's own; or the name of a function of its loop.

    Its limit is a number, or the key of section `report` that holds one, times `scale`. `needed_for`: the
    uses that need this rule to pass. `fails` and `remedy`: a sentence, or a sentence for each case.
    """

    name: str
    figure: str
    at_least: Limit | None = None
    at_most: Limit | None = None
    below: Limit | None = None
    unit: str = ""
    scale: float = Field(1.0, gt=0)
    needed_for: list[str] = []
    fails: str | dict[str, str] = "{name} is {value} (limit {limit})."
    passes: str = ""
    remedy: str | dict[str, str] = ""
    title: str = ""  # above a row of a page; "": its name
    line: str = ""  # the line of the verdict in which it stands; "": its own
    answer: int = 0  # its number on the page of the temperature loop
    allowed: str = ""  # the limit as a page has it; "": with sign and unit
    place: str = ""  # the picture behind it
    beyond: str = "never"  # an infinite figure in words

    def limit(self, limits: ReportRules) -> float:
        """Returns the declared limit; infinite if the key is null."""
        (declared,) = [limit for limit in (self.at_least, self.at_most, self.below) if limit is not None]
        value = getattr(limits, declared) if isinstance(declared, str) else declared
        if value is None:
            return math.inf
        return math.nextafter(value, -math.inf) if self.below is not None else value * self.scale

    def question(self, key: str, limit: float) -> Question:
        """Returns the question that the rule asks."""
        at_least = self.at_least is not None
        return Question(
            self.answer, key, self.title or self.name, self.unit, limit, at_least, self.name, self.beyond
        )

    def limit_text(self, limit: float) -> str:
        """Returns the limit as a page shows it, such as "≤ 6 %"."""
        sign = "≥" if self.at_least is not None else "≤" if self.below is None else "<"
        text = self.allowed or f"{sign} {{limit:g}}{THIN if self.unit else ''}{self.unit}"
        return text.format(limit=limit)


# the uses that a rule of each loop can keep from passing
USES = {
    "temperature": {"trial"},
    "identification": {"design", "predict", "simulate"},
    "deposition": {"simulation", "machine", "learning"},
    "setpoint": {"control", "see"},
}
# limits of any size, for the keys alone
_ANY = ReportRules.model_construct(None, **dict.fromkeys(ReportRules.model_fields, 1.0))


@functools.cache
def _rows(path: Path) -> dict[str, dict[str, Row]]:
    try:
        loops = tomllib.loads(path.read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise ValueError(
            f"{path.name}: {error}; mend the row, or restore it with git checkout {path}"
        ) from None
    return {
        loop: {key: _row(path, loop, key, row) for key, row in each.items()} for loop, each in loops.items()
    }


def _row(path: Path, loop: str, key: str, fields: Mapping[str, Any]) -> Row:
    try:
        row = Row.model_validate(fields)
        row.limit(_ANY)
        row.figure.format(controller="")
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise ValueError(f"{path.name}: [{loop}.{key}] {where}: {first['msg']}") from None
    except KeyError as error:
        raise ValueError(
            f"{path.name}: [{loop}.{key}] figure: {{{error.args[0]}}} is unknown; write {{controller}}"
        ) from None
    except (AttributeError, ValueError):
        raise ValueError(
            f"{path.name}: [{loop}.{key}] expected one of at_least, at_most and below: a number, or a key of "
            f"section report ({', '.join(ReportRules.model_fields)})"
        ) from None
    if more := [use for use in row.needed_for if use not in USES.get(loop, ())]:
        raise ValueError(
            f"{path.name}: [{loop}.{key}] needed_for: {more[0]} is no use of this loop; expected "
            f"{', '.join(sorted(USES.get(loop, ())))}"
        )
    return row


def rows(loop: str) -> dict[str, Row]:
    """Returns the rules of a loop by their keys, in the order in which they are applied."""
    return _rows(PATH).get(loop, {})


# ---- figures by path


def at_path(figures: Figures, path: str, *, at_least: bool) -> Figure | Missing:
    """Returns the figure at a dotted path, or the worst of several. A mapping with q90, low and high is a
    quantile with its band."""
    values = [value for value in map(_as_figure, _leaves(figures, path.split("."))) if value is not None]
    if not values:
        keys = f"Its keys stand in datasets/{path.split('.')[0]}/figures.json"
        return Missing(OPEN, f"{path} is not among what the stages measured", keys)
    return (min if at_least else max)(values, key=lambda figure: figure.value)


def _leaves(data: Any, names: list[str]) -> Iterator[Any]:
    if not names:
        yield data
    elif isinstance(data, Mapping):
        keys = list(data) if names[0] == "*" else [key for key in names[:1] if key in data]
        for key in keys:
            yield from _leaves(data[key], names[1:])


def _as_figure(value: Any) -> Figure | None:
    if isinstance(value, Mapping) and value.get("q90") is not None:
        return Figure(value["q90"], value.get("low", value["q90"]), value.get("high", value["q90"]))
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return count_of(float(value)) if number else None


# ---- a rule


def judge(
    row: Row,
    question: Question,
    read: Callable[[], Reading],
    decides: Callable[[Question, Figure, Mapping[str, Any]], str] | None = None,
) -> Rule:
    """Returns the rule of a row with the figure from `read`, or with the gap if `read` raises Absent.

    `read` also returns words for the sentences. `limit` replaces the question's limit; `case` selects one of
    several sentences; `text`, `allowed`, `reason`, `fails`, `remedy` replace those of the row. `decides`
    returns what would decide an undecided rule.
    """
    try:
        figure, words = read()
    except Absent as absent:
        figure, words = absent.gap, {"remedy": ""}
    question = question._replace(limit=float(words.get("limit", question.limit)))
    allowed = words.get("allowed", row.limit_text(question.limit))
    if isinstance(figure, Missing):
        remedy = row.remedy if isinstance(row.remedy, str) else ""
        return Rule(
            row.name,
            question,
            figure,
            words.get("text", OPEN),
            allowed,
            row.place,
            words.get("reason", figure.sentence()),
            words.get("remedy", remedy),
        )
    case, text = words.get("case", ""), words.get("text", _text(figure.value, row.unit))
    rule = Rule(row.name, question, figure, text, allowed, row.place)
    fails = words.get("fails") or (row.fails if isinstance(row.fails, str) else row.fails[case])
    remedy = words.get("remedy") or (row.remedy if isinstance(row.remedy, str) else row.remedy[case])
    places = {
        "name": row.name,
        "value": text,
        **words,
        "limit": words.get("limit_words") or _text(question.limit, row.unit),
        "undecided": decides(question, figure, words) if decides and rule.state == UNDECIDED else "",
    }
    sentence = row.passes if row.passes and rule.state == PASSED else fails
    try:
        return rule._replace(reason=sentence.format(**places), remedy=remedy.format(**places))
    except (KeyError, IndexError, ValueError) as error:
        raise ValueError(
            f"{PATH.name}: a sentence of the rule {row.name} has no place for {error}; it may use "
            f"{', '.join(f'{{{place}}}' for place in sorted(places))}"
        ) from None


def ask(
    loop: str,
    key: str,
    evidence: Evidence,
    own: Callable[[Question], Reading] | None = None,
    controller: str = "",
    decides: Callable[[Question, Figure, Mapping[str, Any]], str] | None = None,
    row: Row | None = None,
) -> Rule:
    """Returns the rule `key` of a loop for a controller. Its figure comes from the function `own`, or else
    from its path. `row` replaces the row of rules.toml."""
    row = row or rows(loop)[key]
    question = row.question(key, row.limit(evidence.rules))

    def read() -> Reading:
        if own:
            return own(question)
        path = row.figure.format(controller=controller)
        return at_path(evidence.figures, path, at_least=question.at_least), {}

    return judge(row, question, read, decides)


def _text(value: float, unit: str) -> str:
    return f"{value:g}{THIN if unit else ''}{unit}"
