"""The pages beside the verdict: the workflow, the words, and where every figure is from."""

from pipeline.report.about import workflow
from pipeline.report.index.hashes import hashes
from pipeline.report.shared import page, words
from pipeline.report.shared.sources import Sources


def render_workflow(sources: Sources) -> str:
    """The text of workflow.html."""
    return page.render("workflow.html", here="workflow", title="Workflow", workflow=workflow.figure(sources))


def render_words(sources: Sources) -> str:
    """The text of words.html: every word of every page, in alphabetical order."""
    meanings: dict[str, list[str]] = {}
    for word, meaning in words.glossary(sources).values():
        meanings.setdefault(word, []).append(meaning)
    every = sorted(meanings.items(), key=lambda pair: pair[0].lower())
    return page.render("words.html", here="words", title="Words", words=every)


def render_provenance(sources: Sources) -> str:
    """The text of provenance.html: every file that the pages were made from, with its digest."""
    return page.render(
        "provenance.html",
        here="provenance",
        title="Provenance",
        sources=list(sources.read.values()),
        absent=sources.absent,
        hashes=hashes(sources),
        code=sources.code,
    )
