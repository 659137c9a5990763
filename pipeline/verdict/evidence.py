"""The input of a verdict, and how to find a figure in it."""

import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeVar

import numpy as np

from pipeline.temperature.settings import Plant
from pipeline.verdict.settings import ReportRules
from pipeline.verdict.verdict import Missing

Table = dict[str, np.ndarray]
Figures = Mapping[str, Any]  # {stage: its figures, or why there are none}
OFF = Missing("not applicable", "this loop is switched off (loops in params.yaml)")


Value = TypeVar("Value")


class Evidence(NamedTuple):
    """Figures by stage and tables by name. A Missing takes the place of each that could not be read."""

    figures: Figures
    tables: Mapping[str, Any]
    machine: Plant  # inputs and outputs of the temperature loop
    rules: ReportRules  # section `report`: the limits
    params: Mapping[str, Any]  # every section, as text
    quick: bool = False  # the run is a quick look
    certified: Mapping[str, Mapping[str, Any]] = {}  # loop -> controller -> {"passed", "why"}

    def recorded(self, stage: str) -> bool:
        """Returns whether the stage learns from recordings of a user's machine."""
        return self.params.get(stage, {}).get("source") == "recordings"

    def refusal(self, loop: str, controller: str) -> str:
        """Returns why the stage `certify` refuses a controller; "" if the controller passed, or if nothing is
        known."""
        known = self.certified.get(loop, {}).get(controller)
        return str(known["why"]) if known and not known["passed"] else ""


def switched_off(figures: Any) -> bool:
    """Returns whether a stage wrote that it did not run, because its loop is switched off."""
    return isinstance(figures, Mapping) and figures.get("asked") is False


class Absent(Exception):
    """A figure that a rule needs is missing; `gap` says why."""

    def __init__(self, gap: Missing) -> None:
        super().__init__(gap.reason)
        self.gap = gap


def entry(data: Any, *names: str) -> Any:
    """Returns data[name][name]...; None if one of them does not exist."""
    for name in names:
        data = data.get(name) if isinstance(data, Mapping) else None
    return data


def lookup(data: Any, dotted: str, *, what: str = "") -> Any:
    """Returns data["a"]["b"] for "a.b", or the Missing in its place. A null counts as missing."""
    value = data
    for key in dotted.split("."):
        if isinstance(value, Missing):
            return value
        value = value.get(key) if isinstance(value, Mapping) else None
        if value is None:
            return Missing("not measured", f"{what or dotted} is not among what the stage measured")
    return value


def need(value: Value | Missing) -> Value:
    """Returns the value. Raises Absent if it is a Missing."""
    if isinstance(value, Missing):
        raise Absent(value)
    return value


def need_figure(data: Any, dotted: str, *, what: str = "") -> Any:
    """Returns data["a"]["b"] for "a.b". Raises Absent if it does not exist."""
    return need(lookup(data, dotted, what=what))


def known(value: Value | Missing, otherwise: Any) -> Value:
    """Returns the value, or `otherwise` if it is a Missing."""
    return otherwise if isinstance(value, Missing) else value


def gap_of(value: Any) -> Missing | None:
    """Returns why a value is missing; None if it exists."""
    return value if isinstance(value, Missing) else None


def instead(make: Callable[[Missing], Any]) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Returns a decorator. The decorated function returns its own result, or `make(gap)` if it needs
    something that is absent."""

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def guarded(*args: Any, **options: Any) -> Any:
            try:
                return function(*args, **options)
            except Absent as absent:
                return make(absent.gap)

        return guarded

    return decorate


# results if something needed is absent: the gap itself, "", None; an empty list, an empty dict
or_gap, or_nothing, or_none = instead(lambda gap: gap), instead(lambda gap: ""), instead(lambda gap: None)
or_empty, or_no_entries = instead(lambda gap: []), instead(lambda gap: {})
