"""Record -> plant and its spread: reads datasets/ingest/record.parquet; writes
datasets/identify_plant: plant, spread, order, and what the page of the identification shows:
holdout, residuals, steps, dynamics, poles, levels."""

import stages
from pipeline.store import artifacts, params
from pipeline.temperature import plant
from pipeline.temperature.workflow import identify_plant
from pipeline.temperature.workflow.settings import IdentifyPlant, Plant


def main() -> None:
    with artifacts.stage("identify_plant") as out:
        settings, machine = params.load(IdentifyPlant, "identify_plant"), params.load(Plant, "plant")
        identified = identify_plant.identified(settings, machine, "datasets/ingest/record.parquet")
        artifacts.write_arrays(out / "plant.parquet", "plant", 1, plant.stored([identified.plant]))
        artifacts.write_arrays(out / "spread.parquet", "spread", 1, plant.stored(identified.spread))
        for name, (schema, columns) in identified.tables.items():
            artifacts.write_table(out / f"{name}.parquet", schema, columns)
        artifacts.write_metrics("identify_plant", identified.metrics)


if __name__ == "__main__":
    stages.run(main, "identify_plant", loop="temperature")
