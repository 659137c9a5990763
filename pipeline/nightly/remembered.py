"""What the job remembers from night to night: .beadline/last.json, and nights.json for the page. Losing
either costs one repeated night; a broken one is set aside."""

import datetime
import json
from typing import Any

from pipeline.nightly.processes import STATE, git
from pipeline.nightly.records import Night, Remembered, from_json, to_json
from pipeline.store import artifacts

LAST, NIGHTS, METRICS = STATE / "last.json", STATE / "nights.json", "reports/metrics/nightly.json"
LONGEST_HISTORY = 1000


def last() -> Remembered:
    """The last night as the job itself remembers it; on a fresh clone, as the last commit's metrics do.
    Raises ValueError if the file is broken."""
    if LAST.exists():
        memory = from_json(Remembered, artifacts.read_json(LAST))
        if memory.success and not datetime.datetime.fromisoformat(memory.success).tzinfo:
            raise ValueError(f"success {memory.success} has no time zone")
        return memory
    committed = git("show", f"HEAD:{METRICS}", check=False)
    fields = json.loads(committed or "{}")
    return Remembered(night=fields.get("night", 0), success=fields.get("when", ""))


def nights() -> list[Night]:
    """Every night that this checkout remembers, the oldest first. Raises ValueError if the file is broken."""
    rows = artifacts.read_json(NIGHTS) if NIGHTS.exists() else []
    return from_json(list[Night], rows)


def check() -> list[str]:
    """What is wrong with the files that nights remember by, a sentence each."""
    sentences = []
    for path, read in ((LAST, last), (NIGHTS, nights)):
        try:
            read()
        except (ValueError, KeyError, TypeError) as error:
            sentences.append(f"{path} is not what a night writes ({' '.join(str(error).split())})")
    return sentences


def set_broken_aside() -> list[str]:
    """Renames broken files to .broken, and says so: the night looks at everything anew."""
    notes = []
    for sentence in check():
        path = STATE / sentence.split()[0].removeprefix(f"{STATE}/")
        path.replace(f"{path}.broken")
        notes.append(f"{sentence}; it is set aside as {path}.broken, and all is looked at anew")
    return notes


def remember(memory: Remembered, night: Night) -> None:
    """Writes both files."""
    artifacts.write_json(LAST, to_json(memory))
    rows: list[Any] = [*map(to_json, nights()), to_json(night)]
    artifacts.write_json(NIGHTS, rows[-LONGEST_HISTORY:])
