"""Figures of a run -> those of the three loops with their bands, and the headline that git keeps. No file, no
page."""

import json
import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from pipeline.setpoint.agents.criteria import harm_bar
from pipeline.verdict.controllers import heading
from pipeline.verdict.decide import questions
from pipeline.verdict.deposition import REFERENCE
from pipeline.verdict.evidence import Table, known
from pipeline.verdict.settings import ReportRules
from pipeline.verdict.temperature import comparison
from pipeline.verdict.verdict import Figure, Missing, Question

LOOPS = ("temperature", "deposition", "setpoint")
# {stage: its figures}; of another commit its files of reports/metrics, which may hold anything
Metrics = Mapping[str, Any]
# figure -> its name in the headline: with its unit, and short, as `dvc exp show` has a column for each
HEADLINE = {
    "temperature": {
        "settled_error": "settled_error_degC",
        "settling": "settling_s",
        "overshoot": "overshoot_degC",
        "disk": "disk_margin",
        "delay_s": "delay_margin_s",
        "cost": "cost",
    },
    "deposition": {
        "flow_error": "flow_error_percent",
        "line_volume": "line_volume_percent",
        "learned": "learned_percent",
    },
    "setpoint": {
        "settled": "settled_percent",
        "stay": "stay_percent",
        "harm": "disturbed_percent",
        "right_70_150": "right_70_150_percent",
    },
}
ENDS = ("median", "low", "high")
WORDS = {"passed": "pass", "failed": "fail"}


class RunFigures(NamedTuple):
    """{loop: {key: figure}}, and by loop whose figures they are and the verdict's words."""

    figures: Mapping[str, Mapping[str, Figure]]
    controllers: Mapping[str, str]
    verdicts: Mapping[str, str]


def asked(rules: ReportRules, metrics: Metrics) -> dict[str, list[Question]]:
    """{loop: the questions that its figures answer}; the comparison in `metrics` resolves limits that the
    rules leave open."""
    right = 100 * rules.window_right_70_150
    return {
        "temperature": [
            *questions(rules, comparison(metrics)),
            Question(0, "cost", "Cost as deployed", "", math.inf, False, ""),
        ],
        "deposition": [
            Question(0, "flow_error", "Flow error, worst part", "%", rules.flow_error_percent, False, ""),
            Question(0, "line_volume", "Volume of the worst line", "%", rules.line_volume_percent, False, ""),
            Question(0, "learned", "Error left after learning", "%", rules.learned_percent, False, ""),
        ],
        "setpoint": [
            Question(
                0, "settled", "Runs that reach the target, worst case", "%", rules.settled_percent, True, ""
            ),
            Question(0, "stay", "Runs that keep the target, worst case", "%", rules.stay_percent, True, ""),
            Question(0, "harm", "Good prints disturbed, worst case", "%", math.inf, False, ""),
            Question(0, "right_70_150", "Windows classified correctly, flow 70–150 %", "%", right, True, ""),
        ],
    }


def headline(metrics: Metrics) -> dict[str, Any]:
    """A run in few values. Each loop has its verdict with the controller that it is about ("pass: pi") and
    that controller's figures, null for infinite. `bands` has all figures as [value, low, high]. DVC shows no
    lists, so they take no columns."""
    verdicts, figures = section(section(metrics, "report"), "verdicts"), measured(metrics).figures
    values: dict[str, Any] = {}
    for loop, names in HEADLINE.items():
        verdict = section(verdicts, loop)
        state, subject = WORDS.get(str(verdict.get("state")), "undecided"), verdict.get("subject")
        values[loop] = f"{state}: {subject}" if subject else state
        values |= {name: _ends(figures[loop][key])[0] for key, name in names.items() if key in figures[loop]}
    return values | {
        "bands": {loop: {key: _ends(found) for key, found in figures[loop].items()} for loop in LOOPS}
    }


def _ends(figure: Figure) -> list[float | None]:
    return [end if math.isfinite(end) else None for end in (figure.value, figure.low, figure.high)]


def _of_headline(report: Mapping[str, Any]) -> RunFigures:
    """What `headline` wrote."""
    words = {loop: str(report.get(loop) or "").partition(": ") for loop in LOOPS}
    figures = {
        loop: {
            key: found
            for key, ends in section(report["bands"], loop).items()
            if (found := figure(dict(zip(ENDS, ends, strict=False)) if isinstance(ends, list) else None))
        }
        for loop in LOOPS
    }
    controllers = {loop: words[loop][2] for loop in ("temperature", "setpoint")}
    return RunFigures(figures, controllers, {loop: state for loop, (state, *_) in words.items() if state})


def measured(metrics: Metrics) -> RunFigures:
    """The figures of one run."""
    report, heat = section(metrics, "report"), section(metrics, "evaluate_temperature")
    if "bands" in report:
        return _of_headline(report)
    camera = section(metrics, "evaluate_setpoint")
    bands = section(report, "figures")
    subject = section(section(report, "verdicts"), "temperature").get("subject")
    names = (section(report, "verdict").get("winner"), subject, heat.get("best"))
    winner = next((name for name in names if isinstance(name, str) and name in bands), "")
    heated = {str(key): figure(ends) for key, ends in section(bands, winner).items()}
    figures = {
        "temperature": {key: found for key, found in heated.items() if found},
        "deposition": deposition(section(metrics, "compose_parts"), section(metrics, "train_ilc")),
        "setpoint": setpoint(camera, section(metrics, "train_classifier")),
    }
    verdicts = {loop: section(section(report, "verdicts"), loop).get("decision") for loop in LOOPS}
    return RunFigures(
        figures,
        {"temperature": winner, "setpoint": str(camera.get("default") or "")},
        {loop: str(decision) for loop, decision in verdicts.items() if decision},
    )


def section(data: Any, key: str) -> dict:
    """What stands under a key; {} if that is no section."""
    found = data.get(key) if isinstance(data, Mapping) else None
    return found if isinstance(found, dict) else {}


def finite(value: Any) -> float | None:
    """A number that a figure may be; None for all else, True and NaN among it."""
    if isinstance(value, bool) or not isinstance(value, int | float) or math.isnan(value):
        return None
    return float(value)


def figure(ends: Any) -> Figure | None:
    """A figure of {median, low, high}; null has no end. None for data that are no figure."""
    if not isinstance(ends, Mapping) or not {"median", "low", "high"} <= ends.keys():
        return None
    value, low, high = (
        math.inf if ends[end] is None else finite(ends[end]) for end in ("median", "low", "high")
    )
    return None if value is None or low is None or high is None else Figure(value, low, high)


def _single(value: float) -> Figure:
    """A figure without a band."""
    return Figure(value, value, value)


def deposition(parts: Mapping, laws: Mapping) -> dict[str, Figure]:
    """Worst flow error and worst line of the composers in use, and the share of trial 0's error that is left
    after learning, in %. Each is the worst material's. A real machine's forecast counts only if it is judged.
    """
    streams = [
        stream
        for part in parts.values()
        if isinstance(part, dict)
        for stream in part.values()
        if isinstance(stream, dict) and (REFERENCE in stream or section(stream, "judged").get("judged", True))
    ]
    used = [section(stream, str(stream.get("chosen"))) for stream in streams]
    learned = [
        section(material, law).get("last_ratio")
        for material in laws.values()
        for law in ("pixels", "model_inverse")
        if section(material, law)
    ]
    values = {
        "flow_error": [composer.get("rms_percent_of_on_off") for composer in used],
        "line_volume": [composer.get("worst_line_volume_percent") for composer in used],
        "learned": [100 * ratio for ratio in map(finite, learned) if ratio is not None],
    }
    numbers = {key: [n for n in map(finite, column) if n is not None] for key, column in values.items()}
    return {key: _single(max(column)) for key, column in numbers.items() if column}


def setpoint(judged: Mapping, classifier: Mapping) -> dict[str, Figure]:
    """The figures of the default controller in %: the least share of runs that reach the target, and that
    reach and keep it, over the cases that count; the largest share of good prints that it disturbs (beyond 25
    points) over the cases that have a bar; and the windows that the classifier names correctly."""
    cases = [row for row in section(judged, "cases").values() if isinstance(row, dict)]
    settled = [share for row in cases if (share := finite(row.get("settled"))) is not None]
    found = {"settled": _single(min(settled))} if settled else {}
    stays = [(share, row) for row in cases if (share := finite(row.get("stay"))) is not None]
    if stays:
        share, row = min(stays, key=lambda pair: pair[0])
        found["stay"] = figure({**row, "median": share}) or _single(share)
    disturbed = []
    for case, row in section(judged, "harm").items():
        share = finite(row.get("beyond_25")) if isinstance(row, dict) else None
        if share is not None and harm_bar(str(case), perfect=1.0, in_band=1.0) is not None:
            ends = {end: row.get(f"beyond_25_{end}", share) for end in ("low", "high")}
            disturbed.append(figure({"median": share, **ends}) or _single(share))
    if disturbed:
        found["harm"] = max(disturbed, key=lambda each: each.value)
    right = section(classifier, "right_70_150")
    if band := figure({**right, "median": right.get("percent")}) if "percent" in right else None:
        found["right_70_150"] = band
    return found


# of one curve at most
SAMPLES = 40


# {x, y: samples; across, up: names of the axes}
Curve = Mapping[str, Any]


def curves(tables: Mapping[str, Table | Missing]) -> dict[str, Curve]:
    """{name: curve} of the tables that exist."""
    return {
        name: curve
        for table, read in READERS.items()
        if (rows := known(tables[table], None))
        for name, curve in read(rows)
        if curve["x"]
    }


def as_json(drawn: Mapping[str, Curve]) -> str:
    """The curves as a text of JSON, which `accept` keeps."""
    return json.dumps(drawn, ensure_ascii=False)


def _search(table: Table) -> Iterator[tuple[str, Curve]]:
    for name in dict.fromkeys(table["contestant"]):
        rows = table["contestant"] == name
        label = f"Temperature: search of {heading(str(name))}"
        yield (
            label,
            _curve("Evaluation", "Lowest cost so far", table["evaluation"][rows], table["incumbent"][rows]),
        )


def _trials(table: Table) -> Iterator[tuple[str, Curve]]:
    """The first recorded routine with the law that is used: `pixels` if the trials were filmed."""
    law = "pixels" if "pixels" in table["law"] else "model_inverse"
    for material in dict.fromkeys(table["material"]):
        rows = (table["material"] == material) & (table["law"] == law)
        rows &= table["routine"] == min(table["routine"][rows], default=0)
        error = table["rms_measured"][rows]
        yield (
            f"Deposition: error of the measured flow, material {material}",
            _curve("Trial", "% of trial 0", table["trial"][rows], 100 * error / error[:1]),
        )


def _classifier(table: Table) -> Iterator[tuple[str, Curve]]:
    rows = table["learner"] == "vision transformer"
    loss = table["held_out_loss"][rows]
    if rows.any():  # few own pictures train no network
        yield "Setpoint: classifier, held-out loss", _curve("Epoch", "Loss", table["epoch"][rows], loss)


def _agent(table: Table) -> Iterator[tuple[str, Curve]]:
    reward = table["reward"]
    yield "Setpoint: agent, reward of a step", _curve("Update", "Mean reward", table["update"], reward)


def _curve(across: str, up: str, x: np.ndarray, y: np.ndarray) -> Curve:
    """At most SAMPLES samples, the first and the last among them, of four significant digits."""
    known = np.flatnonzero(np.isfinite(np.asarray(y, float)))
    kept = (
        known[np.unique(np.linspace(0, len(known) - 1, SAMPLES).round().astype(int))] if len(known) else known
    )
    samples = {"x": [float(x[i]) for i in kept], "y": [float(f"{y[i]:.4g}") for i in kept]}
    return {"across": across, "up": up, **samples}


# table -> what reads its curves
READERS = {"tuning": _search, "trials": _trials, "course": _classifier, "agents": _agent}
