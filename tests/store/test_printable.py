"""No control character of somebody's file reaches a terminal or a page."""

import json
import re
import unicodedata

import pytest

from pipeline.report.shared.page import environment
from pipeline.store.printable import printable, printable_page

HOSTILE = "\x1b[31m \x1b]0;owned\x07 \u202egnp.exe \x9b2J \u2066a\u2069 \x00 \x7f \r \u2028 \udcff"


def unseen(text: str) -> list[str]:
    """Characters of control, format of direction, and halves of pairs, but for tab and line feed."""
    return [
        letter
        for letter in text
        if unicodedata.category(letter) in ("Cc", "Cs", "Zl", "Zp")
        and letter not in "\t\n"
        or unicodedata.bidirectional(letter)
        in ("LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI")
    ]


def test_control_characters_are_written_out_and_plain_text_is_left_alone():
    assert printable("a\x1b[31m\u202eb\x9b") == r"a\x1b[31m\u202eb\x9b"
    assert not unseen(printable(HOSTILE))
    printable(HOSTILE).encode()  # file names that are no UTF-8 can be printed too
    plain = "Düse 1 — 21,5 °C ↔ 温度\u202f% \t\n"
    assert printable(plain) == plain


@pytest.mark.parametrize("code", [0x1B, 0x7F, 0x9B, 0x202E, 0x2066, 0x200F, 0xDCFF])
def test_a_page_has_none_either_nor_has_the_json_that_its_scripts_read(code):
    template = environment().from_string("<p title='{{ name }}'>{{ name }}</p><p data-x='{{ name|tojson }}'>")
    page = printable_page(template.render(name=f"zone{chr(code)}"))
    assert not unseen(page)
    data = re.search(r"data-x='(.*)'>", page)
    assert data
    assert not unseen(json.loads(data[1]))
    assert "zone" in json.loads(data[1])
