"""What the files of the second pipeline, datasets/papers/dvc.yaml, were made of: made.json holds for each
stage the commit, and the SHA-256 of every dependency and parameter that its entry in dvc.yaml names.

The root's pipeline starts none of these stages and a change of a method makes none of their files anew, so a
page says which of them are older than their method. It is a function of files in git alone: every clone says
the same.
"""

import hashlib
import json
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pipeline.store import artifacts, params

FOLDER = Path("datasets/papers")
PIPELINE, MADE = FOLDER / "dvc.yaml", FOLDER / "made.json"
# dependencies that a sentence names
NAMED = 3


def stages() -> list[str]:
    """The stages of the second pipeline, in its order."""
    return list(params.files(PIPELINE)[str(PIPELINE)]["stages"])


def record(stage: str) -> None:
    """Writes the entry of a stage that has just ended."""
    entries = artifacts.read_json(MADE) if MADE.exists() else {}
    entries[stage] = {"commit": _commit(), "of": dict(_hashes(stage))}
    artifacts.write_json(MADE, dict(sorted(entries.items())))


def changed(stage: str) -> list[str]:
    """Dependencies and parameters of a stage that are not what its file was made of."""
    then, now = _entry(stage).get("of", {}), dict(_hashes(stage))
    return sorted(name for name in then.keys() | now.keys() if then.get(name) != now.get(name))


def sentence(stage: str) -> str:
    """When the file of a stage was made, and whether its method has changed since."""
    entry, names = _entry(stage), changed(stage)
    if not entry:
        return f"Nothing says of which method it was made; run {command(stage)}."
    if not names:
        return f"Made at commit {entry['commit']}; the method has not changed since."
    listed = ", ".join(names[:NAMED]) + (f" and {len(names) - NAMED} more" if len(names) > NAMED else "")
    begun = f"Made at commit {entry['commit']}; the method has changed since"
    return f"{begun}: {listed}. {command(stage)} makes it anew."


def command(stage: str) -> str:
    """What makes the file of a stage anew."""
    return f"./run dvc repro {PIPELINE}:{stage}"


def _entry(stage: str) -> dict[str, Any]:
    return artifacts.read_json(MADE).get(stage, {}) if MADE.exists() else {}


def _hashes(stage: str) -> Iterator[tuple[str, str]]:
    """(name, SHA-256) of each dependency and each section of parameters; "" for a file that is not there."""
    entry = params.files(PIPELINE)[str(PIPELINE)]["stages"][stage]
    for path in entry["deps"]:
        yield path, artifacts.sha256(path) if Path(path).exists() else ""
    for item in entry.get("params", []):
        for file, keys in item.items() if isinstance(item, dict) else [(params.FILE, [item])]:
            sections = params.files(file)[str(file)]
            for key in keys:
                text = json.dumps(_value(sections, key), sort_keys=True)
                yield f"{file}: {key}", hashlib.sha256(text.encode()).hexdigest()


def _value(sections: Any, dotted: str) -> Any:
    for key in dotted.split("."):
        sections = sections.get(key) if isinstance(sections, dict) else None
    return sections


def _commit() -> str:
    ended = subprocess.run(
        ["git", "rev-parse", "--short=7", "HEAD"], capture_output=True, text=True, check=False
    )
    return ended.stdout.strip() or "unknown"
