"""Figures of Zavrakli, Parnell and Dey 2023 from our runs, in their axes."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from markupsafe import Markup

from pipeline.report.papers.figures import HEIGHT, WIDTH, PaperCurve, PaperFigure, axis, plot
from pipeline.report.shared import charts
from pipeline.report.shared.sources import Sources
from pipeline.verdict.digits import number


def pictures(results: Mapping[str, Any], sources: Sources) -> list[PaperFigure]:
    """Figures 2 to 6, and what random starts do to Algorithm 1. Figure 1 is a drawing."""
    model, data = results["model_based"], results["data_driven"]
    return [
        PaperFigure(
            "Figure 2",
            "Outputs, observer-based, Q = R = I",
            [_outputs(model["identity"], "line")],
            FROM_BELOW,
        ),
        PaperFigure("Figure 3 (a)", "Performance index", [_index([("", model["identity"], "line")])]),
        PaperFigure(
            "Figure 3 (b)",
            "Estimation error",
            [_estimate(model["identity"]["estimate"])],
            "The paper shows the lower line under the name of the upper one. Logarithmic here.",
        ),
        PaperFigure(
            "Figure 4 (a)", "Outputs, observer-based, tuned", [_outputs(model["tuned"], "line")], FROM_BELOW
        ),
        PaperFigure(
            "Figure 4 (b)",
            "Performance index before and after tuning",
            [_index([("Q = R = I", model["identity"], "line"), ("tuned", model["tuned"], "line dash")])],
            IN_ITS_OWN,
        ),
        PaperFigure(
            "Figure 5 (a)",
            "Outputs, data-driven, Q = R = I",
            [_outputs(data["identity"], "line dd")],
            FROM_BELOW,
        ),
        PaperFigure("Figure 5 (b)", "Performance index", [_index([("", data["identity"], "line dd")])]),
        PaperFigure(
            "Figure 6 (a)", "Outputs, data-driven, tuned", [_outputs(data["tuned"], "line dd")], FROM_BELOW
        ),
        PaperFigure(
            "Figure 6 (b)",
            "Performance index before and after tuning",
            [_index([("Q = R = I", data["identity"], "line dd"), ("tuned", data["tuned"], "line dd dash")])],
            IN_ITS_OWN,
        ),
        PaperFigure(
            "Algorithm 1",
            "Policies until the gain is found, from random draws",
            [_starts(results["algorithm_1"])],
            f"The paper shows one draw. Of {results['algorithm_1']['starts']} draws "
            f"{results['algorithm_1']['missed']} never find it and have no stroke.",
        ),
    ]


FROM_BELOW = "At the end from the lowest line to the highest: sensors one to five."
IN_ITS_OWN = "Each in the weights of its own, as the paper has it."


def _outputs(column: Mapping[str, Any], css: str) -> Markup:
    lines, steps = column["curves"]["y"], range(1, 101)
    return plot(
        [PaperCurve(steps, line, css) for line in lines],
        title="outputs in °C, against steps",
        alt=f"Five outputs end within {number(column['farthest'], 2)} °C of their references",
    )


def _index(columns: list[tuple[str, Mapping[str, Any], str]]) -> Markup:
    curves = [
        PaperCurve(range(1, 101), np.asarray(column["curves"]["J"]) / 1000, css, name)
        for name, column, css in columns
    ]
    ends = ", ".join(
        f"{name or 'the index'} ends at {number(column['J100'], 0)}" for name, column, _ in columns
    )
    high = max(float(curve.y[-1]) for curve in curves)
    return plot(
        curves,
        title="sum of discounted costs, thousands, against steps",
        alt=ends[:1].upper() + ends[1:],
        up=axis(0.0, high),
    )


def _estimate(told: Mapping[str, Any]) -> Markup:
    steps = range(2, 101)
    curves = [
        PaperCurve(steps, told["state_curve"][1:], "line", "‖x̂ − x‖"),
        PaperCurve(steps, told["output_curve"][1:], "line dash", "‖C(x̂ − x)‖"),
    ]
    return plot(
        curves,
        title="estimation error in °C, against steps",
        alt=f"After 100 steps the state is {number(told['state_error'], 2)} °C off, the outputs are "
        f"{number(told['output_error'], 4)} °C off",
        up=charts.logarithmic(0.001, 10.0),
    )


def _starts(told: Mapping[str, Any]) -> Markup:
    counts = told["by_policies"]
    x, y = [int(policies) for policies in counts], list(counts.values())
    frame = charts.Frame(
        charts.linear(0, max(x) + 1), axis(0, max(y)), WIDTH, HEIGHT, left=52, below=22, above=24, right=12
    )
    return charts.panel(
        frame,
        [charts.stems(frame, x, y)],
        alt=f"Of {told['starts']} random gains {told['missed']} never lead to the optimal one; the "
        f"others take {min(x)} to {max(x)} policies",
        title="draws, against policies evaluated",
    )
