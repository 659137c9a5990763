"""Converts the results of learning to the columns of a table and to JSON, and back."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.deposition.extruder import Routine
from pipeline.deposition.parts.chain import Chain, IdentifiedExtruder
from pipeline.deposition.parts.composition import LearnedLibrary, LearnedMaterial
from pipeline.deposition.parts.forecast import Covered, Missed
from pipeline.deposition.parts.library import Basis, Check, Library, TooFewTrials, Training
from pipeline.deposition.parts.pressure_advance import PressureAdvance, TunedAdvance, slicer_settings

COLUMNS = ("task", "material", "nozzle_mm", "speed_mm_per_s", "pause_s", "lead", "length", "signal_mm")


def to_table(library: Library) -> dict[str, list]:
    """Returns the columns of library.parquet, a row for each basis signal."""
    rows = [
        (b.task, b.material, b.nozzle_mm, b.speed, b.pause_s, b.lead, len(b.signal), b.signal)
        for b in library.columns
    ]
    return {name: list(values) for name, values in zip(COLUMNS, zip(*rows, strict=True), strict=True)}


def to_json(learned: LearnedLibrary) -> dict[str, Any]:
    """Returns everything except the basis signals, as learned.json."""
    return {
        "sample_time_s": learned.library.sample_time_s,
        "marks": {name: list(pair) for name, pair in learned.library.marks.items()},
        "materials": [_material_to_json(material) for material in learned.materials],
        "slicer": {
            one.material: slicer_settings(one.advances["pressure_advance"], one.on_off_gain)
            for one in learned.materials
        },
        "checks": [finite(check._asdict()) for check in learned.checks],
    }


def _material_to_json(material: LearnedMaterial) -> dict[str, Any]:
    values, chain = material._asdict(), material.chain._asdict()
    for name in ("left_out", "members"):
        chain[name] = [finite(one._asdict()) for one in chain[name]]
    chain |= {"extruder": finite(material.chain.extruder._asdict()), "structure": list(chain["structure"])}
    missed = finite(material.missed._asdict()) | {"by_place": material.missed.by_place.tolist()}
    return finite(values) | {
        "chain": finite(chain), "missed": missed, "covered": material.covered._asdict(),
        "advances": {
            name: {end: one._asdict() for end, one in tuned._asdict().items()}
            for name, tuned in material.advances.items()
        },
    }  # fmt: skip


def finite(values: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the same values, with null for numbers that JSON cannot hold."""
    return {key: finite_or_none(value) for key, value in values.items()}


def finite_or_none(value: Any) -> Any:
    """Returns None for NaN and infinity, else the value."""
    return None if isinstance(value, float | np.floating) and not math.isfinite(value) else value


def restore(table: Mapping[str, np.ndarray], rest: Mapping[str, Any]) -> LearnedLibrary:
    """Returns the library that `to_table` and `to_json` wrote. Raises ValueError for other JSON."""
    names = [name for name in COLUMNS if name != "length"]
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
    try:
        marks = {name: (first, last) for name, (first, last) in rest["marks"].items()}
        materials = tuple(_material(values) for values in rest["materials"])
        checks = [Check(**check | {"percent": _number(check["percent"])}) for check in rest["checks"]]
        return LearnedLibrary(Library(columns, rest["sample_time_s"], marks), materials, checks)
    except (AttributeError, KeyError, TypeError) as error:
        raise ValueError(
            f"learned.json is not what segment_library writes ({error}); "
            "make it again with ./run dvc repro segment_library"
        ) from None


def _material(values: Mapping[str, Any]) -> LearnedMaterial:
    chain, missed = dict(values["chain"]), dict(values["missed"])
    for name in ("left_out", "members"):
        chain[name] = tuple(_extruder(one) for one in chain[name])
    chain |= {"extruder": _extruder(chain["extruder"]), "structure": tuple(chain["structure"])}
    missed |= {name: _number(missed[name]) for name in missed if name.endswith("percent")}
    missed["by_place"] = np.array(missed["by_place"], float)
    known: dict[str, Any] = dict(values)
    known |= {"chain": Chain(**chain), "missed": Missed(**missed), "covered": Covered(**values["covered"])}
    known["advances"] = {
        name: TunedAdvance(**{end: PressureAdvance(**one) for end, one in tuned.items()})
        for name, tuned in values["advances"].items()
    }
    return LearnedMaterial(**known)


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def _extruder(values: Mapping[str, float | None]) -> IdentifiedExtruder:
    return IdentifiedExtruder(**{key: math.inf if value is None else value for key, value in values.items()})


def trainings(
    samples: Mapping[str, np.ndarray], law: str, routines: Sequence[Routine], nozzle_mm: float
) -> list[Training]:
    """Returns all trials of a law, by material and routine, from the columns of lessons.parquet. Those of the
    reference routine are used only if there is no other. Raises TooFewTrials if there is none."""
    of_law = samples["law"] == law
    if not of_law.any():
        there = ", ".join(sorted(set(samples["law"])))
        do = (
            "print the commands in datasets/train_ilc/next, "
            "and put their recordings into datasets/raw/deposition"
        )
        raise TooFewTrials(
            f"expected trials of law {law} (segment_library.law), "
            + (f"found {there}; name one of those" if there else f"found none yet; {do}")
        )
    by_routine = []
    for material in sorted(set(samples["material"][of_law])):
        of_material = of_law & (samples["material"] == material)
        numbers = sorted(set(samples["routine"][of_material].tolist()))
        for number in [n for n in numbers if n > 0] or numbers:
            here, shape = of_material & (samples["routine"] == number), (-1, len(routines[number].r))
            u, y = (samples[name][here].reshape(shape) for name in ("command_mm", "measured_mm3_per_s"))
            by_routine.append(Training(material, nozzle_mm, routines[number], u, y))
    return by_routine
