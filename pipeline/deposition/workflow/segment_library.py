"""What segment_library does: learned trials -> trainings -> library; and the
library with its chains, to two files and back."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.deposition import composition
from pipeline.deposition.chain import Chain
from pipeline.deposition.composition import Learned
from pipeline.deposition.extruder import Extruder, Routine
from pipeline.deposition.library import Basis, Check, Library, Training
from pipeline.deposition.workflow.settings import Printer, SegmentLibrary
from pipeline.deposition.workflow.tables import LESSONS, LIBRARY
from pipeline.store import artifacts


def learned(p: SegmentLibrary, printer: Printer, path: str, *, filmed: bool) -> Learned:
    """The library from the lessons in `path`; what was filmed on a real machine has but one
    law. Raises ValueError where they do not suffice."""
    lessons = artifacts.read_table(path, LESSONS)
    found = trainings(lessons, "pixels" if filmed else p.law, printer.trained(), printer.nozzle_mm)
    with artifacts.about(path):
        return composition.learn(found, sample_time_s=printer.sample_time_s)


def trainings(
    lessons: dict[str, np.ndarray], law: str, routines: Sequence[Routine], nozzle_mm: float
) -> list[Training]:
    """All trials of a law, by material and routine; those of the reference routine only where there is
    no other. Raises ValueError where there is none."""
    mine = lessons["law"] == law
    if not mine.any():
        there = ", ".join(sorted(set(lessons["law"])))
        do = "print the commands in datasets/train_ilc/next, and put their recordings into datasets/raw/deposition"
        raise ValueError(
            f"datasets/train_ilc/lessons.parquet: expected trials of law {law} (segment_library.law), "
            + (f"found {there}; name one of those" if there else f"found none yet; {do}")
        )
    found = []
    for material in sorted(set(lessons["material"][mine])):
        numbers = sorted(set(lessons["routine"][mine & (lessons["material"] == material)].tolist()))
        for number in [n for n in numbers if n > 0] or numbers:
            here = mine & (lessons["material"] == material) & (lessons["routine"] == number)
            if here.any():
                shape = (-1, len(routines[number].r))
                u, y = (lessons[name][here].reshape(shape) for name in ("command_mm", "measured_mm3_per_s"))
                found.append(Training(material, nozzle_mm, routines[number], u, y))
    return found


def stored(learned: Learned) -> tuple[dict[str, list], dict[str, Any]]:
    """Columns of the library's table, and the rest as JSON."""
    rows = [
        (b.task, b.material, b.nozzle_mm, b.speed, b.pause_s, b.lead, len(b.signal), b.signal)
        for b in learned.library.columns
    ]
    table = {
        column.name: list(values)
        for column, values in zip(LIBRARY.columns, zip(*rows, strict=True), strict=True)
    }
    materials = [
        known._asdict()
        | {
            "chain": known.chain._asdict()
            | {"extruder": {k: finite_or_none(v) for k, v in known.chain.extruder._asdict().items()}}
        }
        for known in learned.materials
    ]
    rest = {
        "sample_time_s": learned.library.sample_time_s,
        "marks": {name: list(pair) for name, pair in learned.library.marks.items()},
        "materials": [
            {key: finite_or_none(value) for key, value in known.items() if key != "chain"}
            | {"chain": {k: finite_or_none(v) for k, v in known["chain"].items()}}
            for known in materials
        ],
        "checks": [
            {key: finite_or_none(value) for key, value in check._asdict().items()} for check in learned.checks
        ],
    }
    return table, rest


def finite_or_none(value: Any) -> Any:
    return None if isinstance(value, float | np.floating) and not math.isfinite(value) else value


def restored(table: dict[str, np.ndarray], rest: dict[str, Any]) -> Learned:
    """What `stored` made."""
    names = ("task", "material", "nozzle_mm", "speed_mm_per_s", "pause_s", "lead", "signal_mm")
    columns = tuple(
        Basis(
            str(task),
            str(material),
            float(nozzle),
            float(speed),
            float(pause),
            int(lead),
            np.array(signal, float),
        )
        for task, material, nozzle, speed, pause, lead, signal in zip(
            *(table[name] for name in names), strict=True
        )
    )
    library = Library(
        columns, rest["sample_time_s"], {name: (pair[0], pair[1]) for name, pair in rest["marks"].items()}
    )
    materials = []
    for known in rest["materials"]:
        extruder = known["chain"]["extruder"]
        extruder = Extruder(**{key: math.inf if value is None else value for key, value in extruder.items()})
        chain = Chain(**(known["chain"] | {"extruder": extruder}))
        materials.append(composition.Material(**(known | {"chain": chain})))
    checks = [
        Check(**(check | {"percent": math.nan if check["percent"] is None else check["percent"]}))
        for check in rest["checks"]
    ]
    return Learned(library, tuple(materials), checks)


def read_learned(table: str, rest: str) -> Learned:
    """Library and chains of segment_library, from its two files."""
    columns, known = artifacts.read_table(table, LIBRARY), artifacts.read_json(rest)
    try:
        return restored(columns, known)
    except (AttributeError, IndexError, KeyError, TypeError) as error:
        raise ValueError(
            f"{rest} is not what segment_library writes ({error}); "
            "make it again with ./run dvc repro segment_library"
        ) from None
