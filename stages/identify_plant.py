"""Record -> plant and its spread: reads datasets/ingest/record.parquet; writes datasets/identify_plant: plant.parquet, spread.parquet, order.parquet, holdout.parquet.

Order and window are chosen on the first part of every segment; the last part judges; the plant that is handed on is fitted to both with what was chosen."""

from typing import Literal

import numpy as np
from pydantic import Field

from pipeline import artifacts, params, schemas
from pipeline.temperature import identification, plant, validation


class IdentifyPlant(params.Section):
    seed: int = Field(ge=0, le=2**31)
    order: int = Field(ge=0, le=60)
    max_order: int = Field(ge=1, le=60)
    offset: bool
    refinement: Literal["none", "prediction", "simulation", "validated"]
    holdout_share: float = Field(gt=0, lt=0.9)
    ahead_steps: int = Field(ge=1, le=10_000)
    spread_plants: int = Field(ge=20, le=1000)


def main() -> None:
    with artifacts.stage("identify_plant") as out:
        p, machine = params.load(IdentifyPlant, "identify_plant"), params.load(params.Plant, "plant")
        inputs, outputs = [i.name for i in machine.inputs], [o.name for o in machine.outputs]
        recorded = artifacts.read_record("datasets/ingest/record.parquet", machine.inputs, machine.outputs)
        u, y = identification.gapless(*recorded)
        with artifacts.about("datasets/ingest/record.parquet"):
            identification.check_inputs(u, offset=p.offset, names=inputs)
            identification.check_outputs(y, names=outputs)
        cuts = [round(len(us) * (1 - p.holdout_share)) for us in u]
        first = [[signal[:cut] for signal, cut in zip(signals, cuts, strict=True)] for signals in (u, y)]
        last = [[signal[cut:] for signal, cut in zip(signals, cuts, strict=True)] for signals in (u, y)]
        settings = {"sample_time_s": machine.sample_time_s, "offset": p.offset, "refinement": p.refinement, "max_order": p.max_order}
        with artifacts.about("datasets/ingest/record.parquet"):
            chosen = identification.identify(*first, order=p.order or None, **settings)
        fit, ahead = validation.simulate_fit(chosen.plant, *last), validation.predict_fit(chosen.plant, *last, p.ahead_steps)
        tests, excited = validation.residual_tests(chosen.plant, *last), validation.excitation(first[0], chosen.past)
        advice = validation.advice(tests, excited, fit, outputs=outputs, inputs=inputs)
        found = identification.identify(u, y, order=chosen.order, past=chosen.past, **settings)
        if not (observed := plant.observability(found.plant)).passed:
            raise ValueError("datasets/ingest/record.parquet: " + observed.reason)
        family = validation.bootstrap_spread(u, y, found, count=p.spread_plants, order=found.order + 1, rng=np.random.default_rng(p.seed))
        simulated = [validation.simulated(chosen.plant, us, ys) for us, ys in zip(*last, strict=True)]
        artifacts.write_arrays(out / "plant.parquet", "plant", 1, plant.stored([found.plant]))
        artifacts.write_arrays(out / "spread.parquet", "spread", 1, plant.stored(family))
        artifacts.write_table(out / "order.parquet", schemas.ORDER, identification.rows(chosen))
        artifacts.write_table(out / "holdout.parquet", schemas.holdout(machine.outputs), validation.rows(last[1], simulated, outputs, machine.sample_time_s))
        metrics = {
            "order": found.order, "past": found.past, "fit": found.fit, "rows": found.rows, "dropped_rows": found.dropped_rows,
            "samples_cut": sum(map(len, recorded[0])) - sum(map(len, u)), "notes": [*chosen.notes, *found.notes],
            "fit_holdout": dict(zip(outputs, fit, strict=True)), "fit_holdout_ahead": dict(zip(outputs, ahead, strict=True)), "ahead_steps": p.ahead_steps,
            "whiteness_passed": dict(zip(outputs, tests.whiteness_passed, strict=True)), "excitation": {"rank": excited.rank, "full": excited.full, "condition": excited.condition},
            "controllable": plant.controllability(found.plant).passed, "largest_pole": np.abs(np.linalg.eigvals(found.plant.A)).max(), "advice": advice,
        }  # fmt: skip
        artifacts.write_metrics("identify_plant", metrics)


if __name__ == "__main__":
    main()
