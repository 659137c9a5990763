"""Figures of Li and Pattinson 2025 from our runs, in their axes."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from markupsafe import Markup

from pipeline.report.papers.figures import PaperCurve, PaperFigure, plane, plot
from pipeline.report.shared import charts
from pipeline.report.shared.sources import Sources
from pipeline.verdict.digits import number
from pipeline.verdict.evidence import known

CLASSES = ("insufficient", "optimal", "excessive")
FLOW, TEMPERATURE = charts.linear(0, 320), charts.linear(180, 240)


def pictures(results: Mapping[str, Any], sources: Sources) -> list[PaperFigure]:
    """Figures 3 to 8 and the appendix. Figures 1, 2 (a), 3 (a) and 5 (a) are drawings."""
    agents, settings = results["agents"], results["settings"]
    right = f"class right in {number(settings['right_percent'], 0)} %"
    six, three = (number(wait, 0) for wait in sorted(settings["waits_s"], reverse=True))
    view = number(settings["view_s"], 0)
    waits = (
        f"Solid: {six} s. Dashed: {three} s. Simulated, {right}: {view} s after a move the picture shows "
        "only what was laid since."
    )
    example = agents["phase_3"]["figure_3_100"]["run"]
    return [
        PaperFigure("Figure 3 (b)", f"A run from {_start(settings, 'figure_3')}", _setpoints(example)),
        PaperFigure("Figure 3 (c)", "Its scaled distributions", [_shares(example)], SHARES),
        PaperFigure(
            "Figure 3 (d)", "Reward of the three phases", [_ellipses(results)], "Where the reward is nought."
        ),
        PaperFigure("Figure 4", "Waiting after a move", [_waits(agents["phase_4"]["waits"])], waits),
        *_vision(sources),
        PaperFigure(
            "Figure 6", "Reward of an episode through the four phases", [_rewards(results["learning"])]
        ),
        *(_figure_7(agents, _start(settings, "figure_7"), right, *asked) for asked in FIGURE_7),
        *(_figure_8(agents["phase_4"], settings, right, *asked) for asked in FIGURE_8),
        PaperFigure(
            "Figures A.1 to A.6, and 8",
            "Settled in per cent of the runs from each start",
            [],
            f"After phase 4, {right} of windows. The paper shows one run each on a printer.",
            _starts(agents["phase_4"]["starts_70"]["by_start"]),
        ),
        PaperFigure("Section 2", "What had to be guessed", [], "", _guesses(results["guesses"])),
    ]


SHARES = "Each lane from nought to one; one is the class that the camera names."
FIGURE_7 = (
    ("Figure 7 (a, b)", "Phase 1", "phase_1", "figure_7_100"),
    ("Figure 7 (c, d)", "Phase 2", "phase_2", "figure_7_100"),
    ("Figure 7 (e, f)", "Phase 3", "phase_3", "figure_7_100"),
    ("Figure 7 (g, h)", "Phase 3, the class errs", "phase_3", "figure_7_70"),
    ("Figure 7 (i, j)", "Phase 4, the class errs", "phase_4", "figure_7_70"),
)
FIGURE_8 = (
    ("Figure 8 (a, c, e)", "Case 1", "case_1", "case_1_70"),
    ("Figure 8 (b, d, f)", "Case 2", "case_2", "case_2_70"),
)


def _start(settings: Mapping[str, Any], name: str) -> str:
    flow, temperature = settings["starts"][name]
    return f"{flow:g} % and {temperature:g} °C"


def _figure_7(
    agents: Mapping[str, Any], start: str, right: str, at: str, title: str, phase: str, place: str
) -> PaperFigure:
    run = agents[phase][place]["run"]
    caption = f"The {right} of windows." if "errs" in title else "The class is always right."
    return PaperFigure(at, f"{title}: from {start}", [*_setpoints(run), _way(run)], caption)


def _figure_8(
    of: Mapping[str, Any],
    settings: Mapping[str, Any],
    right: str,
    at: str,
    title: str,
    start: str,
    place: str,
) -> PaperFigure:
    run = of[place]["run"]
    told = f"One run in the simulator, {right}; theirs is one on a printer, with photographs."
    panels = [_shares(run), _way(run), *_setpoints(run)]
    return PaperFigure(at, f"{title}, from {_start(settings, start)}", panels, f"{SHARES} {told}")


def _setpoints(run: Mapping[str, Any]) -> list[Markup]:
    flow, temperature = run["flow"], run["temperature"]
    steps = range(len(flow))
    return [
        plot(
            [PaperCurve(steps, flow)],
            title="flow in %, against steps",
            alt=f"The flow goes from {number(flow[0], 0)} % to {number(flow[-1], 0)} %",
            levels=[(100.0, "")],
            height=160,
        ),
        plot(
            [PaperCurve(steps, temperature)],
            title="temperature in °C, against steps",
            alt=f"It goes from {number(temperature[0], 1)} °C to {number(temperature[-1], 1)} °C",
            up=charts.linear(180, 240),
            levels=[(210.0, "")],
            height=140,
        ),
    ]


def _way(run: Mapping[str, Any]) -> Markup:
    rings = [PaperCurve(*_ellipse(20.0, 10.0, scale), "ref") for scale in (1.0, 3.0)]
    frame_title = "temperature in °C, against flow in %"
    return plane(
        rings,
        title=frame_title,
        alt=f"The way ends at {number(run['flow'][-1], 0)} % and {number(run['temperature'][-1], 0)} °C",
        across=FLOW,
        up=TEMPERATURE,
        way=PaperCurve(run["flow"], run["temperature"], "line"),
    )


def _shares(run: Mapping[str, Any]) -> Markup:
    """The scaled share of each class in a lane of its own, from nought to one."""
    rows = np.asarray(run["shares"], float)
    steps, lane = range(len(rows)), 1.25
    lanes = charts.Axis(0.0, 3 * lane, tuple((i * lane + 0.5, name) for i, name in enumerate(CLASSES)))
    curves = [PaperCurve(steps, i * lane + rows[:, i]) for i in range(len(CLASSES))]
    optimal = 100 * float((rows[:, 1] == 1).mean())
    return plot(
        curves,
        title="scaled share of each class, against steps",
        alt=f"The camera names optimal extrusion in {number(optimal, 0)} % of the steps",
        up=lanes,
        left=84,
    )


def _ellipse(a: float, b: float, scale: float = 1.0) -> tuple[list[float], list[float]]:
    """Where (14) has the value (1 - scale) / (1 + scale), turned by 70°: (flows, temperatures)."""
    t, turn = np.linspace(0, 2 * np.pi, 73), np.radians(70.0)
    qr, ur = scale * a * np.cos(t), scale * b * np.sin(t)
    flow = 100 + qr * np.cos(turn) + ur * np.sin(turn)
    temperature = 210 - qr * np.sin(turn) + ur * np.cos(turn)
    return flow.tolist(), temperature.tolist()


def _ellipses(results: Mapping[str, Any]) -> Markup:
    axes = results["settings"]["semi_axes"]
    styles = ("line bl", "line dash", "line")
    curves = [PaperCurve(*_ellipse(axes[2 * i], axes[2 * i + 1]), css) for i, css in enumerate(styles)]
    return plane(
        curves,
        title="temperature in °C, against flow in %",
        alt="Three ellipses about 100 % and 210 °C, each inside the one before",
        across=charts.linear(60, 140),
        up=charts.linear(160, 260),
    )


def _waits(of: Mapping[str, Any]) -> Markup:
    six, three = of["wait_6_view_6"], of["wait_3_view_6"]
    steps = range(len(six["flow"]))
    return plot(
        [PaperCurve(steps, three["flow"], "line dash"), PaperCurve(steps, six["flow"], "line")],
        title="flow in %, against steps",
        alt=f"Mean steps to the band: {number(three['steps'], 0)} with the short wait, "
        f"{number(six['steps'], 0)} with the long one",
        levels=[(100.0, "")],
    )


def _rewards(learning: Mapping[str, Any]) -> Markup:
    x, y, at = [], [], 0
    for part, updates in zip(learning["by_phase"], learning["updates"], strict=True):
        x += [at + updates * (i + 0.5) / len(part) for i in range(len(part))] + [at + updates]
        y += [*part, float("nan")]
        at += updates
    middles = np.cumsum(learning["updates"]) - np.array(learning["updates"]) / 2
    low = float(np.nanmin(y))
    return plot(
        [PaperCurve(x, y)],
        title="reward of an episode of 100 steps, against updates",
        alt=f"The reward ends phase 3 at {number(learning['phase_3']['ends'], 0)} and phase 4 at "
        f"{number(learning['phase_4']['ends'], 0)}",
        texts=[(str(i + 1), float(middle), low) for i, middle in enumerate(middles)],
    )


def _vision(sources: Sources) -> list[PaperFigure]:
    """Figure 5 (b, c) of the classifier of the last run."""
    course, classified = (known(sources.tables[name], None) for name in ("course", "classified"))
    out = []
    if course and len(course["epoch"]):
        mine = course["learner"] == "vision transformer"
        epochs, loss = course["epoch"][mine].tolist(), course["training_loss"][mine].tolist()
        right = course["held_out_accuracy"][mine]
        out.append(
            PaperFigure(
                "Figure 5 (b)",
                "Training of our small transformer",
                [
                    plot(
                        [PaperCurve(epochs, loss)],
                        title="training loss, against epochs",
                        alt=f"The training loss falls from {number(loss[0], 2)} to {number(loss[-1], 2)}",
                        height=160,
                    ),
                    plot(
                        [PaperCurve(epochs, (100 * right).tolist())],
                        title="right of pictures held out, in %, against epochs",
                        alt=f"At best {number(100 * float(np.nanmax(right)), 1)} % of them are right",
                        height=160,
                    ),
                ],
                "Of the last run. Its loss has a part for the flow, too.",
            )
        )
    if classified:
        tables = (
            ("Named as, in per cent of the pictures of a class", _confusion(classified)),
            ("Named right, in per cent, by temperature", _by_temperature(classified)),
        )
        told = "Of the last run, pictures that nothing was learned on."
        out += [PaperFigure("Figure 5 (c)", title, [], told, table) for title, table in tables]
    return out


def _confusion(table: Mapping[str, np.ndarray]) -> tuple[list[str], list[list[str]]]:
    """Per cent of the pictures of a true class that are named so."""
    rows = [
        [title, *(_percent(table["named"][table["label"] == label] == k) for k in range(len(CLASSES)))]
        for label, title in enumerate(CLASSES)
    ]
    return ["True class", *CLASSES], rows


def _by_temperature(table: Mapping[str, np.ndarray]) -> tuple[list[str], list[list[str]]]:
    """Per cent of the pictures of a true class that are named right, by nozzle temperature to ten degrees."""
    near = np.round(table["temperature_degC"], -1)
    levels = np.unique(near)
    right = table["named"] == table["label"]
    rows = [
        [title, *(_percent(right[(table["label"] == label) & (near == level)]) for level in levels)]
        for label, title in enumerate(CLASSES)
    ]
    return ["True class", *(f"{level:g} °C" for level in levels)], rows


def _percent(mask: np.ndarray) -> str:
    return number(100 * float(mask.mean()), 0) if len(mask) else ""


def _starts(by_start: Mapping[str, float]) -> tuple[list[str], list[list[str]]]:
    places = {tuple(part.strip() for part in name.split(",")): value for name, value in by_start.items()}
    flows = list(dict.fromkeys(flow for flow, _ in places))
    temperatures = list(dict.fromkeys(temperature for _, temperature in places))
    return (
        ["°C", *(f"{flow} %" for flow in flows)],
        [[t, *(number(places[flow, t], 0) for flow in flows)] for t in temperatures],
    )


NAMES = {
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


def _guesses(guesses: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    def text(value: Any) -> str:
        if isinstance(value, list):
            return ", ".join(text(one) for one in value)
        return value if isinstance(value, str) else f"{value:,g}"

    return ["Not printed", "Ours"], [[NAMES.get(key, key), text(value)] for key, value in guesses.items()]
