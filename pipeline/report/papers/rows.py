"""What the papers print, row by row, beside ours: the verdict of each row by its rule, and its words with
the figures put in. Printed values stand in datasets/papers/*.toml, ours in datasets/papers/*.json
and in the metrics of the run."""

import math
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from pipeline.papers import made
from pipeline.store import artifacts
from pipeline.verdict.digits import number
from pipeline.verdict.evidence import gap_of
from pipeline.verdict.verdict import Missing

HOLDS, SHAPE, FAILS, OPEN = "holds", "holds in shape", "does not hold", "cannot be judged"
VERDICTS = (HOLDS, SHAPE, FAILS, OPEN)
RULES = ("digits", "same", "at_most", "at_least", "within", "claim", "shape", "entries", "not_judged")
# what arithmetic adds to a difference, as a share of it
ROUNDING = 1e-9


class PaperRow(NamedTuple):
    """A table, a figure or a number of a paper: its place there, what it says, printed and ours as text; ours
    with the smallest change that was found, and whether it holds with it; the verdict, how it is counted and
    why they part; the lines of a table; and the marks of what is printed, (figure, panel, x, y)."""

    at: str
    what: str
    printed: str
    ours: str
    changed: str
    mended: bool
    verdict: str
    why: str
    entries: list[dict[str, str]]
    marks: list[tuple[str, int, float, float]]


class Paper(NamedTuple):
    """A paper: key of its files, title, citation, the finding, the rows, the results behind them and the
    command that made these."""

    key: str
    title: str
    cite: str
    told: str
    rows: list[PaperRow]
    results: Mapping[str, Any]
    command: str

    def count(self, verdict: str) -> int:
        return sum(row.verdict == verdict for row in self.rows)

    def mended(self) -> int:
        """The rows that do not hold, and do with the change that they name."""
        return sum(row.verdict == FAILS and row.mended for row in self.rows)


def read(printed: str, results: str, metrics: Mapping[str, Any]) -> "Paper | Missing":
    """A paper from its two files and the metrics of the run, by stage. A file that is not there is a Missing.

    Raises ValueError, naming file and row, where a row has an unknown rule or asks for a figure that the
    results do not hold.
    """
    for path, remedy in ((printed, f"git checkout {printed}"), (results, made.command(Path(results).stem))):
        if not artifacts.exists(path):
            return Missing("not measured", f"{path} is not there", f"Run {remedy}")
    try:
        told = tomllib.loads(Path(printed).read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{printed}: {error}; bring it back with git checkout {printed}") from None
    found = artifacts.read_json(results)
    rows = [_row(one, found, metrics, f"{printed}: row {i + 1}") for i, one in enumerate(told["row"])]
    head = told["paper"]
    return Paper(
        Path(printed).stem,
        head["title"],
        head["cite"],
        _filled(head["told"], found, metrics, None, f"{printed}: told"),
        rows,
        found,
        found["command"],
    )


# ---- a row


def _row(one: Mapping[str, Any], found: Mapping, metrics: Mapping, place: str) -> PaperRow:
    place = f"{place}, {one.get('at')}"
    rule = one["rule"]
    if rule not in RULES:
        raise ValueError(
            f"{place}: expected one of the rules {', '.join(RULES)}, found {rule!r}; write one of them"
        )
    entries = [_entry(line, found, metrics, place) for line in one.get("entries", ())]
    ours = _ours(one, found, metrics, place)
    unit = _filled(one.get("unit", ""), found, metrics, None, place)
    places = one.get("places")
    printed = _text(one.get("printed"), unit if not isinstance(one.get("printed"), str) else "", places)
    if entries:
        agree = sum(entry["verdict"] == HOLDS for entry in entries)
        printed, shown = f"{len(entries)} entries", f"{agree} of {len(entries)} as printed"
    else:
        shown = _shown(ours, unit, one.get("ours_places", places))
    changed = _ours({**one, "ours": one.get("changed")}, found, metrics, place)
    return PaperRow(
        one["at"],
        one["what"],
        printed,
        shown,
        "" if changed is None else _shown(changed, unit, one.get("ours_places", places)),
        changed is not None and _verdict(one, changed, entries) in (HOLDS, SHAPE),
        _verdict(one, ours, entries),
        _filled(one.get("why", ""), found, metrics, printed, place),
        entries,
        _marks(one),
    )


def _marks(one: Mapping[str, Any]) -> list[tuple[str, int, float, float]]:
    """Where its `mark` draws what a row prints: at x of a panel of its figure, one or one each, or at y; x is
    NaN if the paper does not print where."""
    if (mark := one.get("mark")) is None:
        return []
    printed = _list(one["printed"])
    other = _list(mark.get("y", mark.get("x", math.nan))) * len(printed)
    pairs = [(a, b) if "y" in mark else (b, a) for a, b in zip(printed, other, strict=False)]
    return [(mark.get("figure", one["at"]), mark.get("panel", 0), *pair) for pair in pairs]


def _entry(line: Mapping[str, Any], found: Mapping, metrics: Mapping, place: str) -> dict[str, str]:
    """A line of a table of the paper: its name, what is printed, ours, and whether they agree."""
    ours = _ours(line, found, metrics, place)
    agrees = _same(line["printed"], ours) if "places" not in line else _digits(line, ours)
    texts = {"printed": line["printed"], "ours": ours}
    return {
        "name": line["name"],
        "verdict": HOLDS if agrees else FAILS,
        **{key: _text(value, "", line.get("places")) for key, value in texts.items()},
    }


def _ours(one: Mapping[str, Any], found: Mapping, metrics: Mapping, place: str) -> Any:
    """Our figure or figures, scaled; None where the row has none, a Missing where the run has not got it."""
    asked, scale = one.get("ours"), one.get("scale", 1)
    if asked is None:
        return None
    several = isinstance(asked, list)
    values = [look_up(path, found, metrics, place) for path in (asked if several else [asked])]
    if gap := next(filter(None, map(gap_of, values)), None):
        return gap
    values = [value * scale if scale != 1 else value for value in values]
    return values if several else values[0]


def look_up(path: str, found: Mapping[str, Any], metrics: Mapping[str, Any], place: str) -> Any:
    """The value at a dotted path of the results, or after "run:" of the metrics; a number counts in a list.

    Raises ValueError where the results lack it; what the run lacks is a Missing.
    """
    in_run = path.startswith("run:")
    stage, *_ = keys = path.removeprefix("run:").split(".")
    value: Any = metrics if in_run else found
    for key in keys:
        if gap_of(value):
            return value
        try:
            value = value[int(key)] if isinstance(value, list) else value[key]
        except (KeyError, IndexError, TypeError, ValueError):
            if in_run:
                return Missing("not measured", f"{path} is not among what {stage} measured")
            raise ValueError(
                f"{place}: expected {path} among the results, found none; make them anew with the command in "
                "their file"
            ) from None
    return value


# ---- verdicts


def _verdict(one: Mapping[str, Any], ours: Any, entries: list[dict[str, str]]) -> str:
    """The verdict of a row by its rule."""
    rule, printed = one["rule"], one.get("printed")
    if rule == "not_judged" or gap_of(ours) or not one.get("judged", True):
        return OPEN
    if rule == "entries":
        return HOLDS if all(entry["verdict"] == HOLDS for entry in entries) else FAILS
    if rule in ("claim", "shape"):
        return (HOLDS if rule == "claim" else SHAPE) if ours else FAILS
    if rule == "same":
        return HOLDS if _same(printed, ours) else FAILS
    if rule in ("at_most", "at_least"):
        # a bound of ours stands for words of the paper that print none
        bound = one.get("bound", one.get("our_bound", printed))
        kept = all(value <= bound if rule == "at_most" else value >= bound for value in _list(ours))
        return FAILS if not kept else SHAPE if "our_bound" in one else HOLDS
    if rule == "within":
        apart = max(100 * abs(b / a - 1) for a, b in zip(_list(printed), _list(ours), strict=True))
        near, far = (one.get(key, 0) * (1 + ROUNDING) for key in ("percent", "shape_percent"))
        return HOLDS if apart <= near else SHAPE if apart <= far else FAILS
    return HOLDS if _digits(one, ours) else FAILS


def _digits(one: Mapping[str, Any], ours: Any) -> bool:
    """Whether ours, rounded or cut to as many decimals, is what is printed."""
    step = 10.0 ** -one["places"]
    pairs = list(zip(_list(one["printed"]), _list(ours), strict=True))
    half, whole = step * (0.5 + ROUNDING), step * (1 - ROUNDING)
    return all(abs(b - a) <= half or 0 <= (b - a) * math.copysign(1, a) < whole for a, b in pairs)


def _same(printed: Any, ours: Any) -> bool:
    return _list(printed) == _list(ours)


def _list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]


# ---- words


def _text(value: Any, unit: str, places: int | None) -> str:
    if value is None:
        return ""
    if isinstance(value, list):
        return ", ".join(_text(one, "", places) for one in value) + (f" {unit}" if unit else "")
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, str):
        return value
    shown = number(value, places) if places is not None else f"{value:,g}" if value < 1e6 else f"{value:,}"
    return f"{shown} {unit}" if unit else shown


def _shown(ours: Any, unit: str, places: int | None) -> str:
    """Ours as text. A small number keeps a digit, so that nothing reads as zero that is not."""
    if gap_of(ours):
        return "not measured in this run"
    if isinstance(ours, float) and places is not None and 0 < abs(ours) < 0.5 * 10.0**-places:
        return f"below {number(10.0**-places, places)} {unit}".strip()
    return _text(ours, unit, places)


def _filled(text: str, found: Mapping, metrics: Mapping, printed: str | None, place: str) -> str:
    """The words with {path:places} replaced by our figures, and {printed} by what the row prints."""

    def put(match: re.Match[str]) -> str:
        path, _, places = match[1].partition(":")
        if path == "printed":
            return printed or ""
        value = look_up(path, found, metrics, place)
        return _text(value, "", int(places) if places else None)

    return re.sub(r"\{([^{}]+)\}", put, text)
