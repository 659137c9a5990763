"""The page of the benchmarks: what summary.json holds, with the growth as pictures."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from benchmarks import summary
from pipeline.report.shared import charts, page
from pipeline.report.shared.digits import short
from pipeline.store.printable import printable_page

TEMPLATE = Path(__file__).with_suffix(".html")


def render(gathered: Mapping[str, Any]) -> str:
    """The whole page from what summary.gathered made."""
    growth, stages = gathered["growth"], gathered["stages"]
    return printable_page(
        page.environment()
        .from_string(TEMPLATE.read_text(encoding="utf-8"))
        .render(
            title="Speed, growth, endurance",
            here="benchmarks",
            beside=[],
            quick=None,
            machines=summary.machines(gathered),
            tables=[
                ("Hot paths", [_figure(one) for one in gathered["hot_paths"].values()]),
                ("The default run on two cores", [_figure(one) for one in gathered["default_run"].values()]),
            ],
            stages=stages if isinstance(stages, list) else [],
            stages_command=summary.BENCHMARKS["stages"].command,
            growth=[_grown(one) for one in growth.values() if isinstance(one, Mapping) and "points" in one],
            growth_command=summary.BENCHMARKS["growth"].command,
            endurance=[_endured(name, gathered[name]) for name in summary.ENDURANCE],
            mutants=gathered["mutants"].get("modules", {}),
            scale=summary.scale_sentences(gathered["scale"]),
        )
    )


def _figure(one: Mapping[str, Any]) -> dict[str, str]:
    return {
        "what": one["what"],
        "value": summary.worded(one["value"], one["unit"]),
        "goal": summary.goal_worded(one),
        "state": summary.state(one),
        "command": one["command"],
    }


def _grown(sweep: Mapping[str, Any]) -> dict[str, Any]:
    known = summary.known(sweep)
    missed = [f"{short(point['size'])}: {point['why']}" for point in sweep["points"] if "why" in point]
    told = ["not measured"]
    if "exponent" in sweep:
        told = [
            f"exponent {sweep['exponent']:.2f}, at most {sweep['limit']:g}: "
            f"{'met' if sweep['met'] else 'missed'}",
            f"steepest {sweep['steepest']:.2f}, to {short(sweep['steepest_to'])}",
            f"{short(known[-1]['above_MB'])} MB at the largest, {short(sweep['kB_more_a_unit'])} kB a unit",
        ]
    return {
        "what": sweep["what"],
        "finding": "; ".join([*told, *missed]),
        "picture": picture(sweep) if len(known) > 1 else Markup(""),
    }


def picture(sweep: Mapping[str, Any]) -> Markup:
    """CPU seconds over size, both in decades, a dot a size, and linear growth from the smallest, dashed."""
    known = summary.known(sweep)
    x = np.array([point["size"] for point in known], float)
    y = np.array([point["cpu_s"] for point in known], float)
    linear = y[0] * x / x[0]
    low, high = min(y.min(), linear.min()), max(y.max(), linear.max())
    frame = charts.Frame(
        charts.logarithmic(x[0], x[-1]), charts.logarithmic(low, high), 320, 200, left=44, below=32, above=16
    )
    layers = [
        charts.line(frame, x, linear, "line dash"),
        charts.line(frame, x, y),
        charts.dots(frame, x, y, radius=3),
    ]
    ends = [f"{short(y[k])} s at {short(x[k])} {sweep['unit']}" for k in (0, -1)]
    alt = f"{sweep['what']}: {', '.join(ends)}"
    return charts.panel(
        frame, layers, alt=alt, css="mb", title="CPU, s", across=sweep["unit"], units=(sweep["unit"], "s")
    )


def _endured(name: str, one: Mapping[str, Any]) -> dict[str, str]:
    state = {True: "met", False: "missed", None: one.get("why", "")}[one.get("met")]
    return {
        "what": name.replace("_", " "),
        "found": SAID[name](one) if "why" not in one else "",
        "state": state,
        "command": one["command"],
    }


def _said_kills(one: Mapping[str, Any]) -> str:
    return (
        f"{one['kills']} kills in {one['repros']} repros of {one['stages_made']} stages; after "
        f"{one['repros_with_the_same_bytes']} of these the next run gave the undisturbed bytes of all "
        f"{one['files']} files"
    )


def _said_nights(one: Mapping[str, Any]) -> str:
    kills = [
        f"{each['passed']} of {each['kills']} {kind.replace('_', ' ')}" for kind, each in one["kills"].items()
    ]
    return "; ".join([*kills, f"{one['troubles_passed']} of {one['troubles']} troubles"])


def _said_fuzz(one: Mapping[str, Any]) -> str:
    return (
        f"{one['files']:,} damaged files of {one['kinds']} kinds in {short(one['hours'])} h: "
        f"{one['tracebacks']} tracebacks, {one['hangs']} hangs"
    )


def _said_mutants(one: Mapping[str, Any]) -> str:
    modules = one["modules"].values()
    of = {name: sum(each[name] for each in modules) for name in ("killed", "mutants", "equivalent")}
    return (
        f"{of['killed']} of {of['mutants']} mutants of {len(modules)} modules killed, {of['equivalent']} "
        f"equivalent; at least {100 * one['goal']:g} % of the others in each module"
    )


def _said_branches(one: Mapping[str, Any]) -> str:
    return (
        f"{one['taken']:,} of {one['branches']:,} branches of the methods taken by their tests, "
        f"{100 * one['share_taken']:.1f} %; at least {100 * one['goal']:g} %"
    )


SAID = {
    "killed_repros": _said_kills,
    "killed_nights": _said_nights,
    "fuzz": _said_fuzz,
    "mutants": _said_mutants,
    "branches": _said_branches,
}
