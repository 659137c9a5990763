"""No two modules of pipeline/ need one another, however far round: imports inside functions and those for
types alone count too, as a reader follows them all."""

import ast
from collections.abc import Iterator, Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def imported(path: Path, modules: set[str]) -> Iterator[str]:
    """Modules of `modules` that a file imports, anywhere in it."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            wholes = [f"{node.module}.{alias.name}" for alias in node.names]
            # from pipeline.store import params, Section: each name is a module, or stands in one
            names = [whole if whole in modules else str(node.module) for whole in wholes]
        else:
            continue
        yield from (name for name in names if name in modules)


def import_graph(root: Path, package: str = "pipeline") -> dict[str, set[str]]:
    """What each module of a package imports of the same package."""
    files = {}
    for path in sorted((root / package).rglob("*.py")):
        parts = path.relative_to(root).with_suffix("").parts
        files[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return {name: set(imported(path, set(files))) for name, path in files.items()}


def circles(graph: Mapping[str, set[str]]) -> list[list[str]]:
    """Strongly connected components of more than one module, and modules that import themselves (Tarjan
    1972)."""
    number: dict[str, int] = {}
    lowest: dict[str, int] = {}
    path: list[str] = []
    components = []

    def visit(name: str) -> None:
        number[name] = lowest[name] = len(number)
        path.append(name)
        for other in sorted(graph[name]):
            if other not in number:
                visit(other)
            if other in path:
                lowest[name] = min(lowest[name], lowest[other])
        if lowest[name] == number[name]:
            component = path[path.index(name) :]
            del path[path.index(name) :]
            if len(component) > 1 or name in graph[name]:
                components.append(sorted(component))

    for name in sorted(graph):
        if name not in number:
            visit(name)
    return sorted(components)


def test_no_modules_of_the_pipeline_import_one_another_in_a_circle():
    assert circles(import_graph(ROOT)) == []


def test_a_circle_is_found_through_functions_and_types(tmp_path):
    for name, text in {
        "a": "def read():\n    from pipeline import b\n",
        "b": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from pipeline.c import Rule\n",
        "c": "import pipeline.a\n",
        "d": "from pipeline import a, c\n",
    }.items():
        (tmp_path / "pipeline").mkdir(exist_ok=True)
        (tmp_path / "pipeline" / f"{name}.py").write_text(text)
    assert circles(import_graph(tmp_path)) == [["pipeline.a", "pipeline.b", "pipeline.c"]]
