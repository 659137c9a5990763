"""A figure of a page: its columns of panels, the finding above and the caption below."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

from markupsafe import Markup

from pipeline.verdict.evidence import instead
from pipeline.verdict.verdict import Missing


class PictureColumn(NamedTuple):
    """Panels below one head."""

    head: str
    small: str
    mark: str
    panels: list[Markup]


class Picture(NamedTuple):
    """A figure with its finding as the sentence above it; in the place
    of what cannot be drawn, the reason."""

    finding: str
    columns: list[PictureColumn]
    caption: str
    origin: Markup
    id: str = ""
    title: str = ""
    missing: Missing | None = None


def as_picture(id: str, title: str) -> Callable[[Callable[..., Picture]], Callable[..., Picture]]:
    """A decorator: a picture with its id and title; if it needs something that is absent, the reason."""

    def decorate(draw: Callable[..., Picture]) -> Callable[..., Picture]:
        @functools.wraps(draw)
        def picture(*args: Any, **options: Any) -> Picture:
            made = draw(*args, **options)
            return made._replace(id=made.id or id, title=made.title or title)

        return instead(lambda gap: placeholder(id, title, gap))(picture)

    return decorate


def placeholder(id: str, title: str, missing: Missing) -> Picture:
    """In the place of a picture, why it cannot be drawn."""
    return Picture("", [], "", Markup(""), id, title, missing)


def as_table(**empty: Any) -> Callable[[Callable[..., dict]], Callable[..., dict]]:
    """A decorator: a table for a template, with `missing` None; if it needs something that is absent, `empty`
    and the reason."""

    def decorate(build: Callable[..., dict]) -> Callable[..., dict]:
        @functools.wraps(build)
        def table(*args: Any, **options: Any) -> dict:
            return {"missing": None} | build(*args, **options)

        return instead(lambda gap: empty | {"missing": gap})(table)

    return decorate
