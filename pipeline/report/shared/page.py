"""The frame of every page: templates, one stylesheet, marks, and the small pieces that both pages use."""

import base64
import functools
import hashlib

import jinja2
from markupsafe import Markup, escape

from pipeline.report.shared import digits
from pipeline.report.shared.sources import Source
from pipeline.report.shared.verdict import FAILED, OPEN, PASSED, UNDECIDED
from pipeline.store import artifacts
from pipeline.store.printable import printable_page

GLYPHS = {
    PASSED: "tick",
    FAILED: "cross",
    UNDECIDED: "open",
    OPEN: "open",
    "not applicable": "open",
    "stale": "open",
}
# role or controller -> class of its mark: circle data-driven, square model-based, ring baseline
MARKS = {
    "data_driven": "dd",
    "window": "dd",
    "model_based": "mb",
    "baseline": "bl",
    "kernel": "dd",
    "exact_model": "mb",
}


@functools.cache
def environment() -> jinja2.Environment:
    """Escapes everything that is not Markup; a name that a template misspells is an error."""
    found = jinja2.Environment(
        loader=jinja2.PackageLoader("pipeline.report", "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    found.globals |= {
        "glyph": glyph,
        "mark": mark,
        "bdi": bdi,
        "origin": origin,
        "missing": missing,
        "anchor": anchor,
        "term": term,
        "hashed": hashed,
        "word_id": word_id,
    }
    script = Markup(found.get_template("page.js").render().strip())
    found.globals |= {
        "script": script,
        "script_hash": base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
    }
    found.filters |= {"shortened": digits.shortened, "typeset": digits.typeset, "count": digits.count}
    return found


# pages that the command line writes, linked where they are
BESIDE = (("nightly", "Nightly"), ("history", "History"))


def render(template: str, **values) -> str:
    """A whole page."""
    beside = [
        (name, title)
        for name, title in BESIDE
        if name == values["here"] or artifacts.exists(f"reports/{name}.html")
    ]
    return printable_page(environment().get_template(template).render(beside=beside, **values))


def glyph(state: str) -> Markup:
    """Tick, cross or dashed ring; colour never stands alone."""
    bad = " bad" if state == FAILED else ""
    return Markup('<svg class="g{}" aria-hidden="true"><use href="#{}"/></svg>').format(
        bad, GLYPHS.get(state, "open")
    )


def mark(controller: str) -> Markup:
    hollow = " hollow" if controller in ("kernel", "exact_model") else ""
    return Markup('<span class="mk {}{}" aria-hidden="true"></span>').format(MARKS[controller], hollow)


def bdi(text: object) -> Markup:
    """Text that came with the data: escaped, isolated, short; the whole of it in its title."""
    whole = " ".join(str(text).split())
    cut = digits.shortened(whole)
    title = Markup(' title="{}"').format(whole) if cut != whole else Markup("")
    return Markup("<bdi{}>{}</bdi>").format(title, cut)


def missing(found) -> Markup:
    """State first, reason second, remedy third."""
    return Markup("{}<strong>{}.</strong> <bdi>{}</bdi>").format(
        glyph(found.state), found.state.capitalize(), found.sentence()
    )


def origin(sources: list[Source]) -> Markup:
    """Where the figures beside it are from: stage, artifact, schema,
    hash; the whole hash is in the provenance."""
    if not sources:
        return Markup("")
    parts = [
        Markup('<a href="#{}"><code>{}</code></a>').format(anchor(s.path), s.path.split("/", 1)[1])
        for s in sources
    ]
    return Markup('<p class="src">From {}.</p>').format(Markup(", ").join(parts))


def word_id(word: str) -> str:
    return "word-" + "".join(letter if letter.isalnum() else "-" for letter in word.lower())


def term(word: str, text: str = "") -> Markup:
    """A word of the page's list, linked to its meaning there; where a script runs,
    the meaning stands beside it on hover and focus."""
    return (
        Markup('<a class="term" href="#{}">{}</a>').format(word_id(word), text or word)
        if word
        else escape(text)
    )


def hashed(short: str, sources: list[Source]) -> Markup:
    """The first digits of a hash, linked to the artifact that has it, where it is one's."""
    found = next((source for source in sources if source.sha256.startswith(short)), None)
    code = Markup("<code>{}</code>").format(short)
    return Markup('<a href="#{}">{}</a>').format(anchor(found.path), code) if found else code


def anchor(path: str) -> str:
    return "from-" + "".join(letter if letter.isalnum() else "-" for letter in path)
