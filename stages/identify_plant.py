"""Record -> plant and its spread: reads datasets/ingest/record.parquet; writes
datasets/identify_plant: plant, spread, order, and what the page of the identification shows:
holdout, residuals, steps, dynamics, poles, levels."""

from pipeline.store import artifacts, params
from pipeline.temperature import plant
from pipeline.temperature.workflow import identify_plant
from pipeline.temperature.workflow.settings import IdentifyPlant, Plant


def main() -> None:
    with artifacts.stage("identify_plant") as out:
        p, machine = params.load(IdentifyPlant, "identify_plant"), params.load(Plant, "plant")
        found = identify_plant.identified(p, machine, "datasets/ingest/record.parquet")
        artifacts.write_arrays(out / "plant.parquet", "plant", 1, plant.stored([found.plant]))
        artifacts.write_arrays(out / "spread.parquet", "spread", 1, plant.stored(found.spread))
        for name, (schema, columns) in found.tables.items():
            artifacts.write_table(out / f"{name}.parquet", schema, columns)
        artifacts.write_metrics("identify_plant", found.metrics)


if __name__ == "__main__":
    main()
