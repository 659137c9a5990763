"""Formats numbers for readers: as many decimals as their band supports, a true minus, thin spaces before
units, "never" for what never happens."""

import math
import re
from collections.abc import Sequence

MINUS, THIN, DASH = "\u2212", "\u202f", "\u2013"


def decimals(low: float, high: float, *, value: float = 0.0) -> int:
    """Returns the decimals that a band supports. A step of the last digit is at most a fifth of the band's
    width. At least one and at most three significant digits of the value are kept. Whole numbers get none."""
    size = abs(value) if math.isfinite(value) else 0.0
    if all(float(number).is_integer() for number in (low, high, value) if math.isfinite(number)):
        return 0
    enough, most = (_places(1 / size), _places(100 / size)) if size else (0, 9)
    width = high - low
    if math.isfinite(width) and width > 0:
        return min(max(_places(5 / width), enough), max(most, 0))
    return most


def _places(step: float) -> int:
    return min(max(math.ceil(math.log10(step) - 1e-9), 0), 9)


def number(value: float, places: int) -> str:
    """Returns 1234.5 as "1,234.5", and -0.04 with one decimal as "0.0", without a minus."""
    text = f"{abs(value):,.{places}f}"
    return MINUS + text if value < 0 and float(text.replace(",", "")) != 0 else text


def typeset(text: str | float) -> str:
    """Returns a line of a log as a page prints it: "-15.1 %" with a true minus and a thin space. Names such
    as night-0005 and dates are not changed."""
    signed = re.sub(r"(?<![\w.\-])-(?=\d)", MINUS, str(text))
    return re.sub(r"(?<=\d) (?=%|°C)", THIN, signed)


def declared(value: float) -> int:
    """Returns the decimals of a number that a person wrote down, such as a limit: as many as it has, at most
    six. A measured number, such as a settling time from a record, gets three digits."""
    exact = next((places for places in range(7) if round(value, places) == value), None)
    return max(0, 2 - math.floor(math.log10(abs(value)))) if exact is None else exact


# the largest meaningful figure: ten times the reference, or hotter than any machine. Beyond it the loop is
# useless or unstable, and its digits say nothing
LARGEST = {"%": 1000.0, "°C": 10000.0}


def beyond_meaning(value: float, unit: str) -> str:
    """Returns "beyond 1,000 %" instead of a figure with digits that say nothing; "" for all other figures."""
    largest = LARGEST.get(unit, math.inf)
    if not abs(value) > largest:
        return ""
    return f"{'beyond ' if value > 0 else f'below {MINUS}'}{number(largest, 0)}{THIN}{unit}"


def quantity(value: float, unit: str, places: int, *, beyond: str = "never") -> str:
    """Returns the number with its unit after a thin space; `beyond` instead of infinity, and "beyond 1,000 %"
    instead of a figure that says nothing."""
    if word := beyond_meaning(value, unit):
        return word
    return beyond if math.isinf(value) else with_unit(value, unit, places)


def with_unit(value: float, unit: str, places: int) -> str:
    """Returns a number with its unit, however large, for numbers that a person wrote down."""
    return number(value, places) + (THIN + unit if unit else "")


def band(low: float, high: float, places: int, *, unit: str = "", beyond: str = "never") -> str:
    """Returns "0.61-0.84" with an en dash; with "to" if an end is negative or in words; "" if both ends are
    equal."""
    words = [beyond_meaning(end, unit) or (beyond if math.isinf(end) else "") for end in (low, high)]
    ends = [word or number(end, places) for word, end in zip(words, (low, high), strict=True)]
    if ends[0] == ends[1]:
        return ""
    worded = low < 0 or any(words)
    return f" to {ends[1]}".join([ends[0], ""]) if worded else DASH.join(ends)


def short(value: float, digits: int = 3) -> str:
    """Returns a number without a band, to `digits` significant digits: 0.00123, 45.6, 183,362, 3.1 x 10^-8 in
    superscript."""
    if value == 0 or not math.isfinite(value):
        return "0" if value == 0 else "none"
    exponent = math.floor(math.log10(abs(value)))
    if -4 <= exponent < 7:
        return number(value, min(max(digits - 1 - exponent, 0), 9))
    return f"{number(value / 10.0**exponent, digits - 1)} × {power_of_ten(exponent)}"


def percent(value: float, digits: int = 3) -> str:
    """Returns "45.6 %", or "beyond 1,000 %" if the figure says nothing."""
    return beyond_meaning(value, "%") or short(value, digits) + THIN + "%"


def power_of_ten(exponent: int) -> str:
    """Returns "10⁻³"."""
    return "10" + str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def count(value: int, one: str, many: str = "") -> str:
    """Returns "one run" for 1, "24 runs" for 24; small numbers are words."""
    words = (
        "no",
        "one",
        "two",
        "three",
        "four",
        "five",
        "six",
        "seven",
        "eight",
        "nine",
        "ten",
        "eleven",
        "twelve",
    )
    return (
        f"{words[value] if 0 <= value < len(words) else f'{value:,}'} "
        f"{one if value == 1 else many or one + 's'}"
    )


def listed(names: Sequence[str]) -> str:
    """Returns "a", "a and b", "a, b and c"."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def shortened(text: str, longest: int = 60) -> str:
    """Returns the text, without its middle if it is longer than `longest`."""
    return text if len(text) <= longest else text[: longest // 2 - 1] + "…" + text[-(longest // 2) :]
