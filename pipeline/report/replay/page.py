"""The page of one replayed recording: what was measured and applied, what the controller would have asked,
and what held it back. It is made of arrays alone, and needs nothing but itself."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup

from pipeline.report.shared import charts, page
from pipeline.verdict.digits import count

WIDE, TALL = 880, 170


class ReplayData(NamedTuple):
    """time_s (T,), by input applied and asked (T, m), by output measured and reference (T, p), off (T,) of
    support, names of both, and replay.json."""

    time_s: np.ndarray
    applied: np.ndarray
    asked: np.ndarray
    measured: np.ndarray
    reference: np.ndarray
    off: np.ndarray
    inputs: Sequence[str]
    outputs: Sequence[str]
    told: Mapping[str, Any]


def render(shown: ReplayData) -> str:
    """The text of index.html."""
    told = shown.told
    return page.render(
        "replay.html",
        here="replay",
        title=f"Replay of {told['recording']}",
        state="open" if told["abstains"] else "passed",
        decision=decision(told),
        word="Simulation: the controller was made for a simulated plant." if told["simulated"] else "",
        told=told,
        rows=rows(told),
        temperatures=[
            _plot(shown, (shown.measured[:, j], shown.reference[:, j]), name, "°C")
            for j, name in enumerate(shown.outputs)
        ],
        commands=[
            _plot(
                shown, (shown.applied[:, i], *(() if told["abstains"] else (shown.asked[:, i],))), name, "%"
            )
            for i, name in enumerate(shown.inputs)
        ],
    )


def decision(told: Mapping[str, Any]) -> str:
    """What the replay says of the recording first."""
    if told["abstains"]:
        return "It abstains: the recording is off the support of what was learned."
    means = told["asked_otherwise_percent"] or {}
    if not means:
        return "The recording is too short for a replay."
    most, name = max((mean, name) for name, mean in means.items())
    return f"It would have asked otherwise by {most:.2g} percent on average at most, on {name}."


def rows(told: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Shares of the samples, in words."""
    off = [(f"Off support: {name}", share) for name, share in told["off_support"].items()]
    held = [
        (f"{name} held back by {'its ' if word in ('limit', 'rate') else 'the '}{word}", share)
        for name, words in told["held_back"].items()
        for word, share in words.items()
        if share
    ]
    causes = [(f"Supervisor: {kind}", share) for kind, share in told["causes"].items()]
    return [
        ("Samples", count(told["samples"], "sample")),
        *((name, f"{100 * share:.3g} % of the samples") for name, share in (*off, *held, *causes)),
    ]


def _plot(shown: ReplayData, lines: Sequence[np.ndarray], name: str, unit: str) -> Markup:
    """What was (first) and what was asked for (second, dashed), off support in grey."""
    time = shown.time_s
    low, high = min(float(line.min()) for line in lines), max(float(line.max()) for line in lines)
    room = 0.05 * (high - low) or 1.0
    frame = charts.Frame(
        charts.linear(float(time[0]), float(time[-1]), ticks=8),
        charts.linear(low - room, high + room),
        width=WIDE, height=TALL, left=44,
    )  # fmt: skip
    layers = [
        charts.interval(frame, float(time[a]), float(time[b - 1]))
        for a, b in charts.stretches(shown.off != 0)[:200]
    ]
    layers += [
        charts.line(frame, time, line, css) for line, css in zip(lines, ("line", "lim line"), strict=False)
    ]
    return charts.panel(
        frame,
        layers,
        alt=f"{name} from {low:.4g} to {high:.4g} {unit}",
        title=f"{name} in {unit}",
        units=("s", unit),
    )
