"""Records what the files of the second pipeline, datasets/papers/dvc.yaml, were made from. made.json has for
each stage the commit, and the SHA-256 of every dependency and parameter that its entry in dvc.yaml names. For
code this is the SHA-256 of the syntax tree without imports and docstrings, so a method that only moved is the
same method.

The root's pipeline starts none of these stages, and a change of a method does not make their files again. So
a page says which of the files are older than their method. This depends only on files in git, so every clone
says the same.
"""

import ast
import gc
import hashlib
import json
import subprocess
from pathlib import Path
from typing import Any

from pipeline.store import artifacts, params

FOLDER = Path("datasets/papers")
PIPELINE, MADE = FOLDER / "dvc.yaml", FOLDER / "made.json"
# dependencies that a sentence names
NAMED = 3


def stages() -> list[str]:
    """Returns the stages of the second pipeline, in its order."""
    return list(params.files(PIPELINE)[str(PIPELINE)]["stages"])


def record(stage: str) -> None:
    """Writes the entry of a stage that has just ended."""
    entries = artifacts.read_json(MADE) if MADE.exists() else {}
    entries[stage] = {"commit": _commit(), "of": {name: _sha256(name) for name in names(stage)}}
    artifacts.write_json(MADE, dict(sorted(entries.items())))


def names(stage: str) -> list[str]:
    """Returns what its entry in dvc.yaml names: files, and sections of parameters as "file: section"."""
    entry = params.files(PIPELINE)[str(PIPELINE)]["stages"][stage]
    sections = []
    for item in entry.get("params", []):
        for file, keys in item.items() if isinstance(item, dict) else [(params.FILE, [item])]:
            sections += [f"{file}: {key}" for key in keys]
    return [*entry["deps"], *sections]


def changed(stage: str) -> list[str]:
    """Returns the files and parameters that differ from those the stage's file was made from. It does not
    read dvc.yaml, because DVC allows no stage to depend on that."""
    return sorted(name for name, then in _entry(stage).get("of", {}).items() if _sha256(name) != then)


def sentence(stage: str) -> str:
    """Returns in words when the file of a stage was made, and whether its method has changed since."""
    entry = _entry(stage)
    if not entry:
        return f"Nothing says of which method it was made; run {command(stage)}."
    if not (others := changed(stage)):
        return f"Made at commit {entry['commit']}; the method has not changed since."
    more = f" and {len(others) - NAMED} more" if len(others) > NAMED else ""
    begun = f"Made at commit {entry['commit']}; the method has changed since"
    return f"{begun}: {', '.join(others[:NAMED])}{more}. {command(stage)} makes it anew."


def command(stage: str) -> str:
    """Returns the command that makes the file of a stage again."""
    return f"./run dvc repro {PIPELINE}:{stage}"


def _entry(stage: str) -> dict[str, Any]:
    return artifacts.read_json(MADE).get(stage, {}) if MADE.exists() else {}


def code_digest(source: str) -> str:
    """Returns the SHA-256 of the syntax tree of a module without its imports and docstrings."""
    # CPython 3.11 counts the depth of all parses of a process in one place: a collection in the middle of one
    # lets another thread run, and a parse there makes this one fail ("recursion depth mismatch")
    gc.disable()
    try:
        tree = ast.parse(source)
    finally:
        gc.enable()
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            first = body[:1] if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) else []
            text = [one for one in first if isinstance(one, ast.Expr) and isinstance(one.value, ast.Constant)]
            body[:] = [
                one for one in body if one not in text and not isinstance(one, ast.Import | ast.ImportFrom)
            ]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()


def _sha256(name: str) -> str:
    """Returns the SHA-256 of a file, or of a section of parameters as JSON; "" for a file that does not
    exist."""
    path, _, key = name.partition(": ")
    if not Path(path).exists():
        return ""
    if path.endswith(".py"):
        return code_digest(Path(path).read_text(encoding="utf-8"))
    if not key:
        return artifacts.sha256(path)
    value: Any = params.files(path)[path]
    for part in key.split("."):
        value = value.get(part) if isinstance(value, dict) else None
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def _commit() -> str:
    command = ["git", "rev-parse", "--short=7", "HEAD"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    return ended.stdout.strip() or "unknown"
