"""What the job remembers from run to run: .beadline/memory.json. If it is lost, one run is repeated; a broken
file is set aside."""

import json

from pipeline.nightly.processes import STATE, git
from pipeline.nightly.records import Memory, from_json, to_json
from pipeline.store import artifacts

FILE, METRICS = STATE / "memory.json", "reports/metrics/nightly.json"
LONGEST_HISTORY = 1000


def read() -> Memory:
    """Returns the memory that the last run wrote; on a fresh clone, the memory from the last commit's
    metrics. Raises ValueError if the file is broken."""
    if not FILE.exists():
        fields = json.loads(git("show", f"HEAD:{METRICS}", check=False) or "{}")
        return Memory(fields.get("night", 0), fields.get("when", ""))
    try:
        return from_json(Memory, artifacts.read_json(FILE))
    except ValueError as error:
        why = " ".join(str(error).split())
        raise ValueError(f"{FILE} is not what a night writes ({why})") from None


def read_or_set_aside() -> tuple[Memory, list[str]]:
    """Returns the memory. A broken file is renamed to .broken, with a note, and the run examines everything
    again."""
    try:
        return read(), []
    except ValueError as error:
        FILE.replace(f"{FILE}.broken")
        return read(), [f"{error}; it is set aside as {FILE}.broken, and all is looked at anew"]


def write(memory: Memory) -> None:
    del memory.nights[:-LONGEST_HISTORY]
    artifacts.write_json(FILE, to_json(memory))
