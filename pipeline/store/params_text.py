"""Params as text: read by DVC's own parser; a value written into a file whose comments, order and other lines
stay as they are; and whole sections.

(The round trip of ruamel.yaml moves the entries of lists and writes null as nothing: 64 lines of the two
files as shipped would change.)
"""

import copy
import functools
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.composer import MaxDepthExceededError
from ruamel.yaml.error import MarkedYAMLError, StreamMark, YAMLError
from ruamel.yaml.nodes import CollectionNode, MappingNode, Node, ScalarNode, SequenceNode

RESTORE = "run from the root of the project, or restore it with git checkout {}"
# the project's own files are 6 levels deep
DEEPEST, LONGEST_NUMBER, LARGEST = 50, 30, 200_000
_TAGS = {f"tag:yaml.org,2002:{kind}" for kind in ("bool", "null", "int", "float", "str", "map", "seq")}


def read(path: str | Path) -> Any:
    """What the file holds, unchecked. Raises ValueError with file and line if it is no YAML or has a key
    twice."""
    try:
        size = Path(path).stat().st_size
        if not Path(path).is_file():
            raise ValueError(f"{path} is no file; {RESTORE.format(path)}")
        if size > LARGEST:
            raise ValueError(
                f"{path} has {size} bytes but may have {LARGEST}; restore it with git checkout {path}"
            )
        text = Path(path).read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ValueError(f"{path} is missing; {RESTORE.format(path)}") from None
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: byte {error.start} is not UTF-8; save the file as UTF-8") from None
    try:
        return copy.deepcopy(_parsed(text))
    except MarkedYAMLError as error:
        line = f"line {error.problem_mark.line + 1}: " if isinstance(error.problem_mark, StreamMark) else ""
        # "expected one document", "but found another"
        context = f"{error.context}, " if str(error.problem).startswith("but") else ""
        problem = " ".join(f"{context}{error.problem}".split())
        remedy = "" if ";" in problem else "; mend the line: key: value, indented by spaces"
        raise ValueError(f"{path}: {line}{problem}{remedy}") from None
    except (ValueError, OverflowError) as error:
        raise ValueError(f"{path}: {error}; take that out") from None
    except YAMLError as error:
        raise ValueError(f"{path}: {' '.join(str(error).split())}; remove that character") from None


@functools.lru_cache(maxsize=8)
def _parsed(text: str) -> Any:
    """YAML 1.2 as DVC reads it, by the same parser: 1e-6 is a number, `no` and `on` are words."""
    yaml = YAML(typ="safe", pure=True)
    yaml.max_depth = DEEPEST
    try:
        node = yaml.compose(text)
    except MaxDepthExceededError as error:
        error.problem = f"it is nested deeper than {DEEPEST} levels; put fewer into each other"
        raise
    if node is None:
        return None
    _check(node)
    try:
        return yaml.constructor.construct_document(node)
    except (KeyError, IndexError, ValueError) as error:
        raise MarkedYAMLError(problem=f"{error} does not fit its tag; take the tag out") from None


def _check(node: Node) -> None:
    """Raises MarkedYAMLError for what a reader of the file would take for something else, and for what JSON
    has no type for. An alias is its anchor's node, so that it is not reached."""
    if node.anchor:
        raise _refused(node, f"the anchor &{node.anchor} is refused; write the values out at each place")
    tag = str(node.tag)
    if tag.endswith(":timestamp") and isinstance(node, ScalarNode):
        raise _refused(node, f'{node.value} is a date; write it in quotes: "{node.value}"')
    if tag not in _TAGS:
        raise _refused(node, f"the tag {tag} names no type of parameters; take it out")
    if isinstance(node, ScalarNode) and tag.endswith((":int", ":float")):
        if len(node.value) > LONGEST_NUMBER:
            raise _refused(node, f"a number has {len(node.value)} digits; write at most {LONGEST_NUMBER}")
        if "_" in node.value:
            raise _refused(node, f"{node.value} has underscores; write {node.value.replace('_', '')}")
    if isinstance(node, SequenceNode):
        for inner in node.value:
            _check(inner)
    if isinstance(node, MappingNode):
        lines: dict[str, int] = {}
        for key, inner in node.value:
            if not isinstance(key, ScalarNode):
                raise _refused(key, "a key is no word; write a name before the colon")
            _check(key)
            if key.value in lines:
                raise _refused(
                    key, f"{key.value} is given twice, first in line {lines[key.value]}; keep one of the two"
                )
            lines[key.value] = key.start_mark.line + 1
            _check(inner)


def _refused(node: Node, problem: str) -> MarkedYAMLError:
    return MarkedYAMLError(problem=problem, problem_mark=node.start_mark)


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


def inserted(text: str, dotted: str, lines: Sequence[str]) -> str:
    """`text` with a key that its section lacks, such as plant.disturbances, ahead of the section's first
    key; the entries of its value stand below it, as `replaced` has them. Raises ValueError for a section that
    is missing."""
    section, _, key = dotted.rpartition(".")
    _, value = _nodes(text, section)
    first = value.start_mark.index
    indent = " " * value.start_mark.column
    return replaced(f"{text[:first]}{key}: []\n{indent}{text[first:]}", dotted, lines)


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
