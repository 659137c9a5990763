"""What the three benchmarks of the papers share: how their results are written."""

import json
import re
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent / "results" / "papers"


def write(name: str, result: dict[str, Any]) -> None:
    """benchmarks/results/papers/NAME.json, a list of numbers on one line."""
    text = json.dumps(result, indent=1, allow_nan=False)
    text = re.sub(r"\[[^\[\]{}]*\]", lambda match: " ".join(match[0].split()).replace("[ ", "["), text)
    FOLDER.mkdir(parents=True, exist_ok=True)
    (FOLDER / f"{name}.json").write_text(text.replace(" ]", "]") + "\n")
