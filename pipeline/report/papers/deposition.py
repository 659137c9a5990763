"""Figures of Hoelzle, Alleyne and Wagoner Johnson 2009 from our runs, in their axes."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from markupsafe import Markup

from pipeline.report.papers.figures import HEIGHT, WIDTH, PaperCurve, PaperFigure, axis, plot
from pipeline.report.shared import charts
from pipeline.report.shared.sources import Sources
from pipeline.verdict.digits import number

SHORT = {"Start": "Start", "Stop": "Stop", "Corner": "C", "Steady-State": "S-S", "No-Flow": "N-F"}


def pictures(results: Mapping[str, Any], sources: Sources) -> list[PaperFigure]:
    """Figures 3 to 6, matrix (3), 9, 10 and 12. Figures 1, 2, 7 and 8 are diagrams, 11 is a photograph."""
    learning, library = results["learning"], results["library"]
    return [
        PaperFigure(
            "Figure 3",
            f"Flow at trials {', '.join(_trials(learning))}",
            [_flow(learning, name) for name in ("A", "B")],
            "Of the steady flow. Grey: wanted. Dotted, dashed, solid: these trials.",
        ),
        PaperFigure(
            "Figure 4",
            "R.m.s. error at each trial",
            [_errors(learning), _delays(learning)],
            "The second panel is not in the paper: A with a delay that the law’s model lacks.",
        ),
        PaperFigure("Figure 5", "Input at trial 31", [_inputs(learning)], "Ramps and pause stand out."),
        PaperFigure(
            "Figure 6",
            "The input of A, cut",
            [_cut(library)],
            "Tinted: the signal of a task. The rest is level.",
        ),
        PaperFigure(
            "Matrix (3)",
            "Our library",
            [],
            f"Lead and K in samples, {number(results['settings']['rate_hz'], 0)} a second.",
            _matrix(library),
        ),
        PaperFigure(
            "Figure 9", "Sequence of tasks", [], "Exactly the paper’s.", _sequence(results["figure_9"])
        ),
        PaperFigure(
            "Figure 10",
            "Sequenced basis signals",
            [_sequenced(results["figure_9"]), _printed(results["figure_9"])],
            "Strokes: where a task begins. Our gantry hardly slows at a corner: its signal is nearly level.",
        ),
        PaperFigure(
            "Figure 12",
            "Tic-tac-toe with all five tasks",
            [_map(results["five_tasks"]["path"])],
            "Solid: material A. Dashed: material B. Square and triangle have the corners.",
            _tasks(results),
        ),
    ]


def _trials(learning: Mapping[str, Any]) -> list[str]:
    return [name.removeprefix("trial_") for name in learning["A"]["flow"]]


def _flow(learning: Mapping[str, Any], name: str) -> Markup:
    time, of = learning["time_s"], learning[name]["flow"]
    curves = [
        PaperCurve(time, learning["wanted"], "line bl"),
        *(PaperCurve(time, y, css) for css, y in zip(("ref", "line dash", "line"), of.values(), strict=True)),
    ]
    return plot(
        curves,
        title=f"normalised flow of {name}, against s",
        alt=f"At the end {name} has {number(learning[name]['ratio_30'], 1)} % of the error of trial 0",
    )


def _errors(learning: Mapping[str, Any]) -> Markup:
    rows = {name: learning[name]["ratio"] for name in ("A", "B")}
    curves = [
        PaperCurve(range(len(rows["A"])), rows["A"], "line", "A"),
        PaperCurve(range(len(rows["B"])), rows["B"], "line dash"),
    ]
    return plot(
        curves,
        title="r.m.s. error in % of trial 0’s, against trials",
        alt=f"The error falls to {number(min(rows['A']), 1)} % for A and {number(min(rows['B']), 1)} % for B",
        up=axis(0, 100),
        levels=[(20.0, "printed bound")],
    )


def _delays(learning: Mapping[str, Any]) -> Markup:
    styles = ("line", "line dash", "line bl")
    curves = [
        PaperCurve(range(len(rows)), rows, css)
        for css, rows in zip(styles, learning["delays"].values(), strict=True)
    ]
    told = ", ".join(
        f"{number(rows[-1], 1)} % with {name.split('_')[1]} ms" for name, rows in learning["delays"].items()
    )
    return plot(
        curves,
        title="the same of A, delayed: solid none, dashed, grey most",
        alt=f"The error ends at {told} of delay",
        up=axis(0, 100),
    )


def _inputs(learning: Mapping[str, Any]) -> Markup:
    time = learning["time_s"]
    curves = [
        PaperCurve(time, learning["B"]["command"], "line bl", "B"),
        PaperCurve(time, learning["A"]["command"], "line"),
    ]
    return plot(
        curves,
        title="plunger in mm, against s; grey B, black A",
        alt=f"B needs {number(learning['effort']['rms_ratio'], 2)} times the r.m.s. command of A",
    )


def _cut(library: Mapping[str, Any]) -> Markup:
    time, u = library["time_s"], library["command"]
    low, high = min(u), max(u)
    frame = charts.Frame(
        charts.linear(0, max(time)), axis(low, high), WIDTH, HEIGHT, left=52, below=22, above=24, right=12
    )
    layers = [charts.line(frame, time, u)]
    for task, (ahead, behind) in library["marks_s"].items():
        begin, end = library["events_s"][task]
        layers.append(charts.interval(frame, begin - ahead, end + behind))
        layers.append(charts.label(frame, (begin + end) / 2, low, task, anchor="middle", dy=-2))
    return charts.panel(
        frame,
        layers,
        alt=f"The command of A, {number(high, 1)} mm at most, with the stretches of Start, Corner and Stop",
        title="plunger in mm, against s",
    )


def _matrix(library: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    rows = [
        [row["material"], row["task"], str(row["lead"]), str(row["length"]), _level(row["signal"])]
        for row in library["columns"]
    ]
    return ["Material", "Task", "Lead", "K", "Signal in mm"], rows


def _level(signal: list[float]) -> str:
    low, high = min(signal), max(signal)
    return number(low, 2) if len(signal) == 1 else f"{number(low, 1)} to {number(high, 1)}"


def _sequence(part: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    rows = zip(range(1, len(part["tasks"]) + 1), part["tasks"], part["begin_s"], strict=True)
    return ["Order", "Task", "Begins at, s"], [[str(i), task, number(begin, 1)] for i, task, begin in rows]


def _sequenced(part: Mapping[str, Any]) -> Markup:
    time, u = part["time_s"], part["command"]
    frame = charts.Frame(
        charts.linear(0, max(time)),
        axis(min(u), max(u)),
        WIDTH,
        HEIGHT,
        left=52,
        below=22,
        above=24,
        right=12,
    )
    layers = [charts.line(frame, time, u)]
    for task, begin in zip(part["tasks"], part["begin_s"], strict=True):
        if task in ("Start", "Corner", "Stop"):
            layers.append(charts.interval(frame, begin, begin))
            layers.append(charts.label(frame, begin, min(u), SHORT[task], dx=4, dy=-2))
    return charts.panel(
        frame,
        layers,
        alt=f"The command of figure 9: {len(part['tasks'])} tasks in sequence",
        title="plunger in mm, against s",
    )


def _printed(part: Mapping[str, Any]) -> Markup:
    return plot(
        [
            PaperCurve(part["time_s"], part["wanted"], "line bl"),
            PaperCurve(part["time_s"], part["flow"], "line"),
        ],
        title="normalised flow, against s",
        alt=f"The flow misses the wanted one by {number(part['worst_percent'], 1)} % of what on-off does",
    )


def _map(path: list[Mapping[str, Any]]) -> Markup:
    high = max(max(row["y"]) for row in path)
    wide = max(max(row["x"]) for row in path)
    frame = charts.Frame(
        axis(0, wide), axis(0, high), WIDTH, WIDTH - 40, left=52, below=22, above=24, right=12
    )
    layers = [
        charts.line(frame, np.asarray(row["x"]), np.asarray(row["y"]), "line dash" if row["tool"] else "line")
        for row in path
    ]
    return charts.panel(
        frame,
        layers,
        alt=f"{len(path)} printed strokes: lines, crosses, rings, a square and a triangle",
        title="mm, against mm",
    )


def _tasks(results: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """How often each part needs each task."""
    parts = [results[key]["counts"] for key in ("figure_9", "tic_tac_toe", "five_tasks")]
    names = {key: task for task in SHORT for key in [task.replace("-", "_").lower()]}
    rows = [[names[key], *(str(counts[key]) for counts in parts)] for key in parts[0]]
    return ["Task", "Figure 9", "Plain tic-tac-toe", "With all five"], rows
