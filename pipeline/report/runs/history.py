"""Revisions of reports/metrics in git -> the figures of the pages, revision by revision.

One `git cat-file --batch` reads them all. Figures of earlier versions come under today's names.
"""

import json
import math
import subprocess
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

from pipeline.store import artifacts, renamed

FILES = ("report", "evaluate_temperature", "compose_parts", "train_ilc")
# commit, date and subject of a revision; no subject holds the byte between them
FORMAT = "%H%x00%cI%x00%s"


class Figure(NamedTuple):
    """A median and the ends of its 90 % band; infinite if a run never settles."""

    value: float
    low: float
    high: float


class Revision(NamedTuple):
    """One revision: commit (empty for files that are not committed), date, subject, the verdict's sentence,
    {contestant: {key: figure}}, and who won; runs before the comparison as deployed have other names."""

    commit: str
    date: str
    subject: str
    verdict: str
    figures: Mapping[str, Mapping[str, Figure]]
    winner: str = ""


def revisions(most: int) -> Iterator[Revision]:
    """The last `most` revisions that touched the metrics, oldest first, then the files as they are if they
    differ. Raises ValueError without git, and without a revision."""
    log = _git("log", f"--max-count={most}", f"--format={FORMAT}", "--", "reports/metrics").decode(
        errors="replace"
    )
    commits = [line.split("\0", 2) for line in log.splitlines() if line][::-1]
    if not commits:
        raise ValueError(
            "reports/metrics: git has no revision of it; commit the figures of a run first (git "
            "add reports/metrics)"
        )
    blobs = [f"{commit}:reports/metrics/{name}.json" for commit, *_ in commits for name in FILES]
    contents = _contents(blobs)
    last: Revision | None = None
    for commit, date, subject in commits:
        last = _revision(commit, date, subject, {name: next(contents) for name in FILES})
        yield last
    now = _revision("", "", "not committed", {name: _now(name) for name in FILES})
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
        message = " ".join(error.stderr.decode(errors="replace").split())
        raise ValueError(
            f"the history cannot be read ({message}); run this inside the git checkout of the project"
        ) from None


def _contents(names: Iterable[str]) -> Iterator[dict]:
    """Each blob as JSON, in order; a blob that is missing or no JSON is empty."""
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
        metrics = json.loads(text)
    except ValueError:
        return {}
    return metrics if isinstance(metrics, dict) else {}


def _now(name: str) -> dict:
    return artifacts.read_metrics(name) if artifacts.exists(f"reports/metrics/{name}.json") else {}


# ---- the figures of one revision


def _revision(commit: str, date: str, subject: str, files: Mapping[str, dict]) -> Revision:
    metrics = renamed.metrics(files)
    report = metrics["report"]
    figures = {name: _figures(ends) for name, ends in _dict(report, "figures").items()}
    figures = figures or _judged(metrics["evaluate_temperature"])
    figures["deposition"] = _deposition(metrics["compose_parts"], metrics["train_ilc"])
    verdict = _dict(report, "verdict")
    return Revision(
        commit, date, subject, str(verdict.get("decision", "")), figures, str(verdict.get("winner") or "")
    )


def _dict(data: Any, key: str) -> dict:
    section = data.get(key) if isinstance(data, dict) else None
    return section if isinstance(section, dict) else {}


def _figures(bands: Any) -> dict[str, Figure]:
    """{key: figure} of {key: median, low and high}; what is no figure is left out."""
    items = bands.items() if isinstance(bands, dict) else ()
    return {key: figure for key, ends in items if (figure := _figure(ends))}


def _figure(ends: Any) -> Figure | None:
    """None for data that are no figure; null is without end."""
    if not isinstance(ends, dict) or not {"median", "low", "high"} <= ends.keys():
        return None
    values = [math.inf if ends[end] is None else ends[end] for end in ("median", "low", "high")]
    return Figure(*map(float, values)) if all(isinstance(value, int | float) for value in values) else None


def _judged(metrics: dict) -> dict[str, dict[str, Figure]]:
    """The scorecard's figures, for revisions before the pages kept their figures. The worst case has no
    band."""
    figures = {name: _contestant(own) for name, own in _dict(metrics, "contestants").items()}
    for name, ends in _dict(metrics, "controllers").items():
        figures[name] = _figures(ends)
        worst = _dict(ends, "gap_percent").get("worst")
        if isinstance(worst, int | float):
            figures[name]["worst_case_gap_percent"] = Figure(worst, worst, worst)
    return figures


def _contestant(own: Any) -> dict[str, Figure]:
    """The quantiles of one contestant with their bands."""
    quantiles = {
        key: {"median": ends.get("q90"), "low": ends.get("low"), "high": ends.get("high")}
        for key, ends in (own.items() if isinstance(own, dict) else ())
        if isinstance(ends, dict) and "q90" in ends
    }
    return _figures(quantiles)


def _deposition(parts: dict, laws: dict) -> dict[str, Figure]:
    """Worst flow error and worst line of the composers in use, and the share of trial 0's error that is left
    after learning, in %. Each is the worst material's."""
    streams = [
        stream
        for part in parts.values()
        if isinstance(part, dict)
        for stream in part.values()
        if isinstance(stream, dict)
    ]
    used = [_dict(stream, str(stream.get("chosen"))) for stream in streams]
    learned = [
        _dict(material, law).get("last_ratio", _dict(material, law).get("best_ratio"))
        for material in laws.values()
        for law in ("pixels", "model_inverse")
        if _dict(material, law)
    ]
    values = {
        "flow_error_percent": [composer.get("rms_percent_of_on_off") for composer in used],
        "line_volume_percent": [composer.get("worst_line_volume_percent") for composer in used],
        "learned_percent": [100 * ratio for ratio in learned if isinstance(ratio, int | float)],
    }
    numbers = {
        key: [float(v) for v in column if isinstance(v, int | float)] for key, column in values.items()
    }
    return {key: Figure(*3 * (max(column),)) for key, column in numbers.items() if column}
