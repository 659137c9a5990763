"""Makes text from a user's file safe to show in a terminal and on a page."""

import re

# characters that move a cursor, or colour, hide or reverse text: C0 without tab and line feed, DEL and C1,
# direction marks, line separators, surrogate halves (from file names that are not UTF-8)
_UNSEEN = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
# the same characters as JSON escapes, which a script would convert back
_IN_JSON = re.compile(
    r"\\u(?=00[01][0-9a-f]|007f|00[89][0-9a-f]|061c|200[ef]|202[89a-e]|206[6-9]|d[89ab]|d[c-f])",
    re.IGNORECASE,
)


def printable(text: str) -> str:
    r"""Returns the text with its control characters written out: \x1b, \u202e."""
    return _UNSEEN.sub(lambda found: _written_out(ord(found[0])), text)


def counted(number: int, one: str, many: str = "") -> str:
    """Returns "1 frame", "20 frames"."""
    return f"{number:,} {one if number == 1 else many or one + 's'}"


def printable_page(page: str) -> str:
    """Returns a page without control characters, also in the JSON that its scripts read."""
    return _IN_JSON.sub(r"\\\\u", printable(page))


def _written_out(code: int) -> str:
    return f"\\x{code:02x}" if code < 256 else f"\\u{code:04x}"
