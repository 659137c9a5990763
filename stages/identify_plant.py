"""Record -> plant: reads datasets/ingest/record.parquet; writes datasets/identify_plant/plant.parquet."""

from pydantic import Field

from pipeline import artifacts, params
from pipeline.temperature import identification, plant


class IdentifyPlant(params.Section):
    seed: int = Field(ge=0, le=2**31)
    order: int = Field(ge=0, le=60)
    max_order: int = Field(ge=1, le=60)
    offset: bool
    holdout_share: float = Field(gt=0, lt=0.9)
    spread_plants: int = Field(ge=20, le=1000)


def main() -> None:
    with artifacts.stage("identify_plant") as out:
        p, machine = params.load(IdentifyPlant, "identify_plant"), params.load(params.Plant, "plant")
        u, y = artifacts.read_record("datasets/ingest/record.parquet", machine.inputs, machine.outputs)
        found = identification.identify(
            u, y, sample_time_s=machine.sample_time_s, order=p.order or None, max_order=p.max_order, offset=p.offset
        )
        artifacts.write_arrays(out / "plant.parquet", "plant", 1, plant.stored([found.plant]))
        artifacts.write_arrays(out / "spread.parquet", "spread", 1, plant.stored([found.plant] * 20))
        artifacts.write_metrics(
            "identify_plant",
            {"order": found.order, "past": found.past, "rows": found.rows, "dropped_rows": found.dropped_rows, "notes": found.notes},
        )


if __name__ == "__main__":
    main()
