"""Revisions of reports/metrics in git -> the figures of the pages, revision by revision.

Figures of earlier versions come under today's names.
"""

import json
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from pipeline.report.runs import stored
from pipeline.report.runs.figures import FILES, contestant, deposition, figures, section, setpoint, today
from pipeline.report.shared.verdict import Figure
from pipeline.store import artifacts


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
    commits = stored.commits(most, stored.METRICS)
    if not commits:
        raise ValueError(
            "reports/metrics: git has no revision of it; commit the figures of a run first (git "
            "add reports/metrics)"
        )
    places = [f"{commit.hash}:{stored.METRICS}/{name}.json" for commit in commits for name in FILES]
    objects = stored.objects(places)
    texts = dict(stored.contents(objects))
    found = iter(objects)
    last: Revision | None = None
    for commit in commits:
        files = {name: plain(texts.get(next(found), b"")) for name in FILES}
        last = _revision(commit.hash, commit.date, commit.subject, files)
        yield last
    now = _revision("", "", "not committed", {name: now_of(name) for name in FILES})
    if last and (now.figures, now.verdict) != (last.figures, last.verdict):
        yield now


def plain(text: bytes) -> dict:
    """A file as JSON; {} where it is none."""
    try:
        metrics = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return metrics if isinstance(metrics, dict) else {}


def now_of(name: str) -> dict:
    """Metrics as they lie there; {} where they do not, or are damaged."""
    path = f"{stored.METRICS}/{name}.json"
    try:
        return artifacts.read_metrics(name) if artifacts.exists(path) else {}
    except (ValueError, OSError):
        return {}


# ---- the figures of one revision


def _revision(commit: str, date: str, subject: str, files: Mapping[str, dict]) -> Revision:
    metrics = today(files)
    report = section(metrics, "report")
    found = {str(name): figures(ends) for name, ends in section(report, "figures").items()}
    found = found or _judged(section(metrics, "evaluate_temperature"))
    found["deposition"] = deposition(section(metrics, "compose_parts"), section(metrics, "train_ilc"))
    found["setpoint"] = setpoint(section(metrics, "evaluate_setpoint"), section(metrics, "train_classifier"))
    verdict = section(report, "verdict")
    decision, winner = str(verdict.get("decision", "")), str(verdict.get("winner") or "")
    return Revision(commit, date, subject, decision, found, winner)


def _judged(metrics: dict) -> dict[str, dict[str, Figure]]:
    """The scorecard's figures, for revisions before the pages kept their figures. The worst case has no
    band."""
    found: dict[str, Any] = {name: contestant(own) for name, own in section(metrics, "contestants").items()}
    for name, ends in section(metrics, "controllers").items():
        found[name] = figures(ends)
        worst = section(ends, "gap_percent").get("worst")
        if isinstance(worst, int | float):
            found[name]["worst_case_gap_percent"] = Figure(worst, worst, worst)
    return found
