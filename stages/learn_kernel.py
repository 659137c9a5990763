"""Learn controllers from the record alone: reads datasets/ingest/record.parquet; writes datasets/learn_kernel/window.parquet and, where the record determines it,
kernel.parquet: what the data say whatever the weights, so that new weights need no pass over the data."""

import numpy as np
from pydantic import Field

from pipeline import artifacts, params
from pipeline.temperature import identification, window
from pipeline.temperature.judging import kernel_candidates, sufficiency
from pipeline.temperature.scorecard import Yardstick


class LearnKernel(params.Section):
    longest_window: int = Field(ge=1, le=200)
    largest_kernel_window: int = Field(ge=1, le=10)
    offset: bool
    gain_spread: float = Field(ge=0, le=1)
    allowed_gap_percent: float = Field(gt=0, le=100)


def main() -> None:
    with artifacts.stage("learn_kernel") as out:
        p, machine = params.load(LearnKernel, "learn_kernel"), params.load(params.Plant, "plant")
        tracking, panel = params.load(params.Tracking, "tracking"), params.load(params.Panel, "panel")
        yardstick = Yardstick(
            np.full(len(machine.outputs), tracking.yardstick_q), np.full(len(machine.inputs), tracking.yardstick_r), tracking.gamma
        )
        u, y = artifacts.read_record("datasets/ingest/record.parquet", machine.inputs, machine.outputs)
        with artifacts.about("datasets/ingest/record.parquet"):
            identification.check_inputs(u, offset=p.offset, names=[i.name for i in machine.inputs])
            identification.check_outputs(y, names=[o.name for o in machine.outputs])
        scenario = {
            "start": panel.training.starts_degC[0],
            "reference": np.array([o.reference for o in machine.outputs]),
            "steps": panel.steps,
        }
        long = window.learn(u, y, longest=p.longest_window, offset=p.offset, gain_spread=p.gain_spread)
        enough = sufficiency(u, y, long, yardstick, allowed=p.allowed_gap_percent / 100, offset=p.offset, gain_spread=p.gain_spread, **scenario)
        tried = kernel_candidates(u, y, long, yardstick, largest=p.largest_kernel_window, offset=p.offset, **scenario)
        best = min(tried, key=lambda candidate: candidate.gap)
        artifacts.write_arrays(out / "window.parquet", "window", 1, window.stored(long))
        if best.learned is not None:
            artifacts.write_arrays(out / "kernel.parquet", "kernel", 1, best.learned.stored())
        artifacts.write_metrics(
            "learn_kernel",
            {
                "window": long.N, "samples": long.samples, "half_record_gap_percent": 100 * enough.half_gap, "samples_needed_for_noise": enough.needed,
                "state": best.state if best.learned else None, "refused": None if best.learned else best.refusal,
                "rank": best.learned.rank if best.learned else None, "identifiable": best.learned.unknowns if best.learned else None,
                "samples_needed": best.learned.samples_needed if best.learned else None, "condition": best.learned.condition if best.learned else None,
                "candidates": {c.state: {"gap_on_window_model_percent": 100 * c.gap if np.isfinite(c.gap) else None, "refusal": c.refusal or None} for c in tried},
            },
        )  # fmt: skip


if __name__ == "__main__":
    main()
