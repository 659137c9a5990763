"""The rules of the house on the syntax tree: imports, open files, and the dvc.yaml that the stages ask
for."""

import ast
import functools
import graphlib
import re
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import yaml

from pipeline.store import params

LOOPS = ("temperature", "deposition", "setpoint")
NUMERICS = {"numpy", "scipy", "control", "sklearn", "cv2", "jax", "equinox", "optax", "jaxtyping"}
LANGUAGE = {
    "__future__",
    "abc",
    "bisect",
    "collections",
    "dataclasses",
    "enum",
    "fractions",
    "functools",
    "heapq",
    "itertools",
    "math",
    "numbers",
}
LANGUAGE |= {"operator", "re", "string", "types", "typing", "warnings"}
FORMATS = {"csv", "h5py", "json", "mcap", "orjson", "pandas", "pickle", "pyarrow", "yaml"}
READS = {
    "read_text",
    "read_bytes",
    "load",
    "loadtxt",
    "genfromtxt",
    "fromfile",
    "memmap",
    "read_csv",
    "read_parquet",
    "read_table",
    "open",
}
WRITES = {
    "write_text",
    "write_bytes",
    "write_table",
    "save",
    "savez",
    "savez_compressed",
    "savetxt",
    "tofile",
    "to_csv",
    "to_parquet",
    "dump",
}
EDGE_CALLS = {"artifacts", "params", "recordings"}
# what takes a second to import, or needs a device
HEAVY = {"jax", "equinox", "optax", "cv2", "sklearn", "control", "pandas", "pyarrow", "mcap", "joblib"}
# all that may lie directly in pipeline/
ROOMS = {*LOOPS, "store", "reading", "runtime", "report", "nightly", "papers"}
LOOSE = {"__init__", "around_dvc", "statistics", "cli", "quick"}
# around_dvc imports the standard library alone: artifacts takes longer than it may;
# params_text dumps to a text
WRITERS = {"pipeline/store/artifacts.py", "pipeline/around_dvc.py", "pipeline/store/params_text.py"}
# MT19937: R's generator, with which the script of a paper draws
GENERATORS = {"Generator", "default_rng", "SeedSequence", "BitGenerator", "PCG64", "MT19937"}


# ---- the syntax tree


class File(NamedTuple):
    name: str
    tree: ast.Module

    @property
    def room(self) -> str:
        """stages, store, reading, report, nightly, runtime, statistics, cli; of a loop temperature its
        methods, temperature/workflow, and tables, settings and contestants apart; runtime likewise."""
        parts = self.name.removesuffix(".py").split("/")
        if parts[0] != "pipeline" or len(parts) < 2:
            return parts[0]
        if parts[1] in (*LOOPS, "runtime") and parts[2:3] == ["workflow"]:
            return (
                f"{parts[1]}/{parts[3]}"
                if parts[3:] in (["tables"], ["settings"], ["contestants"])
                else f"{parts[1]}/workflow"
            )
        return "nightly/settings" if parts[1:] == ["nightly", "settings"] else parts[1]


def parsed(path: Path) -> ast.Module:
    return _parsed(path.read_text(encoding="utf-8"))


# every stage imports the same edge; nothing changes a tree
_parsed = functools.cache(ast.parse)


def files(root: Path, *folders: str) -> Iterator[File]:
    for folder in folders:
        for path in sorted((root / folder).rglob("*.py")):
            yield File(path.relative_to(root).as_posix(), parsed(path))


@functools.cache
def imports(tree: ast.AST) -> list[tuple[int, str]]:
    """(line, dotted name) of each import; `from a import b` is a.b. A relative import begins with a dot."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            found += [
                (node.lineno, "." * node.level + f"{node.module or ''}.{alias.name}".strip("."))
                for alias in node.names
            ]
    return found


def project_file(root: Path, name: str) -> str | None:
    """The file of the project that holds the dotted name, None for a library."""
    parts = name.split(".")
    for end in range(len(parts), 0, -1):
        for candidate in ("/".join(parts[:end]) + ".py", "/".join([*parts[:end], "__init__.py"])):
            if (root / candidate).exists():
                return candidate
    return None


@functools.cache
def calls(tree: ast.AST) -> list[tuple[ast.Call, str, str]]:
    """(call, receiver, function) of each call: artifacts.write_text(...) is ("artifacts", "write_text"),
    open(...) ("", "open")."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            *receiver, function = ast.unparse(node.func).rsplit(".", 1)
            found.append((node, "".join(receiver), function))
    return found


# ---- who may know whom


def may_know(room: str, target: str) -> bool:
    """The five rules: whether a file of `room` may import a file of `target`."""
    loop = room.split("/")[0]
    if room == "statistics":
        return False
    if room in LOOPS:  # 1: methods know numerics, their own loop's methods and statistics
        return target in (room, "statistics")
    if loop in LOOPS:  # 2: a workflow knows its own loop and what every stage stands on
        light = room.endswith(("/tables", "/settings"))
        own = (loop, f"{loop}/tables", f"{loop}/settings", f"{loop}/contestants")
        return target in ("store", "reading", "statistics", *own) or (
            target == f"{loop}/workflow" and not light
        )
    if room == "report":  # 3: pages know what a table, a setting and a contestant is, and do not compute
        described = target.endswith(("/tables", "/settings", "/contestants"))
        return target in ("store", "statistics", "report") or described
    if room == "runtime":  # 4: beside a machine run the methods
        return target in (*LOOPS, "store", "statistics", "runtime")
    if room == "runtime/settings":
        return target in ("store", "runtime/settings")
    if room == "runtime/workflow":  # what is exported and replayed is read as the loops' stages left it
        return target.split("/")[0] in (*LOOPS, "store", "reading", "statistics", "runtime")
    if room == "papers":  # the second pipeline plays the methods, and the root's stages on fresh records
        return target.split("/")[0] in (*LOOPS, "store", "statistics", "papers", "stages")
    if room in ("store", "reading"):  # 5: below the loops
        return target in ("store", "reading", "statistics")
    return True  # nightly, cli and stages


def forbidden_imports(root: Path) -> list[str]:
    sentences = []
    for file in files(root, "pipeline", "stages"):
        numerics = file.room in LOOPS or file.room == "statistics"
        for line, name in imports(file.tree):
            target = project_file(root, name)
            room = File(target, file.tree).room if target and target != "pipeline/__init__.py" else ""
            reason = ""
            if name.startswith("."):
                reason = "write the whole name"
            elif (room == "stages" and file.room != "papers") or name.split(".")[0] == "tests":
                reason = "nothing imports a stage or a test"
            elif room and not may_know(file.room, room):
                reason = f"{file.room} must not know {room}"
            elif numerics and not target and name.split(".")[0] not in NUMERICS | LANGUAGE:
                reason = f"{file.room} knows arrays, nothing of files, clocks, processes or figures"
            elif file.room.endswith("/settings") and name.split(".")[0] in HEAVY:
                reason = "a settings class imports nothing heavy"
            elif file.room == "stages" and name.split(".")[0] in FORMATS:
                reason = "only artifacts opens artifacts"
            if reason:
                sentences.append(f"{file.name}:{line} imports {name}: {reason}")
    return sentences


def misplaced(root: Path) -> list[str]:
    """Files and folders of pipeline/ that are no room of the house."""
    return [
        f"pipeline/{path.name}: which room is it of?"
        for path in sorted((root / "pipeline").iterdir())
        if path.name != "__pycache__" and path.stem not in (ROOMS if path.is_dir() else LOOSE)
    ]


def forbidden_files(root: Path) -> list[str]:
    """Files that loops and stages open by themselves, and files that the edge writes without artifacts."""
    sentences = []
    for file in files(root, "pipeline", "stages"):
        forbidden = WRITES | READS if file.room in (*LOOPS, "statistics", "stages") else WRITES
        for call, receiver, function in calls(file.tree):
            modes = call.args[:1] if receiver else call.args[1:2]
            modes += [keyword.value for keyword in call.keywords if keyword.arg == "mode"]
            opened_to_write = function == "open" and any(
                isinstance(mode, ast.Constant) and set(str(mode.value)) & set("wax+") for mode in modes
            )
            if (
                file.name not in WRITERS
                and receiver not in EDGE_CALLS
                and (function in forbidden or opened_to_write)
            ):
                sentences.append(
                    f"{file.name}:{call.lineno} {ast.unparse(call.func)}: only artifacts opens artifacts"
                )
    return sentences


def forbidden_randomness(root: Path) -> list[str]:
    sentences = []
    for file in files(root, "pipeline", "stages"):
        for call, receiver, function in calls(file.tree):
            if receiver in ("np.random", "numpy.random") and (
                function not in GENERATORS or (function == "default_rng" and not call.args)
            ):
                sentences.append(
                    f"{file.name}:{call.lineno} {ast.unparse(call)}: "
                    "the stage makes a seeded generator and hands it on"
                )
    return sentences


def unframed(root: Path) -> list[str]:
    """Reads of a stage outside `with artifacts.stage(...)`. Bad input there ends in a traceback, not in one
    sentence."""
    sentences = []
    for file in files(root, "stages"):
        mains = [node for node in file.tree.body if isinstance(node, ast.FunctionDef) and node.name == "main"]
        for statement in [statement for main in mains for statement in main.body]:
            framed = isinstance(statement, ast.With) and ast.unparse(statement.items[0]).startswith(
                "artifacts.stage("
            )
            for call, receiver, _ in calls(statement):
                if not framed and receiver in EDGE_CALLS:
                    sentences.append(
                        f"{file.name}:{call.lineno} {ast.unparse(call)}: "
                        "move it into `with artifacts.stage(...)`"
                    )
    return sentences


# ---- dvc.yaml


def modules(root: Path, name: str) -> set[str]:
    """The file itself and every file of the project that it imports, directly or not, without empty
    __init__.py."""
    reached, todo = set(), [name]
    while todo:
        here = todo.pop()
        if here not in reached and (root / here).stat().st_size:
            reached.add(here)
            todo += [
                target for _, module in imports(parsed(root / here)) if (target := project_file(root, module))
            ]
    return reached


def data_files(root: Path, modules: set[str]) -> set[str]:
    """Templates and the like beside the modules: a file, or a folder without modules."""
    data = set()
    for folder in {(root / name).parent for name in modules}:
        for path in folder.iterdir():
            inside = [
                file
                for file in (path, *path.rglob("*"))
                if file.is_file() and "__pycache__" not in file.parts
            ]
            if inside and not path.name.startswith(".") and all(file.suffix != ".py" for file in inside):
                data.add(path.relative_to(root).as_posix())
    return data


def literal(file: str, call: ast.Call, position: int) -> str:
    argument = call.args[position] if len(call.args) > position else None
    assert isinstance(argument, ast.Constant), (
        f"{file}:{call.lineno} {ast.unparse(call)}: write the name out, so that one can grep for it"
    )
    return argument.value


def loads(name: str, tree: ast.AST) -> Iterator[tuple[str, str]]:
    """(model, key): the sections that params.load reads, and with model "" the keys that params.value
    reads."""
    for call, receiver, function in calls(tree):
        if receiver == "params" and function == "load":
            yield ast.unparse(call.args[0]), literal(name, call, 1)
        elif receiver == "params" and function == "value":
            yield "", literal(name, call, 0)


def paths(stage: str, name: str, tree: ast.Module) -> tuple[set[str], set[str]]:
    """Literal paths in datasets/ and reports/ that are read; those that are written."""
    written, read = set(), set()
    targets = {
        id(call.args[0]) for call, _, function in calls(tree) if function.startswith("write_") and call.args
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr) and re.match(r"f['\"](datasets|reports)/", ast.unparse(node)):
            raise AssertionError(
                f"{name}:{node.lineno} {ast.unparse(node)}: write the path out, so that one can grep for it"
            )
        if isinstance(node, ast.Constant) and re.fullmatch(r"(datasets|reports)/[\w./-]+", str(node.value)):
            (written if id(node) in targets else read).add(node.value.rstrip("/"))
    read |= {
        f"reports/metrics/{literal(name, call, 0)}.json"
        for call, _, function in calls(tree)
        if function == "read_metrics"
    }
    # a memo is no artifact: whatever is in it, the results are the same
    return {path for path in read if not path.startswith(("datasets/memo", f"datasets/{stage}/"))}, written


@functools.cache
def _sections(owner: Path, *contents: bytes) -> dict[str, Any]:
    """The sections by file of params.yaml and params.expert.yaml, which hold `contents`."""
    return params.files(owner)


def tracked(root: Path, keys: set[str]) -> list[Any]:
    """Keys as DVC lists them, each under the files in which it stands: those of params.yaml bare, those of
    params.expert.yaml below its name."""
    owner, expert = root / params.FILE, root / params.EXPERT
    contents = [path.read_bytes() for path in (owner, expert) if path.exists()]
    by_file = _sections(owner, *contents) if owner.exists() else {}
    present = {
        name: sorted(key for key in keys if key in _flattened(sections)) for name, sections in by_file.items()
    }
    methods = present.get(str(expert), [])
    # what stands nowhere is asked for where a person looks first
    return sorted({*present.get(str(owner), []), *(keys - {*methods})}) + (
        [{params.EXPERT: methods}] if methods else []
    )


def _flattened(sections: dict[str, Any]) -> set[str]:
    """Sections, and the keys of each as section.key."""
    return {
        *sections,
        *(f"{section}.{key}" for section, keys in sections.items() if isinstance(keys, dict) for key in keys),
    }


def expected(root: Path, stage: str) -> dict[str, Any]:
    """The entry of dvc.yaml: deps, params, outs and metrics are what stages/<stage>.py imports and opens,
    directly or through what it imports."""
    name = f"stages/{stage}.py"
    code = modules(root, name)
    read, written, keys = set(), set(), set()
    for module in code:
        # how work is spread over processes changes no byte of what comes out
        keys |= {key for _, key in loads(module, parsed(root / module)) if key != "execution"}
    tree = parsed(root / name)
    # paths stand in the stage's file, where one can grep for them; imported functions take them as arguments
    opened = paths(stage, name, tree)
    read, written = read | opened[0], written | opened[1]
    # a stage that hashes whole folders of code, or reads the parameters whole, depends on them whole
    read |= {
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and node.value in ("pipeline", "stages")
    }
    reads_all_parameters = any(
        (receiver, function) == ("params", "read") for _, receiver, function in calls(tree)
    )
    read |= {params.FILE, params.EXPERT} if reads_all_parameters else set()
    frames = [
        item
        for node in ast.walk(tree)
        if isinstance(node, ast.With)
        for item in node.items
        if ast.unparse(item).startswith("artifacts.stage(")
    ]
    writes_figures = any(function == "write_metrics" for *_, function in calls(tree))
    if writes_figures or any(frame.optional_vars for frame in frames):
        written.add(f"datasets/{stage}")
    for call, _, function in calls(tree):
        assert function not in ("stage", "write_metrics") or literal(name, call, 0) == stage, (
            f"{name}:{call.lineno} the stage's name is {stage}"
        )
    metrics = [f"reports/metrics/{stage}.json"] if writes_figures else []
    entry = {
        "cmd": f"python -m stages.{stage}",
        "deps": [
            dep
            for dep in (name, *sorted(code - {name}), *sorted(data_files(root, code)))
            if dep.split("/")[0] not in read
        ]
        + sorted(read),
        "params": tracked(root, keys),
        # DVC deletes outs before a stage unless they persist; the last good artifacts must outlive a failure
        "outs": [{path: {"persist": True}} for path in sorted(written)],
        "metrics": [{path: {"cache": False, "persist": True}} for path in metrics],
    }
    return {key: value for key, value in entry.items() if value}


# the second pipeline: results that no recording changes, and no stage of the root asks for
PAPERS = "datasets/papers/dvc.yaml"
METHODS = {*LOOPS, "statistics", "papers", "stages"}


def expected_of_paper(root: Path, stage: str) -> dict[str, Any]:
    """The entry of datasets/papers/dvc.yaml: deps and params are what pipeline/papers/<stage>.py imports and
    opens, files and no folder of code. It has no outs: DVC joins pipelines by their outs, and the root's
    `dvc repro` would start it."""
    name = f"pipeline/papers/{stage}.py"
    # how a file is read and a figure written is no method
    code = modules(root, name)
    methods = {path for path in code if File(path, parsed(root / path)).room.split("/")[0] in METHODS}
    keys = {key for module in code for _, key in loads(module, parsed(root / module)) if key != "execution"}
    own = {key for key in keys if key in params.PAPERS_SECTIONS}
    read, _ = paths(stage, name, parsed(root / name))
    read -= {f"datasets/papers/{stage}.json", params.PAPERS}
    entry = {
        "cmd": f"python -m pipeline.papers.{stage}",
        "wdir": "../..",
        "deps": [name, *sorted(methods - {name}), *sorted(read)],
        "params": tracked(root, keys - own) + ([{params.PAPERS: sorted(own)}] if own else []),
    }
    return {key: value for key, value in entry.items() if value}


def second_pipeline(root: Path) -> dict[str, Any]:
    """The stages of the papers: the modules with a `main`."""
    names = sorted(
        path.stem
        for path in (root / "pipeline/papers").glob("*.py")
        if any(isinstance(node, ast.FunctionDef) and node.name == "main" for node in parsed(path).body)
    )
    return {"stages": {stage: expected_of_paper(root, stage) for stage in names}}


def stages(root: Path) -> list[str]:
    return sorted(path.stem for path in (root / "stages").glob("*.py") if path.stem != "__init__")


def pipeline(root: Path) -> dict[str, Any]:
    """All stages, each after those whose results it reads."""
    entries = {stage: expected(root, stage) for stage in stages(root)}
    made = {
        path: stage
        for stage, entry in entries.items()
        for kind in ("outs", "metrics")
        for out in entry.get(kind, [])
        for path in out
    }
    order = {
        stage: [made[out] for out in made for dep in entry["deps"] if f"{dep}/".startswith(f"{out}/")]
        for stage, entry in entries.items()
    }
    ordered = {stage: entries[stage] for stage in graphlib.TopologicalSorter(order).static_order()}
    curves = [
        stage
        for stage in ordered
        if any(
            function == "write_learning_curve" for *_, function in calls(parsed(root / f"stages/{stage}.py"))
        )
    ]
    return {"stages": ordered} | (
        {"plots": [{f"datasets/{stage}/live/plots/metrics": {"x": "step"}} for stage in curves]}
        if curves
        else {}
    )


def differences(entries: dict[str, Any], wanted: dict[str, Any]) -> list[str]:
    """Sentences on the differences between dvc.yaml and what the stages ask for. The order of entries and
    `desc` are free."""

    def flat(entry, kind):
        value = entry.get(kind, [])
        return (
            {value}
            if isinstance(value, str)
            else {
                yaml.safe_dump(item, default_flow_style=True, width=999).replace("\n...", "").strip()
                for item in value
            }
        )

    sentences = [
        f"{stage}: stage is {'missing' if stage in wanted else 'not in stages/'}"
        for stage in sorted(entries.keys() ^ wanted.keys())
    ]
    for stage in entries.keys() & wanted.keys():
        for kind in sorted((entries[stage].keys() | wanted[stage].keys()) - {"desc"}):
            have, want = flat(entries[stage], kind), flat(wanted[stage], kind)
            sentences += [f"{stage}: {kind} lacks {item}" for item in sorted(want - have)] + [
                f"{stage}: {kind} has {item}" for item in sorted(have - want)
            ]
    return sentences


# ---- bounds


def unbounded(kind: Any, place: str, limits: tuple = ()) -> list[str]:
    """The places in a type where a number has no lower or no upper bound, or a key has a default other
    than None."""
    if typing.get_origin(kind) is Annotated:
        kind, *extra = typing.get_args(kind)
        limits = (*limits, *(limit for item in extra for limit in getattr(item, "metadata", [item])))
        return unbounded(kind, place, limits)
    if isinstance(kind, type) and issubclass(kind, params.Section):
        fields = kind.model_fields.items()
        # left out is not there: None, an empty list and false are no values
        defaults = [
            f"{place}.{name} has a default"
            for name, field in fields
            if not field.is_required() and field.default not in (None, [], False)
        ]
        return defaults + [
            item
            for name, field in fields
            for item in unbounded(field.annotation, f"{place}.{name}", tuple(field.metadata))
        ]
    if kind in (int, float):
        has = {
            name
            for limit in limits
            for name in ("ge", "gt", "le", "lt")
            if getattr(limit, name, None) is not None
        }
        sides = ["no lower bound"] * (not has & {"ge", "gt"}) + ["no upper bound"] * (not has & {"le", "lt"})
        return [f"{place} has {side}" for side in sides]
    union = typing.get_origin(kind) in (typing.Union, typing.get_origin(int | None))
    arguments = [] if typing.get_origin(kind) is typing.Literal else typing.get_args(kind)
    return [item for argument in arguments for item in unbounded(argument, place, limits if union else ())]
