"""The temperature loop's figures as the README has them: metrics and verdict of a run -> Markdown."""

import math

from pipeline.report.shared.verdict import Figure, Missing, Question, ReportRules, Verdict
from pipeline.report.temperature.answers import Metrics, comparison, judged, of_contestant, refused
from pipeline.report.temperature.contestants import heading, kind
from pipeline.report.temperature.pairs import deciding_sentence, pair_sentence
from pipeline.report.temperature.scorecard import UNRULED, setting
from pipeline.report.temperature.verdict import questions
from pipeline.report.temperature.wording import places_of, worded

SHOWN = ("settled_error", "settling", "overshoot", "at_limits", "cost", "crossings")
BEGIN, END = "<!-- temperature: written by ./run python -m tests.test_docs -->", "<!-- /temperature -->"


def block(metrics: Metrics, rules: ReportRules, verdict: Verdict) -> str:
    """What stands between BEGIN and END."""
    compared = comparison(metrics)
    names = judged(metrics)
    if not names:
        return f"{BEGIN}\nThe temperature loop is not judged yet.\n{END}"
    asked = {question.key: question for question in (*questions(rules, compared), *UNRULED)}
    shown = [asked[key] for key in SHOWN]
    lines = [
        f"**{verdict.decision}** {verdict.lead} {verdict.reason}",
        "",
        f"{pair_sentence(metrics).text} {deciding_sentence(metrics, verdict.winner)}".strip(),
        "",
        f"As deployed on {setting(compared)}; 90 % quantile of all cases:",
        "",
        f"| | {' | '.join(_head(question) for question in shown)} |",
        f"|---|{'---|' * len(shown)}",
        *(f"| {heading(name)} ({kind(name)}) | {_cells(metrics, name, shown)} |" for name in names),
    ]
    lines += [
        f"| {heading(name)} | {why} |{' |' * (len(shown) - 1)}" for name, why in refused(metrics).items()
    ]
    return plain("\n".join([BEGIN, *lines, END]))


def _head(question: Question) -> str:
    limit = f", at most {question.limit:g} {question.unit}" if math.isfinite(question.limit) else ""
    return f"{question.title[:1].lower()}{question.title[1:]}{limit.rstrip()}"


def _cells(metrics: Metrics, name: str, shown: list[Question]) -> str:
    figures = of_contestant(metrics, name)
    return " | ".join(_cell(question, figures[question.key]) for question in shown)


def _cell(question: Question, figure: Figure | Missing) -> str:
    if isinstance(figure, Missing):
        return figure.state
    return worded(question, figure.value, places_of(question, [figure]))


def plain(text: str) -> str:
    """Spaces that a text file can be searched by."""
    return text.replace("\u202f", " ").replace("\u00a0", " ")


def rewritten(readme: str, text: str, begin: str = BEGIN, end: str = END) -> str:
    """The README with another block between two lines. Raises ValueError where it has none."""
    if begin not in readme or end not in readme:
        raise ValueError(f"README.md: expected the lines {begin} and {end}, found none; put them back")
    before, rest = readme.split(begin, 1)
    return f"{before}{text}{rest.split(end, 1)[1]}"
