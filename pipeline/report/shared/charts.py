"""Figures as inline SVG in the theme's colours: axes, lines, bands, dots and the strip. Each states its
finding in words; nothing here knows of a stage."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from markupsafe import Markup

from pipeline.verdict.digits import number, power_of_ten
from pipeline.verdict.verdict import FAILED, Figure, Missing, Question, share, state


def _n(value: float) -> str:
    return f"{value:.1f}".removesuffix(".0")


# ---- the strip of page one


def strip(
    question: Question, shown: Sequence[tuple[str, str, Figure | Missing]], lanes: Sequence[int] = (11, 23)
) -> Markup:
    """Share of the allowance from 0 to twice the limit, the limit in the middle of every row; (name, class,
    figure) in `lanes`, which never overlap.
    """
    parts = [
        Markup(
            '<rect class="beyond" x="50%" width="50%" height="100%"/><line class="limit" x1="50%" '
            'x2="50%" y1="0" y2="100%"/>'
        )
    ]
    sentences = []
    for (name, css, figure), y in zip(shown, lanes, strict=False):
        if isinstance(figure, Missing):
            sentences.append(f"{name}: {figure.state}")
            continue
        parts.append(_lane(question, css, figure, y))
        sentences.append(f"{name} {_used(question, figure)}")
    alt = "; ".join(sentences)
    return Markup('<svg role="img" aria-label="{}">{}</svg>').format(
        alt[:1].upper() + alt[1:], Markup("").join(parts)
    )


def _used(question: Question, figure: Figure) -> str:
    used = share(question, figure.value)
    if math.isinf(used):
        return "uses more than any allowance"
    words = "beyond its limit" if state(question, figure) == FAILED else "of its allowance"
    if used > 100:
        return f"is beyond 100 times the limit, {words}"
    return (
        f"is {number(100 * used, 0)} % of the limit, {words}"
        if words.startswith("beyond")
        else f"uses {number(100 * used, 0 if used > 0.01 else 1)} % {words}"
    )


def _lane(question: Question, css: str, figure: Figure, y: int) -> Markup:
    low, middle, high = sorted(min(share(question, v), 2.0) for v in (figure.low, figure.value, figure.high))
    css = f"{css} bad" if css != "acc" and state(question, figure) == FAILED else css
    bar = (
        Markup('<line class="{}" x1="{}%" x2="{}%" y1="{}" y2="{}"/>').format(
            css, _n(50 * low), _n(50 * high), y, y
        )
        if high > low
        else ""
    )
    middle = min(share(question, figure.value), 2.0)
    if middle >= 2.0:
        # beyond the scale: the mark keeps its shape, and an arrow says that it goes on
        arrow = Markup('<path class="more {}" d="M-7 {}l4 3.5l-4 3.5"/>').format(css, _n(y - 3.5))
        return Markup('{}<svg x="100%" overflow="visible">{}{}</svg>').format(bar, mark(css, "-14", y), arrow)
    return Markup("{}{}").format(bar, mark(css, f"{_n(max(50 * middle, 0.8))}%", y))


def mark(css: str, x: str, y: float) -> Markup:
    kind = css.split()[0]
    if kind == "mb":
        return Markup(
            '<rect class="{}" x="{}" y="{}" width="7" height="7" transform="translate(-3.5 -3.5)"/>'
        ).format(css, x, y)
    return Markup('<circle class="{}" cx="{}" cy="{}" r="{}"/>').format(
        css, x, y, "4.5" if kind == "dd" else "4"
    )


# ---- axes


class Axis(NamedTuple):
    """A scale from `low` to `high`, linear or logarithmic, with the ticks (value, label) that are drawn."""

    low: float
    high: float
    ticks: tuple[tuple[float, str], ...]
    log: bool = False

    def at(self, values) -> np.ndarray:
        """Position from 0 to 1; values beyond the ends are put on the ends, NaN stays."""
        values = np.asarray(values, float)
        if self.log:
            values = np.log(np.maximum(values, self.low * 1e-3))
            return np.clip((values - math.log(self.low)) / (math.log(self.high) - math.log(self.low)), 0, 1)
        return np.clip((values - self.low) / (self.high - self.low), 0, 1)


def linear(low: float, high: float, *, ticks: int = 4) -> Axis:
    """Ends at or just beyond the data, 1-2-5 ticks inside."""
    if not high > low:
        low, high = low - 1, high + 1
    rough = (high - low) / ticks
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * power for factor in (1, 2, 2.5, 5, 10) if factor * power >= rough * 0.999)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    places = max(-math.floor(math.log10(step) + 1e-9) + (1 if abs(step / power - 2.5) < 1e-9 else 0), 0)
    return Axis(low, high, tuple((k * step, number(k * step, places)) for k in range(first, last + 1)))


def balanced(reach: float) -> Axis:
    """From -reach to reach, with zero and the largest round number on either side."""
    power = 10.0 ** math.floor(math.log10(0.95 * reach))
    tick = max(factor * power for factor in (1, 2, 5) if factor * power <= 0.95 * reach)
    places = max(-math.floor(math.log10(tick) + 1e-9), 0)
    return Axis(-reach, reach, tuple((value, number(value, places)) for value in (-tick, 0.0, tick)))


def logarithmic(low: float, high: float) -> Axis:
    """Whole decades, about five of them labelled."""
    first, last = math.floor(math.log10(low) + 1e-9), math.ceil(math.log10(high) - 1e-9)
    last = max(last, first + 1)
    step = max(1, math.ceil((last - first) / 5))
    ticks = tuple((10.0**k, _power(k)) for k in range(first, last + 1) if (k - first) % step == 0)
    return Axis(10.0**first, 10.0**last, ticks, True)


def _power(k: int) -> str:
    return number(10.0**k, max(-k, 0)) if -3 <= k <= 4 else power_of_ten(k)


class Frame(NamedTuple):
    """A panel of `width` x `height` px with room for tick labels left and below."""

    x: Axis
    y: Axis
    width: int = 208
    height: int = 84
    left: int = 30
    below: int = 16
    above: int = 14
    right: int = 6

    def px(self, values) -> np.ndarray:
        return self.left + self.x.at(values) * (self.width - self.left - self.right)

    def py(self, values) -> np.ndarray:
        return self.height - self.below - self.y.at(values) * (self.height - self.below - self.above)


PHONE = 340  # px of a phone's screen that a picture has: where it is drawn wider, its letters grow


def panel(
    frame: Frame,
    layers: Sequence[Markup],
    *,
    alt: str,
    css: str = "mb",
    title: str = "",
    across: str = "",
    x_ticks: bool = True,
    units: tuple[str, str] = ("", ""),
) -> Markup:
    """The layers on their axes; `title` stands above the y axis and names quantity and unit, `across` below
    the x axis where the frame has 30 px for it, `alt` states the finding, `units` (across, up) stand behind
    the values that the pointer reads off.
    """
    axes = []
    for value, label in frame.y.ticks:
        y = float(frame.py(value))
        axes.append(
            Markup(
                '<line class="tk" x1="{}" x2="{}" y1="{}" y2="{}"/><text x="{}" y="{}" '
                'text-anchor="end">{}</text>'
            ).format(frame.left, frame.width - frame.right, _n(y), _n(y), frame.left - 4, _n(y + 3.5), label)
        )
    base = frame.height - frame.below
    foot = frame.height - (16 if across else 2)
    for value, label in frame.x.ticks if x_ticks else ():
        x = float(frame.px(value))
        anchor = "start" if x < frame.left + 5 else "end" if x > frame.width - frame.right - 8 else "middle"
        axes.append(
            Markup(
                '<line class="ax" x1="{}" x2="{}" y1="{}" y2="{}"/><text x="{}" y="{}" '
                'text-anchor="{}">{}</text>'
            ).format(_n(x), _n(x), base, base + 3, _n(x), foot, anchor, label)
        )
    axes.append(
        Markup('<line class="ax" x1="{}" x2="{}" y1="{}" y2="{}"/>').format(
            frame.left, frame.width - frame.right, base, base
        )
    )
    head = Markup('<text class="yt" x="0" y="9">{}</text>').format(title) if title else Markup("")
    if across:
        head += Markup('<text class="yt across" x="{}" y="{}" text-anchor="end">{}</text>').format(
            frame.width - frame.right, frame.height - 2, across
        )
    grown = frame.width / PHONE
    return Markup(
        '<svg class="plot {}" style="--w:{}px;--k:{:.3f}" viewBox="0 0 {} {}" role="img" '
        'aria-label="{}"{}><g class="axes">{}</g>{}{}</svg>'
    ).format(
        f"{css} grows" if grown > 1 else css,
        frame.width,
        grown,
        frame.width,
        frame.height,
        alt,
        readable(frame, units),
        Markup("").join(axes),
        Markup("").join(layers),
        head,
    )


def readable(frame: Frame, units: tuple[str, str] = ("", "")) -> Markup:
    """What a script needs to tell the values below the pointer: room left, right, above, below, width and
    height in px, then the scales. A scale without ticks is one of names, and is not told.
    """
    room = (frame.left, frame.right, frame.above, frame.below, frame.width, frame.height)
    scales = Markup("").join(
        Markup(' data-{}="{:.6g} {:.6g}{}"').format(name, axis.low, axis.high, " log" if axis.log else "")
        for name, axis in (("x", frame.x), ("y", frame.y))
        if axis.ticks
    )
    behind = Markup(' data-u="{}|{}"').format(*units) if any(units) else ""
    return Markup(' data-f="{}"{}{}').format(" ".join(map(str, room)), scales, behind)


# ---- layers


def decimated(x: np.ndarray, y: np.ndarray, most: int = 240) -> tuple[np.ndarray, np.ndarray]:
    """At most 3 `most` points: of each of `most` stretches its lowest and its
    highest, so that no peak is lost, and a missing one."""
    if len(x) <= 2 * most:
        return x, y
    size = -(-len(x) // most)
    rows = np.append(y, np.full(-len(y) % size, np.nan)).reshape(-1, size)
    lowest = np.where(np.isnan(rows), np.inf, rows).argmin(axis=1)
    highest = np.where(np.isnan(rows), -np.inf, rows).argmax(axis=1)
    # and one that is missing, where any is: the line must break there
    missing = np.isnan(rows).argmax(axis=1)
    index = np.unique(
        np.stack([lowest, highest, np.where(np.isnan(rows).any(axis=1), missing, lowest)], axis=1)
        + size * np.arange(len(rows))[:, None]
    )
    index = index[index < len(x)]
    return x[index], y[index]


def line(frame: Frame, x, y, css: str = "line", *, steps: bool = False, most: int = 240) -> Markup:
    """A line; it breaks where y is missing. `steps` holds a value until the next
    sample, as inputs do; `most` as in `decimated`."""
    x, y = decimated(np.asarray(x, float), np.asarray(y, float), most)
    px, py = frame.px(x), frame.py(y)
    path, pen = [], "M"
    for i, (a, b) in enumerate(zip(px, py, strict=True)):
        if math.isnan(b):
            pen = "M"
            continue
        if steps and pen == "L":
            path.append(f"H{_n(a)}V{_n(b)}" if i else "")
        else:
            path.append(f"{pen}{_n(a)} {_n(b)}")
        pen = "L"
    return Markup('<path class="{}" d="{}"/>').format(css, "".join(path))


def level(frame: Frame, value: float, css: str, label: str = "") -> Markup:
    """A horizontal line across the panel, such as a limit or the optimum, with its name at the right end."""
    y = float(frame.py(value))
    text = (
        Markup('<text x="{}" y="{}" text-anchor="end">{}</text>').format(
            frame.width - frame.right, _n(y - 4), label
        )
        if label
        else ""
    )
    return Markup('<line class="{}" x1="{}" x2="{}" y1="{}" y2="{}"/>{}').format(
        css, frame.left, frame.width - frame.right, _n(y), _n(y), text
    )


def tint(frame: Frame, low: float, high: float) -> Markup:
    top, bottom = float(frame.py(high)), float(frame.py(low))
    return Markup('<rect class="allow" x="{}" width="{}" y="{}" height="{}"/>').format(
        frame.left, frame.width - frame.left - frame.right, _n(top), _n(max(bottom - top, 0))
    )


def stretches(mask: np.ndarray) -> list[tuple[int, int]]:
    """(start, stop) of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def interval(frame: Frame, start: float, end: float, css: str = "flag") -> Markup:
    """A stretch of time, at least a pixel wide."""
    a, b = (float(frame.px(v)) for v in (start, end))
    return Markup('<rect class="{}" x="{}" width="{}" y="{}" height="{}"/>').format(
        css, _n(a), _n(max(b - a, 1)), frame.above, frame.height - frame.below - frame.above
    )


def ribbon(frame: Frame, x, low, high, css: str = "ribbon") -> Markup:
    """The area between two lines, such as a band that moves along."""
    px, ends = frame.px(x), [frame.py(np.asarray(side, float)) for side in (high, low)]
    there, back = (
        "L".join(f"{_n(a)} {_n(b)}" for a, b in zip(px[::step], side[::step], strict=True))
        for side, step in zip(ends, (1, -1), strict=True)
    )
    return Markup('<path class="{}" d="M{}L{}Z"/>').format(css, there, back)


def stems(frame: Frame, x, y, css: str = "stem") -> Markup:
    """A stroke from zero to each value."""
    zero = _n(float(frame.py(0.0)))
    strokes = "".join(
        f"M{_n(a)} {zero}V{_n(b)}" for a, b in zip(frame.px(x), frame.py(y), strict=True) if not math.isnan(b)
    )
    return Markup('<path class="{}" d="{}"/>').format(css, strokes) if strokes else Markup("")


def dots(frame: Frame, x, y, css: str = "dot", radius: float = 2.2) -> Markup:
    pairs = zip(np.atleast_1d(frame.px(x)), np.atleast_1d(frame.py(y)), strict=True)
    return Markup("").join(
        Markup('<circle class="{}" cx="{}" cy="{}" r="{}"/>').format(css, _n(a), _n(b), radius)
        for a, b in pairs
        if not math.isnan(b)
    )


def label(
    frame: Frame, x: float, y: float, text: str, *, anchor: str = "start", dx: float = 0, dy: float = 0
) -> Markup:
    return Markup('<text x="{}" y="{}" text-anchor="{}">{}</text>').format(
        _n(float(frame.px(x)) + dx), _n(float(frame.py(y)) + dy), anchor, text
    )
