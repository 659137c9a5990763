"""A figure of a page: its columns of panels, the finding above and the caption below."""

from typing import NamedTuple

from markupsafe import Markup

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

    id: str
    title: str
    finding: str
    columns: list[PictureColumn]
    caption: str
    origin: Markup
    missing: Missing | None = None


def placeholder(id: str, title: str, missing: Missing) -> Picture:
    return Picture(id, title, "", [], "", Markup(""), missing)
