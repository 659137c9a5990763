"""What a heater's owner looks for first: gain, time constant and dead time of every pair, a PID beside them,
and the PID that the printer has."""

from typing import Any

import numpy as np

from pipeline.report.identification.model_errors import MOST_INPUTS
from pipeline.report.shared.pictures import as_table
from pipeline.report.shared.sources import Sources
from pipeline.verdict.digits import THIN, band, count, decimals, number, short
from pipeline.verdict.evidence import Table, instead, known, need, need_figure, or_empty
from pipeline.verdict.verdict import Missing

# Klipper's pid_Kp, pid_Ki and pid_Kd are of a duty of 0 to 255, ours of one in percent
KLIPPER_FROM_PERCENT = 2.55

# rows of an output with more inputs than a matrix shows: the page has a size to keep
FEW_INPUTS = 4


def heater_table(sources: Sources) -> dict[str, Any]:
    """Every pair of the first-order table with a PID beside it, and the PID that the printer has."""
    printer, note = _printer_rows(sources, sources.tables["first_order"])
    return {"printer": printer, "printer_note": note} | _pairs(sources)


@as_table(finding="", outputs=[])
def _pairs(sources: Sources) -> dict[str, Any]:
    """The first-order table, output by output; of many inputs the strongest of each output."""
    table = need(sources.tables["first_order"])

    gaps = _gaps(table, _horizon(sources))
    outputs = [_output_pairs(table, gaps, output.name) for output in sources.declared.machine.outputs]
    fitted = sum(not gap for gap in gaps)
    every = f"of {count(len(gaps), 'pair')}"
    finding = (
        f"{count(fitted, every, every).capitalize()} {'has' if fitted == 1 else 'have'} a gain of known sign "
        "and a time constant that the record shows. Bold: the input that moves an output furthest."
    )
    return {"finding": finding, "outputs": outputs}


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


def _horizon(sources: Sources) -> float:
    """The longest time after a step that the step responses show, in s."""
    return float(known(sources.tables["steps"], {"time_s": np.array([np.inf])})["time_s"].max())


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


@instead(lambda gap: ([], ""))
def _printer_rows(sources: Sources, table: Table | Missing) -> tuple[list[dict[str, Any]], str]:
    """The printer's PID of each heater over the one by SIMC, and how both are to be read."""
    own = need_figure(sources.tables["printer_pid"], "heaters")
    rows = []
    for pid in own:
        pair = f"{pid['input']} to {pid['output']}"
        rows.append(_pid_row(pair, "the printer’s own", [pid[key] for key in ("Kp", "Ki", "Kd")]))
        rows.append(_pid_row(pair, "SIMC, from this record", _simc(table, pid)))
    logs = ", ".join(sorted({pid["recording"] for pid in own}))
    note = (
        "Klipper’s PID is parallel too; its pid_Kp, pid_Ki, pid_Kd are of a duty of 0 to 255, 2.55 times "
        "those in percent. Its derivative acts on the temperature, smoothed over "
        f"{own[0]['smooth_s']:g}{THIN}s, and its duty ends at {own[0]['most_percent']:g}{THIN}%. "
        f"From the configuration in {logs}."
    )
    return rows, note


@or_empty
def _simc(table: Table | Missing, pid: dict[str, Any]) -> list[float]:
    table = need(table)
    k = np.flatnonzero((table["output"] == pid["output"]) & (table["input"] == pid["input"]))
    gains = [float(table[key][k[0]]) for key in ("Kp", "Ki", "Kd")] if len(k) else []
    return gains if np.isfinite(gains).all() else []


def _pid_row(pair: str, whose: str, gains: list[float]) -> dict[str, Any]:
    """A PID of a heater in percent of duty, and as printer.cfg has it."""
    percent, klipper = (
        [short(gain * scale) for gain in gains] or ["none"] * 3 for scale in (1, KLIPPER_FROM_PERCENT)
    )
    return {"pair": pair, "whose": whose, "gains": percent, "klipper": klipper}
