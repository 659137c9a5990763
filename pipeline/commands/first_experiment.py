"""`beadline experiment temperature`: an experiment from params.yaml alone, for an operator who stays beside
it. There is no model, and so no forecast. A printer's firmware takes targets: it gets G-code of targets,
which its own control follows. Any other machine gets a staircase of inputs.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from pipeline.temperature.settings import Output, Plant, check_output_limits

# targets, as shares of the way from the coolest to the hottest, each kept for a share of the time, with the
# part fan in percent
TARGETS = (0.5, 1.0, 1.0, 0.25, 0.25, 0.75, 0.0, 0.0, 1.0, 0.5, 0.5, 0.75, 0.25, 0.25, 1.0, 0.5)
FANS = (0, 0, 100, 100, 0, 0, 0, 50, 50, 50, 0, 0, 0, 100, 100, 0)
HOLDS = (2.0, 1.0, 1.2, 0.8, 0.7, 1.0, 0.6, 1.1, 0.9, 0.6, 0.8, 0.5, 0.9, 1.0, 0.7, 0.8)
LATER = 5  # steps by which the second heater's targets come after the first's
# °C above a reference at most, below it at most, and below the limit of an output
ABOVE_DEGC, BELOW_DEGC, BELOW_LIMIT_DEGC = 10.0, 30.0, 15.0
BELOW_SHARE, ROOM_DEGC = 0.3, 25.0  # of what a reference is above the room
KLIPPER = ".temp"  # how klippy.log names a temperature
# of an input's range, one level after another: small enough to watch, down again so that cooling is seen too
LEVELS = (0.05, 0.10, 0.15, 0.20, 0.10)
# of the way from the highest temperature down to the lowest: heat that is still on its way stays below it
MARGIN = 0.25


class Targets(NamedTuple):
    """Steps, each the target of every heater in °C, the part fan in percent, and how long they are kept."""

    steps: list[tuple[dict[str, float], int, float]]

    @property
    def seconds(self) -> float:
        """How long all take, without the time in which targets are ramped."""
        return sum(hold_s for _, _, hold_s in self.steps)

    def hottest_degC(self, heater: str) -> float:
        return max(targets[heater] for targets, _, _ in self.steps)


def heaters(machine: Plant, mapping: Mapping[str, Any]) -> dict[str, Output]:
    """The outputs of a printer, by the name that its firmware has for the heater; none for another
    machine."""
    found = {}
    for output in machine.outputs:
        source = mapping[output.name].source if output.name in mapping else ""
        if source.endswith(KLIPPER):
            found[source.removesuffix(KLIPPER)] = output
    return found


def targets(of: Mapping[str, Output], minutes: float) -> Targets:
    """Targets for `minutes`. The hottest is ABOVE_DEGC above the reference, and BELOW_LIMIT_DEGC below the
    declared limit at most. Raises ValueError if an output has no limit, or one below its reference."""
    if not 10 <= minutes <= 600:
        raise ValueError(f"--minutes is {minutes:g}, expected 10 to 600; an hour is enough for a hot end")
    spans = {}
    for name, output in of.items():
        high = _number(output.high)
        hottest = min(output.reference + ABOVE_DEGC, high - BELOW_LIMIT_DEGC)
        coolest = output.reference - min(BELOW_DEGC, BELOW_SHARE * (output.reference - ROOM_DEGC))
        if not coolest < hottest:
            raise ValueError(
                f"params.yaml: plant.outputs: {output.name} has reference {output.reference:g} and high "
                f"{high:g}, expected {BELOW_LIMIT_DEGC:g} °C and more between the coolest target, "
                f"{coolest:g}, and high; set high to the max_temp of the firmware"
            )
        spans[name] = coolest, hottest
    scale, count = 60.0 * minutes / sum(HOLDS), len(TARGETS)
    return Targets(
        [
            (
                {
                    name: round(low + TARGETS[(k + LATER * nth) % count] * (high - low), 1)
                    for nth, (name, (low, high)) in enumerate(spans.items())
                },
                FANS[k],
                round(scale * HOLDS[k], 1),
            )
            for k in range(count)
        ]
    )


def gcode(plan: Targets, ramp_degC_per_min: float) -> str:
    """The experiment as G-code for Klipper and Kalico. With a ramp above 0 a target goes there in steps of
    1 °C."""
    if not 0 <= ramp_degC_per_min <= 1000:
        raise ValueError(f"--ramp is {ramp_degC_per_min:g} °C a minute, expected 0 (none) to 1000")
    lines, before = [f"; {summary(plan).replace('°', 'deg')}"], dict.fromkeys(plan.steps[0][0], ROOM_DEGC)
    for targets_degC, fan, hold_s in plan.steps:
        lines.append(f"M106 S{round(2.55 * fan)}" if fan else "M107")
        ways = {
            name: ramped(before[name], target, ramp_degC_per_min) for name, target in targets_degC.items()
        }
        for k in range(max(map(len, ways.values()))):
            for name, way in ways.items():
                if k < len(way):
                    lines.append(f"SET_HEATER_TEMPERATURE HEATER={name} TARGET={way[k]:g}")
            if ramp_degC_per_min > 0:
                lines.append(f"G4 P{round(60_000 / ramp_degC_per_min)}")
        # a dwell of minutes in one command would hold up what a person asks for meanwhile
        whole, rest_s = divmod(hold_s, DWELL_S)
        lines += [f"G4 P{round(1000 * DWELL_S)}"] * int(whole) + [f"G4 P{round(1000 * rest_s)}"]
        before = targets_degC
    return "\n".join([*lines, "M107", "TURN_OFF_HEATERS", ""])


DWELL_S = 5.0


def ramped(before: float, target: float, ramp_degC_per_min: float) -> list[float]:
    """Targets on the way, 1 °C apart at most; the target alone without a ramp."""
    if ramp_degC_per_min <= 0:
        return [target]
    count = max(int(np.ceil(abs(target - before))), 1)
    return [round(before + (target - before) * (k + 1) / count, 1) for k in range(count)]


def summary(plan: Targets) -> str:
    """ "60 min; hottest target of extruder 215 °C." """
    hottest = ", ".join(f"{name} {plan.hottest_degC(name):g} °C" for name in plan.steps[0][0])
    return f"{plan.seconds / 60:.0f} min; hottest target of {hottest}."


def printed(plan: Targets, file: str) -> str:
    """What the operator does."""
    return (
        f"{summary(plan)}\n"
        "There is no model of this machine, and nobody has forecast how hot it gets. Stay beside it.\n"
        f"1. Home nothing, load no filament, and print {file} from the printer's own storage.\n"
        "2. When it is done, copy klippy.log and that file into datasets/raw/temperature, and run\n"
        "   ./run dvc repro\n"
        "With a macro in printer.cfg the printer's screen starts it:\n"
        f"   [gcode_macro FIRST_EXPERIMENT]\n   gcode: SDCARD_PRINT_FILE FILENAME={file}\n"
        "The filament's feed is not moved: what it does is learned from a print."
    )


class Staircase(NamedTuple):
    """Steps, each kept for hold_s, and the temperature in °C of each output at which the operator stops. A
    step is the input that moves, "" if all rest, and the levels of all inputs, {name: percent}."""

    steps: list[tuple[str, dict[str, float]]]
    hold_s: float
    stop_degC: dict[str, float]


def staircase(machine: Plant, hold_s: float) -> Staircase:
    """One input after another up its levels, the others at rest. Raises ValueError if an output has no
    limits, or if the hold is shorter than ten samples."""
    check_output_limits(machine, "recordings")
    if not hold_s >= 10 * machine.sample_time_s:
        raise ValueError(
            f"--hold is {hold_s:g} s, but ten samples of plant.sample_time_s are "
            f"{10 * machine.sample_time_s:g} s; hold longer"
        )
    rest = {signal.name: signal.low if signal.low > 0 else min(0.0, signal.high) for signal in machine.inputs}
    steps = [("", rest)]
    for signal in machine.inputs:
        top = signal.high - rest[signal.name]
        steps += [(signal.name, rest | {signal.name: rest[signal.name] + share * top}) for share in LEVELS]
        steps.append(("", rest))
    stop = {o.name: _number(o.high) - MARGIN * (_number(o.high) - _number(o.low)) for o in machine.outputs}
    return Staircase(steps, hold_s, stop)


def _number(limit: float | None) -> float:
    """A limit that `check_output_limits` has found declared."""
    return np.nan if limit is None else limit


def columns(plan: Staircase) -> dict[str, np.ndarray]:
    """One row a step: when it starts and how long it is held at most, every input, and where to stop."""
    count = len(plan.steps)
    return {
        "step": np.arange(1, count + 1),
        "start_s": plan.hold_s * np.arange(count),
        "hold_s": np.full(count, plan.hold_s),
        **{name: np.array([levels[name] for _, levels in plan.steps]) for name in plan.steps[0][1]},
        **{f"{name}_stop_degC": np.full(count, stop) for name, stop in plan.stop_degC.items()},
    }


def instructions(plan: Staircase, file: str) -> str:
    """What the operator does, a line a step."""
    stops = ", ".join(f"{name} {stop:g} °C" for name, stop in plan.stop_degC.items())
    lines = [
        "There is no model of this machine, and nobody has forecast how hot it gets. Stay beside it.",
        f"Stop at: {stops}. When one is reached, set every input to its level of step 1, wait until the "
        "machine has cooled, and go on with the next input.",
        f"Record every input and every temperature all the time. Hold each step for {plan.hold_s:g} s, or "
        "shorter if no temperature moves any more.",
    ]
    for k, (moves, levels) in enumerate(plan.steps, 1):
        if moves:
            what = f"{moves} to {levels[moves]:g} percent"
        else:
            rest = ", ".join(f"{name} {level:g}" for name, level in levels.items())
            what = f"all inputs at rest, in percent: {rest}"
        lines.append(f"{k}. {what}")
    return "\n".join(
        [*lines, f"The same as a table: {file}. Put the recording into datasets/raw/temperature."]
    )
