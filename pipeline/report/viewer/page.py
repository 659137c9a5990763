"""The viewer: a page that draws any time series of the run, the files of its columns, and, for where no
script runs, the picture of the deciding case."""

import base64
import hashlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup

from pipeline.report.certificate import exported
from pipeline.report.shared import charts, page
from pipeline.report.shared.pictures import as_table
from pipeline.report.shared.sources import Sources, copies
from pipeline.report.temperature.judgement import Judgement
from pipeline.report.temperature.pictures import degrees_axis, runs_of, until_settled
from pipeline.report.viewer import packed, series
from pipeline.verdict.controllers import heading
from pipeline.verdict.digits import THIN, number, short
from pipeline.verdict.evidence import OFF, Absent, gap_of, need, or_no_entries
from pipeline.verdict.verdict import Missing

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
        row["left_out"] = _left_out(found.entry)
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


def _left_out(entry: dict[str, Any]) -> str:
    """What of a table the viewer does not have, in words; "" where it has all of it."""
    parts = []
    if entry["runs_left_out"]:
        parts.append(f"{number(entry['runs_left_out'], 0)} runs have no room here")
    if entry["events_left_out"]:
        parts.append(f"{number(entry['events_left_out'], 0)} later events have no room here")
    return f"{'; '.join(parts)}: see the Parquet file." if parts else ""


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


STYLES = {"dd": "line dd", "mb": "line", "bl": "line bl"}


@as_table(text="", picture=Markup(""), names=[], origin=Markup(""))
def still(sources: Sources, judged: Judgement) -> dict[str, Any]:
    """The output furthest from its reference in the deciding case, a numbered line a contestant."""
    table = need(sources.tables["trajectories"])
    runs, zone = runs_of(sources, judged, table)
    if not runs:
        raise Absent(Missing("not measured", "no trajectory of the deciding case was recorded"))
    label = sources.zone([o.name for o in sources.declared.machine.outputs].index(zone))
    seconds, time = until_settled(table, runs, zone), table["time_s"]
    early = {who: rows[time[rows] <= seconds] for who, rows in runs.items()}
    frame = charts.Frame(
        charts.linear(0, seconds or 1.0),
        degrees_axis(table, np.concatenate(list(early.values())), zone),
        width=360,
        height=240,
        left=44,
        below=20,
        above=20,
        right=18,
    )
    first = next(iter(early.values()))
    layers = [charts.line(frame, time[first], table[f"{zone}_reference"][first], "ref")]
    names, used = [], set()
    for i, (who, rows) in enumerate(early.items(), 1):
        style, y = STYLES.get(page.MARKS.get(who, "bl"), "line"), table[zone][rows]
        layers.append(charts.line(frame, time[rows], y, style + (" dash" if style in used else "")))
        used.add(style)
        end = float(np.abs(table[zone] - table[f"{zone}_reference"])[runs[who][-1]])
        names.append(f"{i} {heading(who)}: ends {short(end, 2)}{THIN}°C from it")
        # a number of its own height each, where the line comes by
        at = int(np.argmax(np.abs(y - y[0]) >= np.ptp(y) * i / (len(runs) + 1)))
        layers.append(charts.label(frame, time[rows[at]], y[at], str(i), dx=5, dy=4))
    text = f"The deciding case: {label} under {len(runs)} contestants, dashed its reference."
    shown = f"The first {short(seconds, 2)} s. " if seconds < float(time.max()) else ""
    alt, units = f"{text} {'; '.join(names)}", ("s", "°C")
    picture = charts.panel(frame, layers, alt=alt, css="mb", title=f"{label}, °C", units=units)
    return {
        "text": f"{text} {shown}".strip(),
        "picture": picture,
        "names": names,
        "origin": page.files(sources.source("trajectories")),
    }
