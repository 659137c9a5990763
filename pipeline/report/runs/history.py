"""Revisions of reports/metrics in git -> the figures of the pages, run
by run; read by one `git cat-file --batch`."""

import json
import math
import subprocess
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

from pipeline.store import artifacts

FILES = ("report", "evaluate_temperature", "compose_parts", "train_ilc")
# what a revision says of itself, apart by bytes that no subject holds
FORMAT = "%H%x00%cI%x00%s"


class Figure(NamedTuple):
    """A median and the ends of its 90 % band; infinite where a run never settles."""

    value: float
    low: float
    high: float


class Run(NamedTuple):
    """One revision: commit (empty for files that are not committed), its date and subject, the verdict's
    sentence, and {controller: {key: figure}}.
    """

    commit: str
    date: str
    subject: str
    verdict: str
    figures: Mapping[str, Mapping[str, Figure]]


def runs(most: int) -> Iterator[Run]:
    """The last `most` revisions that touched the metrics, oldest first, then the files as they are where they
    differ. Raises ValueError where there is no git, or no revision.
    """
    log = _git("log", f"--max-count={most}", f"--format={FORMAT}", "--", "reports/metrics").decode(
        errors="replace"
    )
    revisions = [line.split("\0", 2) for line in log.splitlines() if line][::-1]
    if not revisions:
        raise ValueError(
            "reports/metrics: git has no revision of it; commit the figures of a run first (git "
            "add reports/metrics)"
        )
    wanted = [f"{commit}:reports/metrics/{name}.json" for commit, *_ in revisions for name in FILES]
    found = _contents(wanted)
    last: Run | None = None
    for commit, date, subject in revisions:
        last = _run(commit, date, subject, {name: next(found) for name in FILES})
        yield last
    now = _run("", "", "not committed", {name: _now(name) for name in FILES})
    if (now.figures, now.verdict) != (last.figures, last.verdict):
        yield now


def _git(*arguments: str, given: str = "") -> bytes:
    try:
        return subprocess.run(
            ["git", *arguments], input=given.encode(), capture_output=True, check=True
        ).stdout
    except FileNotFoundError:
        raise ValueError("git is not installed; install it to see the history") from None
    except subprocess.CalledProcessError as error:
        said = " ".join(error.stderr.decode(errors="replace").split())
        raise ValueError(
            f"the history cannot be read ({said}); run this inside the git checkout of the project"
        ) from None


def _contents(names: Iterable[str]) -> Iterator[dict]:
    """Each blob as JSON, in order; one that is missing or no JSON is empty."""
    data = _git("cat-file", "--batch", given="".join(f"{name}\n" for name in names))
    at = 0
    while at < len(data):
        end = data.index(b"\n", at)
        head = data[at:end].split()
        at = end + 1
        if head[-1] == b"missing" or len(head) != 3:
            yield {}
            continue
        size = int(head[2])
        yield _plain(data[at : at + size])
        at += size + 1


def _plain(text: bytes) -> dict:
    try:
        found = json.loads(text)
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


def _now(name: str) -> dict:
    return artifacts.read_metrics(name) if artifacts.exists(f"reports/metrics/{name}.json") else {}


# ---- the figures of one revision


def _run(commit: str, date: str, subject: str, files: Mapping[str, dict]) -> Run:
    report = files["report"]
    figures = {name: _figures(found) for name, found in _dict(report, "figures").items()} or _judged(
        files["evaluate_temperature"]
    )
    figures["deposition"] = _deposition(files["compose_parts"], files["train_ilc"])
    return Run(commit, date, subject, str(_dict(report, "verdict").get("decision", "")), figures)


def _dict(data: Any, key: str) -> dict:
    found = data.get(key) if isinstance(data, dict) else None
    return found if isinstance(found, dict) else {}


def _figures(found: Any) -> dict[str, Figure]:
    return {
        key: figure
        for key, ends in (found.items() if isinstance(found, dict) else ())
        if (figure := _figure(ends))
    }


def _figure(ends: Any) -> Figure | None:
    """None where it is no figure; null is without end."""
    if not isinstance(ends, dict) or not {"median", "low", "high"} <= ends.keys():
        return None
    values = [math.inf if ends[end] is None else ends[end] for end in ("median", "low", "high")]
    return Figure(*map(float, values)) if all(isinstance(value, int | float) for value in values) else None


def _judged(metrics: dict) -> dict[str, dict[str, Figure]]:
    """Of revisions before the pages kept their figures: the scorecard's, its worst case without a band."""
    found = {}
    for name, ends in _dict(metrics, "controllers").items():
        found[name] = _figures(ends)
        worst = _dict(ends, "gap_percent").get("worst")
        if isinstance(worst, int | float):
            found[name]["worst_case_gap_percent"] = Figure(worst, worst, worst)
    return found


def _deposition(parts: dict, laws: dict) -> dict[str, Figure]:
    """Worst flow error and worst line of the composers in use, and what is left of trial 0's error after
    learning, each the worst material, in %."""
    streams = [
        stream
        for part in parts.values()
        if isinstance(part, dict)
        for stream in part.values()
        if isinstance(stream, dict)
    ]
    used = [_dict(stream, str(stream.get("chosen"))) for stream in streams]
    learned = [
        _dict(one, law).get("best_ratio")
        for one in laws.values()
        for law in ("pixels", "ours")
        if _dict(one, law)
    ]
    values = {
        "flow_error_percent": [one.get("rms_percent_of_on_off") for one in used],
        "line_volume_percent": [one.get("worst_line_volume_percent") for one in used],
        "learned_percent": [100 * ratio for ratio in learned if isinstance(ratio, int | float)],
    }
    known = {key: [float(v) for v in found if isinstance(v, int | float)] for key, found in values.items()}
    return {key: Figure(*3 * (max(found),)) for key, found in known.items() if found}
