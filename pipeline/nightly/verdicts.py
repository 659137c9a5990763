"""The verdict of each loop that the night obeys: that of the run, with the drift of tonight and with the
controllers that are in production."""

from collections.abc import Mapping

from pipeline.nightly import judge
from pipeline.nightly.processes import dvc
from pipeline.nightly.records import Night
from pipeline.nightly.remembered import METRICS
from pipeline.nightly.settings import Nightly
from pipeline.store import artifacts
from pipeline.verdict import night as verdict_night
from pipeline.verdict import verdict
from pipeline.verdict.files import read_evidence
from pipeline.verdict.verdict import Verdict

STORED = "datasets/verdict"
REPORT = "datasets/report/figures.json"


def read_verdicts(settings: Nightly, night: Night) -> dict[str, Verdict]:
    """The verdict of each loop that has a page, as pages say it. A loop that is judged by a file of costs has
    none: its rules are the guards of that file. If nightly.holdout.controller names a controller, the
    temperature loop's verdict is about that one."""
    loops = [name for name, loop in settings.loops.items() if loop.judge != "cases"]
    if not loops:
        return {}
    evidence = read_evidence(STORED)
    stored, named = verdict.read(STORED), settings.holdout.controller
    tonight = artifacts.read_json(METRICS) if artifacts.exists(METRICS) else None
    by_loop = verdict_night.verdicts(evidence, stored, tonight)
    _make_pages_agree(by_loop, night)
    if named != judge.PAGE:
        by_loop = verdict_night.verdicts(evidence, stored, tonight, named=named)
    if lacking := [name for name in loops if name not in by_loop]:
        raise ValueError(
            f"{STORED}/{lacking[0]}.json: expected the verdict of this run, found none; "
            "run ./run dvc repro verdict, or switch the loop off in section loops"
        )
    return {name: by_loop[name] for name in loops}


def _make_pages_agree(pages: Mapping[str, Verdict], night: Night) -> None:
    """Makes the pages anew if they were made before drift or production changed, so that they say what the
    night goes by."""
    shown = (artifacts.read_json(REPORT).get("verdicts") or {}) if artifacts.exists(REPORT) else None
    if shown is None or all(shown.get(loop) == verdict.metrics() for loop, verdict in pages.items()):
        return
    try:
        dvc("repro", "--single-item", "--force", "report")
    except ValueError as error:
        night.notes.append(f"the pages are not of tonight ({error}); run ./run dvc repro --force report")
