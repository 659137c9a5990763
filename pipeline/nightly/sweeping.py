"""`./run beadline sweep`: DVC experiments over a grid of parameters and seeds, one after the other beside the
working tree, with a table and a picture. What can be refused is refused before the first of them runs."""

import difflib
import itertools
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from pipeline.nightly.processes import STATE, dvc, git
from pipeline.report.runs import sweep as swept
from pipeline.report.runs.figures import at
from pipeline.report.runs.sweep import Point, Sweep
from pipeline.report.shared import page
from pipeline.store import artifacts, params

WIRING = Path("dvc.yaml")


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
    each; reports/sweep.csv and reports/sweep.html hold all that ran so far. Raises ValueError before the
    first one where target or metric is none, and at the end where experiments failed."""
    points = grid(settings)
    check(target, metric)
    head, done = git("rev-parse", "HEAD"), []
    for k, chosen in enumerate(points, 1):
        shown = ", ".join(f"{part}={value}" for part, value in chosen.items())
        print(f"sweep: {k} of {len(points)}: {shown}", flush=True)
        done.append(_point(chosen, target, metric, head))
        made = Sweep(metric, tuple(points[0]), tuple(done))
        _write(made)
        swept.remember(made)
    files = (
        "reports/sweep.csv, reports/sweep.html; ./run beadline runs sets them beside other runs; "
        "to take one: dvc exp apply NAME"
    )
    failed = [point for point in done if point.why]
    if failed:
        print(f"{_table(made)}\n{files}")
        raise ValueError(
            f"sweep: {len(failed)} of {len(done)} experiments failed, the others are in reports/sweep.html; "
            f"the first, {failed[0].name}: {failed[0].why}"
        )
    return f"{_table(made)}\n{files}"


# ---- before the first experiment


def check(target: str, metric: str) -> None:
    """Raises ValueError where `target` is no stage, where `metric` is none of its own or of a stage that runs
    before it, and where the metrics as they lie there have no such key."""
    stage, _, key = metric.partition(":")
    if not key:
        raise ValueError(
            "sweep: expected a metric as STAGE:dotted.key, such as "
            f"tune_weights:contestants.subspace_lqg.cost, found {metric}"
        )
    stages = _stages()
    for name, what in ((target, "--target"), (stage, "--metric")):
        if name not in stages:
            raise ValueError(f"sweep: {what} {name}: expected a stage of {WIRING}{_near(name, stages)}")
    if stage not in _before(target, stages):
        raise ValueError(
            f"sweep: --target {target} runs without {stage}, so that {metric} would be the same in every "
            f"experiment; write --target {stage}"
        )
    path = Path(f"reports/metrics/{stage}.json")
    if not path.exists():
        raise ValueError(
            f"sweep: {path}: expected the figures of a run, by which --metric {metric} is checked, "
            f"found none; run ./run dvc repro {stage} first"
        )
    metrics = artifacts.read_json(path)
    if not any(place == key for place in _places(metrics)):
        raise ValueError(f"sweep: {path} has no figure {key}{_near(key, list(_places(metrics)))}")


def _near(name: str, names: Sequence[str] | Mapping[str, Any]) -> str:
    """The names most like one that is not there."""
    close = difflib.get_close_matches(name, list(names), n=3, cutoff=0.4) or list(names)[:3]
    return f"; did you mean {' or '.join(close)}?" if close else "; there is none"


def _places(data: Any, place: str = "") -> Iterator[str]:
    """The dotted keys of all numbers, and of nulls: a figure may be missing in one run."""
    if isinstance(data, Mapping):
        for key, value in data.items():
            yield from _places(value, f"{place}.{key}" if place else str(key))
    elif place and (data is None or isinstance(data, int | float)) and not isinstance(data, bool):
        yield place


def _stages() -> Mapping[str, Mapping[str, set[str]]]:
    """{stage: the paths that it reads and makes} of dvc.yaml."""
    try:
        entries = yaml.safe_load(WIRING.read_text(encoding="utf-8"))["stages"]
        kinds = {"reads": ("deps",), "makes": ("outs", "metrics", "plots")}
        return {
            name: {
                kind: {
                    next(iter(path)) if isinstance(path, dict) else str(path)
                    for part in parts
                    for path in entry.get(part) or ()
                }
                for kind, parts in kinds.items()
            }
            for name, entry in entries.items()
        }
    except FileNotFoundError:
        raise ValueError(f"{WIRING} is missing; run this in the root of the project") from None
    except (yaml.YAMLError, KeyError, TypeError, AttributeError, UnicodeDecodeError) as error:
        why = " ".join(str(error).split())
        raise ValueError(f"{WIRING}: expected stages with deps and outs ({why}); restore the file") from None


def _before(target: str, stages: Mapping[str, Mapping[str, set[str]]]) -> set[str]:
    """The stages that run for `target`, itself among them."""
    found, waiting = set(), [target]
    while waiting:
        name = waiting.pop()
        found.add(name)
        reads = stages[name]["reads"]
        waiting += [
            other
            for other, paths in stages.items()
            if other not in found and any(_touch(read, made) for read in reads for made in paths["makes"])
        ]
    return found


def _touch(one: str, other: str) -> bool:
    """Whether a path is another, or lies below it."""
    return one == other or one.startswith(f"{other}/") or other.startswith(f"{one}/")


# ---- the experiments


def _point(chosen: dict[str, str], target: str, metric: str, head: str) -> Point:
    """Runs one point of the grid. One that fails is told, and the others go on."""
    values, name = tuple(chosen.values()), _name(chosen)
    stage, _, key = metric.partition(":")
    try:
        _experiment(chosen, target, name)
        return Point(name, values, _figure(f"{head[:2]}/{head[2:]}/{name}", stage, key))
    except ValueError as error:
        why = " ".join(str(error).split())
        print(f"sweep: {name}: {why}", flush=True)
        return Point(name, values, math.nan, why)


def _name(chosen: Mapping[str, str]) -> str:
    """The name of an experiment. The whole keys: seed alone would be that of any stage."""
    words = [f"{part}-{value}" for part, value in chosen.items()]
    return "sweep-" + "-".join(words).replace(".", "_").lower()


def _experiment(chosen: Mapping[str, str], target: str, name: str) -> None:
    """Runs one point of the grid up to stage `target`."""
    words = [
        word
        for part, value in chosen.items()
        for word in ("--set-param", f"{params.home(part)}:{part}={value}")
    ]
    log = STATE / "logs" / f"{name}.log"
    dvc("exp", "run", "--temp", "--force", "--name", name, *words, target, log=log)


def _figure(experiment: str, stage: str, key: str) -> float:
    """The number at a dotted key of a stage's metrics, as the experiment wrote them."""
    metrics = json.loads(git("show", f"refs/exps/{experiment}:reports/metrics/{stage}.json"))
    value = at(metrics, key)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"reports/metrics/{stage}.json of the experiment has no number at {key}")
    return float(value)


# ---- the table and the page


def _table(made: Sweep) -> str:
    import pandas as pd

    return pd.DataFrame(_columns(made)).astype(str).to_string(index=False)


def _columns(made: Sweep) -> dict[str, np.ndarray]:
    keys = {key: np.array([point.values[i] for point in made.points]) for i, key in enumerate(made.keys)}
    names = {"experiment": np.array([point.name for point in made.points])}
    # a case of the setpoint loop has a comma in its name
    heading = f'"{made.metric}"' if "," in made.metric else made.metric
    return names | keys | {heading: np.array([point.figure for point in made.points])}


def _write(made: Sweep) -> None:
    """reports/sweep.csv and reports/sweep.html of what ran so far."""
    artifacts.write_csv("reports/sweep.csv", _columns(made))
    html = page.render("sweep.html", here="sweep", title="Sweep", **_shown(made))
    artifacts.write_text("reports/sweep.html", html)


def _shown(made: Sweep) -> dict[str, Any]:
    """What the page shows of a sweep."""
    return {
        "swept": made,
        "picture": swept.picture(made),
        "finding": swept.finding(made),
        "caption": swept.caption(made),
    }
