"""The page of the deposition loop: whose signal prints the parts, what it leaves of on-off control's error, what that took, and the pictures behind it."""

from typing import Any

from pipeline.report import charts, deposition_learning, deposition_library, deposition_parts, index, page, words
from pipeline.report.deposition_verdict import FLOW, LIBRARY, LINE, MARK, NAMES, OURS, PAPER, Structure, gamma, structures, verdict
from pipeline.report.digits import THIN, number, percent
from pipeline.report.sources import Sources, digest
from pipeline.report.verdict import Figure, Missing, Question

WORDS = (
    "on_off",
    "basis",
    "library",
    "priority",
    "superposition",
    "whole",
    "forecast",
    "lead",
    "trial",
    "through_pictures",
    "gamma",
    "saturation",
    "line_volume",
    "accepted",
)
SECTIONS = ("printer", "camera", "train_ilc", "segment_library", "compose_parts")


def render(sources: Sources) -> str:
    """The text of deposition.html."""
    judged, found = verdict(sources), structures(sources)
    measured = [] if isinstance(found, Missing) else found
    return page.render(
        "deposition.html",
        here="deposition",
        title=f"Deposition: {judged.decision.rstrip('.')}",
        verdict=judged,
        verdict_mark=MARK.get(judged.composer, "data_driven"),
        beforehand=_beforehand(sources),
        real=judged.real,
        no_scores=found if isinstance(found, Missing) else None,
        answers=[_answer(one) for one in measured],
        scoreboard=scoreboard(measured),
        learning=deposition_learning.pictures(sources),
        frames=deposition_learning.frames(sources),
        measured=deposition_learning.measured(sources),
        camera=deposition_learning.camera(sources),
        signals=deposition_library.signals(sources),
        assumptions=deposition_library.assumptions(sources),
        chains=deposition_library.chains(sources),
        columns=deposition_library.columns(sources),
        maps=deposition_parts.maps(sources),
        stretches=deposition_parts.stretches(sources),
        lines=deposition_parts.lines(sources),
        forecasts=deposition_parts.forecasts(sources),
        refused=deposition_parts.refused(sources),
        declared=declared(sources),
        words=words.chosen(sources, WORDS),
        sources=list(sources.read.values()),
        absent=sources.absent,
        hashes=hashes(sources),
        from_scores=sources.source("scores", "compose_parts"),
        from_film=sources.source("filmed", "models", "train_ilc"),
        from_library=sources.source("library", "learned", "models"),
        from_lines=sources.source("lines", "conformance"),
    )


def hashes(sources: Sources) -> list[tuple[str, str]]:
    """Short digests by which two pages can be told to be of one run."""
    tables = {source.name: source.sha256 for source in sources.read.values()}
    found = [(word, tables.get(name, "missing")) for word, name in (("trials", "trials"), ("library", "library"), ("scores", "scores"))]
    return [(name, value[:8]) for name, value in [*found, ("parameters", digest(sources.declared.everything)), ("code", sources.code)]]


def _beforehand(sources: Sources) -> str:
    found = gamma(sources)
    if found is None:
        return "The convergence of the paper’s law was not tested beforehand; ours identifies the machine in its first trials and goes back to the best one where the error rises."
    return (
        f"Tested before anything ran: with γ = max |Q² (1 − L P)| below 1 the paper’s law shrinks the error at every trial. γ is {number(found['gamma'], 2)} on the nominal plant and up to "
        f"{number(found['gamma_worst'], 2)} over its family, above 1 on {percent(found['gamma_above_1_percent'], 2)} of it: there the law may look fine for a dozen trials and then diverge. "
        "Ours identifies the machine in its first trials, and goes back to the best one where the error rises."
    )


# ---- the first screen: a row for each structure and material


def _answer(one: Structure) -> dict[str, Any]:
    """Ours beside the library on one scale, the strip's limit in its middle; the worst line's volume of the composer that was chosen."""
    question = Question(0, "", one.part, "%", FLOW, False, "")
    shown = [
        (NAMES[name], css, Figure(*3 * (one.scores[name].error,)) if name in one.scores else Missing("not measured", "no score"))
        for name, css in ((OURS, "dd"), (LIBRARY, "mb"), ("ilc", "acc"))
    ]
    chosen = one.scores.get(one.chosen)
    line = chosen.worst_line if chosen else None
    best = one.best()
    return {
        "part": one.part,
        "material": one.material,
        "state": one.state(),
        "cells": [
            {
                "css": css,
                "name": NAMES[name],
                "value": percent(one.scores[name].error, 2) if name in one.scores else "not measured",
                "band": _forecast(one.scores[name].predicted) if name in one.scores else "",
                "bad": name in one.scores and one.scores[name].error > FLOW,
                "best": name == best,
            }
            for css, name in (("dd", OURS), ("mb", LIBRARY))
        ],
        "whole": percent(one.scores["ilc"].error, 2) if "ilc" in one.scores else "none",
        "strip": charts.strip(question, shown, (9, 25, 17)),
        "line": "no line" if line is None else percent(line, 2),
        "line_bad": line is not None and line > LINE,
        "chosen": NAMES.get(one.chosen, one.chosen),
    }


def _forecast(value: float | None) -> str:
    return "" if value is None else f"forecast {percent(value, 2)}"


def scoreboard(found: list[Structure]) -> dict[str, Any]:
    """Structures and materials down, composers across: true error, what was forecast, and the worst line's volume."""
    names = ("basis", "priority", "superposition", "on_off", "ilc")
    heads = [{"mark": MARK[name], "name": NAMES[name], "method": PAPER[name]} for name in names]
    rows = []
    for one in found:
        best = one.best()
        cells = []
        for name in names:
            score = one.scores.get(name)
            if score is None:
                cells.append({"value": "not measured", "band": "", "line": "", "best": False, "bad": False, "chosen": False, "line_bad": False})
                continue
            cells.append(
                {
                    "value": percent(score.error, 2),
                    "band": _forecast(score.predicted),
                    "line": "no line long enough" if score.worst_line is None else f"worst line {percent(score.worst_line, 2)}",
                    "best": name == best,
                    "bad": score.error > FLOW and name != "on_off",
                    "line_bad": score.worst_line is not None and score.worst_line > LINE and name != "on_off",
                    "chosen": name == one.chosen,
                }
            )
        rows.append({"part": one.part, "material": one.material, "cells": cells})
    return {"heads": heads, "rows": rows, "limit": f"{FLOW:g}{THIN}%", "line": f"±{LINE:g}{THIN}%"}


def declared(sources: Sources) -> list[tuple[str, list[tuple[str, str]]]]:
    """Sections of params.yaml that this loop reads, flattened, as text."""
    return [(section, _flat(sources.declared.everything.get(section, {}))) for section in SECTIONS]


def _flat(data: Any, name: str = "") -> list[tuple[str, str]]:
    if isinstance(data, dict):
        return [pair for key, value in data.items() for pair in _flat(value, f"{name}.{key}" if name else str(key))]
    if isinstance(data, list) and any(isinstance(item, dict) for item in data):
        return [(f"{name}[{i}]", ", ".join(f"{key} {value}" for key, value in item.items())) for i, item in enumerate(data)]
    if isinstance(data, list):
        return [(name, ", ".join(map(str, data)))]
    return [(name, "none" if data is None else str(data))]


