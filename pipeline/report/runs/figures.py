"""Metrics of a run, of any version -> the figures of all three loops with their bands, and why one is not
there. No file, no page."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from pipeline.report.shared.digits import MINUS, beyond_meaning, short
from pipeline.report.shared.verdict import Figure, Question, ReportRules
from pipeline.report.temperature.verdict import questions
from pipeline.setpoint.workflow.tables import harm_bar
from pipeline.store import renamed

LOOPS = ("temperature", "deposition", "setpoint")
# the files of reports/metrics that figures are read off
FILES = (
    "report",
    "evaluate_temperature",
    "compose_parts",
    "train_ilc",
    "evaluate_setpoint",
    "train_classifier",
)
# what a loop's figures are of
STAGES = {
    "temperature": ("evaluate_temperature",),
    "deposition": ("compose_parts", "train_ilc"),
    "setpoint": ("evaluate_setpoint", "train_classifier"),
}

# names of the comparison before controllers were judged as deployed: same keys, other figures
BEFORE = ("window", "model_based", "baseline", "kernel", "data_driven")


class Column(NamedTuple):
    """A figure that the table of runs has: its loop ("" for a metric that somebody named), the stage that
    gives it, and what is asked of it."""

    loop: str
    stage: str
    question: Question

    @property
    def key(self) -> str:
        return f"{self.loop}.{self.question.key}" if self.loop else self.question.key


class Measured(NamedTuple):
    """Of a run {key of the column: its figure}, {key: why it is not there}, whose figures they are by loop,
    and each loop's verdict in a word."""

    figures: Mapping[str, Figure]
    missing: Mapping[str, str]
    controllers: Mapping[str, str]
    verdicts: Mapping[str, str]


class Cell(NamedTuple):
    """A figure in words, the number that its column sorts by, and whether it lies beyond today's limit."""

    text: str
    number: float | str = ""
    bad: bool = False


def cell(figure: Figure | None, question: Question) -> Cell:
    """What a table of runs shows of a figure."""
    if figure is None:
        return Cell("not measured")
    beyond = figure.value < question.limit if question.at_least else figure.value > question.limit
    if not math.isfinite(figure.value):
        return Cell(question.beyond, "", beyond)
    text = beyond_meaning(figure.value, question.unit) or short(figure.value, 3).replace("-", MINUS)
    return Cell(text, rounded(figure.value), beyond and math.isfinite(question.limit))


def rounded(value: float) -> float:
    """Six digits: more would differ between runs without a meaning."""
    return float(f"{value:.6g}")


def parts_questions(rules: ReportRules) -> list[Question]:
    return [
        Question(
            0, "flow_error_percent", "Worst flow error of a part", "%", rules.flow_error_percent, False, ""
        ),
        Question(0, "line_volume_percent", "Worst line’s volume", "%", rules.line_volume_percent, False, ""),
        Question(0, "learned_percent", "Left after learning", "%", rules.learned_percent, False, ""),
    ]


def setpoint_questions(rules: ReportRules) -> list[Question]:
    right = 100 * rules.window_right_70_150
    return [
        Question(0, "settled", "Settles, worst case", "%", rules.settled_percent, True, ""),
        Question(0, "stay", "Stays, worst case", "%", rules.stay_percent, True, ""),
        Question(0, "harm", "Good prints spoilt, worst case", "%", math.inf, False, ""),
        Question(0, "right_70_150", "Windows right, 70–150 % of flow", "%", right, True, ""),
    ]


def columns(rules: ReportRules) -> list[Column]:
    """What the table of runs has of the three loops, in its order."""
    asked = [*questions(rules, {}), Question(0, "cost", "Cost as deployed", "", math.inf, False, "")]
    heat = [Column("temperature", "evaluate_temperature", question) for question in asked]
    parts = [
        Column("deposition", "train_ilc" if question.key == "learned_percent" else "compose_parts", question)
        for question in parts_questions(rules)
    ]
    camera = [
        Column("setpoint", "train_classifier" if q.key == "right_70_150" else "evaluate_setpoint", q)
        for q in setpoint_questions(rules)
    ]
    return [*heat, *parts, *camera]


def named(metric: str) -> Column:
    """The column of a metric as STAGE:dotted.key of reports/metrics. Raises ValueError where it is none."""
    stage, _, key = metric.partition(":")
    if not stage.isidentifier() or not key:
        raise ValueError(
            "expected a metric as STAGE:dotted.key, such as "
            f"tune_weights:contestants.subspace_lqg.cost, found {metric}"
        )
    return Column("", stage, Question(0, metric, metric, "", math.inf, False, ""))


# ---- plain data of unknown shape


def section(data: Any, key: str) -> dict:
    """What stands under a key; {} where that is no section."""
    found = data.get(key) if isinstance(data, Mapping) else None
    return found if isinstance(found, dict) else {}


def at(data: Any, key: str) -> Any:
    """What stands at a dotted key; a name may have dots of its own, such as "accuracy 0.9". None where
    nothing does."""
    if not key:
        return data
    names = key.split(".")
    for many in range(len(names), 0, -1):
        name = ".".join(names[:many])
        if isinstance(data, Mapping) and name in data:
            return at(data[name], ".".join(names[many:]))
    return None


def finite(value: Any) -> float | None:
    """A number that a figure may be; None for all else, True and NaN among it."""
    if isinstance(value, bool) or not isinstance(value, int | float) or math.isnan(value):
        return None
    try:
        return float(value)
    except OverflowError:
        return None


def figure(ends: Any, middle: str = "median") -> Figure | None:
    """A figure of {middle, low, high}; null is without end. None for data that are no figure."""
    if not isinstance(ends, Mapping) or not {middle, "low", "high"} <= ends.keys():
        return None
    value, low, high = (
        math.inf if ends[end] is None else finite(ends[end]) for end in (middle, "low", "high")
    )
    return None if value is None or low is None or high is None else Figure(value, low, high)


def figures(bands: Any) -> dict[str, Figure]:
    """{key: figure} of {key: median, low and high}; what is no figure is left out."""
    items = bands.items() if isinstance(bands, Mapping) else ()
    return {str(key): found for key, ends in items if (found := figure(ends))}


def _once(value: float) -> Figure:
    return Figure(value, value, value)


def today(files: Mapping[str, dict]) -> dict[str, dict]:
    """{stage: its metrics} of any version under today's names. Only stages of which a name changed are looked
    through: the others are large, and there may be a thousand runs."""
    concerned = {name.split(".")[0] for entry in renamed.METRICS.items() for name in entry}
    old = {name: data for name, data in files.items() if name in concerned}
    return {**files, **renamed.metrics(old)}


# ---- the loops


def contestant(own: Any) -> dict[str, Figure]:
    """The quantiles of one contestant of evaluate_temperature.json with their bands, its crossings of limits,
    and its margins on the median plant."""
    items = own.items() if isinstance(own, Mapping) else ()
    found = {str(key): figure(ends, "q90") for key, ends in items}
    counted = {"crossings": finite(section(own, "crossings").get("cases"))}
    for key, ends in section(own, "margins").items():
        counted[str(key)] = finite(ends.get("median")) if isinstance(ends, Mapping) else None
    exact = {key: _once(value) for key, value in counted.items() if value is not None}
    return exact | {key: each for key, each in found.items() if each}


def deposition(parts: Mapping, laws: Mapping) -> dict[str, Figure]:
    """Worst flow error and worst line of the composers in use, and the share of trial 0's error that is left
    after learning, in %. Each is the worst material's."""
    streams = [
        stream
        for part in parts.values()
        if isinstance(part, dict)
        for stream in part.values()
        if isinstance(stream, dict)
    ]
    used = [section(stream, str(stream.get("chosen"))) for stream in streams]
    learned = [
        section(material, law).get("last_ratio", section(material, law).get("best_ratio"))
        for material in laws.values()
        for law in ("pixels", "model_inverse")
        if section(material, law)
    ]
    values = {
        "flow_error_percent": [composer.get("rms_percent_of_on_off") for composer in used],
        "line_volume_percent": [composer.get("worst_line_volume_percent") for composer in used],
        "learned_percent": [100 * ratio for ratio in map(finite, learned) if ratio is not None],
    }
    numbers = {key: [n for n in map(finite, column) if n is not None] for key, column in values.items()}
    return {key: _once(max(column)) for key, column in numbers.items() if column}


def setpoint(judged: Mapping, classifier: Mapping) -> dict[str, Figure]:
    """Of the default: the least share of runs that settle, and that settle and stay, over the cases that
    count; the largest share of good prints that it spoils (beyond 25 points) over the cases that have a bar;
    and the windows that the classifier names rightly. In %; runs of earlier versions kept no bands."""
    name = judged.get("default")
    own = section(judged, name) if isinstance(name, str) else {}
    # earlier versions kept the cases of the default below its name only
    earlier = {case: row for group in ("paper", "recorded") for case, row in section(own, group).items()}
    cases = [row for row in (section(judged, "cases") or earlier).values() if isinstance(row, dict)]
    settled = [share for row in cases if (share := finite(row.get("settled"))) is not None]
    found = {"settled": _once(min(settled))} if settled else {}
    stays = [(share, row) for row in cases if (share := finite(row.get("stay"))) is not None]
    if stays:
        share, row = min(stays, key=lambda pair: pair[0])
        found["stay"] = figure(row, "stay") or _once(share)
    spoilt = []
    for case, row in (section(judged, "harm") or section(own, "harm")).items():
        share = finite(row.get("beyond_25")) if isinstance(row, dict) else None
        if share is not None and harm_bar(str(case), perfect=1.0, in_band=1.0) is not None:
            ends = {end: row.get(f"beyond_25_{end}", share) for end in ("low", "high")}
            spoilt.append(figure({"median": share, **ends}) or _once(share))
    if spoilt:
        found["harm"] = max(spoilt, key=lambda each: each.value)
    right = figure(classifier.get("right_70_150"), "percent")
    return found | ({"right_70_150": right} if right else {})


# ---- a run


def measured(metrics: Mapping[str, dict], gone: Mapping[str, str], asked: Sequence[Column]) -> Measured:
    """The figures of one run, of metrics under today's names. `gone` says of stages why nothing is read off
    them: their file is not there, is damaged, or is of another run."""
    report, heat = section(metrics, "report"), section(metrics, "evaluate_temperature")
    verdict = section(report, "verdict")
    camera = section(metrics, "evaluate_setpoint")
    shown = section(report, "figures")
    winner = _winner(verdict, heat, shown)
    own = contestant(section(section(heat, "contestants"), winner))
    mine = figures(section(shown, winner)) if winner in shown else own
    loops = {
        "temperature": mine,
        "deposition": deposition(section(metrics, "compose_parts"), section(metrics, "train_ilc")),
        "setpoint": setpoint(camera, section(metrics, "train_classifier")),
    }
    found = {f"{loop}.{key}": each for loop, keys in loops.items() for key, each in keys.items()}
    earlier = not winner and bool(shown or section(heat, "controllers"))
    for column in (column for column in asked if not column.loop):
        value = finite(at(section(metrics, column.stage), column.key.partition(":")[2]))
        found |= {} if value is None else {column.key: _once(value)}
    missing = {column.key: _why(column, gone, earlier=earlier) for column in asked if column.key not in found}
    default = camera.get("default")
    controllers = {"temperature": winner, "setpoint": default if isinstance(default, str) else ""}
    return Measured(found, missing, controllers, _verdicts(report))


def _why(column: Column, gone: Mapping[str, str], *, earlier: bool) -> str:
    if column.loop == "temperature" and earlier:
        return "of an earlier comparison, which did not judge controllers as deployed"
    return (
        gone.get(column.stage) or f"{column.stage}.json has no such figure: of an earlier version, or edited"
    )


def _winner(verdict: Mapping, heat: Mapping, shown: Mapping) -> str:
    """Whom the verdict of the temperature loop names, else the best of the comparison; "" for runs before
    it."""
    names = (verdict.get("winner"), verdict.get("subject"), heat.get("best"))
    known = {*section(heat, "contestants"), *shown}.difference(BEFORE)
    return next((name for name in names if isinstance(name, str) and name in known), "")


def _verdicts(report: Mapping) -> dict[str, str]:
    """Passed, failed or open by loop; of earlier versions the temperature loop's alone."""
    told = section(report, "verdicts") or {"temperature": report.get("verdict")}
    words = {"passed": "passed", "failed": "failed"}
    states = {loop: section(told, loop).get("state") for loop in LOOPS if section(told, loop)}
    return {loop: words.get(str(state), "open") for loop, state in states.items() if state}
