"""Files that were made wrong, for as long as one likes: recordings, MCAP, CSV, G-code, parameters, artifacts.

`./run python -m benchmarks.fuzz --hours 1` gives every reader of tests/fuzzing.py files that hypothesis
damages, 50 of one kind after 50 of the next, each round from a seed of its own, until the time is over;
`--only CSV,G-code` some of them, `--seed 7` other files. A reader may take a file or refuse it by a sentence.
Anything else is a traceback; more than 20 s of CPU is a hang. The smallest file that shows it is kept as
benchmarks/results/fuzz/<kind>-<seed><suffix>. Counts go to benchmarks/results/fuzz.json after every round;
the exit status is 1 where anything was found.
"""

import argparse
import collections
import sys
import time
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hypothesis
from hypothesis import HealthCheck, Phase

from pipeline.store import artifacts
from tests import fuzzing

RESULTS = Path(__file__).parent / "results" / "fuzz.json"
KEPT = RESULTS.with_suffix("")
AT_ONCE = 50


class Failed(Exception):
    """A file that was neither read nor refused: the file, and what happened."""

    def __init__(self, content: bytes, said: str):
        super().__init__(said)
        self.content, self.said = content, said


def round_of(name: str, seed: int) -> tuple[collections.Counter, Failed | None]:
    """How `AT_ONCE` damaged files of one kind are answered, and the smallest that fails."""
    target, counts = fuzzing.TARGETS[name], collections.Counter()
    good = target.good()

    @hypothesis.seed(seed)
    @hypothesis.settings(
        max_examples=AT_ONCE, database=None, deadline=None, derandomize=False,
        phases=(Phase.generate, Phase.shrink), suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @hypothesis.given(fuzzing.DAMAGE)
    def each(edits):
        content = fuzzing.damaged(good, edits)
        try:
            counts[fuzzing.answer(target, content)] += 1
        except fuzzing.Hang as hang:
            raise Failed(content, f"hang: {hang}") from None
        except Exception as error:
            place = traceback.extract_tb(error.__traceback__)[-1]
            said = f"{type(error).__name__}: {error} ({Path(place.filename).name}:{place.lineno})"
            raise Failed(content, said) from None

    try:
        each()
    except Failed as failed:
        return counts, failed
    return counts, None


def keep(name: str, seed: int, failed: Failed) -> dict[str, Any]:
    KEPT.mkdir(parents=True, exist_ok=True)
    path = KEPT / f"{name.replace(' ', '_')}-{seed}{fuzzing.TARGETS[name].suffix}"
    path.write_bytes(failed.content)
    print(f"{name}, seed {seed}: {failed.said}; kept as {path}", flush=True)
    return {"kind": name, "seed": seed, "said": failed.said[:300], "file": path.name}


def fuzz(names: list[str], hours: float, seed: int) -> Iterator[dict[str, Any]]:
    """Files by kind and answer, and what was found, after every round of all kinds until the time is over."""
    counts = {name: collections.Counter() for name in names}
    found, began, first, gone = [], time.monotonic(), seed, 0.0
    while gone < 3600 * hours:
        for name in names:
            answers, failed = round_of(name, seed)
            counts[name] += answers
            if failed:
                found.append(keep(name, seed, failed))
        gone = time.monotonic() - began
        yield {
            "hours": round(gone / 3600, 4),
            "seeds": [first, seed],
            "files": {name: dict(sorted(counter.items())) for name, counter in counts.items()},
            "tracebacks": sum(not row["said"].startswith("hang") for row in found),
            "hangs": sum(row["said"].startswith("hang") for row in found),
            "found": found,
        }
        seed += 1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--hours", type=float, default=1.0)
    parser.add_argument("--only", default=",".join(fuzzing.TARGETS), metavar="KIND,KIND")
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    names = asked.only.split(",")
    if unknown := [name for name in names if name not in fuzzing.TARGETS]:
        parser.error(f"{unknown[0]} is no kind of file; choose among {', '.join(fuzzing.TARGETS)}")
    result: dict[str, Any] = {"files": {}, "tracebacks": 0, "hangs": 0, "found": []}
    for result in fuzz(names, asked.hours, asked.seed):
        artifacts.write_json(RESULTS, result)
    for name, answers in result["files"].items():
        print(f"{name:15} {answers}")
    print(f"{result['tracebacks']} tracebacks, {result['hangs']} hangs")
    sys.exit(1 if result["found"] else 0)


if __name__ == "__main__":
    main()
