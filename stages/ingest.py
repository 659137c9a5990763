"""Recordings -> one table: reads datasets/probe_machine (simulated) or every file below
datasets/raw/temperature (recordings); writes datasets/ingest/record.parquet, quality.parquet,
set_points.parquet if the mapping has set-points, and printer_pid.json. Zones whose record never moves are
left out of record and set-points. A recording that was processed before, with the same parameters and code,
is taken from a memo; a broken one is quarantined with its reason."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

import stages
from pipeline.store import artifacts, params
from pipeline.store.params import Execution, Mapped, Section
from pipeline.temperature import tables
from pipeline.temperature.settings import Plant, check_output_limits

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import numpy as np

    from pipeline.recordings.formats import Source
    from pipeline.recordings.recording_folders import RecordingWish

# a zone that is left out of the design
STILL = "{}: its record never moves; it keeps its own control; record a set-point change to judge it"


class MappedSignal(Mapped):
    """Where a signal of the plant comes from. `set_point` is the column of what an output should be, with the
    scale and offset of the output; null: not recorded."""

    set_point: str | None = Field(default=None, min_length=1, max_length=300)


class Ingest(Section):
    """Section `ingest`."""

    mapping: dict[str, MappedSignal]
    time: str = Field(max_length=300)
    decimal: Literal["", ".", ","]
    max_gap_s: float = Field(gt=0, le=86400)
    longest_s: float = Field(ge=1, le=86400)
    largest_mb: int = Field(ge=100, le=1_000_000)
    strict: bool


# figures of control that git keeps and that runs are compared by
METRICS = ("recordings", "samples", "segments", "findings")


def main() -> None:
    with artifacts.stage("ingest") as out:
        from pipeline.recordings import recording_folders
        from pipeline.recordings.isolated import Budget

        settings, machine = params.load(Ingest, "ingest"), params.load(Plant, "plant")
        source = params.value("generate_probing.source", one_of=("simulated", "recordings"))
        check_output_limits(machine, source)
        # what probe_machine wrote has our own names, and lies beside its figures
        folder, mapping, ignored = Path("datasets/probe_machine"), {}, ["figures.json"]
        if source == "recordings":
            folder, mapping, ignored = Path("datasets/raw/temperature"), settings.mapping, []
        wish = recording_wish(settings, machine, mapping)
        results = recording_folders.read_folder(
            folder,
            wish,
            params.load(Execution, "execution"),
            memo=Path("datasets/memo/ingest"),
            budget=Budget(settings.longest_s, settings.largest_mb),
            ignored=ignored,
            waits=source == "recordings",
        )
        strict = settings.strict or "--strict" in sys.argv
        record, quality, figures = recording_folders.join(results, wish, strict=strict)
        done = recording_folders.count_work(results)
        print(f"ingest: {done['processed']} recordings read, {done['reused']} taken from the memo")
        inputs = [signal.name for signal in machine.inputs]
        pids = recording_folders.printer_pids(folder, results, wish.sources, inputs)
        still = still_zones(machine, record, pids.get("heaters", []))
        for output in still:
            quality = recording_folders.with_finding(quality, output, "still", STILL.format(output))
            figures["findings"].setdefault(output, {})["still"] = 1
        kept = without(machine, still)
        schemas = {"record": tables.record(kept.acting, kept.outputs)}
        if wish.set_points is not None:
            schemas["set_points"] = tables.set_points(kept.outputs)
        for name, schema in schemas.items():
            columns = {column.name: record[column.name] for column in schema.columns}
            artifacts.write_table(out / f"{name}.parquet", schema, columns)
        artifacts.write_table(out / "quality.parquet", wish.quality, quality)
        artifacts.write_json(out / "printer_pid.json", pids)
        artifacts.write_metrics("ingest", figures, METRICS)


def still_zones(
    machine: Plant, record: Mapping[str, np.ndarray], heaters: Sequence[Mapping[str, Any]]
) -> dict[str, str]:
    """{output: its heater} of the zones whose record never moves: nothing can be learned of them, and no
    controller designed. A heater is known from the printer's PIDs, or by its name: heater_bed of
    temperature_bed. {} if no other zone would be left."""
    from pipeline.recordings.quality import stands_still

    by_name = {signal.name.partition("_")[2]: signal.name for signal in machine.inputs}
    by_pid = {heater["output"]: heater["input"] for heater in heaters}
    zones = {}
    for output in machine.outputs:
        heater = by_pid.get(output.name) or by_name.get(output.name.partition("_")[2])
        measured = record[output.name][~record[f"{output.name}_masked"]]
        if heater and stands_still(measured, record.get(tables.set_point_of(output.name))):
            zones[output.name] = heater
    enough = len(zones) < len(machine.outputs) and len(set(zones.values())) < len(machine.inputs)
    return zones if enough else {}


def without(machine: Plant, zones: Mapping[str, str]) -> Plant:
    """The machine without these outputs and their heaters."""
    inputs = [signal for signal in machine.inputs if signal.name not in zones.values()]
    outputs = [signal for signal in machine.outputs if signal.name not in zones]
    return machine.model_copy(update={"inputs": inputs, "outputs": outputs})


def recording_wish(settings: Ingest, machine: Plant, mapping: dict[str, MappedSignal]) -> RecordingWish:
    """What to take from every recording of the machine."""
    from pipeline.recordings.recording_folders import RecordingWish

    any_set_point = any(mapped.set_point is not None for mapped in mapping.values())
    return RecordingWish(
        sources(machine, mapping),
        limits={signal.name: (signal.low, signal.high) for signal in machine.inputs},
        held=tuple(signal.name for signal in machine.acting),
        sample_time_s=machine.sample_time_s,
        time=settings.time,
        max_gap_s=settings.max_gap_s,
        decimal=settings.decimal,
        record=tables.record(machine.acting, machine.outputs),
        quality=tables.QUALITY,
        set_points=tables.set_points(machine.outputs) if any_set_point else None,
    )


def sources(machine: Plant, mapping: dict[str, MappedSignal]) -> tuple[Source, ...]:
    """Where a recording has the signals of the machine, and the set-points of its outputs: by `mapping`, else
    under their own names. Raises ValueError for a mapping of no signal, of another unit, or with a
    set-point of what is no output."""
    from pipeline.recordings.formats import Source, nearest_names

    signals = [*machine.acting, *machine.outputs]
    unknown = sorted(set(mapping) - {signal.name for signal in signals})
    if unknown:
        raise ValueError(
            f"params.yaml: ingest.mapping.{unknown[0]} is no signal of the plant; "
            f"{nearest_names(unknown[0], [s.name for s in signals])}"
        )
    for signal in machine.acting:
        if signal.name in mapping and mapping[signal.name].set_point is not None:
            raise ValueError(
                f"params.yaml: ingest.mapping.{signal.name}.set_point is for outputs alone, but "
                f"{signal.name} is none; take it out"
            )
    mapped_sources = []
    for signal in signals:
        mapped = mapping.get(signal.name)
        if mapped is None:
            mapped_sources.append(Source(signal.name, signal.name, signal.unit))
            continue
        if mapped.unit != signal.unit:
            raise ValueError(
                f"params.yaml: ingest.mapping.{signal.name}.unit is {mapped.unit} but the plant's "
                f"{signal.name} is in {signal.unit}; convert with scale and offset, "
                f"and write unit: {signal.unit}"
            )
        source = Source(signal.name, mapped.source, mapped.unit, mapped.scale, mapped.offset)
        mapped_sources.append(source)
        if mapped.set_point is not None:
            set_point = tables.set_point_of(signal.name)
            mapped_sources.append(source._replace(signal=set_point, source=mapped.set_point))
    return tuple(mapped_sources)


if __name__ == "__main__":
    stages.run(main, "ingest", loop="temperature")
