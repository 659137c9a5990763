"""A sweep: one metric over the values of its parameters, repeats beside one another, as a picture."""

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from markupsafe import Markup

from pipeline.report.shared import charts
from pipeline.report.shared.digits import count, short
from pipeline.store import artifacts

FILE, MOST = Path(".beadline/sweeps.json"), 100
SEED = re.compile(r"(^|[._])seeds?$")
# series that a picture can name at the ends of their lines
MOST_SERIES, TICKS = 6, 6


class Point(NamedTuple):
    """An experiment of a sweep: its name, its values in the order of the sweep's keys, its metric, and why
    there is none (then NaN)."""

    name: str
    values: tuple[str, ...]
    figure: float
    why: str = ""


class Sweep(NamedTuple):
    """What was tried: the metric as STAGE:dotted.key, the keys of the grid, a point an experiment."""

    metric: str
    keys: tuple[str, ...]
    points: tuple[Point, ...]


class Layout(NamedTuple):
    """Which key runs along the axis, which tell series apart, and which only repeat (seeds)."""

    across: str
    series: tuple[str, ...]
    repeats: tuple[str, ...]


class Series(NamedTuple):
    """A line of a sweep: its name, its places, the median of each place, and [(place, figure)] of each
    repeat."""

    name: str
    places: list[float]
    medians: list[float]
    dots: list[tuple[float, float]]


def layout(sweep: Sweep) -> Layout:
    """Along the axis the first key of several values that is no seed, else the first of several values. A
    seed repeats where another key runs along the axis."""
    many = [key for i, key in enumerate(sweep.keys) if len({point.values[i] for point in sweep.points}) > 1]
    wanted = [key for key in many if not SEED.search(key)]
    across = next(iter([*wanted, *many, *sweep.keys]))
    repeats = tuple(key for key in many if key != across and SEED.search(key))
    return Layout(across, tuple(key for key in wanted if key != across), repeats)


def numbers(values: Sequence[str]) -> list[float] | None:
    """The values as finite numbers; None where one is none."""
    try:
        found = [float(value) for value in values]
    except ValueError:
        return None
    return found if all(map(math.isfinite, found)) else None


def axis(values: Sequence[str]) -> tuple[charts.Axis, dict[str, float]]:
    """The axis of a parameter, and the place of each of its values: by value where all are numbers (in
    decades where they span fifty to one), else side by side."""
    given = list(dict.fromkeys(values))
    found = numbers(given)
    if found is None:
        places = {value: float(k) for k, value in enumerate(given)}
        return charts.Axis(-0.5, len(given) - 0.5, tuple((k, v) for v, k in places.items())), places
    low, high, places = min(found), max(found), dict(zip(given, found, strict=True))
    if low > 0 and high > 50 * low:
        return charts.logarithmic(low, high), places
    room = 0.06 * (high - low) or 0.5
    if len(set(found)) > TICKS:
        return charts.linear(low - room, high + room)._replace(ticks=charts.linear(low, high).ticks), places
    ticks: list[tuple[float, str]] = []
    for number, value in sorted({number: value for value, number in places.items()}.items()):
        if not ticks or number - ticks[-1][0] > 0.1 * (high - low):
            ticks.append((number, value))
    return charts.Axis(low - room, high + room, tuple(ticks)), places


def series(sweep: Sweep) -> list[Series]:
    """The lines, in the order in which they were tried; what has no figure is in none."""
    told = layout(sweep)
    at = [sweep.keys.index(key) for key in told.series]
    x = sweep.keys.index(told.across)
    places = axis([point.values[x] for point in sweep.points])[1]
    found: dict[str, list[tuple[float, float]]] = {}
    for point in sweep.points:
        name = ", ".join(f"{sweep.keys[i]} {point.values[i]}" for i in at)
        dots = found.setdefault(name, [])
        if math.isfinite(point.figure):
            dots.append((places[point.values[x]], point.figure))
    lines = []
    for name, dots in found.items():
        where = sorted({place for place, _ in dots})
        medians = [float(np.median([y for x, y in dots if x == place])) for place in where]
        lines.append(Series(name, where, medians, dots))
    return lines


def _scale(values: np.ndarray) -> charts.Axis:
    low, high = float(values.min()), float(values.max())
    if low > 0 and high > 50 * low:
        return charts.logarithmic(low, high)
    room = 0.1 * (high - low) or 0.05 * abs(high) or 1.0
    return charts.linear(low - room, high + room)


def picture(sweep: Sweep) -> Markup:
    """The metric over the parameter: a dot an experiment, a line through the medians of repeats; a series
    each for the values of the other parameters. Without one figure a sentence."""
    told, lines = layout(sweep), series(sweep)
    values = np.array([y for line in lines for _, y in line.dots])
    if not len(values):
        return Markup('<p class="finding"><strong>Not measured.</strong> No experiment gave {}.</p>').format(
            sweep.metric
        )
    x = sweep.keys.index(told.across)
    across, _ = axis([point.values[x] for point in sweep.points])
    named = len(lines) <= MOST_SERIES and len(lines) > 1
    frame = charts.Frame(across, _scale(values), 360, 250, left=52, below=22, above=22, right=24)
    layers = []
    for number, line in enumerate(lines, 1):
        if len(line.places) > 1:
            layers.append(charts.line(frame, line.places, line.medians))
        where, heights = (np.array(part) for part in zip(*line.dots, strict=True)) if line.dots else ((), ())
        layers.append(charts.dots(frame, where, heights, radius=3))
        if named and line.dots:
            end = (line.places[-1], line.medians[-1])
            layers.append(charts.label(frame, *end, str(number), dx=6, dy=4))
    return charts.panel(frame, layers, alt=finding(sweep), css="mb sweep", title=sweep.metric[-44:])


def finding(sweep: Sweep) -> str:
    """Where the metric is lowest and highest, in words."""
    told, lines = layout(sweep), series(sweep)
    x = sweep.keys.index(told.across)
    words = {place: value for value, place in axis([p.values[x] for p in sweep.points])[1].items()}
    ends = [
        (median, f"{told.across} {words[place]}{f' ({line.name})' if line.name else ''}")
        for line in lines
        for place, median in zip(line.places, line.medians, strict=True)
    ]
    if not ends:
        return f"{sweep.metric} was not measured"
    (low, where), (high, other) = min(ends), max(ends)
    if low == high:
        return f"{sweep.metric} is {short(low, 4)} in every experiment"
    return f"{sweep.metric}: lowest at {where}, {short(low, 4)}; highest at {other}, {short(high, 4)}"


def caption(sweep: Sweep) -> str:
    """What the picture shows: its axis, its dots and its lines."""
    told, lines = layout(sweep), series(sweep)
    parts = [f"Across: {told.across}."]
    most = max((sum(x == place for x, _ in line.dots) for line in lines for place in line.places), default=0)
    if most > 1:
        by = f" over {' and '.join(told.repeats)}" if told.repeats else ""
        parts.append(f"A dot is an experiment; the line joins the medians of at most {most} repeats{by}.")
    if 1 < len(lines) <= MOST_SERIES:
        parts.append(" ".join(f"{k} {line.name}." for k, line in enumerate(lines, 1)))
    elif len(lines) > MOST_SERIES:
        parts.append(f"{len(lines)} lines, one for each choice of {', '.join(told.series)}.")
    failed = sum(not math.isfinite(point.figure) for point in sweep.points)
    if failed:
        parts.append(f"{count(failed, 'experiment')} gave no figure.".capitalize())
    return " ".join(parts)


def remembered() -> tuple[list[Sweep], list[str]]:
    """The sweeps of this checkout, the oldest first, and a sentence where their file cannot be read."""
    if not FILE.exists():
        return [], []
    try:
        return read(artifacts.read_json(FILE)), []
    except (ValueError, OSError) as error:
        return [], [f"Sweeps are left out: {' '.join(str(error).split())}."]


def remember(sweep: Sweep) -> None:
    """One more sweep; one of the same metric and keys takes the place of its last."""
    before = [each for each in remembered()[0] if (each.metric, each.keys) != (sweep.metric, sweep.keys)]
    artifacts.write_json(FILE, [written(each) for each in [*before, sweep][-MOST:]])


def read(rows: object) -> list[Sweep]:
    """The sweeps of what `written` gave, the oldest first; what is none is left out."""
    found = []
    for row in rows if isinstance(rows, list) else []:
        try:
            points = tuple(
                Point(
                    str(point["name"]),
                    tuple(map(str, point["values"])),
                    math.nan if point["figure"] is None else float(point["figure"]),
                    str(point.get("why", "")),
                )
                for point in row["points"]
            )
            swept = Sweep(str(row["metric"]), tuple(map(str, row["keys"])), points)
        except (KeyError, TypeError, ValueError, AttributeError):
            continue
        if swept.keys and points and all(len(point.values) == len(swept.keys) for point in points):
            found.append(swept)
    return found


def written(sweep: Sweep) -> dict:
    """As .beadline/sweeps.json has it."""
    points = [
        {
            "name": point.name,
            "values": list(point.values),
            "figure": point.figure if math.isfinite(point.figure) else None,
            "why": point.why,
        }
        for point in sweep.points
    ]
    return {"metric": sweep.metric, "keys": list(sweep.keys), "points": points}
