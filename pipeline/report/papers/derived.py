"""What figures.toml asks of the papers' results beyond reading them: ellipses, lanes, stretches of time, and
tables (heads, rows)."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.report.shared.charts import Axis
from pipeline.verdict.digits import number

CLASSES = ("insufficient", "optimal", "excessive")
SHORT = {"Start": "Start", "Stop": "Stop", "Corner": "C", "Steady-State": "S-S", "No-Flow": "N-F"}
Rows = tuple[list[str], list[list[str]]]
# from the foot of a class's lane to that of the next
LANE = 1.25
LANES = Axis(0.0, 3 * LANE, tuple((i * LANE + 0.5, name) for i, name in enumerate(CLASSES)))
GUESSES = {
    "delta": "δ of (6), steps",
    "alpha": "α of (7)",
    "sigma": "σ of (7)",
    "flow_limits_percent": "Limits of the flow, %",
    "target_limits_degC": "Limits of the target, °C",
    "target_at_the_start": "Target at the start",
    "updates_by_phase": "Updates a phase",
    "environments": "Episodes at once",
    "replay_capacity": "Replay memory",
    "explore_by_phase": "Exploration as a phase begins",
    "explore_least": "and at its end",
}


def ellipse(a: float, b: float, scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Where (14) of Li and Pattinson has the value (1 - scale) / (1 + scale), turned by 70°: (flows,
    temperatures)."""
    t, turn = np.linspace(0, 2 * np.pi, 73), np.radians(70.0)
    qr, ur = scale * a * np.cos(t), scale * b * np.sin(t)
    flow = 100 + qr * np.cos(turn) + ur * np.sin(turn)
    return flow, 210 - qr * np.sin(turn) + ur * np.cos(turn)


def lanes(shares: Sequence[Sequence[float]]) -> np.ndarray:
    """The scaled share of each class, (classes, steps), in a lane of its own from nought to one."""
    return np.asarray(shares, float).T + LANE * np.arange(len(CLASSES))[:, None]


def phases(learning: Mapping[str, Any]) -> dict[str, Any]:
    """The rewards of the phases against updates, one after the other with a gap between two; and the number
    of each phase in its middle."""
    updates = np.array(learning["updates"])
    ends = np.cumsum(updates)
    x = [
        [end - one + one * (np.arange(len(part)) + 0.5) / len(part), [end]]
        for end, one, part in zip(ends, updates, learning["by_phase"], strict=True)
    ]
    y = np.concatenate([[*part, np.nan] for part in learning["by_phase"]])
    texts = [(str(i), middle, np.nanmin(y)) for i, middle in enumerate(ends - updates / 2, 1)]
    return {"x": np.concatenate(sum(x, [])), "y": y, "texts": texts}


def cuts(library: Mapping[str, Any]) -> Iterable[tuple[float, float, float, str]]:
    """The stretch of each task's signal, and where its name stands."""
    for task, (ahead, behind) in library["marks_s"].items():
        begin, end = library["events_s"][task]
        yield begin - ahead, end + behind, (begin + end) / 2, task


def begins(part: Mapping[str, Any]) -> Iterable[tuple[float, float, float, str]]:
    """Where each trained task of a part begins, with its short name."""
    for task, begin in zip(part["tasks"], part["begin_s"], strict=True):
        if task in ("Start", "Corner", "Stop"):
            yield begin, begin, begin, SHORT[task]


# ---- tables


def matrix(columns: Sequence[Mapping[str, Any]]) -> Rows:
    """The matrix (3) of Hoelzle, Alleyne and Wagoner Johnson, a row a column."""
    ends = [[number(end, 1) for end in (min(row["signal"]), max(row["signal"]))] for row in columns]
    levels = [
        number(row["signal"][0], 2) if len(row["signal"]) == 1 else " to ".join(end)
        for row, end in zip(columns, ends, strict=True)
    ]
    keys = ("material", "task", "lead", "length")
    rows = [[*(str(row[key]) for key in keys), level] for row, level in zip(columns, levels, strict=True)]
    return ["Material", "Task", "Lead", "K", "Signal in mm"], rows


def sequence(part: Mapping[str, Any]) -> Rows:
    """The tasks of a part in order."""
    rows = enumerate(zip(part["tasks"], part["begin_s"], strict=True), 1)
    return ["Order", "Task", "Begins at, s"], [[str(i), task, number(begin, 1)] for i, (task, begin) in rows]


def tasks(*parts: Mapping[str, Any]) -> Rows:
    """How often each part needs each task."""
    names = {task.replace("-", "_").lower(): task for task in SHORT}
    rows = [[names[key], *(str(part["counts"][key]) for part in parts)] for key in parts[0]["counts"]]
    return ["Task", "Figure 9", "Plain tic-tac-toe", "With all five"], rows


def starts(by_start: Mapping[str, float]) -> Rows:
    """Settled runs by start, {"flow, temperature": per cent}: temperatures down, flows across."""
    places = {tuple(part.strip() for part in name.split(",")): value for name, value in by_start.items()}
    flows, temperatures = (list(dict.fromkeys(place[k] for place in places)) for k in (0, 1))
    rows = [[t, *(number(places[flow, t], 0) for flow in flows)] for t in temperatures]
    return ["°C", *(f"{flow} %" for flow in flows)], rows


def guessed(values: Mapping[str, Any]) -> Rows:
    """What the paper does not print and we set."""

    def text(value: Any) -> str:
        if isinstance(value, list):
            return ", ".join(text(one) for one in value)
        return value if isinstance(value, str) else f"{value:,g}"

    return ["Not printed", "Ours"], [[GUESSES.get(key, key), text(value)] for key, value in values.items()]


def confusion(table: Mapping[str, np.ndarray]) -> Rows:
    """Per cent of the pictures of a true class that are named so."""
    named = [table["named"][table["label"] == label] for label in range(len(CLASSES))]
    rows = [
        [title, *(_percent(mine == k) for k in range(len(CLASSES)))]
        for title, mine in zip(CLASSES, named, strict=True)
    ]
    return ["True class", *CLASSES], rows


def by_temperature(table: Mapping[str, np.ndarray]) -> Rows:
    """Per cent of the pictures of a true class that are named right, by nozzle temperature to ten degrees."""
    near, right = np.round(table["temperature_degC"], -1), table["named"] == table["label"]
    levels = np.unique(near)
    rows = [
        [title, *(_percent(right[(table["label"] == label) & (near == level)]) for level in levels)]
        for label, title in enumerate(CLASSES)
    ]
    return ["True class", *(f"{level:g} °C" for level in levels)], rows


def _percent(mask: np.ndarray) -> str:
    return number(100 * float(mask.mean()), 0) if len(mask) else ""


def transformer(course: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """The epochs of the vision transformer: {column: values}, and the best accuracy on what was held out."""
    mine = course["learner"] == "vision transformer"
    own = {name: values[mine] for name, values in course.items()}
    return own | {"best": float(np.nanmax(own["held_out_accuracy"]))}


KNOWN = {
    function.__name__: function
    for function in (
        ellipse,
        lanes,
        phases,
        cuts,
        begins,
        matrix,
        sequence,
        tasks,
        starts,
        guessed,
        confusion,
        by_temperature,
        transformer,
    )  # fmt: skip
} | {"LANES": LANES}
