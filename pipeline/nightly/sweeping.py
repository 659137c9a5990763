"""`./run beadline sweep`: DVC experiments over a grid of parameters and seeds, one after the other beside the
working tree, with a table and a picture."""

import itertools
import json
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from pipeline.nightly.processes import STATE, dvc, git
from pipeline.report.shared import charts, page
from pipeline.store import artifacts, params


def grid(settings: Sequence[str]) -> list[dict[str, str]]:
    """Every combination of `key=a,b,c` or `file:key=a,b,c`. Raises ValueError where a key stands in no file
    of parameters or in another, or has no values."""
    axes = {}
    for text in settings:
        key, _, values = text.partition("=")
        file, _, dotted = key.rpartition(":")
        home = params.home(dotted)
        if not home or file not in ("", home) or not values:
            raise ValueError(
                f"sweep: expected KEY=VALUE,VALUE with a key of {' or '.join(params.files())}, found {text}; "
                "write for example tune_weights.seed=1,2,3"
            )
        axes[dotted] = values.split(",")
    return [dict(zip(axes, chosen, strict=True)) for chosen in itertools.product(*axes.values())]


def sweep(settings: Sequence[str], target: str, metric: str) -> str:
    """Runs each experiment up to stage `target`, and tells `metric` (STAGE:dotted.key of reports/metrics) of
    each; reports/sweep.csv and reports/sweep.html hold them all."""
    stage, _, key = metric.partition(":")
    if not key:
        raise ValueError(
            "sweep: expected a metric as STAGE:dotted.key, such as "
            f"tune_weights:contestants.subspace_lqg.cost, found {metric}"
        )
    import pandas as pd

    points, rows = grid(settings), []
    head = git("rev-parse", "HEAD")
    for k, point in enumerate(points, 1):
        shown = ", ".join(f"{part}={value}" for part, value in point.items())
        print(f"sweep: {k} of {len(points)}: {shown}", flush=True)
        name = _experiment(point, target)
        rows.append(
            {"experiment": name, **point, metric: _figure(f"{head[:2]}/{head[2:]}/{name}", stage, key)}
        )
    table = pd.DataFrame(rows)
    artifacts.write_csv("reports/sweep.csv", {str(name): column.to_numpy() for name, column in table.items()})
    picture = _picture(table[metric].to_numpy(), metric)
    html = page.render("sweep.html", here="sweep", title="Sweep", table=table, metric=metric, picture=picture)
    artifacts.write_text("reports/sweep.html", html)
    files = "reports/sweep.csv, reports/sweep.html; to take one: dvc exp apply NAME"
    return f"{table.astype(str).to_string(index=False)}\n{files}"


def _experiment(point: dict[str, str], target: str) -> str:
    """Runs one point of the grid up to stage `target`; the experiment's name."""
    # the whole key: seed alone would be that of any stage
    words = [f"{part}-{value}" for part, value in point.items()]
    name = "sweep-" + "-".join(words).replace(".", "_").lower()
    chosen = [
        word
        for part, value in point.items()
        for word in ("--set-param", f"{params.home(part)}:{part}={value}")
    ]
    log = STATE / "logs" / f"{name}.log"
    dvc("exp", "run", "--temp", "--force", "--name", name, *chosen, target, log=log)
    return name


def _figure(experiment: str, stage: str, key: str) -> float:
    """The number at a dotted key of a stage's metrics, as the experiment wrote them."""
    value: Any = json.loads(git("show", f"refs/exps/{experiment}:reports/metrics/{stage}.json"))
    for part in key.split("."):
        value = value.get(part) if isinstance(value, dict) else None
    if not isinstance(value, int | float):
        raise ValueError(
            f"sweep: reports/metrics/{stage}.json has no number at {key}; look at the file for its keys"
        )
    return float(value)


def _picture(values: np.ndarray, metric: str) -> Markup:
    """The metric over the experiments in their order."""
    margin = 0.1 * (np.ptp(values) or max(abs(values[0]), 1.0))
    ticks = tuple((float(k), str(k)) for k in range(1, len(values) + 1, max(1, math.ceil(len(values) / 12))))
    frame = charts.Frame(
        charts.Axis(0.5, len(values) + 0.5, ticks),
        charts.linear(values.min() - margin, values.max() + margin),
        760,
        220,
        60,
        18,
        20,
        12,
    )
    best = int(values.argmin()) + 1
    return charts.panel(
        frame,
        [charts.dots(frame, np.arange(1, len(values) + 1), values, radius=4)],
        alt=f"{metric}: lowest in experiment {best}, {values.min():.4g}",
        title=metric,
    )
