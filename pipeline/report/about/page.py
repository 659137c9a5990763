"""The page of the words."""

from pipeline.report.shared import page, words
from pipeline.report.shared.sources import Sources


def render_words(sources: Sources) -> str:
    """The text of words.html: every word of every page, in alphabetical order."""
    meanings: dict[str, list[str]] = {}
    for word, meaning in words.glossary(sources).values():
        meanings.setdefault(word, []).append(meaning)
    every = sorted(meanings.items(), key=lambda pair: pair[0].lower())
    return page.render("words.html", here="words", sources=sources, title="Words", words=every)


def render_off(sources: Sources) -> str:
    """The text of the page of a loop that is switched off."""
    return page.render("off.html", here="", sources=sources, title="Switched off")
