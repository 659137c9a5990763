"""What a heater's owner looks for first: gain, time constant and dead time of every pair, a PID beside them,
and the PID that the printer has."""

from typing import Any, NamedTuple

import numpy as np

from pipeline.report.identification.model_errors import MOST_INPUTS
from pipeline.report.shared.sources import Sources
from pipeline.verdict.digits import THIN, band, count, decimals, number, short
from pipeline.verdict.evidence import Table, lookup
from pipeline.verdict.verdict import Missing

# Klipper's pid_Kp, pid_Ki and pid_Kd are of a duty of 0 to 255, ours of one in percent
KLIPPER_FROM_PERCENT = 2.55

# rows of an output with more inputs than a matrix shows: the page has a size to keep
FEW_INPUTS = 4


class Banded(NamedTuple):
    value: str
    band: str


class PairRow(NamedTuple):
    """K e^(-theta s) / (tau s + 1) of a pair with bands, and its PID. `strongest`: no input moves the output
    further."""

    input: str
    strongest: bool
    gain: Banded
    tau: Banded
    delay: Banded
    Kp: str
    Ki: Banded
    Kd: Banded


class PidRow(NamedTuple):
    """A PID of a heater in percent of duty, and as printer.cfg has it."""

    pair: str
    whose: str
    gains: list[str]
    klipper: list[str]


def heater_table(sources: Sources) -> dict[str, Any]:
    """Every pair of the first-order table, output by output; of many inputs the strongest of each output."""
    table = sources.tables["first_order"]
    printer, note = _printer_rows(sources, table)
    if isinstance(table, Missing):
        return {"finding": "", "outputs": [], "printer": printer, "printer_note": note, "missing": table}
    gaps = _gaps(table, _horizon(sources))
    outputs = [_output_pairs(table, gaps, output.name) for output in sources.declared.machine.outputs]
    fitted = sum(not gap for gap in gaps)
    every = f"of {count(len(gaps), 'pair')}"
    finding = (
        f"{count(fitted, every, every).capitalize()} {'has' if fitted == 1 else 'have'} a gain of known sign "
        "and a time constant that the record shows. Bold: the input that moves an output furthest."
    )
    return {"finding": finding, "outputs": outputs, "printer": printer, "printer_note": note, "missing": None}


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
    steps = sources.tables["steps"]
    return np.inf if isinstance(steps, Missing) else float(steps["time_s"].max())


def _gaps(table: Table, horizon: float) -> list[str]:
    """Why each pair has no first-order model; empty where it has one. A time constant beyond the horizon is
    an extrapolation of the response's beginning."""
    slow = f"not settled within {short(horizon)}{THIN}s"
    return [
        "sign not known" if not seen else slow if tau > horizon else ""
        for seen, tau in zip(table["seen"], table["time_constant_s"], strict=True)
    ]


def _pair(table: Table, k: int, strongest: bool) -> PairRow:
    gain, tau, delay = (_banded(table, key, k) for key in ("gain", "time_constant_s", "delay_s"))
    Kp, Ki, Kd = (float(table[key][k]) for key in ("Kp", "Ki", "Kd"))
    integral = Banded(short(Ki), f"Ti {short(Kp / Ki, 2)}{THIN}s")
    derivative = Banded(short(Kd), f"Td {short(Kd / Kp, 2)}{THIN}s")
    return PairRow(str(table["input"][k]), strongest, gain, tau, delay, short(Kp), integral, derivative)


def _banded(table: Table, key: str, k: int) -> Banded:
    value, low, high = (float(table[f"{key}{end}"][k]) for end in ("", "_low", "_high"))
    places = decimals(low, high, value=value)
    return Banded(number(value, places), band(low, high, places))


# ---- the printer's own


def _printer_rows(sources: Sources, table: Table | Missing) -> tuple[list[PidRow], str]:
    """The printer's PID of each heater over the one by SIMC, and how both are to be read."""
    own = lookup(sources.tables["printer_pid"], "heaters")
    if isinstance(own, Missing):
        return [], ""
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


def _simc(table: Table | Missing, pid: dict[str, Any]) -> list[float]:
    if isinstance(table, Missing):
        return []
    k = np.flatnonzero((table["output"] == pid["output"]) & (table["input"] == pid["input"]))
    gains = [float(table[key][k[0]]) for key in ("Kp", "Ki", "Kd")] if len(k) else []
    return gains if np.isfinite(gains).all() else []


def _pid_row(pair: str, whose: str, gains: list[float]) -> PidRow:
    if not gains:
        return PidRow(pair, whose, ["none"] * 3, ["none"] * 3)
    return PidRow(
        pair, whose, [short(gain) for gain in gains], [short(gain * KLIPPER_FROM_PERCENT) for gain in gains]
    )
