"""The rules of the house on the syntax tree: who may know whom, who opens files, what dvc.yaml must name."""

import ast
import functools
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from pipeline.store import params

ROOT = Path(__file__).resolve().parents[1]
LOOPS = ("temperature", "deposition", "setpoint")
# what other rooms may read: of a loop constants and its table of controllers, which its methods may read too;
# of a loop and of other rooms settings, schemas and records
CONSTANTS = {"controllers", "controllers/table", "agents/criteria", "published"}
PLAIN = {"settings", "tables", "records", "made"}
# of a loop, what saves and loads networks, frames and recordings
FILES = {"files", "recordings"}
# methods that pose the temperature loop's cases, from its settings
POSE = {f"pipeline/temperature/test_set/{name}.py" for name in ("controller_search", "evaluation", "panel")}
# room -> rooms that it may know beside itself; own: the methods of its loop, files: what saves networks
MAY_KNOW: dict[str, set[str]] = {
    "statistics": set(),
    "store": set(),
    "recordings": {"store", "statistics"},
    "methods": {"constants", "statistics"},
    "plain": {"own", "constants", "store", "statistics", "verdict"},
    "constants": {"own", "plain", "files", "store", "statistics"},
    "files": {"own", "plain", "constants", "store", "statistics", "recordings"},
    "verdict": {"plain", "constants", "store", "statistics"},
    "deploy": {"verdict", "methods", "plain", "constants", "store", "statistics"},
    "report": {"verdict", "plain", "constants", "store", "statistics"},
    "papers": {"methods", "plain", "constants", "files", "store", "statistics", "stages"},
}
# who may know every room; room -> who alone may know it
WHOLE = {"stages", "cli", "quick", "commands", "nightly", "around_dvc", "side_by_side"}
ONLY = {
    "report": {"stages", "cli"},
    "commands": {"cli", "quick", "nightly"},
    "stages": {"papers", "quick", "cli", "commands", "nightly"},
}
ROOMS = {*LOOPS, *MAY_KNOW, *WHOLE, "__init__"} - {"methods", "plain", "constants", "files", "stages"}
NUMERICS = {"numpy", "scipy", "control", "sklearn", "cv2", "jax", "equinox", "optax", "jaxtyping"}
NUMERICS |= {"__future__", "abc", "bisect", "collections", "dataclasses", "enum", "fractions", "functools"}
NUMERICS |= {
    "heapq",
    "itertools",
    "math",
    "numbers",
    "operator",
    "re",
    "string",
    "types",
    "typing",
    "warnings",
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
}
WRITES |= {"to_csv", "to_parquet", "dump"}
READS = {"read_text", "read_bytes", "load", "loadtxt", "genfromtxt", "fromfile", "memmap", "open"}
READS |= {"read_csv", "read_parquet", "read_table"}
EDGE = {"artifacts", "params", "recordings"}
FRAME = "stages/__init__.py"
# the frame of a stage and around_dvc import the standard library alone; params_text dumps to a text
WRITERS = {"pipeline/store/artifacts.py", "pipeline/store/params_text.py", "pipeline/around_dvc.py", FRAME}
WRITERS |= {"pipeline/deploy/checks.py"}  # into a temporary folder that is compiled
# MT19937: R's generator, with which the script of a paper draws
GENERATORS = {"Generator", "default_rng", "SeedSequence", "BitGenerator", "PCG64", "MT19937"}
# the one file of metrics, with a column a value; the figures of other stages are outs
HEADLINE = "reports/metrics/report.json"
# memos (results are the same whatever is in them), and what the night and the quick look say beside a run
UNTRACKED: tuple[str, ...] = ("reports/nightly.html", "reports/metrics/nightly.json")
UNTRACKED += (
    "datasets/memo",
    "reports/metrics/nightly.json",
    "reports/nightly.html",
    "reports/quick_look.json",
)
PLACES = ("stages/", "pipeline/verdict/", "pipeline/report/")
# the second pipeline: results that no recording changes, and no stage of the root asks for
PAPERS = "datasets/papers/dvc.yaml"
# a stage depends on these rooms whole, and on at most 8 files or folders of a loop's methods
SHARED, MOST_METHODS = {"store", "recordings", "verdict", "deploy", "report"}, 8


# ---- the syntax tree


class File(NamedTuple):
    name: str
    tree: ast.Module

    @property
    def room(self) -> str:
        """stages, store, ..., cli; of a loop `temperature`, `temperature/plain`, .../constants, .../files."""
        top, room, *rest = [*self.name.removesuffix(".py").split("/"), "", ""]
        if top != "pipeline" or not room:
            return top
        path, loop = "/".join(rest).rstrip("/"), room in LOOPS
        kinds = {"constants": loop and path in CONSTANTS, "files": loop and path.rpartition("/")[2] in FILES}
        kinds["plain"] = room in (*LOOPS, "deploy", "nightly", "papers") and path in PLAIN
        return next((f"{room}/{kind}" for kind, holds in kinds.items() if holds), room)


def parsed(path: Path) -> ast.Module:
    return _parsed(path.read_text(encoding="utf-8"))


# every stage imports the same rooms; nothing changes a tree
_parsed = functools.cache(ast.parse)


def files(root: Path, *folders: str) -> Iterator[File]:
    for path in [path for folder in folders for path in sorted((root / folder).rglob("*.py"))]:
        yield File(path.relative_to(root).as_posix(), parsed(path))


@functools.cache
def imports(tree: ast.AST) -> list[tuple[int, str]]:
    """(line, dotted name) of each import; `from a import b` is a.b. A relative import begins with a dot."""
    names = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            of = node.module or "" if isinstance(node, ast.ImportFrom) else ""
            begin = "." * node.level if isinstance(node, ast.ImportFrom) else ""
            names += [(node.lineno, begin + f"{of}.{alias.name}".strip(".")) for alias in node.names]
    return names


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
    """(call, receiver, function) of each call: artifacts.write_text(...) is ("artifacts", "write_text")."""
    nodes = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    names = [ast.unparse(node.func).rpartition(".") for node in nodes]
    return [(node, receiver, function) for node, (receiver, _, function) in zip(nodes, names, strict=True)]


# ---- who may know whom


def may_know(room: str, target: str) -> bool:
    """Whether a file of `room` may import a file of `target`."""
    (own, _, kind), (other, _, part) = room.partition("/"), target.partition("/")
    if target in ONLY and room != target:
        return room in ONLY[target]
    if room == target or room in WHOLE or (own == other and own not in LOOPS):
        return True
    allowed, wanted = MAY_KNOW[kind or ("methods" if own in LOOPS else own)], part or other
    if own in LOOPS and other in LOOPS:  # loops never meet
        return own == other and (part or "own") in allowed
    return ("methods" if wanted in LOOPS else wanted) in allowed


def forbidden_imports(root: Path) -> list[str]:
    sentences = []
    for file in files(root, "pipeline", "stages"):
        for line, name in imports(file.tree):
            target, library = project_file(root, name), name.split(".")[0]
            room = File(target, file.tree).room if target and not target.endswith("/__init__.py") else ""
            reasons = {
                "write the whole name": name.startswith("."),
                "nothing imports a test or a benchmark": library in ("tests", "benchmarks"),
                f"{file.room} must not know {room}": room
                and not (may_know(file.room, room) or (file.name in POSE and room == "temperature/plain")),
                f"{file.room} knows arrays, nothing of files, clocks, processes or figures": not target
                and file.room in (*LOOPS, "statistics")
                and library not in NUMERICS,
            }
            if reason := next((reason for reason, holds in reasons.items() if holds), ""):
                sentences.append(f"{file.name}:{line} imports {name}: {reason}")
    return sentences


def misplaced(root: Path) -> list[str]:
    """Files and folders of pipeline/ that are no room of the house; a folder of workflows is none."""
    names = [path for path in sorted((root / "pipeline").iterdir()) if path.name != "__pycache__"]
    workflows = sorted((root / "pipeline").glob("*/workflow/"))
    return [f"pipeline/{path.name}: which room is it of?" for path in names if path.stem not in ROOMS] + [
        f"{path.relative_to(root).as_posix()}: a stage is one file; its methods lie in the loop"
        for path in workflows
    ]


def doubles(root: Path) -> dict[str, list[str]]:
    """Names of classes that stand in more than one module, with the modules."""
    modules = defaultdict(list)
    for file in files(root, "pipeline", "stages"):
        for name in {node.name for node in ast.walk(file.tree) if isinstance(node, ast.ClassDef)}:
            modules[name].append(file.name)
    return {name: places for name, places in sorted(modules.items()) if len(places) > 1}


# ---- files, randomness, the frame of a stage


def forbidden_files(root: Path) -> list[str]:
    """Files that methods and stages open by themselves, and those that others write without artifacts."""
    sentences = []
    for file in files(root, "pipeline", "stages"):
        forbidden = WRITES | READS if file.room in (*LOOPS, "statistics", "stages") else WRITES
        for call, receiver, function in calls(file.tree):
            modes = [
                *call.args[not receiver :][:1],
                *(key.value for key in call.keywords if key.arg == "mode"),
            ]
            to_write = any(
                isinstance(mode, ast.Constant) and set(str(mode.value)) & set("wax+") for mode in modes
            )
            if file.name in WRITERS or receiver in (*EDGE, "ast"):
                continue
            if function in forbidden or (function == "open" and to_write):
                name = ast.unparse(call.func)
                sentences.append(f"{file.name}:{call.lineno} {name}: only artifacts opens artifacts")
    return sentences


def forbidden_randomness(root: Path) -> list[str]:
    return [
        f"{file.name}:{call.lineno} {ast.unparse(call)}: the stage makes a seeded generator and hands it on"
        for file in files(root, "pipeline", "stages")
        for call, receiver, function in calls(file.tree)
        if receiver in ("np.random", "numpy.random")
        and (function not in GENERATORS or (function == "default_rng" and not call.args))
    ]


def unframed(root: Path) -> list[str]:
    """Reads of a stage outside `with artifacts.stage(...)`: bad input there ends in a traceback."""
    return [
        f"{file.name}:{call.lineno} {ast.unparse(call)}: move it into `with artifacts.stage(...)`"
        for file in files(root, "stages")
        for main in file.tree.body
        if isinstance(main, ast.FunctionDef) and main.name == "main"
        for statement in main.body
        if not ast.unparse(statement).startswith("with artifacts.stage(")
        for call, receiver, _ in calls(statement)
        if receiver in EDGE
    ]


# ---- dvc.yaml


def stages(root: Path) -> list[str]:
    return sorted(path.stem for path in (root / "stages").glob("*.py") if path.stem != "__init__")


def reached(root: Path, name: str) -> dict[str, ast.Module]:
    """The file itself and all files that it imports, directly or not, without empty __init__.py. Of another
    stage only its imports, and the definitions that are used."""
    trees, todo = {}, [(name, "*")]
    while todo:
        file, wanted = here = todo.pop()
        if here in trees or not (root / file).stat().st_size:
            continue
        trees[here] = tree = parsed(root / file) if wanted == "*" else _used(parsed(root / file), wanted)
        names = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
        for dotted in [dotted for _, dotted in imports(tree)]:
            if target := project_file(root, dotted):
                part, last = (
                    dotted.count(".") == 2 and dotted.startswith("stages."),
                    dotted.rpartition(".")[2],
                )
                todo.append((target, "*" if not part else last if last in names else ""))
    files = {file: [tree for (one, _), tree in trees.items() if one == file] for file, _ in trees}
    return {
        file: ast.Module([node for tree in some for node in tree.body], []) for file, some in files.items()
    }


def _used(tree: ast.Module, name: str) -> ast.Module:
    """The imports of a file, and the definition of a name with those that it uses."""
    definitions: dict[str, ast.stmt] = {}
    for node in tree.body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", node)]
        for target in targets:
            definitions[getattr(target, "name", getattr(target, "id", ""))] = node
    kept, todo = {""}, [name]
    while todo:
        one = todo.pop()
        if one in definitions and one not in kept:
            kept.add(one)
            todo += [node.id for node in ast.walk(definitions[one]) if isinstance(node, ast.Name)]
    nodes = [definitions[one] for one in kept - {""}]
    return ast.Module(
        [node for node in tree.body if node in nodes or isinstance(node, ast.Import | ast.ImportFrom)], []
    )


def beside(root: Path, code: Iterable[str]) -> set[str]:
    """Templates, rules and the like: files that are no modules, in the folders of modules or below."""
    folders = {(root / name).parent for name in code}
    found = {path for folder in folders for path in (*folder.glob("*"), *folder.glob("templates/**/*"))}
    names = {path.relative_to(root).as_posix() for path in found if path.is_file() and path.suffix != ".py"}
    return {name for name in names if "/." not in name and "__pycache__" not in name}


def literal(file: str, call: ast.Call, position: int) -> str:
    argument = call.args[position] if len(call.args) > position else None
    assert isinstance(argument, ast.Constant), (
        f"{file}:{call.lineno} {ast.unparse(call)}: write the name out, so that one can grep for it"
    )
    return str(argument.value)


def keys(root: Path, code: dict[str, ast.Module]) -> set[str]:
    """The parameters that change what modules write, as dvc.yaml has them: "key" or "FILE: key".

    How work is spread over processes changes nothing, and the frame of a stage refuses sections that it does
    not use. What stands in no file is asked for where a person looks first.
    """
    asked: set[str] = set()
    for name, tree in [(name, tree) for name, tree in code.items() if name != FRAME]:
        for call, receiver, function in calls(tree):
            if receiver == "params" and function == "value":
                asked.add(literal(name, call, 0))
            elif receiver == "params" and function == "load":
                section = literal(name, call, 1)
                part = _fields(code, ast.unparse(call.args[0]))
                asked |= {f"{section}.{field}" for field in part} or {section}
            elif (receiver, function) == ("stages", "run"):
                asked |= {f"loops.{ast.literal_eval(keyword.value)}" for keyword in call.keywords}
    asked.discard("execution")
    held: dict[str, set[str]] = {}
    for file in (params.FILE, params.EXPERT, params.PAPERS):
        sections = yaml.safe_load((root / file).read_text()) if (root / file).exists() else {}
        inner = {f"{name}.{key}" for name, of in sections.items() if isinstance(of, dict) for key in of}
        held[file] = asked & {*sections, *inner}
    others = {f"{file}: {key}" for file in (params.EXPERT, params.PAPERS) for key in held[file]}
    return others | held[params.FILE] | (asked - held[params.EXPERT] - held[params.PAPERS])


def _fields(code: dict[str, ast.Module], model: str) -> set[str]:
    """The fields of a class that reads a part of its section; none of one that reads it whole."""
    nodes = [node for tree in code.values() for node in tree.body if getattr(node, "name", "") == model]
    return {
        item.target.id
        for node in nodes
        if isinstance(node, ast.ClassDef)
        and any(ast.unparse(key) == "extra='ignore'" for key in node.keywords)
        for item in node.body
        if isinstance(item, ast.AnnAssign) and isinstance(item.target, ast.Name)
    }


def paths(name: str, tree: ast.Module) -> tuple[set[str], set[str]]:
    """Literal paths in datasets/ and reports/ that a module reads; those that it writes."""
    written, read = set(), set()
    targets = {id(call.args[0]) for call, _, verb in calls(tree) if verb.startswith("write_") and call.args}
    for node in ast.walk(tree):
        text = ast.unparse(node) if isinstance(node, ast.JoinedStr) else ""
        assert not re.match(r"f['\"](datasets|reports)/", text), (
            f"{name}:{node.lineno} {text}: write the path out, so that one can grep for it"
        )
        if isinstance(node, ast.Constant) and re.fullmatch(r"(datasets|reports)/[\w./-]+", str(node.value)):
            (written if id(node) in targets else read).add(str(node.value).rstrip("/"))
    figures = [call for call, _, verb in calls(tree) if verb == "read_figures"]
    return read | {f"datasets/{literal(name, call, 0)}/figures.json" for call in figures}, written


def covered(path: str, deps: Iterable[str]) -> bool:
    """Whether a path is one of the deps, or lies in one."""
    return any(f"{path}/".startswith(f"{dep}/") for dep in deps)


def expected(root: Path, name: str) -> dict[str, set[str]]:
    """What a stage imports and opens, directly or through what it imports: code, deps, params, outs, metrics.
    Paths stand in stages, verdict and pages; other modules take them as arguments."""
    code, stage = reached(root, name), Path(name).stem
    tree, read = code[name], set()
    for file in [file for file in code if file.startswith(PLACES) or file == name]:
        read |= paths(file, code[file])[0]
        if any((receiver, verb) == ("params", "read") for _, receiver, verb in calls(code[file])):
            read |= {params.FILE, params.EXPERT}
    read = {path for path in read if not path.startswith((*UNTRACKED, f"datasets/{stage}/"))}
    for call, _, verb in calls(tree):
        assert verb not in ("stage", "write_metrics") or literal(name, call, 0) == stage, (
            f"{name}:{call.lineno} the stage's name is {stage}"
        )
    measures = any(verb == "write_metrics" for *_, verb in calls(tree))
    written = paths(name, tree)[1]
    if measures or re.search(r"artifacts\.stage\(.*\) as ", ast.unparse(tree)):
        written.add(f"datasets/{stage}")
    wanted: dict[str, set[str]] = {
        "code": {*code} | beside(root, code),
        "deps": {path for path in read if not covered(path, read - {path})},
        "params": keys(root, code),
        # DVC deletes outs before a stage unless they persist; the last good artifacts must outlive a failure
        "outs": {f"{path} persist" for path in written},
        "metrics": set(),
    }
    if measures:
        metric = f"reports/metrics/{stage}.json"
        wanted["metrics" if metric == HEADLINE else "outs"].add(f"{metric} uncached persist")
    return wanted


def expected_of_paper(root: Path, stage: str) -> dict[str, set[str]]:
    """How a file is read and a figure written is no method. A stage of the second pipeline has no outs: DVC
    joins pipelines by their outs, and the root's `dvc repro` would start it."""
    wanted = expected(root, f"pipeline/papers/{stage}.py")
    methods = {*LOOPS, "statistics", "papers", "stages"}
    rooms = {path: File(path, ast.Module([], [])).room for path in wanted["code"]}
    code = {path for path, room in rooms.items() if room.split("/")[0] in methods and room != "papers/plain"}
    # `relearned` plays the root's stages in a folder of its own
    name = f"pipeline/papers/{stage}.py"
    own = {f"datasets/papers/{stage}.json", f"datasets/papers/{stage}", params.PAPERS}
    read = {path for path in paths(name, parsed(root / name))[0] - own if not path.startswith(UNTRACKED)}
    keys = {key for key in wanted["params"] if not key.startswith("loops.")}
    return {"code": code, "deps": read, "params": keys, "outs": set(), "metrics": set()}


def differences(stage: str, entry: dict[str, Any], wanted: dict[str, set[str]]) -> list[str]:
    """What an entry of dvc.yaml lacks, and what it has that the stage does not read or write."""
    deps = set(entry["deps"])
    code = {dep for dep in deps if dep.split("/")[0] in ("pipeline", "stages")}
    have = {"deps": deps - {dep for dep in code if any(covered(path, [dep]) for path in wanted["code"])}}
    want = {"deps": whole(wanted["deps"]) | {path for path in wanted["code"] if not covered(path, code)}}
    have["params"], want["params"] = set(), wanted["params"]
    for item in entry.get("params", []):
        for file, names in item.items() if isinstance(item, dict) else [("", [item])]:
            have["params"] |= {f"{file}: {name}" if file else name for name in names}
    for kind in ("outs", "metrics"):
        outs = [out if isinstance(out, dict) else {out: {}} for out in entry.get(kind, [])]
        want[kind] = wanted[kind]
        have[kind] = {
            path + " uncached" * (not options.get("cache", True)) + " persist" * options.get("persist", False)
            for out in outs
            for path, options in out.items()
        }
    return [
        f"{stage}: {kind} {word} {item}"
        for kind in have
        for word, items in (("lacks", want[kind] - have[kind]), ("has", have[kind] - want[kind]))
        for item in sorted(items)
    ]


# their files wait for a machine's trials, and DVC does not start a stage without a file that it names
WAITING = ("datasets/segment_library", "datasets/compose_parts")


def whole(deps: Iterable[str]) -> set[str]:
    """The same, with the folders that wait in place of their files."""
    return {next((folder for folder in WAITING if dep.startswith(f"{folder}/")), dep) for dep in deps}


BESIDE = (["settings.py"], ["tables.py"], ["controllers.py"])


def coarse(stage: str, deps: Iterable[str]) -> list[str]:
    """Shared rooms that are not named whole, and loops that are, or of which there are too many methods: a
    comment in pipeline/setpoint would cost a quarter of an hour."""
    parts = [dep.split("/") for dep in deps if dep.startswith("pipeline/")]
    sentences = [
        f"{stage}: name {'/'.join(part[:2])} whole" for part in parts if part[1] in SHARED and part[2:]
    ]
    for loop in LOOPS:
        methods = [part for part in parts if part[1] == loop and part[2:] not in BESIDE]
        if ["pipeline", loop] in methods or len(methods) > MOST_METHODS:
            sentences.append(f"{stage}: name at most {MOST_METHODS} files or folders of pipeline/{loop}")
    return sentences
