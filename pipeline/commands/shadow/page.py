"""The page of a watch: one file that refreshes itself, with everything in it and no script. It is written
anew for each decision, and asks for nothing."""

import base64
import html
import string
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from pipeline.commands.shadow.decide import DeployedLoop, DrawnFrame, ShadowDecision
from pipeline.setpoint.agents import flow_filter
from pipeline.setpoint.deployment import deployment
from pipeline.setpoint.material import GOOD, PrintedMaterial
from pipeline.setpoint.simulation import actuation
from pipeline.setpoint.simulation.actuation import ACTS
from pipeline.setpoint.vision.proof import verdict
from pipeline.store.printable import counted, printable, printable_page

COLOURS = ("#3b76c4", "#2f9e5a", "#d0662a")
ENDED = "The watch has ended."
# of the drawing of the belief
WIDTH, HEIGHT, TICKS = 640, 90, (20, 50, 150, 200, 310)
REASONS_LISTED, NOTES_LISTED = 5, 10


def render(
    place: str,
    of: DeployedLoop,
    decisions: Sequence[ShadowDecision],
    state: str,
    notes: Sequence[str],
    trouble: str,
) -> str:
    """The page after these decisions of `of`, the last one at the end. `state` is a sentence on why nothing
    comes, "" if frames do; `trouble` why the decisions cannot be written. After ENDED it refreshes itself
    no more."""
    last = decisions[-1] if decisions else None
    warnings = [text for text in (state, trouble) if text]
    values = {
        "place": _text(place),
        "controller": _text(of.name),
        "proof": _text(verdict(of.proof)),
        "refresh": "" if state == ENDED else '<meta http-equiv="refresh" content="2">',
        "warnings": "".join(f"<p class=warning>{_text(text)}</p>" for text in warnings),
        "would": "<p class=big>No window yet.</p>" if last is None else _would(last),
        "shares": "" if last is None else _shares(last),
        "belief": "" if last is None or last.belief is None else _belief(last.belief, of.material),
        "frames": "" if last is None else _frames(last),
        "rows": "".join(_row(decision) for decision in reversed(decisions)),
        "notes": _list([*notes][-NOTES_LISTED:]),
    }
    template = Path(__file__).with_name("page.html").read_text(encoding="utf-8")
    return printable_page(string.Template(template).substitute(values))


def _text(text: str) -> str:
    return html.escape(printable(text))


def _would(last: ShadowDecision) -> str:
    """What it would do now, and why."""
    acts = last.judged.reason[0] == ACTS
    words = f"It would {_text(last.row['would'])}." if last.row["would"].startswith("change") else ""
    words = words or (f"It would send: {_text(last.row['would'])}." if acts else "It would hold.")
    because = _text(last.row["why"])
    setpoint = f"The print is set to {last.setpoint[0]:g} % of flow and {last.setpoint[1]:g} °C."
    return (
        f"<p class=big>{words}</p><p>{because}</p>"
        f"<p class=quiet>Decision {last.number} at {last.time_s:.1f} s. {setpoint}</p>"
    )


def _shares(last: ShadowDecision) -> str:
    """Bars of the window's shares."""
    bars = "".join(
        f'<tr><th>{name}</th><td><svg width="260" height="14" role="img" aria-label="{p:.2f}">'
        f'<rect width="{260 * p:.1f}" height="14" fill="{colour}"/></svg></td><td>{p:.2f}</td></tr>'
        for name, p, colour in zip(deployment.CLASSES, last.judged.p[0], COLOURS, strict=True)
    )
    used, valid = int(last.judged.used[0]), int(last.judged.valid[0])
    frames = (
        f"{used} of {counted(len(last.names), 'frame')} {'counts' if used == 1 else 'count'}, "
        f"{valid} {'shows' if valid == 1 else 'show'} a line"
    )
    return f"<h2>What the window shows</h2><table>{bars}</table><p class=quiet>{frames}</p>"


def _belief(belief: np.ndarray, material: PrintedMaterial) -> str:
    """The belief over the flow of a material as a drawing, on a logarithmic axis, with the good range
    shaded."""
    grid, (thin, thick) = material.own_flow(flow_filter.GRID), material.good_flow_percent
    low, high = np.log(grid[[0, -1]])

    def place(flow: float) -> float:
        return float(WIDTH * (np.log(flow) - low) / (high - low))

    density = belief / np.gradient(np.log(grid))  # by logarithm of the flow
    tops = HEIGHT - (HEIGHT - 10) * density / density.max()
    points = " ".join(f"{place(q):.1f},{y:.1f}" for q, y in zip(grid, tops, strict=True))
    ticks = "".join(
        f'<text x="{place(q):.0f}" y="{HEIGHT + 16}" text-anchor="middle">{q:g}</text>'
        for q in sorted({*TICKS, thin, thick})
        if grid[0] <= q <= grid[-1]
    )
    width = place(thick) - place(thin)
    good = f'<rect x="{place(thin):.1f}" width="{width:.1f}" height="{HEIGHT}" class="good"/>'
    median = float(np.interp(0.5, np.cumsum(belief), grid))
    inside = float(belief[material.label(grid) == GOOD].sum())
    words = f"Most likely about {median:.0f} %; inside {thin:g} to {thick:g} % with probability {inside:.2f}."
    return (
        f'<h2>Belief over the flow</h2><svg viewBox="-10 0 {WIDTH + 20} {HEIGHT + 22}" role="img" '
        f'aria-label="belief over flow in percent">{good}'
        f'<polygon points="0,{HEIGHT} {points} {WIDTH},{HEIGHT}" class="belief"/>{ticks}</svg>'
        f"<p>{words} <span class=quiet>Axis: flow in percent of nominal.</span></p>"
    )


def _frames(last: ShadowDecision) -> str:
    """The window's frames with the key area, and why frames were rejected."""
    figures = "".join(
        f'<figure><img alt="frame {_text(one.name)}" src="{_embedded(one)}">'
        f"<figcaption>{_text(one.name)}: {_text(one.reason) or 'accepted'}</figcaption></figure>"
        for one in last.pictures
    )
    counts: dict[str, int] = {}
    for reason in last.reasons:
        kind = reason.partition(":")[0]
        counts[kind] = counts.get(kind, 0) + bool(kind)
    most = sorted(counts.items(), key=lambda item: -item[1])[:REASONS_LISTED]
    rejected = _list([f"{count} rejected: {reason}" for reason, count in most if count])
    return f"<h2>Last frames</h2><div class=row>{figures}</div>{rejected}"


def _row(one: ShadowDecision) -> str:
    acts = one.judged.reason[0] == ACTS
    does = _text(one.row["would"]) if acts else f"hold: {_text(actuation.REASONS[one.judged.reason[0]])}"
    shares = " ".join(f"{p:.2f}" for p in one.judged.p[0])
    median = one.row["belief_flow_percent"]
    belief = "" if median is None else f"{median:.0f} %"
    return (
        f"<tr><td>{one.number}</td><td>{one.time_s:.1f}</td><td>{one.judged.used[0]}</td><td>{shares}</td>"
        f"<td>{belief}</td><td>{does}</td></tr>"
    )


def _list(texts: Sequence[str]) -> str:
    return f"<ul>{''.join(f'<li>{_text(text)}</li>' for text in texts)}</ul>" if texts else ""


def _embedded(one: DrawnFrame) -> str:
    """A JPEG inside the page."""
    bgr = cv2.cvtColor(one.picture, cv2.COLOR_RGB2BGR)
    data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 80])[1]
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()
