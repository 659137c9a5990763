"""A value of a params file written into its text: comments, order and all other lines stay as they are."""

from collections.abc import Sequence

import yaml


def replaced(text: str, dotted: str, lines: Sequence[str]) -> str:
    """`text` with the value of a key such as plant.inputs replaced: by a scalar or [...] on its line, or by
    the entries of a block below the key.

    Raises ValueError for a key that the text does not have.
    """
    key, value = _nodes(text, dotted)
    start, end = value.start_mark.index, _end(value)
    line_end = text.find("\n", key.end_mark.index)
    line_end = len(text) if line_end < 0 else line_end
    is_entry = lines[0].startswith("- ") or isinstance(yaml.safe_load(lines[0]), dict)
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


def _comment(text: str, key: yaml.Node, line_end: int) -> str:
    """The comment behind the colon of a key whose value stands below it."""
    rest = text[key.end_mark.index : line_end].lstrip().removeprefix(":").strip()
    return f"  {rest}" if rest else ""


def _nodes(text: str, dotted: str) -> tuple[yaml.Node, yaml.Node]:
    node = yaml.compose(text, yaml.SafeLoader)
    key = None
    for name in dotted.split("."):
        pairs = node.value if isinstance(node, yaml.MappingNode) else []
        key, node = next(((k, v) for k, v in pairs if k.value == name), (None, None))
        if key is None or node is None:
            raise ValueError(f"{dotted} is not in the file; restore its sections with git checkout")
    assert key is not None and node is not None
    return key, node


def _end(node: yaml.Node) -> int:
    """Where the node's last character stands; the end that YAML gives a block lies behind its comments."""
    if isinstance(node, yaml.CollectionNode) and not node.flow_style and node.value:
        last = node.value[-1]
        return _end(last[1] if isinstance(last, tuple) else last)
    return node.end_mark.index
