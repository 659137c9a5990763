"""The stages and what each reads of the others, drawn with what is the same
as in the accepted run, and what was made anew."""

from collections.abc import Mapping
from typing import NamedTuple

from markupsafe import Markup

from pipeline.report.shared import page
from pipeline.report.shared.digits import count
from pipeline.report.shared.sources import Sources
from pipeline.report.shared.verdict import Missing

# stage -> stages that it reads, in the order of their lanes; tests hold it against dvc.yaml
READS: dict[str, tuple[str, ...]] = {
    "probe_machine": (),
    "ingest": ("probe_machine",),
    "identify_plant": ("ingest",),
    "generate_probing": ("ingest", "identify_plant"),
    "learn_kernel": ("ingest",),
    "tune_weights": ("identify_plant", "ingest", "learn_kernel"),
    "evaluate_temperature": ("ingest", "identify_plant", "learn_kernel", "tune_weights"),
    "train_ilc": (),
    "segment_library": ("train_ilc",),
    "compose_parts": ("segment_library", "train_ilc"),
    "render_frames": (),
    "train_classifier": ("render_frames",),
    "train_agent": ("train_classifier",),
    "evaluate_setpoint": ("train_classifier", "train_agent"),
    "export_controllers": (
        "evaluate_temperature",
        "ingest",
        "identify_plant",
        "learn_kernel",
        "tune_weights",
        "train_classifier",
        "train_agent",
        "evaluate_setpoint",
        "compose_parts",
    ),
}
SAME, CHANGED, GONE, FIRST = "unchanged", "made anew", "not there", "first run"
OTHER = "other machine"
CSS = {SAME: "same", CHANGED: "anew", GONE: "lost", FIRST: "same", OTHER: "anew"}
# stages of the loop whose machine the accepted run may not share
TEMPERATURE = (
    "probe_machine",
    "ingest",
    "identify_plant",
    "generate_probing",
    "tune_weights",
    "learn_kernel",
    "evaluate_temperature",
)
WIDE, TALL, ACROSS, DOWN = 170, 40, 46, 18


class Workflow(NamedTuple):
    """Finding, picture, and what both are from."""

    finding: str
    picture: Markup
    origin: Markup


def figure(sources: Sources) -> Workflow:
    """The stages, and which of them were made anew."""
    states = {stage: state(sources, stage) for stage in READS}
    groups = [
        (word, [stage for stage, is_now in states.items() if is_now == word])
        for word in (CHANGED, OTHER, GONE, SAME, FIRST)
    ]
    listed = "; ".join(f"{word}: {', '.join(names)}" for word, names in groups if names)
    alt = f"{len(states)} stages. {listed[:1].upper()}{listed[1:]}"
    return Workflow(_finding(states), _drawn(states, alt), page.origin(sources.source("accepted", *READS)))


def state(sources: Sources, stage: str) -> str:
    """Unchanged: figures and all artifacts that the pages read are the same to
    the byte, whether they were reused or made again."""
    if isinstance(sources.metrics.get(stage), Missing) or any(
        path.startswith(f"datasets/{stage}/") for path in sources.absent
    ):
        return GONE
    before = sources.accepted
    if before is None or isinstance(before, Missing):
        return FIRST
    if sources.another_machine and stage in TEMPERATURE:
        return OTHER
    mine = {
        path: source.sha256 for path, source in sources.read.items() if path.startswith(f"datasets/{stage}/")
    }
    hashes = before.get("hashes") or {}
    equal = all(hashes.get(path) == value for path, value in mine.items())
    return (
        SAME if equal and (before.get("metrics") or {}).get(stage) == sources.metrics.get(stage) else CHANGED
    )


def _finding(states: Mapping[str, str]) -> str:
    names = [stage for stage, word in states.items() if word == CHANGED]
    same = sum(word == SAME for word in states.values())
    if FIRST in states.values():
        return "No run was accepted yet: nothing says what is new."
    if OTHER in states.values() and not names:
        return "The accepted run is of another machine: nothing of the temperature loop is compared with it."
    if not names:
        return f"The results of {same} of {len(states)} stages are those of the accepted run, to the byte."
    # what was made anew although nothing that it reads was: there the
    # cause is in its own inputs, parameters or code
    first = [stage for stage in names if not any(states[read] == CHANGED for read in READS[stage])]
    return (
        f"{count(same, 'stage').capitalize()} of {len(states)} gave what they gave in the accepted run, to "
        f"the byte. New results begin at {', '.join(first)}."
    )


# ---- the drawing


def reduced(reads: Mapping[str, tuple[str, ...]]) -> dict[str, list[str]]:
    """The arrows that cannot be left out: none to what another of its sources reads already."""

    def all_of(stage: str) -> set[str]:
        return set(reads[stage]).union(*(all_of(read) for read in reads[stage]))

    return {
        stage: [read for read in reads[stage] if not any(read in all_of(other) for other in reads[stage])]
        for stage in reads
    }


def places(reads: Mapping[str, tuple[str, ...]]) -> dict[str, tuple[int, int]]:
    """(column, lane): one column right of the last stage that it reads; in the
    lane of the first, or in the next one that is free."""
    taken: dict[str, tuple[int, int]] = {}
    for stage, sources in reads.items():
        column = max((taken[read][0] + 1 for read in sources), default=0)
        lane = taken[sources[0]][1] if sources else max((lane for _, lane in taken.values()), default=-1) + 1
        while (column, lane) in taken.values():
            lane += 1
        taken[stage] = column, lane
    return taken


def _drawn(states: Mapping[str, str], alt: str) -> Markup:
    at = places(READS)
    width = (max(column for column, _ in at.values()) + 1) * (WIDE + ACROSS) - ACROSS + 4
    height = (max(lane for _, lane in at.values()) + 1) * (TALL + DOWN) - DOWN + 4
    left = {stage: 2 + column * (WIDE + ACROSS) for stage, (column, _) in at.items()}
    top = {stage: 2 + lane * (TALL + DOWN) for stage, (_, lane) in at.items()}
    arrows = [
        # straight on in its own lane, then across to the other's
        Markup('<path class="arrow" d="M{} {}H{}C{} {} {} {} {} {}"/>').format(
            left[read] + WIDE, top[read] + TALL // 2, left[stage] - ACROSS,
            left[stage] - ACROSS // 2, top[read] + TALL // 2, left[stage] - ACROSS // 2,
            top[stage] + TALL // 2,
            left[stage], top[stage] + TALL // 2,
        )
        for stage, sources in reduced(READS).items()
        for read in sources
    ]  # fmt: skip
    boxes = [
        Markup(
            '<g class="{}"><rect x="{}" y="{}" width="{}" height="{}" rx="2"/><text x="{}" '
            'y="{}">{}</text><text x="{}" y="{}">{}</text></g>'
        ).format(
            CSS[word],
            left[stage],
            top[stage],
            WIDE,
            TALL,
            left[stage] + 10,
            top[stage] + 17,
            stage,
            left[stage] + 10,
            top[stage] + 32,
            word,
        )
        for stage, word in states.items()
    ]
    return Markup(
        '<svg class="plot dag" style="--w:{}px" viewBox="0 0 {} {}" role="img" aria-label="{}">{}{}</svg>'
    ).format(width, width, height, alt, Markup("").join(arrows), Markup("").join(boxes))
