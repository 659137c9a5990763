"""The verdict of each loop that the night obeys: that of the run, with the drift of tonight and with the
controllers that are in production."""

from collections.abc import Mapping

from pipeline.nightly import judge
from pipeline.nightly.processes import STATE, dvc
from pipeline.nightly.records import Night
from pipeline.nightly.settings import Nightly
from pipeline.report.shared import headline
from pipeline.report.shared.sources import Declared, Sources, collect
from pipeline.report.shared.verdict import ReportRules, Verdict
from pipeline.report.temperature.judgement import judgement
from pipeline.store import artifacts, params
from pipeline.temperature.workflow.settings import Plant

# stages whose metrics the pages show; those before `learn_kernel` have no tables there
MEASURED = (
    "probe_machine", "generate_probing", "learn_kernel", "ingest", "identify_plant", "tune_weights",
    "evaluate_temperature", "train_ilc", "segment_library", "compose_parts",
    "train_classifier", "train_agent", "evaluate_setpoint", "export_controllers",
)  # fmt: skip
REPORT = "reports/metrics/report.json"
ACCEPTED = "reports/accepted.json"


def read_verdicts(settings: Nightly, night: Night) -> tuple[dict[str, Verdict], Night]:
    """The verdict of each loop that has a page, from the files that the pages are made of; the night with a
    note where the pages are of other files. A loop that is judged by a file of costs has none: its rules are
    the guards of that file. Where nightly.holdout.controller names a contestant, the temperature loop's
    verdict is about that one."""
    loops = [name for name, loop in settings.loops.items() if loop.judge != "cases"]
    if not loops:
        return {}, night
    sources, named = page_sources(), settings.holdout.controller
    each = headline.verdicts(sources, judgement(sources))
    night = _make_pages_agree(each, night)
    if named != judge.PAGE:
        each = headline.verdicts(sources, judgement(sources, named=named))
    return {name: each[name] for name in loops}, night


def page_sources() -> Sources:
    """What the stage `report` reads."""
    declared = Declared(params.load(ReportRules, "report"), params.load(Plant, "plant"), params.read())
    return collect(
        declared,
        {stage: f"reports/metrics/{stage}.json" for stage in MEASURED},
        {stage: f"datasets/{stage}" for stage in MEASURED},
        ACCEPTED,
        (),
    )


def _make_pages_agree(pages: Mapping[str, Verdict], night: Night) -> Night:
    """Makes the pages anew where they were made before drift or production changed, so that they say what the
    night goes by."""
    if not artifacts.exists(REPORT):
        return night
    shown = artifacts.read_json(REPORT).get("verdicts") or {}
    if all(shown.get(loop) == verdict.metrics() for loop, verdict in pages.items()):
        return night
    try:
        dvc("repro", "--single-item", "--force", "report", log=STATE / "logs" / f"{night.run}-report.log")
    except ValueError as error:
        return night.noted(f"the pages are not of tonight ({error}); run ./run dvc repro --force report")
    return night
