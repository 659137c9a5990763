"""The frame of every page: templates, one stylesheet, marks, and the small pieces that both pages use."""

import base64
import functools
import hashlib
import itertools
import re
import urllib.parse
from collections.abc import Iterable, Mapping, Sequence

import jinja2
from markupsafe import Markup, escape

from pipeline.report.shared import headline
from pipeline.report.shared.pictures import PictureColumn
from pipeline.report.shared.sources import SourceFile, Sources
from pipeline.store import artifacts
from pipeline.store.printable import printable_page
from pipeline.temperature.controllers.table import CONTROLLERS as CONTESTANTS
from pipeline.verdict import digits
from pipeline.verdict.controllers import heading, in_a_sentence
from pipeline.verdict.deposition import NOT_JUDGED
from pipeline.verdict.evidence import entry, gap_of
from pipeline.verdict.settings import QUICK_LOOK
from pipeline.verdict.verdict import FAILED, OPEN, PASSED, UNDECIDED, Missing

GLYPHS = {
    PASSED: "tick",
    FAILED: "cross",
    UNDECIDED: "open",
    OPEN: "open",
    "not applicable": "open",
    "stale": "open",
}
# marks of controllers that the table gives none: told apart by their outline, in print and in grey too
SHAPES = {
    "triangle": "50% 0,100% 100%,0 100%",
    "diamond": "50% 0,100% 50%,50% 100%,0 50%",
    "wedge": "0 0,100% 0,50% 100%",
    "plus": "35% 0,65% 0,65% 35%,100% 35%,100% 65%,65% 65%,65% 100%,35% 100%,35% 65%,0 65%,0 35%,35% 35%",
    "hourglass": "0 0,100% 0,50% 50%,100% 100%,0 100%,50% 50%",
    "bow": "0 0,50% 50%,100% 0,100% 100%,50% 50%,0 100%",
}
_unmarked = [contestant.name for contestant in CONTESTANTS if not contestant.mark]
# role or contestant -> class of its mark: circle data-driven, square model-based, ring baseline; hollow
# circle: another learned one of a loop
MARKS = (
    {"data_driven": "dd", "model_based": "mb", "baseline": "bl", "kernel": "dd"}
    | {contestant.name: contestant.mark for contestant in CONTESTANTS if contestant.mark}
    | {shape: shape for shape in SHAPES}
    | dict(zip(_unmarked, itertools.cycle(SHAPES), strict=False))
)
HOLLOW = {"kernel", *(contestant.name for contestant in CONTESTANTS if contestant.hollow)}


@functools.cache
def environment() -> jinja2.Environment:
    """Escapes everything that is not Markup; a name that a template misspells is an error."""
    templates = jinja2.Environment(
        loader=jinja2.PackageLoader("pipeline.report", "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    templates.globals |= {
        "glyph": glyph,
        "mark": mark,
        "bdi": bdi,
        "origin": origin,
        "linked": linked,
        "placed": placed,
        "verbatim": verbatim,
        "missing": missing,
        "term": term,
        "word_id": word_id,
        "entry": entry,
        "gap_of": gap_of,
        "not_judged": NOT_JUDGED,
    }
    script = Markup(templates.get_template("page.js").render().strip())
    templates.globals |= {
        "script": script,
        "script_hash": base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
    }
    templates.filters |= {
        "widest": widest,
        "shortened": digits.shortened,
        "typeset": digits.typeset,
        "count": digits.count,
        "number": digits.number,
        "percent": digits.percent,
        "quantity": digits.quantity,
        "band": digits.band,
        "listed": digits.listed,
        "short": digits.short,
        "heading": heading,
        "in_a_sentence": in_a_sentence,
    }
    return templates


# the loop that a page is about
LOOP_OF = {
    "temperature": "temperature",
    "identification": "temperature",
    "certificate": "temperature",
    "deposition": "deposition",
    "setpoint": "setpoint",
}


def render(template: str, *, sources: Sources | None = None, **values) -> str:
    """A whole page; at its foot the table of the files that the pages of this run are made from."""
    # the nightly job writes its page after the others
    nightly = values["here"] == "nightly" or artifacts.exists("reports/nightly.html")
    quick = artifacts.read_json(QUICK_LOOK) if artifacts.exists(QUICK_LOOK) else None
    # the pages of a loop that is switched off say so, and no page leads to them
    off = [] if sources is None else [key for key, loop in LOOP_OF.items() if loop not in sources.verdicts]
    beside = [("nightly", "Nightly")] if nightly else []
    loop = LOOP_OF.get(values["here"])
    judged = [] if sources is None else [loop] if loop in sources.verdicts else list(sources.verdicts)
    data = headline.data(sources, judged).split("; no")[0].rstrip(".") if sources and judged else ""
    frame = {"beside": beside, "quick": quick, "sources": sources, "off": off, "machine_of": data}
    return printable_page(environment().get_template(template).render(**frame, **values))


def glyph(state: str) -> Markup:
    """Tick, cross or dashed ring; colour never stands alone."""
    bad = " bad" if state == FAILED else ""
    return Markup('<svg class="g{}" aria-hidden="true"><use href="#{}"/></svg>').format(
        bad, GLYPHS.get(state, "open")
    )


def widest(columns: Sequence[PictureColumn]) -> int:
    """Width in px for which the widest chart of these columns was drawn."""
    panels = "".join(str(panel) for column in columns for panel in column.panels)
    return max(map(int, re.findall(r'style="--w:(\d+)px', panels)), default=208)


def mark(controller: str) -> Markup:
    css = MARKS.get(controller, "bl") + (" hollow" if controller in HOLLOW else "")
    if css in SHAPES:
        return Markup(
            '<span class="mk {}" style="background:var(--ink);clip-path:polygon({})" '
            'aria-hidden="true"></span>'
        ).format(css, SHAPES[css])
    return Markup('<span class="mk {}" aria-hidden="true"></span>').format(css)


STYLES = {"dd": "line dd", "mb": "line", "bl": "line bl"}


def line_styles(marks: Mapping[str, str]) -> dict[str, str]:
    """{controller: the class of its line}, from the role or the name that has its mark; the second of a hue
    is dashed."""
    styles: dict[str, str] = {}
    for name, role in marks.items():
        style = STYLES.get(MARKS.get(role, "bl"), "line")
        styles[name] = f"{style} dash" if style in styles.values() else style
    return styles


def line_key(lines: Iterable[tuple[str, str]]) -> Markup:
    """Which line of a picture is whose: of each (name, class of its line) a stroke, and the name."""
    stroke = Markup(
        '<span class="ln"><svg class="plot stroke" viewBox="0 0 20 8" aria-hidden="true"><path class="{}" '
        'd="M0 4H20"/></svg> {}</span>'
    )
    return Markup(", ").join(stroke.format(css, name) for name, css in lines)


def bdi(text: object) -> Markup:
    """Text that came with the data: escaped, isolated, short; the whole of it in its title."""
    whole = " ".join(str(text).split())
    cut = digits.shortened(whole)
    title = Markup(' title="{}"').format(whole) if cut != whole else Markup("")
    return Markup("<bdi{}>{}</bdi>").format(title, cut)


def missing(gap: Missing) -> Markup:
    """State first, reason second, remedy third."""
    return Markup("{}<strong>{}.</strong> <bdi>{}</bdi>").format(
        glyph(gap.state), gap.state.capitalize(), gap.sentence()
    )


def hole(gap: Missing) -> Markup:
    """The same in the place of a panel."""
    return Markup('<div class="hole">{}</div>').format(missing(gap))


# sources that the viewer shows by the same name; a test holds them against its tables
IN_VIEWER = (
    "trajectories",
    "record",
    "holdout",
    "steps",
    "trials",
    "lessons",
    "signals",
    "decisions",
    "paths",
    "agents",
)


def in_viewer(table: str, **place: str | Sequence[str]) -> Markup:
    """A link to a table's place in the viewer: values by key, lines by `y`, as its address has them."""
    state = urllib.parse.urlencode({"t": table} | place, doseq=True, quote_via=urllib.parse.quote)
    return Markup('<a class="in-viewer" href="viewer.html#{}">Open in the viewer</a>').format(state)


def origin(sources: list[SourceFile], **place: str | Sequence[str]) -> Markup:
    """Where the figures beside it are from: artifact and hash; the whole hash stands at the foot of the page.
    A time series is linked to its place in the viewer, which `place` tells."""
    if not sources:
        return Markup("")
    series = next((source.name for source in sources if source.name in IN_VIEWER), None)
    if series:
        return Markup('{} <p class="src">{}.</p>').format(files(sources), in_viewer(series, **place))
    return files(sources)


def files(sources: Sequence[SourceFile]) -> Markup:
    """The artifacts by name: a click gives the file, the title its digest."""
    return Markup('<p class="src">From {}.</p>').format(linked(sources)) if sources else Markup("")


def linked(sources: Sequence[SourceFile], *, short: bool = False) -> Markup:
    """The links to these files, with commas between them; `short`: figures by their stage, tables by their
    name."""

    def name(path: str) -> str:
        stage, _, file = path.split("/", 1)[1].rpartition("/")
        return f"{stage}/{file}" if not short else stage if file == "figures.json" else file

    return Markup(", ").join(
        placed(
            source.link,
            source.path,
            verbatim(name(source.path)),
            f"{source.path}, SHA-256 {source.sha256[:8]}",
        )
        for source in sources
    )


def verbatim(text: str) -> Markup:
    return Markup("<code>{}</code>").format(text)


def placed(link: str, path: str, text: str, title: str = "") -> Markup:
    """A file, linked where it lies below reports/; else its path in words, because who has the pages alone
    cannot follow a link out of their folder."""
    if link.startswith("../"):
        return Markup('<span class="outside">{} of the project</span>').format(verbatim(path))
    shown = Markup(' title="{}"').format(title) if title else Markup("")
    return Markup('<a class="from" href="{}"{}>{}</a>').format(link, shown, text)


def word_id(word: str) -> str:
    return "word-" + "".join(letter if letter.isalnum() else "-" for letter in word.lower())


def term(word: str, text: str = "") -> Markup:
    """A word of the page's list, linked to its meaning there; where a script runs,
    the meaning stands beside it on hover and focus."""
    return (
        Markup('<a class="term" href="words.html#{}">{}</a>').format(word_id(word), text or word)
        if word
        else escape(text)
    )
