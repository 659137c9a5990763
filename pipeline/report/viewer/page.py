"""The viewer: a page that draws any time series of the run, the files of its columns, and, for where no
script runs, the picture of the deciding case."""

import base64
import hashlib
from pathlib import Path
from typing import Any, NamedTuple

from markupsafe import Markup

from pipeline.report.certificate import exported
from pipeline.report.shared import page
from pipeline.report.shared.pictures import as_table
from pipeline.report.shared.sources import Sources, copies
from pipeline.report.temperature.card import deciding
from pipeline.report.temperature.judgement import Judgement
from pipeline.report.temperature.pictures import runs_of, until_settled
from pipeline.report.viewer import packed, series
from pipeline.verdict.digits import number
from pipeline.verdict.evidence import OFF, gap_of, need, or_no_entries

VENDOR = Path(__file__).parent / "vendor"
LIBRARY = "uPlot.js"


class Viewer(NamedTuple):
    """The text of viewer.html, and the files of the folder data/ beside it."""

    text: str
    files: dict[str, str | bytes]


def render(sources: Sources, judged: Judgement) -> Viewer:
    """viewer.html and what it loads."""
    files: dict[str, str | bytes] = {
        LIBRARY: library(),
        **copies(sources),
        **exported.copies(sources, exported.lines(sources, judged.verdict)),
    }
    room = packed.LARGEST - sum(map(len, files.values()))
    entries, rows = [], []
    for shown in series.tables(sources):
        table = sources.tables["every_lesson" if shown.name == "lessons" else shown.name]
        if table is OFF:
            continue
        row: dict[str, Any] = {"title": shown.title, "note": shown.note, "missing": gap_of(table)}
        row |= dict.fromkeys(("rows", "link", "size", "source", "left_out"), "")
        rows.append(row)
        if row["missing"]:
            continue
        source = sources.source(shown.name)[0]
        link, size = source.link, packed.size_of(source)
        found = packed.packed(shown, need(table), room)
        room -= sum(map(len, found.files.values()))
        files |= found.files
        if found.entry["books"]:
            entries.append(found.entry | {"link": link, "size": size, "path": source.path})
        row |= {"rows": number(found.entry["rows"], 0), "link": link, "size": size, "source": source.path}
        row["left_out"] = [
            (found.entry["runs_left_out"], "runs"),
            (found.entry["events_left_out"], "later events"),
        ]
    script = page.environment().get_template("viewer.js").render().strip()
    text = page.render(
        "viewer.html",
        here="viewer",
        sources=sources,
        title="Viewer",
        rows=rows,
        still=still(sources, judged),
        data=Markup(packed.script_safe({"tables": entries, "start": start(sources, judged)})),
        own=Markup(script),
        own_digest=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        library_style=Markup((VENDOR / "uPlot.min.css").read_text(encoding="utf-8").strip()),
        convention=not sources.recorded,
        bound=number(packed.LARGEST / 1e6, 0),
    )
    return Viewer(text, dict(sorted(files.items())))


def library() -> str:
    """uPlot behind its licence."""
    licence = (VENDOR / "LICENSE").read_text(encoding="utf-8").strip()
    return f"/*!\n{licence}\n*/\n" + (VENDOR / "uPlot.iife.min.js").read_text(encoding="utf-8")


# ---- the deciding case


@or_no_entries
def start(sources: Sources, judged: Judgement) -> dict[str, Any]:
    """What the viewer shows where its address says nothing: the deciding case of the temperature loop."""
    table = need(sources.tables["trajectories"])
    if not len(table["time_s"]):
        return {}
    runs, zone = runs_of(sources, judged, table)
    if not runs:
        return {}
    place = {"t": "trajectories", "case_name": ["deciding"], "contestant": list(runs), "y": [zone]}
    seconds = until_settled(table, runs, zone)
    if seconds < float(table["time_s"].max()):
        place["x"] = [0.0, seconds]
    return place


@as_table(text="", picture=Markup(""), origin=Markup(""))
def still(sources: Sources, judged: Judgement) -> dict[str, Any]:
    """What stands where no script runs: the deciding case of the temperature loop, as page one draws it."""
    found = need(deciding(sources, judged, (360, 240), "The deciding case: "))
    return {
        "text": Markup("{} {}").format(found.finding, found.key),
        "picture": found.drawn,
        "origin": page.files(sources.source("trajectories")),
    }
