"""Params as text: a value written into a file whose comments, order and other lines stay as they are, and
whole sections.

(The round trip of ruamel.yaml moves the entries of lists and writes null as nothing: 64 lines of the two
files as shipped would change.)
"""

import io
from collections.abc import Sequence
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.nodes import CollectionNode, MappingNode, Node


def written(value: Any, *, flow: bool = False) -> str:
    """The value as YAML, in the order of its keys; `flow`: on one line."""
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = flow
    yaml.sort_base_mapping_type_on_output = False
    # an object that stands twice is written out twice
    yaml.representer.ignore_aliases = lambda _: True
    yaml.width = 1000
    stream = io.StringIO()
    yaml.dump(value, stream)
    return stream.getvalue()


def replaced(text: str, dotted: str, lines: Sequence[str]) -> str:
    """`text` with the value of a key such as plant.inputs replaced: by a scalar or [...] on its line, or by
    the entries of a block below the key.

    Raises ValueError for a key that the text does not have.
    """
    key, value = _nodes(text, dotted)
    start, end = value.start_mark.index, _end(value)
    line_end = text.find("\n", key.end_mark.index)
    line_end = len(text) if line_end < 0 else line_end
    is_entry = lines[0].startswith("- ") or isinstance(YAML(typ="safe", pure=True).load(lines[0]), dict)
    if len(lines) == 1 and not is_entry:
        if value.start_mark.line != key.start_mark.line:  # a block below the key
            return text[: key.end_mark.index] + f": {lines[0]}{_comment(text, key, line_end)}" + text[end:]
        return text[:start] + lines[0] + text[end:]
    indent = " " * (key.start_mark.column + 2)
    block = "".join(f"\n{indent}{line}" for line in lines)
    if value.start_mark.line == key.start_mark.line and end <= line_end:
        rest = text[end:line_end].strip()
        comment = f"  {rest}" if rest else ""
        return text[: key.end_mark.index] + ":" + comment + block + text[line_end:]
    return text[: key.end_mark.index] + ":" + _comment(text, key, line_end) + block + text[end:]


def _comment(text: str, key: Node, line_end: int) -> str:
    """The comment behind the colon of a key whose value stands below it."""
    rest = text[key.end_mark.index : line_end].lstrip().removeprefix(":").strip()
    return f"  {rest}" if rest else ""


def _nodes(text: str, dotted: str) -> tuple[Node, Node]:
    node = YAML(typ="safe", pure=True).compose(text)
    key = None
    for name in dotted.split("."):
        pairs = node.value if isinstance(node, MappingNode) else []
        key, node = next(((k, v) for k, v in pairs if k.value == name), (None, None))
        if key is None or node is None:
            raise ValueError(f"{dotted} is not in the file; restore its sections with git checkout")
    assert key is not None and node is not None
    return key, node


def _end(node: Node) -> int:
    """Where the node's last character stands; the end that YAML gives a block lies behind its comments."""
    if isinstance(node, CollectionNode) and not node.flow_style and node.value:
        last = node.value[-1]
        return _end(last[1] if isinstance(last, tuple) else last)
    return node.end_mark.index
