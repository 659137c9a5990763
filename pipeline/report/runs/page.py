"""The page of the runs: one table that sorts, a scatter of two columns, two runs side by side, the sweeps.

The table and the sweeps need no script. What the script needs of a run (figures with their bands, parameters,
reasons) stands in the page once; curves lie in files beside it and are loaded when two runs are compared.
"""

import base64
import hashlib
import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from markupsafe import Markup

from pipeline.report.runs import curves, sweep
from pipeline.report.runs.collected import KINDS, Collected, Run, folders, lock_now, varied
from pipeline.report.runs.figures import LOOPS, Cell, Column, cell, rounded
from pipeline.report.runs.sweep import Sweep
from pipeline.report.shared import page
from pipeline.report.shared.digits import count, shortened
from pipeline.report.temperature.contestants import heading
from pipeline.report.viewer.packed import script_safe
from pipeline.report.viewer.page import LIBRARY, VENDOR, library

FOLDER = Path("reports/runs")
# columns of parameters that the table has room for, sweeps that are drawn, and letters of a subject
MOST_PARAMETERS, MOST_SWEEPS, SUBJECT = 6, 12, 120
WORDS = {
    "accepted": "accepted",
    "night": "night",
    "experiment": "experiment",
    "revision": "committed",
    "files": "not committed",
}


class Row(NamedTuple):
    """A run in the table. `missing`: why figures are not there, each reason once."""

    run: Run
    name: str
    kind: str
    verdicts: list[str]
    controllers: str
    cells: list[Cell]
    parameters: list[str]
    missing: str


class Drawn(NamedTuple):
    """A sweep in words and as a picture."""

    metric: str
    over: str
    picture: Markup
    finding: str
    caption: str


class Pages(NamedTuple):
    """The text of runs.html, and the files of the folder runs/ beside it."""

    text: str
    files: dict[str, str]


def render(found: Collected, asked: Sequence[Column], sweeps: Sequence[Sweep]) -> Pages:
    """runs.html and what it loads."""
    runs = found.runs
    packed = curves.packed(runs, folders(lock_now()))
    keys = _parameter_columns(runs)
    script = page.environment().get_template("runs.js").render().strip()
    text = page.render(
        "runs.html",
        here="runs",
        title=f"Runs: {count(len(runs), 'run')}",
        kinds=_kinds(runs),
        asked=asked,
        keys=keys,
        loops=LOOPS,
        rows=[_row(run, asked, keys) for run in reversed(runs)],
        troubles=found.troubles,
        sweeps=[_drawn(each) for each in reversed(sweeps[-MOST_SWEEPS:])],
        more_sweeps=max(len(sweeps) - MOST_SWEEPS, 0),
        data=Markup(script_safe(data(runs, asked, packed))),
        own=Markup(script),
        own_digest=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        library_style=Markup((VENDOR / "uPlot.min.css").read_text(encoding="utf-8").strip()),
    )
    return Pages(text, {LIBRARY: library(), **packed.files})


def name_of(run: Run) -> str:
    """What a run is called: a night's or an experiment's name, else its commit."""
    return run.name or run.commit[:8] or "files"


def _kinds(runs: Sequence[Run]) -> str:
    counted = Counter(run.kind for run in runs)
    words = {"accepted": "accepted run", "night": "night", "experiment": "experiment"}
    parts = [count(counted[kind], word) for kind, word in words.items() if counted[kind]]
    rest = counted["revision"] + counted["files"]
    return ", ".join([*parts, *([f"{count(rest, 'run')} that nobody accepted"] if rest else [])])


def _parameter_columns(runs: Sequence[Run]) -> list[str]:
    """Parameters that the table shows: those in which experiments differ from where they began, the most
    frequent first."""
    by_commit = {run.commit: run for run in runs if run.commit}
    changed: Counter[str] = Counter()
    tried = [run for run in runs if run.kind == "experiment"]
    for run in tried:
        base = by_commit.get(run.base)
        changed.update(varied([run, base] if base else tried))
    keys = [key for key, _ in sorted(changed.items(), key=lambda pair: (-pair[1], pair[0]))]
    return keys[:MOST_PARAMETERS]


# ---- the table


def _row(run: Run, asked: Sequence[Column], keys: Sequence[str]) -> Row:
    reasons = dict.fromkeys(run.measured.missing.values())
    if run.no_parameters and keys:
        reasons |= {run.no_parameters: None}
    who = [heading(name) for name in run.measured.controllers.values() if name]
    unset = "not measured" if run.no_parameters else "not set"
    return Row(
        run,
        name_of(run),
        WORDS[run.kind],
        [run.measured.verdicts.get(loop, "none kept") for loop in LOOPS],
        " · ".join(who) or "none kept",
        [cell(run.measured.figures.get(column.key), column.question) for column in asked],
        [run.parameters.get(key, unset) for key in keys],
        "; ".join(reasons),
    )


# ---- what the script reads


def data(runs: Sequence[Run], asked: Sequence[Column], packed: curves.Packed) -> dict[str, Any]:
    """Columns, and of each run its figures, its parameters as changes to the run before it, and its reasons;
    texts that come often stand once, and are numbered."""
    texts: dict[str, int] = {}

    def numbered(text: str) -> int:
        return texts.setdefault(text, len(texts))

    entries: list[dict[str, Any]] = []
    before: dict[str, str] = {}
    for run, (file, drawn), why in zip(runs, packed.places, packed.why, strict=True):
        own = dict(run.parameters)
        changes = [
            number
            for key in (*before, *(key for key in own if key not in before))
            if before.get(key) != own.get(key)
            for number in (numbered(key), numbered(own[key]) if key in own else -1)
        ]
        before = own
        figures = run.measured.figures
        entry = {
            "name": shortened(name_of(run)),
            "id": run.name or run.commit[:10] or "files",
            "kind": KINDS.index(run.kind),
            "date": run.date[:16].replace("T", " "),
            "subject": shortened(run.subject, SUBJECT),
            "figures": [_triple(figures[c.key]) if c.key in figures else None for c in asked],
            "missing": [numbered(run.measured.missing.get(c.key, "")) for c in asked],
            "verdicts": [run.measured.verdicts.get(loop, "") for loop in LOOPS],
            "who": [heading(run.measured.controllers.get(loop, "")) for loop in LOOPS],
            "changes": changes,
            "none": run.no_parameters,
            "file": file,
            "curves": [numbered("\n".join(curve)) for curve in drawn],
            "why": numbered(why),
        }
        entries.append(entry)
    return {
        "runs": entries,
        "texts": list(texts),
        "kinds": [WORDS[kind] for kind in KINDS],
        "columns": [
            {
                "key": column.key,
                "loop": column.loop,
                "title": column.question.title,
                "unit": column.question.unit,
                "limit": column.question.limit if math.isfinite(column.question.limit) else None,
                "more": column.question.at_least,
                "beyond": column.question.beyond,
            }
            for column in asked
        ],
        "loops": LOOPS,
    }


def _triple(figure) -> list[float | str]:
    """[value, low, high], one number where all are equal; JSON knows no infinity."""
    ends = [rounded(v) if math.isfinite(v) else "inf" if v > 0 else "-inf" for v in figure[:3]]
    return ends[:1] if ends[0] == ends[1] == ends[2] else ends


# ---- sweeps


def _drawn(swept: Sweep) -> Drawn:
    keys = ", ".join(swept.keys)
    return Drawn(swept.metric, keys, sweep.picture(swept), sweep.finding(swept), sweep.caption(swept))
