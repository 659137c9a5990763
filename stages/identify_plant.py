"""Record -> plant and its spread: reads datasets/ingest/record.parquet; writes datasets/identify_plant: plant, spread, order, and what the page of the identification
shows: holdout, residuals, steps, dynamics, poles, levels.

Order and window are chosen on the first part of every segment; the last part judges; the plant that is handed on is fitted to both with what was chosen."""

from typing import Literal

import numpy as np
from pydantic import Field

from pipeline import artifacts, params, schemas
from pipeline.temperature import identification, order, plant, trust, validation


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
        u, clipped = identification.within_limits(u, tuple(zip(*((i.low, i.high) for i in machine.inputs), strict=True)), names=inputs)
        cuts = [round(len(us) * (1 - p.holdout_share)) for us in u]
        first = [[signal[:cut] for signal, cut in zip(signals, cuts, strict=True)] for signals in (u, y)]
        last = [[signal[cut:] for signal, cut in zip(signals, cuts, strict=True)] for signals in (u, y)]
        with artifacts.about("datasets/ingest/record.parquet"):
            chosen = identification.identify(
                *first, sample_time_s=machine.sample_time_s, order=p.order or None, offset=p.offset, refinement=p.refinement, max_order=p.max_order, names=inputs
            )
        judged = trust.holdout(chosen.plant, *last, p.ahead_steps, block=2 * chosen.past, rng=np.random.default_rng(p.seed))
        tests, excited = validation.residual_tests(chosen.plant, *last, lags=trust.residual_lags(last[0])), validation.excitation(first[0], chosen.past)
        found = identification.refit(u, y, chosen, names=inputs)
        if not (observed := plant.observability(found.plant)).passed:
            raise ValueError("datasets/ingest/record.parquet: " + observed.reason)
        family = validation.bootstrap_spread(u, y, found, count=p.spread_plants, order=found.order + 1, rng=np.random.default_rng(p.seed))
        steps = trust.steps(found.plant, family, max(map(len, u)))
        artifacts.write_arrays(out / "plant.parquet", "plant", 1, plant.stored([found.plant]))
        artifacts.write_arrays(out / "spread.parquet", "spread", 1, plant.stored(family))
        for name, schema, rows in (
            ("order", schemas.ORDER, identification.rows(chosen)),
            ("holdout", schemas.holdout(machine.outputs), trust.holdout_rows(last[1], judged, outputs, machine.sample_time_s)),
            ("residuals", schemas.RESIDUALS, trust.residual_rows(tests, outputs, inputs)),
            ("steps", schemas.STEPS, trust.step_rows(steps, outputs, inputs, machine.sample_time_s)),
            ("dynamics", schemas.DYNAMICS, trust.dynamics_rows(steps, outputs, inputs, machine.sample_time_s)),
            ("poles", schemas.POLES, trust.pole_rows(found.plant, family)),
            ("levels", schemas.LEVELS, trust.level_rows(trust.input_levels(u), inputs)),
        ):
            artifacts.write_table(out / f"{name}.parquet", schema, rows)
        metrics = {
            "order": found.order, "order_tolerance_percent": 100 * order.WORTH_A_STATE, "past": found.past, "fit": found.fit, "rows": found.rows, "dropped_rows": found.dropped_rows,
            "samples": sum(map(len, recorded[0])), "samples_cut": sum(map(len, recorded[0])) - sum(map(len, u)), "samples_holdout": sum(map(len, last[0])),
            "delays": dict(zip(inputs, found.delays, strict=True)), "notes": list(dict.fromkeys([*clipped, *chosen.notes, *found.notes])), "ahead_steps": p.ahead_steps,
            **trust.fit_figures(judged, outputs), **trust.outcome_figures(tests, excited, outputs, inputs),
            "controllable": plant.controllability(found.plant).passed, "largest_pole": np.abs(np.linalg.eigvals(found.plant.A)).max(),
            "advice": validation.advice(tests, excited, judged.fit[0], outputs=outputs, inputs=inputs),
        }  # fmt: skip
        artifacts.write_metrics("identify_plant", metrics)


if __name__ == "__main__":
    main()
