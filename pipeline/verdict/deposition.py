"""Makes the verdict on the deposition loop from the scores of the composers, the learning and the conformance
report: whose signal to use, and whether the parts can be printed."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from pipeline import statistics
from pipeline.deposition.controllers import COMPOSERS as TABLE
from pipeline.verdict.digits import THIN, band, count, number, percent, short
from pipeline.verdict.evidence import Evidence, Figures, gap_of, instead, known, lookup, need, or_gap
from pipeline.verdict.rules import Reading, ask, rows
from pipeline.verdict.settings import ReportRules
from pipeline.verdict.verdict import (
    FAILED,
    OPEN,
    PASSED,
    UNJUDGED,
    Missing,
    PairSentence,
    Rule,
    Verdict,
    Words,
    count_of,
    deciding,
    overall,
    words_for,
)

LOOP = "deposition"
# errors that differ by less than this, in points of on-off control's, count as equal: the simpler composer is
# used
SAME = 0.5
# learning a part itself is as good as a composer if its error is at most this many times as large
AS_GOOD = 1.1
# the simplest first. The signal learned on the part itself is a reference, because it cannot compose another
# part
COMPOSERS = tuple(row.name for row in TABLE if row.kind != "reference")
REFERENCE = next(row.name for row in TABLE if row.kind == "reference")
BASELINE = next(row.name for row in TABLE if row.kind == "baseline")
OURS, LIBRARY = (
    next(row.name for row in TABLE if row.kind == kind) for kind in ("model-based", "data-driven")
)
# the library's rules for joining its signals; the better one represents the data-driven composers
RULES_OF_LIBRARY = tuple(row.name for row in TABLE if row.kind == "data-driven")
NAMES = {row.name: row.heading for row in TABLE}
KIND = {row.name: row.kind for row in TABLE}
NOT_JUDGED = "not judged"
# in a sentence
USE = {
    "on_off": "on\u2011off control",
    "pressure_advance": "pressure advance",
    "pressure_advance_lead": "pressure advance with a lead",
    "priority": "the library by its priority rule",
    "superposition": "the library by superposition",
    "basis": "the basis functions",
}
# tables made from the trials of the deposition loop
COMPOSED = ("library", "learned", "signals", "scores", "prints", "tasks", "lines", "conformance")
# what to do if no trial is recorded yet
FIRST_TRIALS = (
    "Play the commands of datasets/train_ilc/next, put their recordings into datasets/raw/deposition, and "
    "run ./run dvc repro."
)
# replaces the forecast that a report of an earlier version lacks
NO_FORECAST = {"reason": "the conformance report has none", "trial": "run ./run dvc repro compose_parts"}


def phrase(name: str) -> str:
    """Returns the composer's name for a sentence, such as "the basis functions", or its heading if it has
    none."""
    return USE.get(name, NAMES.get(name, name))


def untried(figures: Figures) -> bool:
    """Returns whether no trial of a real deposition machine is recorded yet."""
    learning = figures["train_ilc"]
    return isinstance(learning, Mapping) and not any("pixels" in laws for laws in learning.values())


def of_recorded_trials(figures: Figures, tables: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the tables of a machine that learns from recorded trials. If no trial is recorded, or a table
    was made from simulated trials, a Missing takes the table's place."""
    scores, gap = tables["scores"], None
    if untried(figures):
        gap = Missing("not measured", "No trial is recorded yet")
    elif REFERENCE in known(scores, {"composer": ()})["composer"]:
        gap = Missing("stale", "It was made from simulated trials", "Run ./run dvc repro compose_parts")
    return dict(tables) if gap is None else {**tables, **dict.fromkeys(set(COMPOSED) & set(tables), gap)}


class Score(NamedTuple):
    """r.m.s. flow error in % of on-off control's: the true one if the machine is simulated, otherwise the
    upper end of its forecast; the middle of the forecast; largest volume error of a line in %; the forecast's
    90 % interval, and whether the forecast is valid."""

    error: float
    predicted: float | None
    worst_line: float | None
    low: float | None = None
    high: float | None = None
    judged: bool = True


class Structure(NamedTuple):
    """One material of one part program, its scores by composer, and the composer that was chosen
    beforehand."""

    part: str
    material: str
    scores: Mapping[str, Score]
    chosen: str
    asked: ReportRules
    simulated: bool = True
    why: str = ""
    trial: str = ""

    def judged(self) -> bool:
        """Returns whether the forecast is valid. True if no composer was chosen, because then there is no
        forecast."""
        return self.chosen not in self.scores or self.scores[self.chosen].judged

    def unknown(self) -> bool:
        """Returns whether the result of the chosen composer is unknown: its forecast is not valid, and the
        true flow is not known."""
        return not self.simulated and not self.judged()

    def known(self) -> Mapping[str, Score]:
        """Returns the scores that may be shown and compared: none if the result of the chosen composer is
        unknown."""
        return {} if self.unknown() else self.scores

    def error(self, composer: str) -> float | None:
        """Returns the flow error of a composer; None if it is not known."""
        return self.known()[composer].error if composer in self.known() else None

    def worst_line(self, composer: str) -> float | None:
        """Returns the volume error of the composer's worst line; None if no line was judged."""
        return self.known()[composer].worst_line if composer in self.known() else None

    def best(self) -> str:
        """Returns the composer with the least error, on-off control included, "" if no error is known. The
        one that learned the part itself is only a reference."""
        scores = self.known()
        return min(
            (name for name in COMPOSERS if name in scores), key=lambda name: scores[name].error, default=""
        )

    def state(self) -> str:
        """Returns the state of the composer that was chosen, from its flow error, its volume error, and
        whether its forecast is valid."""
        score = self.known().get(self.chosen)
        if score is None:
            return OPEN
        if (
            score.error > self.asked.flow_error_percent
            or (score.worst_line or 0.0) > self.asked.line_volume_percent
        ):
            return FAILED
        return PASSED if score.judged else OPEN


@or_gap
def structures(evidence: Evidence) -> list[Structure] | Missing:
    """Returns every material of every part, in the order of the table."""
    groups = pd.DataFrame(need(evidence.tables["scores"])).groupby(["part", "material"], sort=False)
    told = known(evidence.tables["conformance"], {})
    parts = [_structure(rows, evidence.rules, told) for _, rows in groups]
    return parts or Missing("not measured", "no part was composed", "Copy a part program to datasets/parts")


def unknown_streams(evidence: Evidence) -> set[tuple[str, str]]:
    """Returns (part, material) of the forecasts that are not valid, so that their figures must not be
    shown."""
    return {(part.part, part.material) for part in known(structures(evidence), []) if part.unknown()}


def _structure(rows: pd.DataFrame, rules: ReportRules, conformance: Mapping[str, Any]) -> Structure:
    """Returns one material of one part, from its rows of the scores and its forecast in the conformance
    report. A composer without an error is left out."""
    judged = rows.dropna(subset="rms_percent_of_on_off")
    each: list[Any] = list(judged.itertuples())
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
        for row in each
    }
    chosen = judged.composer[judged.chosen.astype(bool)]
    return Structure(
        part,
        material,
        scores,
        "" if chosen.empty else chosen.iloc[-1],
        rules,
        simulated=REFERENCE in scores,
        why=forecast.get("reason", ""),
        trial=forecast.get("trial", ""),
    )


def _finite(figure: float) -> float | None:
    return None if math.isnan(figure) else figure


def worst(parts: Sequence[Structure], composer: str) -> tuple[float, Structure] | None:
    """Returns the largest error of a composer, and the part that has it."""
    return _largest(parts, lambda part: part.error(composer))


def data_driven(parts: Sequence[Structure]) -> str:
    """Returns the library's rule with the smaller worst error; the paper's rule if both are equal."""
    errors = {name: pair[0] for name in RULES_OF_LIBRARY if (pair := worst(parts, name))}
    return min(errors, key=lambda name: errors[name], default=LIBRARY)


def winner(parts: Sequence[Structure]) -> str:
    """Returns the composer with the smallest worst error. Of those within SAME of it, the simplest is
    returned."""
    errors = {name: pair[0] for name in COMPOSERS if (pair := worst(parts, name))}
    return next((name for name, error in errors.items() if error <= min(errors.values()) + SAME), "")


# ---- model-based against data-driven


@instead(lambda gap: PairSentence("Model-based against data-driven: not measured.", None))
def pair_sentence(evidence: Evidence) -> PairSentence:
    """Returns the comparison of model-based with data-driven, on the same streams: "the basis functions leave
    0.25 of the flow error that the library by superposition leaves", or that more parts are needed. Its note
    says from how many prints on this holds, and after how many prints of a part direct learning is as
    good."""
    head, parts = "Model-based against data-driven:", need(structures(evidence))
    if evidence.recorded("train_ilc"):
        return PairSentence(
            f"{head} forecasts cannot tell, as they come from the chain that the basis functions invert; "
            "print a part by both and measure it.",
            None,
        )
    other = data_driven(parts)
    ratios = np.array([
        part.scores[OURS].error / max(part.scores[other].error, 1e-9)
        for part in parts
        if {OURS, other} <= part.scores.keys()
    ])  # fmt: skip
    if len(ratios) < 2:
        return PairSentence(f"{head} undecided; compose more parts (datasets/parts).", None)
    logs = np.log(np.maximum(ratios, 1e-9))
    log = statistics.mean_of_pools(logs, level=0.9)
    better, worse, sign = (OURS, other, 1) if log.value <= 0 else (other, OURS, -1)
    ratio, ends = math.exp(sign * log.value), sorted(math.exp(sign * end) for end in (log.low, log.high))
    same = f"on the same {count(len(ratios), 'stream')}"
    interval = f"90{THIN}% interval {band(*ends, 2)}"
    if log.low <= 0 <= log.high:
        half = (log.high - log.low) / 2
        text = f"undecided between {phrase(OURS)} and {phrase(other)} {same}"
        text += f" (ratio of their flow errors {number(ratio, 2)}, {interval})"
        if log.value == 0.0:
            more = "no number of streams would tell"
        else:
            needed = math.ceil(len(ratios) * ((half / log.value) ** 2 - 1))
            more = f"about {count(max(needed, 1), 'more stream')} would tell"
        return PairSentence(f"{head} {text}; {more}.", None, f"{head} undecided; {more}.")
    leave = "leave" if better == OURS else "leaves"
    text = (
        f"{phrase(better)} {leave} {number(ratio, 2)} of the flow error that {phrase(worse)} "
        f"{'leave' if worse == OURS else 'leaves'}, {same} ({interval})"
    )
    spent = evidence.tables.get("prints")
    turns = "" if not isinstance(spent, Mapping) else _turns(pd.DataFrame(spent), better, worse)
    loser = phrase(worse).split(" by ")[0]
    short = f"{head} {phrase(better)}, {number(ratio, 2)} times the flow error of {loser} ({band(*ends, 2)})."
    return PairSentence(f"{head} {text}.", better, short, turns)


def _turns(spent: pd.DataFrame, better: str, worse: str) -> str:
    """Returns whether the answer changes with the number of prints learned from, and after how many prints of
    a part direct learning is as good as the better composer."""
    error = spent.pivot_table(
        index=["part", "material", "prints"], columns="composer", values="rms_percent_of_on_off"
    )
    if not {better, worse, REFERENCE} <= set(error.columns):
        return ""
    both = error[[better, worse]].dropna()
    fewer = both.groupby("prints").mean()  # the mean over the streams; all have the same counts
    turned = fewer.index[fewer[better] > fewer[worse]]
    first, last = int(fewer.index.min()), int(fewer.index.max())
    text = (
        f"The answer is the same at every number of prints tried, {first} to {last} of a material."
        if turned.empty
        else f"Up to {int(turned.max())} prints of a material the other is better."
    )
    after, streams = [], 0
    for _, of_stream in error.groupby(["part", "material"]):
        own = of_stream[REFERENCE].dropna().droplevel(["part", "material"])
        end = of_stream[better].dropna()
        if len(own) and len(end):
            streams += 1
            worse_prints = own.index[own > AS_GOOD * end.iloc[-1]]
            reached = 1 if worse_prints.empty else int(worse_prints.max()) + 1
            after += [reached] if reached <= own.index.max() else []
    if not streams:
        return text
    of = f"on {len(after)} of {streams} streams, after {_range(after)} prints of it" if after else "on none"
    return f"{text} Learning the part itself (data-driven) comes within a tenth of that {of}."


def _range(values: Sequence[int]) -> str:
    low, high = min(values), max(values)
    return f"{low}" if low == high else f"{low} to {high}"


# ---- the rules: of each a pair, that of the model-based composer and that of the library or the one in use


Pair = tuple[Rule, Rule]


class Parts(NamedTuple):
    """The input of the rules of one composer: the evidence; the parts; and, for the streams that the drive
    cannot follow, the least error in % of on-off control's that any command leaves, by part and material."""

    evidence: Evidence
    parts: Sequence[Structure]
    bound: Mapping[tuple[str, str], float]

    @property
    def unknown(self) -> set[tuple[str, str]]:
        return {(part.part, part.material) for part in self.parts if part.unknown()}

    @property
    def followed(self) -> list[Structure]:
        return [part for part in self.parts if (part.part, part.material) not in self.bound]


def rules(evidence: Evidence, parts: Sequence[Structure], beside: str = LIBRARY) -> tuple[Pair, ...]:
    """Returns the rules of a run: for each a pair, that of the model-based composer and that of the one
    beside it."""
    unknown = {(part.part, part.material) for part in parts if part.unknown()}
    bound = {place: least for place, least in _bound(evidence).items() if place not in unknown}
    return rules_of(Parts(evidence, parts, bound), beside)


def rules_of(case: Parts, beside: str = LIBRARY) -> tuple[Pair, ...]:
    """Returns the rules: the drive first, then whether the forecasts are valid. If the drive cannot follow, a
    signal is compared with the best that any command within the drive's limits could reach, otherwise with
    the wanted flow."""
    asked = [key for key in rows(LOOP) if key != "near" or case.bound]
    return tuple((_rule(case, key, OURS), _rule(case, key, beside)) for key in asked)


def _rule(case: Parts, key: str, composer: str) -> Rule:
    own = (lambda question: FIGURES[key](case, composer)) if key in FIGURES else None
    rule = ask(LOOP, key, case.evidence, own, composer)
    gap = gap_of(rule.figure)
    if gap and gap.state == UNJUDGED:
        return rule._replace(question=None)
    return rule._replace(figure=gap._replace(state=OPEN)) if gap else rule


def _open(text: str = OPEN, reason: str = "", **words: str) -> Reading:
    """Returns the reading of a figure that is not known."""
    return Missing(OPEN, ""), {"text": text, "reason": reason, **words}


def _largest(
    parts: Sequence[Structure], value: Callable[[Structure], float | None]
) -> tuple[float, Structure] | None:
    """Returns the largest value of the parts that have one, and its part."""
    known = [(figure, part) for part in parts if (figure := value(part)) is not None]
    return max(known, key=lambda pair: pair[0], default=None)


def _worst_of(
    parts: Sequence[Structure],
    value: Callable[[Structure], float | None],
    worded: Callable[[float], str] = lambda value: percent(value, 2),
    shown: Callable[[str], str] = str,
) -> Reading:
    """Returns the reading of the parts' largest value; open if one of the parts is unknown."""
    if any(part.unknown() for part in parts):
        return _open(NOT_JUDGED, remedy="")
    pair = _largest(parts, value)
    if pair is None:
        return _open()
    text = worded(pair[0])
    return count_of(pair[0]), {"text": shown(text), "value": text, "where": where(pair[1])}


def _flow(case: Parts, composer: str) -> Reading:
    return _worst_of(case.followed, lambda part: part.error(composer))


def _line(case: Parts, composer: str) -> Reading:
    return _worst_of(case.followed, lambda part: part.worst_line(composer), shown="±{}".format)


def _near(case: Parts, composer: str) -> Reading:
    """Returns the reading if the drive cannot follow: the error divided by the least error that any command
    within the drive's limits leaves."""

    def ratio(part: Structure) -> float | None:
        error = part.error(composer)
        return None if error is None else error / max(case.bound[part.part, part.material], 1e-9)

    bounded = [part for part in case.parts if (part.part, part.material) in case.bound]
    figure, words = _worst_of(bounded, ratio, lambda value: f"{number(value, 2)} ×")
    if gap_of(figure):
        return figure, words
    part = max((part for part in bounded if ratio(part) is not None), key=lambda part: ratio(part) or 0.0)
    return figure, {
        **words,
        "value": percent(part.scores[composer].error, 2),
        "least": percent(case.bound[part.part, part.material], 2),
    }


def _above(case: Parts, composer: str) -> Reading:
    """Returns the reading of the largest difference, in points, between a composer's error and that of direct
    learning of the part."""

    def above(part: Structure) -> float | None:
        error, reached = part.error(composer), part.error(REFERENCE)
        return None if error is None or reached is None else error - reached

    pair = _largest(case.parts, above)
    if pair is None:
        return _open()
    points, part = pair
    return count_of(points), {
        "text": f"{'+' if points > 0 else '−'}{number(abs(points), 1)} points",
        "value": number(points, 1),
        "where": where(part),
    }


def _forecast(case: Parts, composer: str) -> Reading:
    """Returns the reading of whether every forecast is valid. It is open if one is not, also for a simulated
    machine: on a real machine this part would not be printed without another trial."""
    doubtful = [part for part in case.parts if not part.judged()]
    if not case.parts:
        return _open(reason="No part was composed.")
    if not doubtful:
        return count_of(0), {"text": "all"}
    first, others = doubtful[0], [f"{part.part} ({part.material})" for part in doubtful[1:]]
    also = f" Nor is that of {', '.join(others[:3])}" if others else ""
    also += f" and {len(others) - 3} more" if len(others) > 3 else ""
    return _open(
        f"{len(doubtful)} of {len(case.parts)} not",
        f"The forecast of {where(first)} is not judged: {first.why}.{also}{'.' if also else ''}",
        remedy=f"To judge it, {first.trial}.",
    )


def where(structure: Structure) -> str:
    return f"{structure.part}, material {structure.material},"


def _learning(case: Parts, composer: str) -> Reading:
    laws = ("hoelzle_2009",) if KIND[composer] == "data-driven" else ("pixels", "model_inverse")
    # figures of an earlier version have only the best
    keys = [f"{law}.{which}_ratio" for law in laws for which in ("last", "best")]
    ratios = next((ratios for key in keys if (ratios := _each(case.evidence, key))), None)
    if ratios is None:
        return _open(reason="No trial was learned from.")
    share = 100 * max(ratios)
    return count_of(share), {"text": percent(share, 2)}


def _each(evidence: Evidence, key: str) -> list[float]:
    """Returns a figure of every material that has it."""
    figures = [lookup(material, key) for material in known(evidence.figures["train_ilc"], {}).values()]
    return [float(value) for value in figures if not gap_of(value)]


def gamma(evidence: Evidence) -> dict[str, float] | None:
    """Returns gamma of the paper's law before any trial: nominal, worst of the plausible models, and the
    share of these above 1 in %. Each is the worst of all materials. None if one of them is missing."""
    figures = {key: _each(evidence, key) for key in ("gamma", "gamma_worst", "gamma_above_1_percent")}
    return {key: max(values) for key, values in figures.items()} if all(figures.values()) else None


def _convergence(case: Parts, composer: str) -> Reading:
    """Returns the reading of gamma. Our law is tested after its first trials have identified the machine,
    over all machines that these trials cannot tell apart."""
    if KIND[composer] != "data-driven":
        values, absent = (
            _each(case.evidence, "gamma_model_inverse_worst"),
            (Missing(UNJUDGED, ""), "rolls back"),
        )
    else:
        before = gamma(case.evidence)
        values, absent = [] if before is None else [before["gamma_worst"]], (Missing(OPEN, ""), OPEN)
    if not values:
        return absent[0], {"text": absent[1]}
    return count_of(max(values)), {"text": f"γ up to {number(max(values), 2)}"}


class Asked(NamedTuple):
    """One stream of a part: the largest command (mm) and speed (mm/s) that it needs, the drive's limits
    (None: not declared), the share of its time at a limit in %, and whether the drive can follow."""

    part: str
    material: str
    command_mm: float
    speed_mm_per_s: float
    amplitude_mm: float | None
    limit_mm_per_s: float | None
    share: float
    enough: bool

    def text(self) -> str:
        """Returns the largest command and speed."""
        return f"{short(self.command_mm, 2)}{THIN}mm, {short(self.speed_mm_per_s, 2)}{THIN}mm/s"

    def limit(self) -> str:
        """Returns the drive's limits, "declared" if there are none."""
        if self.amplitude_mm is None or self.limit_mm_per_s is None:
            return "declared"
        return f"{self.amplitude_mm:g}{THIN}mm, {self.limit_mm_per_s:g}{THIN}mm/s"


def asked_of_the_drive(part: str, material: str, saturation: Mapping[str, Any]) -> Asked:
    """Returns one stream from the conformance report of its part. Values that an earlier version did not
    write are NaN."""
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


def _drive(case: Parts, composer: str) -> Reading:
    """Returns the reading of whether the drive can follow every command; open until a drive is declared."""
    conformance = need(case.evidence.tables["conformance"])
    saturations = {
        (part, material): saturation
        for part, report in conformance.items()
        for material, saturation in report.get("saturation", {}).items()
    }
    streams = [asked_of_the_drive(*place, saturation) for place, saturation in saturations.items()]
    if not streams:
        return _open(reason="No part was composed.")
    if any(math.isnan(stream.command_mm) for stream in streams):
        return _open(
            reason="The conformance report is of an earlier version and names no command.",
            remedy="Run ./run dvc repro compose_parts.",
        )
    worst = max(streams, key=lambda stream: (not stream.enough, stream.command_mm, stream.speed_mm_per_s))
    place = f"{worst.part}, material {worst.material},"
    if any(stream.limit() == "declared" for stream in streams):
        return _open(
            worst.text(),
            f"The command for {place} goes to {worst.text()}, and no drive is declared.",
            remedy="Declare the drive (printer.drive).",
            allowed=worst.limit(),
        )
    ramp = conformance[worst.part].get("ramp_that_would_do_s", {}).get(worst.material)
    least = case.bound.get((worst.part, worst.material))
    best = (
        "what that costs is not judged"
        if (worst.part, worst.material) in case.unknown
        else "no signal can make up for it"
        if least is None
        else f"the best signal within it leaves {percent(least, 2)} of on\u2011off control’s flow error"
    )
    # the error that remains if the drive follows the command almost exactly
    shares = [one.get("least_percent") for place, one in saturations.items() if place not in case.unknown]
    leaves = [share for share in shares if share is not None]
    followed = worst.enough and len(leaves) == len(saturations)
    return count_of(sum(not stream.enough for stream in streams)), {
        "allowed": worst.limit(),
        "text": f"leaves {percent(max(leaves), 2)}" if followed else worst.text(),
        "case": "stronger" if ramp is None else "ramp",
        "ramp": "" if ramp is None else f"{ramp:.2f}{THIN}s",
        "where": place,
        "demand": worst.text(),
        "limits": worst.limit(),
        "share": percent(worst.share, 2),
        "best": best,
    }


def _bound(evidence: Evidence) -> dict[tuple[str, str], float]:
    """Returns the least error in % of on-off control's that any command leaves, by part and material, for the
    streams that the drive cannot follow."""
    return {
        (part, material): float(saturation["least_percent"])
        for part, report in known(evidence.tables["conformance"], {}).items()
        for material, saturation in report.get("saturation", {}).items()
        if not saturation["enough"] and saturation.get("least_percent") is not None
    }


def _printed(case: Parts, composer: str) -> Reading:
    conformance = need(case.evidence.tables["conformance"])
    refused = [
        (part, line) for part, report in conformance.items() for line in _listed(report.get("refused", []))
    ]
    # the priority rule does not print a line that is shorter than the lead
    short_lines = sum(report.get("shorter_than_lead", 0) for report in conformance.values())
    lost = len(refused) + (short_lines if composer == LIBRARY else 0)
    return count_of(lost), {
        "text": f"{lost:,} not" if lost else "all",
        "case": "refused" if refused else "short",
        "lines": count(len(refused) or short_lines, "line was", "lines were").capitalize(),
        "first": f", the first in {refused[0][0]}: {refused[0][1]}" if refused else "",
    }


def _listed(refused: Any) -> list[str]:
    if isinstance(refused, str):
        return [refused]
    return [f"line {line['line']}, {line['why']}" for line in refused for _ in range(line.get("count", 1))]


FIGURES: dict[str, Callable[[Parts, str], Reading]] = {
    "drive": _drive,
    "forecast": _forecast,
    "near": _near,
    "flow": _flow,
    "line": _line,
    "above": _above,
    "learning": _learning,
    "convergence": _convergence,
    "printed": _printed,
}


# ---- the verdict


def verdict(evidence: Evidence) -> Verdict:
    """Returns the verdict on whose signal to use: the composer with the smallest worst error is judged by the
    rules. `winner` is this composer, "" if nothing was composed; `note` is the price of the signals."""
    parts, machine = structures(evidence), evidence.recorded("train_ilc")
    words = words_for(recorded=machine, quick=evidence.quick)
    if isinstance(parts, Missing):
        return Verdict(
            loop=LOOP,
            state=OPEN,
            decision=words.undecided,
            lead="Nothing was composed.",
            reason=parts.sentence(),
            remedy=FIRST_TRIALS if machine and untried(evidence.figures) else "",
            rule="",
            winner="",
            note=_price(evidence, []),
            rules=rules(evidence, []),
        )
    use = winner(parts)
    # pressure advance has no signals of the library, so it has rules of its own
    own = use not in (BASELINE, "") and KIND.get(use) == "baseline"
    beside = use if own else data_driven(parts)
    lines = rules(evidence, parts, beside)
    # the model-based composer's column, also if nothing is known, or that of the other composer
    column = 0 if use in (OURS, "") else 1
    needs = {row.name: row.needed_for for row in rows(LOOP).values()}
    asked = [line[column] for line in lines if column == 0 or "learning" not in needs[line[0].name]]
    judged = [rule for rule in asked if rule.state != UNJUDGED]
    # a rule that cannot be measured on a machine's own trials does not block them. But a drive can be
    # declared, and there is a trial for each forecast that is not judged
    binding = [
        rule
        for rule in judged
        if "machine" in needs[rule.name]
        or ("simulation" in needs[rule.name] and not (machine and rule.state == OPEN))
    ]
    state = FAILED if use == BASELINE else overall([rule.state for rule in binding])
    first = None if state == PASSED else deciding(binding) or deciding(judged)
    reported = first is not None and first.reason and (use == OURS or own or "machine" in needs[first.name])
    summary = _summary(parts, use, machine)
    return Verdict(
        loop=LOOP,
        state=state,
        decision=_decision(state, use, words),
        lead=_lead(state, first, len(judged), condition=len(judged) < len(asked)),
        reason=f"{first.reason} {summary}" if reported else summary,
        remedy=first.remedy if first else "",
        rule=first.name if first else "",
        winner=use,
        note=_price(evidence, parts),
        rules=lines,
    )


def _decision(state: str, use: str, words: Words) -> str:
    """Returns the decision. It says which composer comes closest only if that is known for any part."""
    if not use:
        return words.of(state)
    if state == PASSED:
        return words.passed.format(phrase(use))
    return f"{words.of(state).rstrip('.')}: {phrase(use)} {'come' if use == OURS else 'comes'} closest."


def _lead(state: str, first: Rule | None, judged: int, *, condition: bool) -> str:
    """Returns how many rules passed, and whether some could not be judged; or the first rule that did not
    pass."""
    if state != PASSED:
        if first is None:
            return "Nothing beats on\u2011off control."
        word = "failed" if state == FAILED else "undecided"
        return f"First {word} rule: {first.name[:1].lower()}{first.name[1:]}."
    return f"All {count(judged, 'rule')} {'that can be judged ' if condition else ''}passed."


def _summary(parts: Sequence[Structure], use: str, machine: bool) -> str:
    """Returns the largest error of the composer in use, in % of on-off control's, and its worst line."""
    found = worst(parts, use)
    if found is None:
        return "What the parts come to is not known."
    error, place = found
    lines = [line for part in parts if (line := part.worst_line(use)) is not None]
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
        f"({place.part}, {place.material}).{volume}{forecast}"
    )


def _bare(name: str) -> str:
    return phrase(name).removeprefix("the ")


def _price(evidence: Evidence, parts: Sequence[Structure]) -> str:
    """Returns what the signals cost: trials, peak command, what the paper's law would have done, and the
    lines that the priority rule would not print."""
    learning, sentences = known(evidence.figures["train_ilc"], {}).values(), []
    learned = [laws[law] for laws in learning for law in ("model_inverse", "pixels") if law in laws]
    if learned:
        routines = max(len(laws.get("other_routines", [])) for laws in learning)
        trials, peak = (max(law[key] for law in learned) for key in ("trials", "peak_over_steady"))
        of = f"{count(routines, 'routine')} of {trials + 1} trials" if routines else f"{trials + 1} trials"
        sentences.append(
            f"Price: {of} for each material, and commands up to {number(peak, 0)} times the steady one."
        )
    before = gamma(evidence)
    if before:
        safe = before["gamma_worst"] < 1
        sentences.append(
            f"Before anything ran, γ of the paper’s law was {number(before['gamma'], 2)} on the nominal "
            f"plant and {number(before['gamma_worst'], 2)} on the worst of its family, "
            f"above 1 on {percent(before['gamma_above_1_percent'], 2)}: "
            f"{'that law may run' if safe else 'do not run that law'} on this machine."
        )
    reports = known(evidence.tables["conformance"], {})
    short = {part: report.get("shorter_than_lead", 0) for part, report in reports.items()}
    sentences += [
        f"{count(n, 'line', 'lines').capitalize()} of {part} {'is' if n == 1 else 'are'} shorter than the "
        f"lead: the priority rule would not print {'it' if n == 1 else 'them'}."
        for part, n in short.items()
        if n
    ][:2]
    missed = [
        part
        for part in parts
        if part.chosen in part.known()
        and part.chosen != part.best()
        and part.scores[part.chosen].error > part.scores[part.best()].error + SAME
    ]
    sentences += (
        [f"The forecast chose wrongly for {where(missed[0])[:-1]}: {_bare(missed[0].best())} is better."]
        if missed
        else []
    )
    return " ".join(sentences)
