"""`beadline first-experiment`: a staircase for a machine without a record, from its params alone, for an
operator who stays beside it. There is no model, and so no forecast."""

from typing import NamedTuple

import numpy as np

from pipeline.temperature.settings import Plant, check_output_limits

# of an input's range, one level after another: small enough to watch, down again so that cooling is seen too
LEVELS = (0.05, 0.10, 0.15, 0.20, 0.10)
# of the way from the highest temperature down to the lowest: heat that is still on its way stays below it
MARGIN = 0.25


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
        "shorter where no temperature moves any more.",
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
