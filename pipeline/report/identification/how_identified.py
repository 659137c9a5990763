"""How the record was taken and the model identified: loop open or closed and what follows, gains that physics
forbids, what was chosen, and every output's fits with and without a free mean."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.report.shared.pictures import as_table
from pipeline.report.shared.sources import Sources
from pipeline.verdict.digits import THIN, band, count, decimals, number, short
from pipeline.verdict.evidence import Absent, Table, gap_of, known, lookup, need, need_figure, or_empty
from pipeline.verdict.identification import Fit, fit_figure, flagged_remedy, flagged_sentence
from pipeline.verdict.verdict import Figure, Missing

MOST_INPUTS = 7  # panels in a row of a matrix; a machine with more shows the strongest

REFINED = {
    "subspace": "none, the subspace fit stands",
    "prediction": "to the least errors one step ahead",
    "simulation": "to the least errors of simulation",
}


# ---- open or closed loop


@as_table(closed=False)
def loop_state(sources: Sources) -> dict[str, Any]:
    """Whether inputs answered what the outputs did: in a word, the test behind it, and what follows for the
    model."""
    tested = need_figure(sources.metrics["identify_plant"], "closed_loop", what="the test for feedback")
    p_values = tested["p_value"]
    if not p_values:
        reason = "the record is noise-free: it holds no errors that an input could answer"
        raise Absent(Missing("not applicable", reason))
    nearest, level = min(p_values, key=p_values.get), tested.get("level", 0.0)
    answering = [name for name, p in p_values.items() if p < level] or [nearest]
    return {
        "closed": tested["closed"],
        "level": level,
        "nearest": nearest,
        "least": p_values[nearest],
        "answering": answering,
        "largest": max(p_values[name] for name in answering),
        "fit": known(lookup(sources.metrics["identify_plant"], "fit"), ""),
    }


# ---- gains that physics forbids


@as_table(finding="", rows=[])
def flagged(sources: Sources) -> dict[str, Any]:
    """Gains of heaters with a sign or a size that physics forbids."""
    gains = need_figure(
        sources.metrics["identify_plant"], "forbidden_gains", what="the check of signs and sizes"
    )
    machine = sources.declared.machine
    heaters = [signal.name for signal in machine.inputs if signal.heats]
    if not heaters:
        reason = "no input is declared to heat, so no sign is known to be wrong"
        raise Absent(Missing("not applicable", reason, "Set heats: true for heaters in plant.inputs"))
    finding = f"{flagged_sentence(gains)} {flagged_remedy(gains)}" if gains else ""
    rows = [gain | {"places": decimals(gain["low"], gain["high"], value=gain["gain"])} for gain in gains]
    return {"finding": finding, "heaters": heaters, "rows": rows}


# ---- what was chosen


def chosen(sources: Sources) -> dict[str, Any]:
    """What the record decided beside the order, each with a Missing if it is not known."""
    metrics = sources.metrics["identify_plant"]
    return {
        **{key: lookup(metrics, key) for key in ("past", "fit", "feedthrough", "validation")},
        "refined": REFINED,
        "left_out": left_out_words(sources),
        "machine": sources.declared.machine,
    }


def left_out_words(sources: Sources) -> str:
    """What was left out in turn to judge candidates."""
    if lookup(sources.metrics["identify_plant"], "validation") == "recordings":
        return "one recording left out in turn"
    return "blocks of the record left out in turn"


# ---- fits by output


def fit_table(sources: Sources, fits: Sequence[Fit]) -> dict[str, Any]:
    """Every output with and without a free mean: what another ambient or operating point costs."""
    metrics = sources.metrics["identify_plant"]
    rows = [
        (
            fit,
            fit_figure(metrics, "fit_holdout_free_mean", fit.name),
            lookup(metrics, f"feedthrough.{fit.name}"),
        )
        for fit in fits
    ]
    gains, compared = {}, []
    for fit, free, _ in rows:
        if isinstance(fit.simulated, Figure) and isinstance(free, Figure):
            compared.append(fit.name)
            if free.low > fit.simulated.high:
                gains[fit.name] = f"{number(free.value - fit.simulated.value, 1)} points"
    return {
        "rows": rows,
        "gains": gains,
        "moved": [f"{gain} in {name}" for name, gain in gains.items()],
        "compared": compared,
        "known": any(not gap_of(free) for _, free, _ in rows),
    }


# rows of an output with more inputs than a matrix shows: the page has a size to keep
FEW_INPUTS = 4


def heater_table(sources: Sources) -> dict[str, Any]:
    """Every pair of the first-order table with a PID beside it, and the PID that the printer has."""
    own = known(lookup(sources.tables["printer_pid"], "heaters"), [])
    printer = [(pid, _simc(sources.tables["first_order"], pid)) for pid in own]
    return {"printer": printer} | _pairs(sources)


@as_table(finding="", outputs=[])
def _pairs(sources: Sources) -> dict[str, Any]:
    """The first-order table, output by output; of many inputs the strongest of each output."""
    table = need(sources.tables["first_order"])

    # the longest time after a step that the step responses show
    horizon = known(sources.tables["steps"], {"time_s": np.array([np.inf])})["time_s"].max()
    gaps = _gaps(table, float(horizon))
    fitted = sum(not gap for gap in gaps)
    every = f"of {count(len(gaps), 'pair')}"
    return {
        "finding": f"{count(fitted, every, every).capitalize()} {'has' if fitted == 1 else 'have'} a gain of "
        "known sign and a time constant that the record shows. Bold: the input that moves an output "
        "furthest.",
        "outputs": [_output_pairs(table, gaps, output.name) for output in sources.declared.machine.outputs],
    }


def _output_pairs(table: Table, gaps: list[str], output: str) -> dict[str, Any]:
    mine = sorted(np.flatnonzero(table["output"] == output), key=lambda k: -abs(table["gain"][k]))
    known = [k for k in mine if table["seen"][k]]
    fitted = [k for k in mine if not gaps[k]]
    fitted = fitted if len(fitted) <= MOST_INPUTS else fitted[:FEW_INPUTS]
    rows = [_pair(table, k, k == known[0]) for k in sorted(fitted)]
    reasons = sorted({gaps[k] for k in mine if gaps[k]})
    sentences = [
        f"{reason}: {shortened_list([str(table['input'][k]) for k in sorted(mine) if gaps[k] == reason])}"
        for reason in reasons
    ]
    left = sum(not gaps[k] for k in mine) - len(fitted)
    sentences += [f"{count(left, 'weaker input is', 'weaker inputs are')} not shown"] if left else []
    return {"output": output, "rows": rows, "gaps": "; ".join(sentences)}


def shortened_list(names: list[str]) -> str:
    """The first names, and how many more there are."""
    shown = ", ".join(names[:MOST_INPUTS])
    return shown + (f" and {len(names) - MOST_INPUTS} more" if len(names) > MOST_INPUTS else "")


def _gaps(table: Table, horizon: float) -> list[str]:
    """Why each pair has no first-order model; empty where it has one. A time constant beyond the horizon is
    an extrapolation of the response's beginning."""
    slow = f"not settled within {short(horizon)}{THIN}s"
    return [
        "sign not known" if not seen else slow if tau > horizon else ""
        for seen, tau in zip(table["seen"], table["time_constant_s"], strict=True)
    ]


def _pair(table: Table, k: int, strongest: bool) -> dict[str, Any]:
    """K e^(-theta s) / (tau s + 1) of a pair with bands, and its PID. `strongest`: no input moves the output
    further."""
    Kp, Ki, Kd = (float(table[key][k]) for key in ("Kp", "Ki", "Kd"))
    return {
        "input": str(table["input"][k]),
        "strongest": strongest,
        "gain": _banded(table, "gain", k),
        "tau": _banded(table, "time_constant_s", k),
        "delay": _banded(table, "delay_s", k),
        "Kp": short(Kp),
        "Ki": {"value": short(Ki), "band": f"Ti {short(Kp / Ki, 2)}{THIN}s"},
        "Kd": {"value": short(Kd), "band": f"Td {short(Kd / Kp, 2)}{THIN}s"},
    }


def _banded(table: Table, key: str, k: int) -> dict[str, str]:
    value, low, high = (float(table[f"{key}{end}"][k]) for end in ("", "_low", "_high"))
    places = decimals(low, high, value=value)
    return {"value": number(value, places), "band": band(low, high, places)}


# ---- the printer's own


@or_empty
def _simc(table: Table | Missing, pid: dict[str, Any]) -> list[float]:
    table = need(table)
    k = np.flatnonzero((table["output"] == pid["output"]) & (table["input"] == pid["input"]))
    gains = [float(table[key][k[0]]) for key in ("Kp", "Ki", "Kd")] if len(k) else []
    return gains if np.isfinite(gains).all() else []
