"""Writes the files of datasets/papers that the second pipeline makes: results, with a list of numbers on one
line, and made.json, which records the code and parameters that each was made from."""

import json
import re
from collections.abc import Mapping
from typing import Any

from pipeline.papers import made
from pipeline.store import artifacts


def write(name: str, result: Mapping[str, Any]) -> None:
    """Writes datasets/papers/NAME.json, and its entry in made.json."""
    text = json.dumps(result, indent=1, allow_nan=False)
    text = re.sub(r"\[[^\[\]{}]*\]", lambda match: " ".join(match[0].split()).replace("[ ", "["), text)
    artifacts.write_text(made.FOLDER / f"{name}.json", text.replace(" ]", "]") + "\n")
    made.record(name)
