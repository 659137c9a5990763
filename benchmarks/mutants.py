"""Mutants: small wrong changes of one module at a time, and whether the nearest test file notices.

`./run python -m benchmarks.mutants kernel tracking` draws 60 changes of each module by a seed and runs its
test file against each, the quick tests first, up to the first failure; without names all of `MODULES`.
`--count 20` draws fewer, `--slowest 2` leaves out tests that take more seconds of CPU, and `--again` then
plays what survived with all tests. Results go into benchmarks/results/mutants.json, by module; a module that
is not there was not played.

A mutant is the module's text with one node changed: a comparison, an operator, a number, a condition, a
statement left out. It stands in a folder of its own and is found before the module; the tests run in a fork
of a process that has imported the libraries, none of the project. A test that starts Python anew meets the
module as it is. A mutant is killed when a test fails or an import does, or when the tests take more than four
times their CPU time. What survives is listed with its line; `JUDGED` says which of these change nothing that
can be seen, and why.
"""

import argparse
import ast
import copy
import importlib
import importlib.abc
import importlib.util
import json
import os
import random
import resource
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from pipeline.store import artifacts

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks/results/mutants.json"
# the module, and the test file nearest to it
MODULES = {
    "kernel": ("pipeline.temperature.kernel", "tests/temperature/test_kernel.py"),
    "tracking": ("pipeline.temperature.tracking", "tests/temperature/test_tracking.py"),
    "controller": ("pipeline.temperature.controller", "tests/temperature/test_controller.py"),
    "ilc": ("pipeline.deposition.ilc", "tests/deposition/test_ilc.py"),
    "composition": ("pipeline.deposition.composition", "tests/deposition/test_composition.py"),
    "gcode": ("pipeline.deposition.gcode", "tests/deposition/test_gcode.py"),
    "bayes": ("pipeline.setpoint.bayes", "tests/setpoint/test_baselines.py"),
    "judge": ("pipeline.nightly.judge", "tests/nightly/test_nightly_judge.py"),
    "supervisor": ("pipeline.runtime.supervisor", "tests/runtime/test_supervisor.py"),
}
# imported once, before the forks; nothing of the project, which each fork imports with its mutant
LIBRARIES = (
    "numpy", "scipy.linalg", "scipy.signal", "scipy.optimize", "scipy.stats", "pyarrow.parquet", "pydantic",
    "yaml", "cv2", "hypothesis", "control", "safetensors.numpy", "mcap.writer", "joblib", "jinja2",
)  # fmt: skip
BAR = 0.9
SEED = 23
SPARE_S = 5.0  # CPU seconds over four times the tests' own: importing takes a few
EXACTLY = "differs only where two computed numbers are equal to the last bit"
RESOLUTION = "the search halves its step until it is below 1e-3 percent, from wherever it starts"
CLAMPED = "_steady clamps the slack at the same share of the limits, so that wider asks for nothing more"
DROPPED = "what lies behind the last sample is cut off again"
RESTS = "a part begins with two seconds of rest: no task reaches its first sample"
SET_FIRST = "it is read only of causes that are there, and they set it"
# {(module, "line: before -> after"): why nothing can see it}
JUDGED = {
    ("kernel", "260: sv > tolerance * size.max() -> sv >= tolerance * size.max()"): EXACTLY,
    ("tracking", "321: step > 0.001 -> step >= 0.001"): EXACTLY,
    ("tracking", "319: (high - low).min() / 4 -> (high - low).min() * 4"): RESOLUTION,
    ("tracking", "319: 4 -> 5"): RESOLUTION,
    ("tracking", "324: slack + step -> slack - step"): CLAMPED,
    ("tracking", "363: x <= high -> x < high"): EXACTLY,
    ("tracking", "367: at < 0 -> at <= 0"): "what is free is solved for before it is read",
    ("controller", "93: np.abs(target.miss).max() > tolerance -> "
     "np.abs(target.miss).max() >= tolerance"): EXACTLY,
    ("controller", "98: abs(u - limit) < 1e-06 * (limits.high[i] - limits.low[i]) -> "
     "abs(u - limit) <= 1e-06 * (limits.high[i] - limits.low[i])"): EXACTLY,
    ("controller", "158: 1e-09 -> 2e-09"): "only keeps a balance that leaks nothing from being singular",
    ("supervisor", "527: 1 -> 2"): SET_FIRST,
    ("supervisor", "287: 1.0 -> 2.0"): SET_FIRST,
    ("supervisor", "308: 0 -> 1"): "before a heater is found wrong nothing is lacking: u (1 - 0)",
    ("supervisor", "691: 0 -> 1"): "what the first target fills is not read before it",
    ("gcode", "259: np.count_nonzero(begins) > np.count_nonzero(leads) -> np.count_nonzero(begins) >= "
     "np.count_nonzero(leads)"): "every lead begins: where there are as many, none is left to be taken back",
    ("gcode", "569: np.abs(e) > TINY -> np.abs(e) >= TINY"): EXACTLY,
    ("gcode", "182: 0 -> 1"): "a row of nothing, which is no move and is left out",
    ("gcode", "323: key >= M -> key > M"): "M0 is none of the words that go on in their line",
    ("gcode", "323: key < T -> key <= T"): "T0 is no M word that goes on in its line",
    ("composition", "295: lines.begin_s >= (begin - 1) * Ts -> lines.begin_s > (begin - 1) * Ts"): RESTS,
    ("composition", "292: 1 -> 2"): RESTS,
    ("composition", "295: 1 -> 2"): "an excerpt begins with rest, and what begins behind its end is cut off",
    ("composition", "210: 0.0 -> 1.0"): DROPPED,
    ("composition", "183: 1 -> 2"): DROPPED,
    ("composition", "357: True -> False"): "columns are computed that nobody reads",
    ("composition", "227: at >= 0 -> at > 0"): RESTS,
    ("composition", "227: 0 -> 1"): RESTS,
    ("composition", "213: at < 0 -> at <= 0"): RESTS,
    ("composition", "213: 0 -> 1"): RESTS,
}  # fmt: skip

COMPARED = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.In: ast.NotIn, ast.NotIn: ast.In, ast.Is: ast.IsNot, ast.IsNot: ast.Is,
}  # fmt: skip
COMPUTED = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult,
    ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
}  # fmt: skip
SWAPPED = {"min": "max", "max": "min", "any": "all", "all": "any", "minimum": "maximum", "maximum": "minimum"}


class Mutant(NamedTuple):
    """The line that is changed, how (before -> after), and the whole text with the change."""

    line: int
    change: str
    text: str


class Played(NamedTuple):
    """How the tests ended ("killed", "hangs", "survives"), and their seconds of CPU."""

    outcome: str
    cpu_s: float


# ---- changes


def changed(node: ast.AST) -> ast.AST | None:
    """A wrong form of one node, or None where no change is defined."""
    new: Any = copy.deepcopy(node)
    match new:
        case ast.Compare() if type(new.ops[0]) in COMPARED:
            new.ops[0] = COMPARED[type(new.ops[0])]()
        case ast.BinOp() | ast.AugAssign() if type(new.op) in COMPUTED:
            new.op = COMPUTED[type(new.op)]()
        case ast.BoolOp():
            new.op = ast.Or() if isinstance(new.op, ast.And) else ast.And()
        case ast.UnaryOp(op=ast.Not() | ast.USub() | ast.Invert()):
            return new.operand
        case ast.Constant(value=bool()):
            new.value = not new.value
        case ast.Constant(value=int() | float()):
            new.value = new.value + 1 if isinstance(new.value, int) else (2 * new.value or 1.0)
        case ast.If() | ast.IfExp() | ast.While():
            new.test = ast.UnaryOp(ast.Not(), new.test)
        case ast.Call(func=ast.Name(id=name)) if name in SWAPPED:
            new.func.id = SWAPPED[name]
        case ast.Call(func=ast.Attribute(attr=name)) if name in SWAPPED:
            new.func.attr = SWAPPED[name]
        case ast.Attribute(attr="T"):
            return new.value
        case ast.Raise() | ast.Expr(value=ast.Call()):
            return ast.Pass()
        case _:
            return None
    return new


def nodes(tree: ast.AST) -> Iterator[tuple[ast.AST, str, int | None]]:
    """(parent, field, place in a list) of every node that runs: no annotations, no slices of types, and no
    pieces of f-strings, whose words are messages."""
    for parent in ast.walk(tree):
        if isinstance(parent, ast.JoinedStr | ast.FormattedValue):
            continue
        for field, value in ast.iter_fields(parent):
            if field in ("annotation", "returns", "decorator_list"):
                continue
            if isinstance(value, list):
                yield from ((parent, field, k) for k, inner in enumerate(value) if isinstance(inner, ast.AST))
            elif isinstance(value, ast.AST):
                yield parent, field, None


def _hidden(tree: ast.AST) -> set[int]:
    """The nodes inside annotations, decorators and f-strings."""
    hidden = set()
    for node in ast.walk(tree):
        inside = [getattr(node, name, None) for name in ("annotation", "returns")]
        inside += getattr(node, "decorator_list", [])
        if isinstance(node, ast.JoinedStr):
            inside.append(node)
        for inner in inside:
            if inner is not None:
                hidden |= {id(below) for below in ast.walk(inner)}
    return hidden


def mutants(text: str, count: int, seed: str) -> list[Mutant]:
    """`count` mutants of a module's text, drawn by the seed from all that can be made; each parses and is
    another program."""
    tree = ast.parse(text)
    hidden = _hidden(tree)
    places = [place for place in nodes(tree) if id(place[0]) not in hidden]
    possible = []
    for parent, field, k in places:
        value = getattr(parent, field)
        node = value if k is None else value[k]
        if id(node) not in hidden and (new := changed(node)) is not None:
            possible.append((parent, field, k, node, new))
    drawn = random.Random(seed).sample(range(len(possible)), min(count, len(possible)))
    return [_mutant(tree, *possible[k]) for k in sorted(drawn)]


def _mutant(tree: ast.AST, parent: Any, field: str, k: int | None, node: Any, new: Any) -> Mutant:
    def put(value: ast.AST) -> None:
        if k is None:
            setattr(parent, field, value)
        else:
            getattr(parent, field)[k] = value

    new = ast.copy_location(new, node)
    put(new)
    text = ast.unparse(ast.fix_missing_locations(copy.deepcopy(tree)))
    put(node)
    return Mutant(node.lineno, f"{_short(node)} -> {_short(new)}", text)


def _short(node: ast.AST) -> str:
    """The node's first line, for a condition its test."""
    if isinstance(node, ast.If | ast.While):
        return f"{'if' if isinstance(node, ast.If) else 'while'} {ast.unparse(node.test)}"
    return ast.unparse(node).splitlines()[0][:90]


# ---- tests against one mutant


class _Found(importlib.abc.MetaPathFinder):
    """The mutant's file in place of the module's."""

    def __init__(self, name: str, path: Path):
        self.name, self.path = name, path

    def find_spec(self, fullname, path=None, target=None):
        if fullname == self.name:
            return importlib.util.spec_from_file_location(fullname, self.path)
        return None


class _QuickFirst:
    """Tests in the order of their durations; those over the limit not at all. Notes durations."""

    def __init__(self, known: dict[str, float], slowest_s: float):
        self.known, self.slowest_s, self.seen = known, slowest_s, {}

    def pytest_collection_modifyitems(self, items):
        items[:] = [item for item in items if self.known.get(item.nodeid, 0.0) <= self.slowest_s]
        items.sort(key=lambda item: self.known.get(item.nodeid, 0.0))

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_call(self, item):
        began = time.process_time()
        yield
        self.seen[item.nodeid] = time.process_time() - began


def _tests(file: str, order: _QuickFirst) -> int:
    return pytest.main(
        ["-n", "0", "-x", "-q", "-p", "no:cacheprovider", "--no-header", file], plugins=[order]
    )


def in_fork(name: str, path: Path, file: str, order: _QuickFirst, limit_s: float) -> tuple[int, float, str]:
    """Exit status (or minus the signal), CPU seconds, and the durations as JSON, of the tests in a fork."""
    with tempfile.NamedTemporaryFile("r") as noted:
        child = os.fork()
        if child == 0:
            status = 70
            try:
                sink = os.open(os.devnull, os.O_WRONLY)
                os.dup2(sink, 1)
                os.dup2(sink, 2)
                hard = int(limit_s) + 2
                resource.setrlimit(resource.RLIMIT_CPU, (int(limit_s) + 1, hard))
                for loaded in [name for name in sys.modules if name.split(".")[0] in ("pipeline", "tests")]:
                    del sys.modules[loaded]
                sys.meta_path.insert(0, _Found(name, path))
                status = int(_tests(file, order))
                Path(noted.name).write_text(json.dumps(order.seen))
            finally:
                os._exit(status)
        _, ended, used = os.wait4(child, 0)
        code = os.waitstatus_to_exitcode(ended)
        return code, used.ru_utime + used.ru_stime, noted.read()


def play(name: str, count: int, slowest_s: float, before: dict[str, Any] | None = None) -> dict[str, Any]:
    """The table of one module: killed, hanging and surviving mutants, and the tests left out. Where a
    table `before` is given, those that it says survived are played; the others are taken over as killed."""
    module, file = MODULES[name]
    source = ROOT / (module.replace(".", "/") + ".py")
    text = source.read_text()
    alive = {row["mutant"] for row in before["survivors"]} if before else None
    drawn = mutants(text, before["mutants"] if before else count, f"{SEED} {name}")
    if alive and (other := alive - {f"{mutant.line}: {mutant.change}" for mutant in drawn}):
        raise SystemExit(
            f"{name}: the module has changed since, {min(other)} is none of its mutants; play it without "
            "--again"
        )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / source.name
        path.write_text(ast.unparse(ast.parse(text)))
        status, whole_s, noted = in_fork(module, path, file, _QuickFirst({}, 1e9), 1000.0)
        if status != 0:
            raise SystemExit(f"{file}: fails on {module} as it is (status {status}); mend it first")
        known = json.loads(noted)
        order = _QuickFirst(known, slowest_s)
        rows = []
        for mutant in drawn:
            if alive is not None and f"{mutant.line}: {mutant.change}" not in alive:
                rows.append((mutant, Played("killed", 0.0)))
                continue
            path.write_text(mutant.text)
            code, cpu_s, _ = in_fork(module, path, file, order, 4 * whole_s + SPARE_S)
            outcome = "survives" if code == 0 else "killed" if code > 0 else "hangs"
            rows.append((mutant, Played(outcome, cpu_s)))
            print(f"{name} {len(rows)}: {outcome} {mutant.line}: {mutant.change}", flush=True)
    left_out = sorted(test for test, took in known.items() if took > slowest_s)
    return table(name, file, rows, left_out)


def table(name: str, file: str, rows: list[tuple[Mutant, Played]], left_out: list[str]) -> dict[str, Any]:
    """Counts, share of the non-equivalent that was killed, and every survivor with why."""
    alive = [
        (mutant, f"{mutant.line}: {mutant.change}") for mutant, played in rows if played.outcome == "survives"
    ]
    why = [{"mutant": what, "equivalent": JUDGED.get((name, what))} for _, what in alive]
    equal = sum(row["equivalent"] is not None for row in why)
    killed = len(rows) - len(alive)
    return {
        "tests": file,
        "mutants": len(rows),
        "killed": killed,
        "of_these_hang": sum(played.outcome == "hangs" for _, played in rows),
        "equivalent": equal,
        "share_killed": round(killed / max(len(rows) - equal, 1), 3),
        "bar": BAR,
        "survivors": why,
        "tests_left_out": left_out,
        "cpu_s": round(sum(played.cpu_s for _, played in rows), 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("modules", nargs="*", choices=[*MODULES, []], help="all of them where none is named")
    parser.add_argument("--count", type=int, default=60, help="mutants a module")
    parser.add_argument(
        "--slowest", type=float, default=1e9, help="CPU seconds of the slowest test that runs"
    )
    parser.add_argument("--again", action="store_true", help="only what survived before")
    asked = parser.parse_args()
    os.chdir(ROOT)
    for library in LIBRARIES:
        importlib.import_module(library)
    for name in asked.modules or MODULES:
        known = artifacts.read_json(RESULTS) if RESULTS.exists() else {}
        if asked.again and name not in known:
            parser.error(f"{name} is not in {RESULTS.name}; play it without --again first")
        result = play(name, asked.count, asked.slowest, known[name] if asked.again else None)
        print(f"{name}: {result['killed']} of {result['mutants']} killed, share {result['share_killed']}")
        known = artifacts.read_json(RESULTS) if RESULTS.exists() else {}
        artifacts.write_json(RESULTS, dict(sorted((known | {name: result}).items())))


if __name__ == "__main__":
    main()
