"""What the job remembers from night to night: .beadline/memory.json. Losing it costs one repeated night; a
broken one is set aside."""

import json

from pipeline.nightly.processes import STATE, git
from pipeline.nightly.records import Memory, from_json, to_json
from pipeline.store import artifacts

FILE, METRICS = STATE / "memory.json", "reports/metrics/nightly.json"
LONGEST_HISTORY = 1000


def read() -> Memory:
    """As the last night wrote it; on a fresh clone, what the last commit's metrics say. Raises ValueError if
    the file is broken."""
    if not FILE.exists():
        fields = json.loads(git("show", f"HEAD:{METRICS}", check=False) or "{}")
        return Memory(fields.get("night", 0), fields.get("when", ""))
    try:
        return from_json(Memory, artifacts.read_json(FILE))
    except ValueError as error:
        why = " ".join(str(error).split())
        raise ValueError(f"{FILE} is not what a night writes ({why})") from None


def read_or_set_aside() -> tuple[Memory, list[str]]:
    """The memory; a broken file becomes .broken, which the note says, and the night looks at everything
    anew."""
    try:
        return read(), []
    except ValueError as error:
        FILE.replace(f"{FILE}.broken")
        return read(), [f"{error}; it is set aside as {FILE}.broken, and all is looked at anew"]


def write(memory: Memory) -> None:
    del memory.nights[:-LONGEST_HISTORY]
    artifacts.write_json(FILE, to_json(memory))
