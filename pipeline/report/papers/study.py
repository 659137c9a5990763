"""The machine of Zavrakli 2023, simulated: what noise costs its learners."""

from collections.abc import Mapping
from typing import Any

import pandas as pd


def ranking(table: Mapping[str, Any]) -> list[tuple[float, float, float]]:
    """(noise in °C, kernel on the raw window, kernel on the predicted state): median gaps to the optimum over
    the data sets, as multiples of that of window and Riccati equation. `table`: {column: values}."""
    medians = pd.DataFrame(table).astype({"gap": float}).groupby(["noise_degC", "route"])["gap"].median()
    routes = medians.unstack("route")
    ratios = routes.div(routes["window"], axis=0)
    return list(ratios[["kernel", "kernel_predicted_state"]].itertuples(name=None))
