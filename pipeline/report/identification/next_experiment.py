"""What to play on the machine next: what the family forecasts beside the limits, or why nothing is written;
and what it would teach."""

from collections.abc import Mapping
from typing import Any

from pipeline.report.shared.pictures import as_table
from pipeline.report.shared.sources import Sources
from pipeline.verdict.digits import THIN, number, short
from pipeline.verdict.evidence import need_figure


@as_table(sentences=[], rows=[])
def next_experiment(sources: Sources) -> dict[str, Any]:
    """Of the stage generate_probing."""
    metrics = sources.metrics["generate_probing"]
    told, added = need_figure(metrics, "next_experiment"), need_figure(metrics, "closed_loop")
    if not told["written"]:
        why = f"No experiment is written: {_celsius(told['reason'])}."
        return {"sentences": [why, _around(added)], "rows": []}
    rows = [
        {
            "output": output.name,
            "target": _degrees(told["target_degC"].get(output.name)),
            "forecast": _range(told["lowest_degC"].get(output.name), told["highest_degC"].get(output.name)),
            "limits": _range(*(told["limit_degC"][output.name][end] for end in ("low", "high"))),
        }
        for output in sources.declared.machine.outputs
        if output.name in told["limit_degC"]
    ]
    return {"sentences": [_played(told), _taught(told), _around(added)], "rows": rows}


def _played(told: Mapping[str, Any]) -> str:
    least, most = (pick(told["amplitude_percent"].values()) for pick in (min, max))
    moves = short(most, 2) if least == most else f"{short(least, 2)} to {short(most, 2)}"
    doubt = told.get("doubt")
    doubted = (
        ""
        if doubt is None
        else f", though input gains be wrong by {100 * doubt['input_gain']:g}{THIN}% and the ambient by "
        f"{doubt['ambient_degC']:g}{THIN}°C"
    )
    return (
        f"next_experiment.csv lasts {number(told['seconds'], 0)}{THIN}s, starts at the last recorded inputs, "
        f"and moves each by {moves}{THIN}%. Every plant of the family stays within the limits{doubted}. "
        "Start it only where the machine stands as the record left it, and stay beside it."
    )


def _taught(told: Mapping[str, Any]) -> str:
    errors = [pair for pairs in told["expected_error_percent"].values() for pair in pairs.values()]
    if not errors:
        return "No pair of input and output is seen."
    gain, pace = (max(pair[key] for pair in errors) for key in ("gain", "time_constant"))
    return (
        f"It would leave gains unknown by at most {short(gain, 2)}{THIN}% and time constants by "
        f"{short(pace, 2)}{THIN}% (standard errors on first-order models, the worst of {len(errors)} pairs); "
        f"rank {told['excitation_rank']} of {told['excitation_full_rank']}{_gap(told)}."
    )


def _gap(told: Mapping[str, Any]) -> str:
    gap = told["expected_gap_percent"]
    return "" if gap is None else f", expected gap of a controller {short(gap, 2)}{THIN}%"


def _around(added: Mapping[str, Any]) -> str:
    if not added["written"]:
        return f"Nothing is written to add to a running controller: {_celsius(added['reason'])}."
    return (
        f"next_experiment_closed_loop.csv is to be added to the running controller's commands: up to "
        f"{short(max(added['amplitude_percent'].values()), 2)}{THIN}%; around a PI the family stays between "
        f"{short(min(added['lowest_degC'].values()), 3)} and "
        f"{short(max(added['highest_degC'].values()), 3)}{THIN}°C."
    )


def _celsius(reason: str) -> str:
    return reason.rstrip(".").replace(" degC", f"{THIN}°C")


def _degrees(value: float | None) -> str:
    return "" if value is None else short(value, 3)


def _range(low: float | None, high: float | None) -> str:
    return "" if low is None or high is None else f"{short(low, 3)} to {short(high, 3)}"
