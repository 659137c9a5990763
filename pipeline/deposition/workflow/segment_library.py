"""What segment_library does: learned trials -> trainings -> library; and the
library with its chains, to two files and back."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.deposition.extruder import Routine
from pipeline.deposition.parts import composition
from pipeline.deposition.parts.chain import Chain, Identified
from pipeline.deposition.parts.composition import Learned
from pipeline.deposition.parts.forecast import Covered, Missed
from pipeline.deposition.parts.library import Basis, Check, Library, Training
from pipeline.deposition.workflow.settings import Printer, SegmentLibrary
from pipeline.deposition.workflow.tables import LESSONS, LIBRARY
from pipeline.store import artifacts


def learned(settings: SegmentLibrary, printer: Printer, path: str, *, recorded: bool) -> Learned:
    """The library from the sampled trials in `path`; the recordings of a real machine have but one
    law. Raises ValueError where they do not suffice."""
    samples = artifacts.read_table(path, LESSONS)
    law = "pixels" if recorded else settings.law
    learned_trials = trainings(samples, law, printer.trained(), printer.nozzle_mm)
    with artifacts.about(path):
        return composition.learn(learned_trials, sample_time_s=printer.sample_time_s)


def trainings(
    samples: dict[str, np.ndarray], law: str, routines: Sequence[Routine], nozzle_mm: float
) -> list[Training]:
    """All trials of a law, by material and routine; those of the reference routine only where there is
    no other. Raises ValueError where there is none."""
    of_law = samples["law"] == law
    if not of_law.any():
        there = ", ".join(sorted(set(samples["law"])))
        do = (
            "print the commands in datasets/train_ilc/next, "
            "and put their recordings into datasets/raw/deposition"
        )
        raise ValueError(
            f"datasets/train_ilc/lessons.parquet: expected trials of law {law} (segment_library.law), "
            + (f"found {there}; name one of those" if there else f"found none yet; {do}")
        )
    by_routine = []
    for material in sorted(set(samples["material"][of_law])):
        numbers = sorted(set(samples["routine"][of_law & (samples["material"] == material)].tolist()))
        for number in [n for n in numbers if n > 0] or numbers:
            here = of_law & (samples["material"] == material) & (samples["routine"] == number)
            if here.any():
                shape = (-1, len(routines[number].r))
                u, y = (samples[name][here].reshape(shape) for name in ("command_mm", "measured_mm3_per_s"))
                by_routine.append(Training(material, nozzle_mm, routines[number], u, y))
    return by_routine


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
    rest = {
        "sample_time_s": learned.library.sample_time_s,
        "marks": {name: list(pair) for name, pair in learned.library.marks.items()},
        "materials": [_material_as_json(material) for material in learned.materials],
        "checks": [finite(check._asdict()) for check in learned.checks],
    }
    return table, rest


def _material_as_json(material: composition.Material) -> dict[str, Any]:
    values, chain = material._asdict(), material.chain._asdict()
    for name in ("left_out", "members"):
        chain[name] = [finite(one._asdict()) for one in chain[name]]
    chain |= {"extruder": finite(material.chain.extruder._asdict()), "structure": list(chain["structure"])}
    missed = finite(material.missed._asdict()) | {"by_place": material.missed.by_place.tolist()}
    return finite(values) | {
        "chain": finite(chain), "missed": missed, "covered": material.covered._asdict()
    }  # fmt: skip


def figures(rest: dict[str, Any]) -> dict[str, Any]:
    """The rest as metrics: without the chains that the trials cannot tell apart and what they missed place by
    place."""
    materials = []
    for material in rest["materials"]:
        chain = {k: v for k, v in material["chain"].items() if k not in ("left_out", "members")}
        missed = {k: v for k, v in material["missed"].items() if k != "by_place"}
        materials.append(material | {"chain": chain, "missed": missed})
    return rest | {"materials": materials}


def finite(values: dict[str, Any]) -> dict[str, Any]:
    """The same with null for what JSON has no number for."""
    return {key: finite_or_none(value) for key, value in values.items()}


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
    for material in rest["materials"]:
        chain, missed = dict(material["chain"]), dict(material["missed"])
        for name in ("left_out", "members"):
            chain[name] = tuple(_identified(one) for one in chain[name])
        chain |= {"extruder": _identified(chain["extruder"]), "structure": tuple(chain["structure"])}
        missed |= {name: math.nan for name in ("ratio", "changed") if missed[name] is None}
        missed["by_place"] = np.array(missed["by_place"], float)
        known = {
            "chain": Chain(**chain),
            "missed": Missed(**missed),
            "covered": Covered(**material["covered"]),
        }
        materials.append(composition.Material(**(material | known)))
    checks = [
        Check(**(check | {"percent": math.nan if check["percent"] is None else check["percent"]}))
        for check in rest["checks"]
    ]
    return Learned(library, tuple(materials), checks)


def _identified(values: dict[str, float | None]) -> Identified:
    return Identified(**{key: math.inf if value is None else value for key, value in values.items()})


def read_learned(table: str, rest: str) -> Learned:
    """Library and chains of segment_library, from its two files."""
    columns, chains = artifacts.read_table(table, LIBRARY), artifacts.read_json(rest)
    try:
        return restored(columns, chains)
    except (AttributeError, IndexError, KeyError, TypeError) as error:
        raise ValueError(
            f"{rest} is not what segment_library writes ({error}); "
            "make it again with ./run dvc repro segment_library"
        ) from None
