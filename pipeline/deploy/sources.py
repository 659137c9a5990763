"""Parts of the project's own source as one file: what runs on a machine is what was judged, to the letter.

From some entry points, every definition that they use is gathered, across modules, in the order in which the
modules define them. Where two modules use one name, the later one is prefixed by its module's. Nothing is
written twice by hand, so that nothing can drift apart.
"""

import ast
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
Place = tuple[str, str]  # module and name
# what an exported file imports, and how
LIBRARIES: dict[Place, str] = {
    ("math", ""): "import math",
    ("collections.abc", "Mapping"): "from collections.abc import Mapping, Sequence",
    ("collections.abc", "Sequence"): "from collections.abc import Mapping, Sequence",
    ("typing", "NamedTuple"): "from typing import NamedTuple",
    ("numpy", ""): "import numpy as np",
}


class Module(NamedTuple):
    """`definitions` by name, and where each imported name comes from: (module, name), or (module, "") for a
    module as a whole."""

    lines: list[str]
    definitions: dict[str, ast.stmt]
    imported: dict[str, Place]


def _file(module: str) -> Path:
    return ROOT / (module.replace(".", "/") + ".py")


@functools.cache
def parsed(module: str) -> Module:
    text = _file(module).read_text(encoding="utf-8")
    definitions, imported = {}, {}
    for node in ast.parse(text).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            definitions[node.name] = node
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            definitions |= {one.id: node for t in targets for one in ast.walk(t) if isinstance(one, ast.Name)}
        elif isinstance(node, ast.Import):
            imported |= {alias.asname or alias.name: (alias.name, "") for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                is_module = node.module.startswith("pipeline") and _file(whole).exists()
                imported[alias.asname or alias.name] = (whole, "") if is_module else (node.module, alias.name)
    return Module(text.splitlines(), definitions, imported)


def _imports(node: ast.stmt) -> bool:
    """Whether a method imports a library by itself: it is of no use beside a machine, and stays behind."""
    return isinstance(node, ast.FunctionDef) and any(
        isinstance(one, ast.Import | ast.ImportFrom) for one in ast.walk(node)
    )


class _Uses(ast.NodeVisitor):
    """Names and module.name pairs that a definition uses, each with its node; annotations do not count."""

    def __init__(self, module: str, replaced: Mapping[Place, Place]):
        self.module, self.source, self.replaced = module, parsed(module), replaced
        self.found: list[tuple[ast.expr, Place]] = []
        self.local: set[str] = set()

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        if _imports(node):
            return
        outer = self.local
        stored = (one for one in ast.walk(node) if isinstance(one, ast.Name | ast.arg))
        self.local = outer | {
            one.arg if isinstance(one, ast.arg) else one.id
            for one in stored
            if isinstance(one, ast.arg) or isinstance(one.ctx, ast.Store)
        }
        for part in (*node.decorator_list, *node.args.defaults, *node.args.kw_defaults, *node.body):
            if part is not None:
                self.visit(part)
        self.local = outer

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.visit(node.value)

    def visit_Attribute(self, node: ast.Attribute) -> None:
        name = node.value.id if isinstance(node.value, ast.Name) else ""
        at = self.source.imported.get(name) if name not in self.local else None
        if at and at[0].startswith("pipeline") and not at[1]:
            self._add(node, (at[0], node.attr))
        else:
            self.generic_visit(node)

    def visit_Name(self, node: ast.Name) -> None:
        if node.id in self.local:
            return
        if node.id in self.source.definitions:
            self._add(node, (self.module, node.id))
        elif node.id in self.source.imported:
            self._add(node, self.source.imported[node.id])

    def _add(self, node: ast.expr, place: Place) -> None:
        self.found.append((node, self.replaced.get(place, place)))


def gathered(entries: list[Place], replaced: Mapping[Place, Place], order: list[str]) -> str:
    """The source of all that `entries` use, modules in `order`; `replaced` leads from what needs more than
    numpy to what stands in its place. Raises ValueError where something of another library is left."""
    uses: dict[Place, list[tuple[ast.expr, Place]]] = {}
    libraries: set[Place] = set()
    todo = list(entries)
    while todo:
        place = todo.pop()
        if place in uses:
            continue
        module, name = place
        if not module.startswith("pipeline"):
            libraries.add(place)
            continue
        visitor = _Uses(module, replaced)
        visitor.visit(parsed(module).definitions[name])
        uses[place] = visitor.found
        todo += [used for _, used in visitor.found]
    if strangers := sorted(f"{m}.{n}".rstrip(".") for m, n in libraries - LIBRARIES.keys()):
        raise ValueError(
            f"an exported file has numpy only but its code uses {', '.join(strangers)}; replace what needs it"
        )
    names = _names(uses, order)
    parts = [_text(place, uses[place], names) for place in _in_order(list(uses), order)]
    return "\n\n\n".join(dict.fromkeys(parts))


def _in_order(places: list[Place], order: list[str]) -> list[Place]:
    return sorted(places, key=lambda at: (order.index(at[0]), parsed(at[0]).definitions[at[1]].lineno))


def _names(uses: Mapping[Place, object], order: list[str]) -> dict[Place, str]:
    """The name of each definition in the one file."""
    names: dict[Place, str] = {}
    for module, name in _in_order(list(uses), order):
        taken = name in names.values()
        names[module, name] = f"{module.rsplit('.', 1)[1]}_{name}" if taken else name
    return names


def _text(place: Place, uses: list[tuple[ast.expr, Place]], names: Mapping[Place, str]) -> str:
    """One definition with the comment above it, its uses under their names in the one file."""
    module, name = place
    source, node = parsed(module), parsed(module).definitions[place[1]]
    decorators = getattr(node, "decorator_list", [])
    first = min([node.lineno, *(one.lineno for one in decorators)])
    edits = [
        (one.lineno, one.col_offset, one.end_col_offset or 0, names[at]) for one, at in uses if at in names
    ]
    if names[place] != name and isinstance(node, ast.FunctionDef | ast.ClassDef):
        start = len("def ") if isinstance(node, ast.FunctionDef) else len("class ")
        edits.append((node.lineno, start, start + len(name), names[place]))
    lines = {number: source.lines[number - 1] for number in range(first, (node.end_lineno or first) + 1)}
    for line, start, end, text in sorted(edits, reverse=True):
        raw = lines[line].encode()
        lines[line] = (raw[:start] + text.encode() + raw[end:]).decode()
    for method in getattr(node, "body", []):
        if _imports(method):
            start = min([method.lineno, *(one.lineno for one in method.decorator_list)])
            for number in range(start - 1, method.end_lineno + 1):
                lines.pop(number, None)
    while source.lines[first - 2].startswith("#") and not source.lines[first - 2].startswith("# ----"):
        first -= 1
        lines[first] = source.lines[first - 1]
    return "\n".join(lines[number] for number in sorted(lines))
