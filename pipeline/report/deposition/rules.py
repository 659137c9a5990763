"""Scores of the composers, the learning and the conformance -> structures with
their scores, and the rules that they must pass."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import pandas as pd

from pipeline.report.shared.sources import Sources, lookup
from pipeline.verdict.digits import THIN, count, number, percent, short
from pipeline.verdict.settings import ReportRules
from pipeline.verdict.verdict import (
    BELOW_ONE,
    FAILED,
    OPEN,
    PASSED,
    UNJUDGED,
    Figure,
    Missing,
    Question,
    Rule,
    count_of,
)

# errors closer than this, in points of on-off control's, are one: the simpler composer is taken
SAME = 0.5
OURS, LIBRARY = "basis", "priority"
# rules that may stay open on any machine: until its drive is declared, until a trial judges the forecast
DRIVE, FORECAST = "The drive follows", "Every forecast judged"
FLOW = "Flow error"
# where it does not, a signal may leave so many times the least error that any command within it leaves
NEAR_THE_BEST = 1.2
NOT_JUDGED = "not judged"
# simplest first
COMPOSERS = ("on_off", "priority", "superposition", "basis")
NAMES = {
    "on_off": "On\u2011off",
    "priority": "Library, priority",
    "superposition": "Library, superposition",
    "basis": "Basis functions",
    "ilc": "Learned whole",
}
PAPER = {
    "on_off": "wanted flow over gain",
    "priority": "the paper’s rule",
    "superposition": "overlaps are added",
    "basis": "identified chain, inverted",
    "ilc": "trials of this very part",
}
USE = {
    "on_off": "on\u2011off control",
    "priority": "the library by its priority rule",
    "superposition": "the library by superposition",
    "basis": "the basis functions",
}
# marks of the other pages: circle data-driven, square model-based,
# ring baseline; hollow: a second of its kind
MARK = {
    "basis": "data_driven",
    "priority": "model_based",
    "superposition": "exact_model",
    "on_off": "baseline",
    "ilc": "kernel",
}
# in the place of a forecast that a report of an earlier version does not have
NO_FORECAST = {"reason": "the conformance report has none", "trial": "run ./run dvc repro compose_parts"}
# what the two columns of its rules are, and the mark of the second
HEADS = ("Data\u2011driven", "The paper", "model_based")


class Score(NamedTuple):
    """r.m.s. flow error in % of on-off control's, true where the machine is simulated, else the upper end of
    its forecast; the middle of the forecast; largest volume error of a line in %; the forecast's 90 %
    interval, and whether it may be believed."""

    error: float
    predicted: float | None
    worst_line: float | None
    low: float | None = None
    high: float | None = None
    judged: bool = True


class Structure(NamedTuple):
    """One material of one part program, its scores by composer, and
    the composer that was chosen beforehand."""

    part: str
    material: str
    scores: Mapping[str, Score]
    chosen: str
    asked: ReportRules
    simulated: bool = True
    why: str = ""
    trial: str = ""

    def judged(self) -> bool:
        """Whether the forecast may be believed; of a part of which nothing was chosen there is none."""
        return self.chosen not in self.scores or self.scores[self.chosen].judged

    def unknown(self) -> bool:
        """Whether nothing tells how the chosen composer does: its forecast is not to be believed, and the
        true flow is not known."""
        return not self.simulated and not self.judged()

    def best(self) -> str:
        """The composer, on-off control too, with the least error; what
        learned the part itself is a yardstick."""
        return min(
            (name for name in COMPOSERS if name in self.scores),
            key=lambda name: self.scores[name].error,
            default="",
        )

    def state(self) -> str:
        """Of the composer that was chosen, by flow, volume, and whether its forecast is judged."""
        score = self.scores.get(self.chosen)
        if score is None or self.unknown():
            return OPEN
        if (
            score.error > self.asked.flow_error_percent
            or (score.worst_line or 0.0) > self.asked.line_volume_percent
        ):
            return FAILED
        return PASSED if score.judged else OPEN


def structures(sources: Sources) -> list[Structure] | Missing:
    """Every material of every part, in the order of the table."""
    table = sources.tables["scores"]
    if isinstance(table, Missing):
        return table
    groups = pd.DataFrame(table).groupby(["part", "material"], sort=False)
    conformance = sources.tables["conformance"]
    told = {} if isinstance(conformance, Missing) else conformance
    parts = [_structure(rows, sources.declared.rules, told) for _, rows in groups]
    return parts or Missing("not measured", "no part was composed", "Copy a part program to datasets/parts")


def _structure(rows: pd.DataFrame, rules: ReportRules, conformance: Mapping[str, Any]) -> Structure:
    """One material of one part from its rows of the scores and its forecast in the conformance report; a
    composer without an error is left out."""
    judged = rows.dropna(subset="rms_percent_of_on_off")
    part, material = rows.part.iloc[0], rows.material.iloc[0]
    forecast = conformance.get(part, {}).get("forecast", {}).get(material, NO_FORECAST)
    scores = {
        row.composer: Score(
            row.rms_percent_of_on_off,
            _finite(row.predicted_percent),
            _finite(row.worst_line_volume_percent),
            *(forecast.get("composers", {}).get(row.composer, {}).get(end) for end in ("low", "high")),
            judged=bool(forecast.get("judged")),
        )
        for row in judged.itertuples()
    }
    chosen = judged.composer[judged.chosen.astype(bool)]
    return Structure(
        part,
        material,
        scores,
        "" if chosen.empty else chosen.iloc[-1],
        rules,
        simulated="ilc" in scores,
        why=forecast.get("reason", ""),
        trial=forecast.get("trial", ""),
    )


def _finite(figure: float) -> float | None:
    return None if math.isnan(figure) else figure


def real(sources: Sources) -> bool:
    """Whether the trials are a machine's own, so that nobody knows its true flow."""
    return sources.declared.everything.get("train_ilc", {}).get("source") == "recordings"


def worst(parts: Sequence[Structure], composer: str) -> tuple[float, Structure] | None:
    """The largest error of a composer and where."""
    return max(
        ((part.scores[composer].error, part) for part in parts if composer in part.scores),
        key=lambda pair: pair[0],
        default=None,
    )


def winner(parts: Sequence[Structure]) -> str:
    """The composer with the least worst error; among those as good, the simplest."""
    errors = {name: pair[0] for name in COMPOSERS if (pair := worst(parts, name))}
    return next((name for name, error in errors.items() if error <= min(errors.values()) + SAME), "")


# ---- the rules: of each a pair, ours and the paper's


Pair = tuple[Rule, Rule]


def rules(sources: Sources, parts: Sequence[Structure]) -> tuple[Pair, ...]:
    """The drive first, then what may be believed. Where the drive cannot follow, a signal is held against the
    best that any command could reach within it, elsewhere against the flow that is wanted."""
    asked, bound = sources.declared.rules, _bound(sources)
    followed = [part for part in parts if (part.part, part.material) not in bound]
    return (
        _drive(sources),
        _forecast(parts),
        *([_near(parts, bound)] if bound else []),
        _flow(followed, asked.flow_error_percent),
        _line(followed, asked.line_volume_percent),
        _above(parts, asked.above_whole_points),
        _learning(sources),
        _convergence(sources),
        _printed(sources),
    )


def _pair(shared: Rule, figures: Sequence[Figure | Missing], texts: Sequence[str]) -> Pair:
    """The rule for ours and for the paper's, each with its own figure."""
    ours, paper = (
        shared._replace(figure=figure, text=text) for figure, text in zip(figures, texts, strict=True)
    )
    return ours, paper


def _at_most(name: str, most: float, **words: str) -> Rule:
    """A rule that asks for at most so much; its figures come with `_pair`."""
    return Rule(name, Question(0, "", name, "", most, False, name), Missing(OPEN, ""), **words)


def _of_known(rule: Rule, parts: Sequence[Structure], pairs: Sequence[Any], texts: Sequence[str]) -> Pair:
    """The rule with its figures (value, where), open where one of the parts is not known."""
    if any(part.unknown() for part in parts):
        return _pair(rule._replace(reason="", remedy=""), [Missing(OPEN, "")] * 2, [NOT_JUDGED] * 2)
    return _pair(rule, [_measured(pair) for pair in pairs], texts)


def _measured(pair: tuple[float, Any] | None) -> Figure | Missing:
    return Missing(OPEN, "") if pair is None else count_of(pair[0])


def _flow(parts: Sequence[Structure], limit: float) -> Pair:
    pairs = [worst(parts, name) for name in (OURS, LIBRARY)]
    rule = _at_most(
        FLOW,
        limit,
        limit=f"≤ {limit:g}{THIN}%",
        place="scoreboard",
        reason=""
        if pairs[0] is None
        else (
            f"{where(pairs[0][1])} keeps {percent(pairs[0][0], 2)} of on\u2011off control’s flow error; "
            f"{limit:g}{THIN}% are allowed."
        ),
        remedy="Run more trials, or train the speeds and pauses of that part (printer.routines).",
    )
    texts = [OPEN if pair is None else percent(pair[0], 2) for pair in pairs]
    return _of_known(rule, parts, pairs, texts)


def _forecast(parts: Sequence[Structure]) -> Pair:
    """Whether every forecast may be believed; open where one is not judged, simulated or not: a simulation
    does not pass what would not be printed on a machine without another trial."""
    rule = _at_most(FORECAST, 0, limit="all", place="saturation")
    left = [part for part in parts if not part.judged()]
    if not parts:
        return _pair(rule._replace(reason="No part was composed."), [Missing(OPEN, "")] * 2, [OPEN] * 2)
    if not left:
        return _pair(rule, [count_of(0)] * 2, ["all"] * 2)
    first, others = left[0], [f"{part.part} ({part.material})" for part in left[1:]]
    also = f" Nor is that of {', '.join(others[:3])}" if others else ""
    also += f" and {len(others) - 3} more" if len(others) > 3 else ""
    rule = rule._replace(
        reason=f"The forecast of {where(first)} is not judged: {first.why}.{also}{'.' if also else ''}",
        remedy=f"To judge it, {first.trial}.",
    )
    return _pair(rule, [Missing(OPEN, "")] * 2, [f"{len(left)} of {len(parts)} not"] * 2)


def where(structure: Structure) -> str:
    return f"{structure.part}, material {structure.material},"


def _line(parts: Sequence[Structure], limit: float) -> Pair:
    pairs = [_worst_line(parts, name) for name in (OURS, LIBRARY)]
    rule = _at_most(
        "Line volume",
        limit,
        limit=f"±{limit:g}{THIN}%",
        place="lines",
        reason=""
        if pairs[0] is None
        else (
            f"A line of {where(pairs[0][1])} is {percent(pairs[0][0], 2)} off its volume; "
            f"±{limit:g}{THIN}% is allowed."
        ),
        remedy="Print that line slower, or longer: the table of lines names it.",
    )
    texts = [OPEN if pair is None else f"±{percent(pair[0], 2)}" for pair in pairs]
    return _of_known(rule, parts, pairs, texts)


def _worst_line(parts: Sequence[Structure], name: str) -> tuple[float, Structure] | None:
    lines = [
        (part.scores[name].worst_line, part)
        for part in parts
        if name in part.scores and part.scores[name].worst_line is not None
    ]
    return max(lines, default=None, key=lambda pair: pair[0])


def _above(parts: Sequence[Structure], limit: float) -> Pair:
    pairs = [_most_above(parts, name) for name in (OURS, LIBRARY)]
    place = pairs[0] or pairs[1]
    rule = _at_most(
        "Above learning it whole",
        limit,
        limit=f"≤ {limit:g} point",
        place="scoreboard",
        reason=""
        if place is None
        else (
            f"{where(place[1])} lies {number(place[0], 1)} points above what learning it trial by trial "
            f"reaches; {limit:g} is allowed."
        ),
        remedy="Learn that part itself, where it is printed often.",
    )
    texts = [
        OPEN if pair is None else f"{'+' if pair[0] > 0 else '−'}{number(abs(pair[0]), 1)} points"
        for pair in pairs
    ]
    return _pair(rule, [_measured(pair) for pair in pairs], texts)


def _most_above(parts: Sequence[Structure], name: str) -> tuple[float, Structure] | None:
    """By how many points a composer lies above what learned the part itself, at most, and where."""
    above = [
        (part.scores[name].error - part.scores["ilc"].error, part)
        for part in parts
        if name in part.scores and "ilc" in part.scores
    ]
    return max(above, key=lambda pair: pair[0], default=None)


def _learning(sources: Sources) -> Pair:
    limit, shares = sources.declared.rules.learned_percent, []
    for laws in (("pixels", "model_inverse"), ("hoelzle_2009",)):
        # metrics of before name the best alone
        keys = [f"{law}.{which}_ratio" for law in laws for which in ("last", "best")]
        ratios = next((ratios for key in keys if (ratios := _each(sources, key))), None)
        shares.append(None if ratios is None else 100 * max(ratios))
    texts = [OPEN if share is None else percent(share, 2) for share in shares]
    rule = _at_most(
        "Learned to",
        limit,
        limit=f"≤ {limit:g}{THIN}%",
        place="learning",
        reason="No trial was learned from."
        if shares[0] is None
        else (f"The error after learning is still {texts[0]} of trial 0’s; {limit:g}{THIN}% are asked for."),
        remedy="Run more trials (train_ilc.trials).",
    )
    return _pair(rule, [Missing(OPEN, "") if share is None else count_of(share) for share in shares], texts)


def _each(sources: Sources, key: str) -> list[float]:
    """A figure of every material that has it."""
    metrics = sources.metrics["train_ilc"]
    figures = [] if isinstance(metrics, Missing) else [lookup(material, key) for material in metrics.values()]
    return [float(value) for value in figures if not isinstance(value, Missing)]


def gamma(sources: Sources) -> dict[str, float] | None:
    """Of the paper's law, before anything ran: nominal, worst of the family, and the share of it above 1 in
    %, each the worst of all materials."""
    figures = {key: _each(sources, key) for key in ("gamma", "gamma_worst", "gamma_above_1_percent")}
    return {key: max(values) for key, values in figures.items()} if all(figures.values()) else None


def _convergence(sources: Sources) -> Pair:
    before, values = gamma(sources), _each(sources, "gamma_model_inverse_worst")
    rule = _at_most("Convergence test", BELOW_ONE, limit="γ < 1", place="beforehand")
    ours, paper = _pair(
        rule,
        [
            count_of(max(values)) if values else Missing(UNJUDGED, ""),
            Missing(OPEN, "") if before is None else count_of(before["gamma_worst"]),
        ],
        [
            f"γ up to {number(max(values), 2)}" if values else "rolls back",
            OPEN if before is None else f"γ up to {number(before['gamma_worst'], 2)}",
        ],
    )
    # ours is tested once its first trials have identified the machine,
    # over the machines that these cannot tell apart
    return ours if values else ours._replace(question=None), paper


class Asked(NamedTuple):
    """One stream of a part: the largest command (mm) and speed (mm/s) that it asks for, the drive's limits
    beside them (None: not declared), the share of its time at a limit in %, and whether the drive follows."""

    part: str
    material: str
    command_mm: float
    speed_mm_per_s: float
    amplitude_mm: float | None
    limit_mm_per_s: float | None
    share: float
    enough: bool

    def text(self) -> str:
        """Largest command and speed."""
        return f"{short(self.command_mm, 2)}{THIN}mm, {short(self.speed_mm_per_s, 2)}{THIN}mm/s"

    def limit(self) -> str:
        """The drive's own."""
        if self.amplitude_mm is None or self.limit_mm_per_s is None:
            return "declared"
        return f"{self.amplitude_mm:g}{THIN}mm, {self.limit_mm_per_s:g}{THIN}mm/s"


def asked_of_the_drive(part: str, material: str, saturation: Mapping[str, Any]) -> Asked:
    """One stream out of the conformance report of its part; nan where an earlier version wrote it."""
    limits = (saturation.get(key) for key in ("amplitude_mm", "speed_mm_per_s"))
    return Asked(
        part,
        material,
        float(saturation.get("largest_command_mm", math.nan)),
        float(saturation.get("largest_speed_mm_per_s", math.nan)),
        *(None if limit is None else float(limit) for limit in limits),
        float(saturation["share_percent"]),
        bool(saturation["enough"]),
    )


def _drive(sources: Sources) -> Pair:
    """Whether the drive follows every command as it is asked for; open until a drive is declared."""
    conformance = sources.tables["conformance"]
    rule = _at_most(DRIVE, 0, limit="declared", place="saturation")
    if isinstance(conformance, Missing):
        rule = rule._replace(reason=conformance.sentence())
        return _pair(rule, [conformance._replace(state=OPEN)] * 2, [OPEN] * 2)
    streams = [
        asked_of_the_drive(part, material, saturation)
        for part, report in conformance.items()
        for material, saturation in report.get("saturation", {}).items()
    ]
    if not streams:
        return _pair(rule._replace(reason="No part was composed."), [Missing(OPEN, "")] * 2, [OPEN] * 2)
    if any(math.isnan(stream.command_mm) for stream in streams):
        rule = rule._replace(
            reason="The conformance report is of an earlier version and names no command.",
            remedy="Run ./run dvc repro compose_parts.",
        )
        return _pair(rule, [Missing(OPEN, "")] * 2, [OPEN] * 2)
    worst = max(streams, key=lambda stream: (not stream.enough, stream.command_mm, stream.speed_mm_per_s))
    rule = rule._replace(limit=worst.limit())
    place = f"{worst.part}, material {worst.material}"
    if any(stream.limit() == "declared" for stream in streams):
        rule = rule._replace(
            reason=f"The command for {place}, goes to {worst.text()}, and no drive is declared.",
            remedy="Declare the drive (printer.drive).",
        )
        return _pair(rule, [Missing(OPEN, "")] * 2, [worst.text()] * 2)
    ramp = conformance[worst.part].get("ramp_that_would_do_s", {}).get(worst.material)
    least = _bound(sources).get((worst.part, worst.material))
    best = (
        "no signal can make up for it"
        if least is None
        else (f"the best signal within it leaves {percent(least, 2)} of on\u2011off control’s flow error")
    )
    rule = rule._replace(
        reason=(
            f"{place}, asks for {worst.text()}; the drive gives {worst.limit()}, is at a limit "
            f"{percent(worst.share, 2)} of the printing time, and {best}."
        ),
        remedy="Print slower, or take a stronger drive (printer.drive): no ramp would do."
        if ramp is None
        else f"Ramps of {ramp:.2f}{THIN}s would do (printer.longest_ramp_s).",
    )
    # where it follows what is asked for, up to a little: how much that little is
    leaves = [
        saturation.get("least_percent")
        for report in conformance.values()
        for saturation in report.get("saturation", {}).values()
    ]
    followed = worst.enough and all(share is not None for share in leaves)
    text = f"leaves {percent(max(leaves), 2)}" if followed else worst.text()
    return _pair(rule, [count_of(sum(not stream.enough for stream in streams))] * 2, [text] * 2)


def _bound(sources: Sources) -> dict[tuple[str, str], float]:
    """The least error in % of on-off control's that any command leaves, by part and material, of the streams
    that the drive cannot follow."""
    conformance = sources.tables["conformance"]
    if isinstance(conformance, Missing):
        return {}
    return {
        (part, material): float(saturation["least_percent"])
        for part, report in conformance.items()
        for material, saturation in report.get("saturation", {}).items()
        if not saturation["enough"] and saturation.get("least_percent") is not None
    }


def _near(parts: Sequence[Structure], bound: Mapping[tuple[str, str], float]) -> Pair:
    """Where the drive cannot follow: the error over the least that any command within it leaves."""
    bounded, pairs = [part for part in parts if (part.part, part.material) in bound], []
    for name in (OURS, LIBRARY):
        ratios = [
            (part.scores[name].error / max(bound[part.part, part.material], 1e-9), part)
            for part in bounded
            if name in part.scores
        ]
        pairs.append(max(ratios, key=lambda pair: pair[0], default=None))
    ours = pairs[0]
    rule = _at_most(
        "Near the best reachable",
        NEAR_THE_BEST,
        limit=f"≤ {NEAR_THE_BEST:g} ×",
        place="saturation",
        reason=""
        if ours is None
        else (
            f"{where(ours[1])} keeps {percent(ours[1].scores[OURS].error, 2)} of on\u2011off control’s flow "
            f"error, and the best command within the drive "
            f"{percent(bound[ours[1].part, ours[1].material], 2)}."
        ),
        remedy="Learn that part itself, or run more trials.",
    )
    texts = [OPEN if pair is None else f"{number(pair[0], 2)} ×" for pair in pairs]
    return _of_known(rule, bounded, pairs, texts)


def _printed(sources: Sources) -> Pair:
    conformance = sources.tables["conformance"]
    rule = _at_most("Every line printed", 0, limit="all", place="refused")
    if isinstance(conformance, Missing):
        rule = rule._replace(reason=conformance.sentence())
        return _pair(rule, [conformance._replace(state=OPEN)] * 2, [OPEN] * 2)
    refused = [
        (part, line) for part, report in conformance.items() for line in _listed(report.get("refused", []))
    ]
    # the priority rule does not print a line that is shorter than the lead
    short = sum(report.get("shorter_than_lead", 0) for report in conformance.values())
    counts = (len(refused), len(refused) + short)
    rule = rule._replace(
        reason=f"{count(len(refused), 'line was', 'lines were')} refused".capitalize()
        + (f", the first in {refused[0][0]}: {refused[0][1]}" if refused else ""),
        remedy="Mend these lines of the program, or print without them.",
    )
    return _pair(rule, [count_of(n) for n in counts], ["all" if not n else f"{n:,} not" for n in counts])


def _listed(refused: Any) -> list[str]:
    if isinstance(refused, str):
        return [refused]
    return [f"line {line['line']}, {line['why']}" for line in refused for _ in range(line.get("count", 1))]
