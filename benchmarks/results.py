"""benchmarks/results.json: for each benchmark its rows, and the machine, date and commit of their measuring;
and docs/reference/benchmarks.md, which shows it.

A row is (what, measured, beside, note): what was measured with its size, the figure with its unit, the limit
or the peer beside it, and what a reader has to know to judge it, such as a faster peer and where that figure
is from.
"""

import datetime
import json
import os
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[1]
FILE, PAGE = ROOT / "benchmarks/results.json", ROOT / "docs/reference/benchmarks.md"
BEGIN, END = "<!-- benchmarks: written by ./run python -m benchmarks --render -->", "<!-- /benchmarks -->"
# the order of the page, and the heading of each part
TITLES = {
    "stages": "The whole run",
    "growth": "Growth with size, and the kernel",
    "identification": "Identification",
    "reading_speed": "Reading recordings",
    "gcode": "G-code",
    "frames": "Frames to flow",
    "ilc": "Learning trial by trial",
    "agent": "The agent of the setpoint loop",
}


class Row(NamedTuple):
    """A line of a table, each cell as text."""

    what: str
    measured: str
    beside: str = ""
    note: str = ""


def write(name: str, rows: Sequence[Row]) -> None:
    """Puts the rows of one benchmark into the file, and the file into the page."""
    parts = json.loads(FILE.read_text()) if FILE.exists() else {}
    parts[name] = {
        "machine": machine(),
        "date": datetime.date.today().isoformat(),
        "commit": subprocess.check_output(
            ["git", "rev-parse", "--short=7", "HEAD"], cwd=ROOT, text=True
        ).strip(),
        "rows": [list(row) for row in rows],
    }
    FILE.write_text(dumped({key: parts[key] for key in TITLES if key in parts}), encoding="utf-8")
    put_in_page()


def dumped(parts: dict[str, Any]) -> str:
    """JSON with a row on one line."""
    blocks = []
    for name, part in parts.items():
        head = [f"  {json.dumps(key)}: {json.dumps(part[key])}," for key in ("machine", "date", "commit")]
        rows = ",\n".join(f"   {json.dumps(row, ensure_ascii=False)}" for row in part["rows"])
        blocks.append("\n".join([f" {json.dumps(name)}: {{", *head, f'  "rows": [\n{rows}\n  ]\n }}']))
    return "{\n" + ",\n".join(blocks) + "\n}\n"


def machine(told: Path = Path("/proc/cpuinfo")) -> str:
    """The CPU's name, and how many cores this process may use."""
    pairs = (line.partition(":") for line in told.read_text().split("\n\n")[0].splitlines())
    names = {key.strip(): value.strip() for key, _, value in pairs}
    return f"{names.get('model name', os.uname().machine)}, {len(os.sched_getaffinity(0))} cores"


def render(parts: dict[str, Any]) -> str:
    """The tables of the page."""
    lines = []
    for name, title in TITLES.items():
        if name not in parts:
            continue
        part = parts[name]
        lines += [
            f"## {title}",
            "",
            f"`./run --group peers python -m benchmarks.{name}`, measured on {part['machine']}, "
            f"{part['date']}, commit {part['commit']}.",
            "",
            "| | measured | limit or peer | |",
            "|---|---|---|---|",
            *(f"| {' | '.join(row)} |" for row in part["rows"]),
            "",
        ]
    return "\n".join(lines)


def page(text: str, parts: dict[str, Any]) -> str:
    """The page with its generated block made anew. Raises ValueError if it has no block."""
    if text.count(BEGIN) != 1 or text.count(END) != 1:
        raise ValueError(f"{PAGE.name}: expected one block between {BEGIN} and {END}; put it back")
    head, rest = text.split(BEGIN)
    return f"{head}{BEGIN}\n\n{render(parts)}{END}{rest.split(END)[1]}"


def put_in_page() -> None:
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(page(text, json.loads(FILE.read_text(encoding="utf-8"))), encoding="utf-8")
