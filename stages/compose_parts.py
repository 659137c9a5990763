"""Part programs -> plunger commands and what will become of them: reads datasets/parts,
datasets/segment_library, datasets/train_ilc/models.json and, for a simulated machine, lessons.parquet there;
writes datasets/compose_parts: signals.parquet, tasks.parquet, lines.parquet, scores.parquet, prints.parquet
and conformance.json."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import stages
from pipeline.deposition.settings import ComposeParts, Printer, TrainIlc
from pipeline.deposition.tables import LESSONS, LIBRARY, LINES, PRINTS, SCORES, SIGNALS, TASKS
from pipeline.store import artifacts, params
from stages.segment_library import SegmentLibrary, wait

if TYPE_CHECKING:
    from pipeline.deposition.parts.composition import LearnedLibrary
    from pipeline.deposition.parts.evaluation import Judging
    from pipeline.deposition.parts.part import ComposedPart

# the trials of each routine that a simulated machine's parts are composed from, beside all of them
TRIALS = (2, 4, 8, 16)

# figures of control that git keeps and that runs are compared by
METRICS = (
    "*.*.*.rms_percent_of_on_off",
    "*.*.*.worst_line_volume_percent",
    "*.*.chosen",
    "*.*.forecast",
    "*.*.judged.judged",
)


def main() -> None:
    import numpy as np
    from tqdm import tqdm

    from pipeline.deposition.extruder import from_json
    from pipeline.deposition.parts import evaluation, part_report, stored
    from pipeline.recordings import part_files

    with artifacts.stage("compose_parts") as out:
        settings, printer = params.load(ComposeParts, "compose_parts"), params.load(Printer, "printer")
        training = params.load(TrainIlc, "train_ilc")
        if training.source == "recordings" and not Path("datasets/segment_library/learned.json").exists():
            return wait(out, "compose_parts", "nothing is learned yet")
        table = artifacts.read_table("datasets/segment_library/library.parquet", LIBRARY)
        learned = stored.restore(table, artifacts.read_json("datasets/segment_library/learned.json"))
        models = artifacts.read_json("datasets/train_ilc/models.json")
        folder, parts, refused = Path("datasets/parts"), {}, {}
        for path in part_files.part_programs(folder):
            try:
                parts[path] = compose_part(path, learned, printer, settings)
            except ValueError as error:
                refused[path.stem] = str(error)
        if not parts:
            first = next(iter(refused.values()))
            raise ValueError(
                f"{folder}: none of {len(refused)} part programs can be composed; the first: {first}"
            )
        judging = evaluation.Judging(
            nominals={name: from_json(model["nominal"]) for name, model in models.items()},
            plants={name: from_json(model["plant"]) for name, model in models.items() if "plant" in model},
            laws=training.laws(printer), noise=training.shares, updates=settings.full_part_updates,
            bead_area_mm2=printer.bead_area_mm2, shortest_s=settings.shortest_s,
        )  # fmt: skip
        rng = np.random.default_rng(settings.seed)
        scored = [
            (part, evaluation.evaluate(learned, part.composed, part.conformance.lines, judging, rng))
            for part in tqdm(parts.values(), desc="compose_parts: parts", mininterval=2)
        ]
        prints = [part_report.print_rows(part, course) for part, (_, course) in scored]
        if judging.plants:
            prints += learn_from_fewer(parts, learned, printer, settings, judging)
        scored = [(part, scores) for part, (scores, _) in scored]
        rows = part_report.rows(scored) | {"prints": part_report.stacked(prints)}
        schemas = {"signals": SIGNALS, "scores": SCORES, "tasks": TASKS, "lines": LINES, "prints": PRINTS}
        for name, schema in schemas.items():
            artifacts.write_table(out / f"{name}.parquet", schema, rows[name])
        reports = {part.name: report_with_measured(part, folder) for part in parts.values()}
        reports |= {name: {"refused": why} for name, why in refused.items()}
        artifacts.write_json(out / "conformance.json", reports)
        artifacts.write_metrics("compose_parts", part_report.figures(scored) | {"refused": refused}, METRICS)


def compose_part(
    path: Path,
    learned: LearnedLibrary,
    printer: Printer,
    settings: ComposeParts,
    *,
    filament_mm: float | None = None,
    extruder: str = "",
    declared_bead: bool = False,
) -> ComposedPart:
    """A part program, composed; with the diameter of what E pushes, what drives the extrusion, and the
    declared bead instead of E, if a person requests these. Raises ValueError naming the file, and the line if
    there is one."""
    from pipeline.deposition.parts import extrusion, part
    from pipeline.recordings.part_files import read_part_program

    learned_s = learned.library.sample_time_s
    if learned_s != printer.sample_time_s:
        raise ValueError(
            f"params.yaml: printer.sample_time_s is {printer.sample_time_s:g} but the library was learned "
            f"at {learned_s:g} s; learn it again with ./run dvc repro"
        )
    data = read_part_program(path)
    with artifacts.about(path):
        program = part.parse(data, extruder=extruder)
        del data
        declared_mm = printer.filament_mm
        extruded = extrusion.wanted(
            program, bead_area_mm2=printer.bead_area_mm2, asked_mm=filament_mm,
            declared_mm={one.tool: declared_mm for one in printer.materials if declared_mm is not None},
            declared_bead=declared_bead,
        )  # fmt: skip
        return part.compose(
            path.stem, program, extruded, learned, settings.of_part(printer), printer.gantry,
            materials={one.tool: one.name for one in printer.materials},
            longest_ramp_s=printer.longest_ramp_s, shortest_s=settings.shortest_s,
            largest_error_percent=settings.largest_error_percent,
        )  # fmt: skip


def learn_from_fewer(
    parts: dict[Path, ComposedPart], learned: LearnedLibrary, printer: Printer, settings: ComposeParts,
    judging: Judging,
) -> list[dict[str, list]]:  # fmt: skip
    """Rows of the true errors of each part, as the first TRIALS of every routine alone would have it composed
    and as `learned` from all of them has it. One part at a time is held beside `parts`."""
    from tqdm import tqdm

    from pipeline.deposition.parts import composition, evaluation, part_report, stored

    law, path = params.load(SegmentLibrary, "segment_library").law, "datasets/train_ilc/lessons.parquet"
    samples = artifacts.read_table(path, LESSONS)
    trainings = stored.trainings(samples, law, printer.training_routines(), printer.nozzle_mm)
    del samples
    trials, found = max(len(one.u) for one in trainings), []
    for count in tqdm([*(n for n in TRIALS if n < trials), trials], desc="compose_parts: from fewer trials"):
        fewer = [one._replace(u=one.u[:count], y=one.y[:count]) for one in trainings]
        then = learned
        if count < trials:
            try:
                then = composition.learn(fewer, sample_time_s=printer.sample_time_s)
            except ValueError:
                continue  # of so few trials nothing is learned
        for path, known in parts.items():
            part = known if then is learned else compose_part(path, then, printer, settings)
            prints = [
                sum(len(one.u) for one in fewer if one.material == stream.material)
                for stream in part.composed.streams
            ]
            learning = evaluation.learned_from(then, part.composed, judging, prints)
            found.append(part_report.print_rows(part, learning))
    return found


def report_with_measured(part: ComposedPart, folder: Path) -> dict[str, Any]:
    """The conformance report of a part, with measured_percent beside the forecast of each material whose
    print was measured."""
    from pipeline.deposition.parts import forecast, part_report
    from pipeline.recordings import part_files

    report = part_report.report(part)
    for stream in part.composed.streams:
        path = part_files.print_path(folder, part.name, stream.material)
        if path:
            y, _ = part_files.read_measured(path, len(stream.r), part.composed.sample_time_s)
            with artifacts.about(path):
                percent = forecast.measured_percent(y, stream.on_off, stream.r)
            report["forecast"][stream.material]["measured_percent"] = percent
    return report


if __name__ == "__main__":
    stages.run(main, "compose_parts", loop="deposition")
